"""What runs on a worker: the slots that it declares, and those that a task lends."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from .scheduler import SUBMITTER, Resources, SubmittingTask


def has_running_tasks(dask_worker: Any = None) -> bool:
    """Return whether a worker runs a task, even if its scheduler has forgotten the task."""
    return bool(dask_worker.state.all_running_tasks)


def running_keys(worker: Any) -> list[Any]:
    """Return the keys of the tasks that a worker runs, cancelled tasks included."""
    return [task.key for task in worker.state.all_running_tasks]


# -- what a worker declares --------------------------------------------------------------


class _Available(dict[str, float]):
    """Available slots by resource: 0, rather than an error, for an undeclared resource.

    The request to declare and tasks use different connections: a cancelled task may still be on
    its way, and a worker would break down if it got a task for an unknown resource.
    """

    def __missing__(self, name: str) -> float:
        return 0.0


def declare_on_worker(resources: Resources, dask_worker: Any = None) -> bool:
    """Declare exactly these resources.

    Runs on a worker.

    Returns False if tasks still hold a resource that is removed. Such a task may be cancelled but
    still running, and unknown to the scheduler.
    """
    state = dask_worker.state
    total = state.total_resources
    available = state.available_resources
    # Not what is available: a task may have lent its slots, and takes them back.
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
    """Return the resources that a running task takes from its worker."""
    return {name: slots for name, slots in (task.resource_restrictions or {}).items() if slots}


def declared_resources(worker: Any) -> tuple[str, ...]:
    """Names of the resources that a worker has.

    Runs on the worker.
    """
    return tuple(sorted(name for name, slots in worker.state.total_resources.items() if slots))


# -- slots that a task lends while it waits -------------------------------------------------
#
# What Dask does when a task secedes and rejoins, also several times: the worker counts it as
# long-running from the first time to its end, so that a task in its place may start but have to
# wait for a thread; its resources stay taken throughout.


def current_task() -> tuple[Any, Any] | None:
    """Return the worker and the state of the task of this thread, or None outside tasks."""
    from distributed.worker import thread_state

    if (key := getattr(thread_state, "key", None)) is None:
        return None
    worker = thread_state.execution_state["worker"]
    task = worker.state.tasks.get(key)  # a call of an actor's method is not a task
    return None if task is None else (worker, task)


def submitter_of(worker: Any, key: Any) -> SubmittingTask | None:
    """Return the task that has submitted a task of this worker from inside a partition."""
    task = worker.state.tasks.get(key)
    submitter = (task.annotations or {}).get(SUBMITTER) if task is not None else None
    return None if submitter is None else SubmittingTask(*submitter)


def threads_of(worker: Any) -> int:
    """Return the number of threads that a worker has for tasks."""
    return int(worker.state.nthreads)


def is_running(worker: Any, key: Any) -> bool:
    """Return whether a worker runs a task, even if the task has seceded."""
    return any(task.key == key for task in worker.state.all_running_tasks)


def release_slots(worker: Any, slots: Resources) -> None:
    """Give slots of a worker to its waiting tasks, in its event loop."""
    from distributed.worker_state_machine import UnpauseEvent

    for name, number in slots.items():
        worker.state.available_resources[name] += number
    if worker.state.running:  # or it is paused, and starts them when it goes on
        worker.handle_stimulus(UnpauseEvent(stimulus_id=f"poolpart-lent-{time.time()}"))


def reserve_slots(worker: Any, slots: Resources) -> None:
    """Keep these slots from waiting tasks, even if there are fewer now, in its event loop."""
    for name, number in slots.items():
        worker.state.available_resources[name] -= number


def count_slots(worker: Any, name: str) -> tuple[float, float]:
    """Return the available slots of a worker, below 0 if reserved, and all its slots."""
    return worker.state.available_resources[name], worker.state.total_resources[name]


def add_handler(worker: Any, question: str, answer: Callable[..., Any]) -> None:
    """Add a handler to a worker that lacks the handler."""
    worker.handlers.setdefault(question, answer)


# -- inputs ------------------------------------------------------------------------------


async def why_unreadable(key: Any, holder: str, dask_worker: Any = None) -> str:
    """Return why a worker cannot unpickle a result that another worker holds, or "" if it can.

    Raises OSError if the holder does not answer.
    """
    from distributed.core import connect, send_recv

    # Not a connection of the worker's pool. If a result cannot be unpickled, Dask returns the
    # connection to its pool in the middle of an exchange, so that the next request on it fails.
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
        await connection.write("OK")  # the holder waits for it
    finally:
        connection.abort()
    return reason
