"""Access a worker's resources, slots, and inputs through private API."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from .scheduler import SUBMITTER, Resources, SubmittingTask


def has_running_tasks(dask_worker: Any = None) -> bool:
    """Return whether a worker runs any task, including tasks unknown to its scheduler."""
    return bool(dask_worker.state.all_running_tasks)


def running_times(worker: Any) -> dict[Any, float]:
    """Return for how many seconds a worker has run each of its tasks, including canceled tasks."""
    now = time.time()
    return {task.key: now - (task.start_time or now) for task in worker.state.all_running_tasks}


# -- declared resources ------------------------------------------------------------------


class _Available(dict[str, float]):
    """Available slots by resource, with 0 for undeclared resources.

    The request to declare resources and the tasks use different connections. Therefore, a canceled
    task may arrive late, and the worker would fail if its resource were unknown.
    """

    def __missing__(self, name: str) -> float:
        return 0.0


def declare_on_worker(resources: Resources, dask_worker: Any = None) -> bool:
    """Declare exactly the given resources, and return whether this was possible.

    The result is False if a running task still holds a resource to be removed. The task may be
    canceled and unknown to the scheduler. Runs on a worker.
    """
    state = dask_worker.state
    total = state.total_resources
    available = state.available_resources
    # The available resources are not used here, because tasks that have lent slots will need them.
    held = {name for task in state.all_running_tasks for name in resources_of(task)}
    if held & (total.keys() - resources.keys()):
        return False
    held_slots = {name: total.get(name, 0) - available.get(name, 0) for name in resources}
    state.available_resources = _Available(
        {name: slots - held_slots[name] for name, slots in resources.items()}
    )
    state.total_resources = dict(resources)
    return True


def resources_of(task: Any) -> Resources:
    """Return the worker resources that a running task occupies."""
    return {name: slots for name, slots in (task.resource_restrictions or {}).items() if slots}


def declared_resources(worker: Any) -> tuple[str, ...]:
    """Return the sorted names of the resources that a worker declares. Runs on the worker."""
    return tuple(sorted(name for name, slots in worker.state.total_resources.items() if slots))


# -- lending of slots -----------------------------------------------------------------------
#
# After a task has seceded once, Dask counts it as long-running until it ends, even if it rejoins.
# Therefore, another task may start in its place and wait for a thread. The resources of a seceded
# task remain in use.


def current_task() -> tuple[Any, Any] | None:
    """Return the worker and the state of this thread's task, or None outside tasks."""
    from distributed.worker import thread_state

    if (key := getattr(thread_state, "key", None)) is None:
        return None
    worker = thread_state.execution_state["worker"]
    task = worker.state.tasks.get(key)  # None for a method call of an actor
    return None if task is None else (worker, task)


def start_time_of_task() -> float:
    """Return when this run of this thread's task started, or 0 outside tasks.

    If Dask runs a task again, the new run has the same key and a different start time.
    """
    from distributed.worker import thread_state

    return 0.0 if current_task() is None else float(getattr(thread_state, "start_time", 0.0))


def submitter_of(worker: Any, key: Any) -> SubmittingTask | None:
    """Return the task that submitted a nested task on this worker, or None if it is unknown."""
    task = worker.state.tasks.get(key)
    submitter = (task.annotations or {}).get(SUBMITTER) if task is not None else None
    return None if submitter is None else SubmittingTask(*submitter)


def threads_of(worker: Any) -> int:
    """Return the number of threads in which a worker runs tasks."""
    return int(worker.state.nthreads)


def is_running(worker: Any, key: Any) -> bool:
    """Return whether a worker is running a task, which may have seceded."""
    return any(task.key == key for task in worker.state.all_running_tasks)


def seceded_tasks(worker: Any) -> list[Any]:
    """Return the tasks whose threads have left the worker's thread pool and not rejoined it.

    Dask counts a task that has rejoined as long-running, so only its thread shows the difference.
    """
    pool = {thread.ident for thread in getattr(worker.executor, "_threads", set()).copy()}
    with worker.active_threads_lock:
        keys = [key for thread, key in worker.active_threads.items() if thread not in pool]
    tasks = (worker.state.tasks.get(key) for key in keys)
    return [task for task in tasks if task in worker.state.long_running]


def set_resources_to_release(task: Any, resources: Resources) -> None:
    """Set the resources that a running task occupies, and that Dask releases when it ends."""
    task.resource_restrictions = resources  # not changed in place, because others may share it


def release_slots(worker: Any, slots: Resources) -> None:
    """Make slots available to a worker's waiting tasks. Runs in the worker's event loop."""
    from distributed.worker_state_machine import UnpauseEvent

    for name, number in slots.items():
        worker.state.available_resources[name] += number
    if worker.state.running:  # a paused worker starts the tasks when it resumes
        worker.handle_stimulus(UnpauseEvent(stimulus_id=f"poolpart-lent-{time.time()}"))


def reserve_slots(worker: Any, slots: Resources) -> None:
    """Reserve slots, even if fewer are available. Runs in the worker's event loop."""
    for name, number in slots.items():
        worker.state.available_resources[name] -= number


def count_slots(worker: Any, name: str) -> tuple[float, float]:
    """Return a worker's available slots, which may be negative, and its total slots."""
    return worker.state.available_resources[name], worker.state.total_resources[name]


def add_handler(worker: Any, name: str, handler: Callable[..., Any]) -> None:
    """Add a request handler to a worker, unless it already has one with this name."""
    worker.handlers.setdefault(name, handler)


# -- inputs ------------------------------------------------------------------------------


async def why_unreadable(key: Any, holder: str, dask_worker: Any = None) -> str:
    """Return why a worker cannot unpickle another worker's result, or "" if it can.

    Raises
    ------
    OSError
        If the worker that holds the result does not respond.
    """
    from distributed.core import connect, send_recv

    # A new connection is used instead of the worker's connection pool. If a result cannot be
    # unpickled, Dask returns the connection to the pool in the middle of an exchange, and the next
    # request on it fails.
    connection = await connect(holder, **dask_worker.connection_args)
    try:
        await send_recv(connection, op="get_data", keys=[key], who=dask_worker.address)
    except OSError:
        raise
    except Exception as error:
        reason = repr(error)
    else:
        reason = ""
    try:
        await connection.write("OK")  # the holder waits for this message
    finally:
        connection.abort()
    return reason
