"""Cancel tasks, including tasks that are already running.

Dask does not stop a running function. Its thread continues and keeps the task's slot. The function
can check `cancelled`, or the worker process can be restarted if nothing else would be lost
(`free_worker`): the scheduler stops assigning tasks to the worker, moves waiting tasks and results
to other workers, and asks the worker which tasks it runs. A worker that does not respond cannot
hand anything over, so its waiting tasks are assigned again.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Collection, Coroutine, Mapping, Set
from typing import Any, NamedTuple, TypeVar

from distributed import Client, Future, Status

from ..errors import PoolError
from ..fetch import holds_bytes
from ..internals.scheduler import (
    call_worker,
    cancel_keys,
    copy_results,
    hand_off_tasks,
    is_bound,
    only_copies,
    requires_any,
    reschedule_tasks,
    restart_worker,
    resume_assigning,
    running_candidates,
    stop_assigning,
)
from ..internals.worker import current_task, running_times
from ..pipe_states import fail_pipes_of_killed_task
from ..workers import run_on_scheduler

T = TypeVar("T")
Outcomes = dict[Any, str]  # {task key: outcome}

ARRIVAL_S = 1.0  # time for submitted tasks to arrive, which use another connection
ANSWER_S = 5.0  # time for a worker to respond, which a function that holds the GIL can delay
MOVE_S = 1.0  # time for a worker to hand its waiting tasks over
COPY_S = 10.0  # time to copy the results of a worker to other workers
RESTART_S = 60.0  # time for a restarted worker to rejoin
_CHECK_S = 0.5  # interval between requests to a worker whose tasks are awaited


def cancelled() -> bool:
    """Return whether the calling task was canceled.

    Dask does not stop running functions, so a canceled function keeps its slot until it returns. In
    a long-running function, call `cancelled` regularly from the task's own thread, and return early
    when it returns True. Outside of tasks, it always returns False.

    Examples
    --------
    >>> def search(start):                                               # doctest: +SKIP
    ...     while not cancelled():
    ...         start = improve(start)
    """
    running = current_task()
    return running is not None and running[1].state == "cancelled"


def cancel_tasks(
    tasks: Mapping[Any, Future], client: Client, name: str, restarts: bool, recompute: bool
) -> Outcomes:
    """Cancel tasks of a partition on the scheduler, and return the outcome for each key.

    Tasks that had not started or had already finished are omitted from the result. If `restarts` is
    true, workers that only run these tasks are restarted. If `recompute` is true, they may also run
    other tasks, and have results that cannot be copied, all of which are computed again.

    Raises
    ------
    PoolError
        If a task belongs to another partition.
    """
    outcomes, complaint = run_on_scheduler(
        client,
        _cancel_tasks,
        keys=list(tasks),
        pending_keys=[key for key, task in tasks.items() if task.status == "pending"],
        name=name,
        client_id=client.id,
        restarts=restarts,
        recompute=recompute,
    )
    if complaint:
        raise PoolError(complaint)
    return dict(outcomes)


async def _cancel_tasks(
    keys: Collection[Any],
    pending_keys: Collection[Any],
    name: str,
    client_id: str,
    restarts: bool,
    recompute: bool,
    dask_scheduler: Any = None,
) -> tuple[Outcomes, str]:
    """Cancel tasks, and return their outcomes. If this is not possible, return an error message."""
    scheduler = dask_scheduler
    deadline = time.monotonic() + ARRIVAL_S
    while not scheduler.tasks.keys() >= {*pending_keys} and time.monotonic() < deadline:
        await asyncio.sleep(0.01)
    known = {key: scheduler.tasks[key] for key in keys if key in scheduler.tasks}
    for key, task in known.items():
        if not requires_any(task, [name]):
            return {}, f"Task {key!r} does not belong to partition {name!r}. No task was canceled."
    annotations = {key: task.annotations for key, task in known.items()}
    members = [worker for worker in scheduler.workers.values() if worker.resources.get(name)]
    candidates = {worker: {task.key for task in running_candidates(worker)} for worker in members}
    cancel_keys(scheduler, keys, client_id)
    kept = [key for key in known if key in scheduler.tasks]
    outcomes: Outcomes = dict.fromkeys(kept, "kept: another client needs its result")
    loads = await asyncio.gather(*(request_load(scheduler, worker) for worker in members))

    async def end(worker: Any, load: Load | None) -> None:
        # A canceled task may prevent its worker from responding.
        running = candidates[worker] if load is None else load.running
        found = [key for key in running if key in keys and key not in kept]
        if not found:
            return
        outcome = f"running: worker {worker.name}{' does not respond' if load is None else ''}"
        if restarts:
            ended, others = {*found}, candidates[worker]
            outcome = await free_worker(scheduler, worker, name, ended, others, recompute=recompute)
        outcomes.update(dict.fromkeys(found, outcome))
        if outcome.startswith("restarted"):
            for key in found:
                fail_pipes_of_killed_task(scheduler, key, annotations.get(key))

    await asyncio.gather(*map(end, members, loads))
    return outcomes, ""


async def free_worker(
    scheduler: Any,
    worker: Any,
    name: str,
    ended: Set[Any],
    candidates: Set[Any],
    *,
    recompute: bool = False,
    recompute_if_silent: bool = False,
    patience_s: float = 0.0,
) -> str:
    """Restart a worker to free the slots of tasks that do not end, and return the outcome.

    The worker is not restarted if it runs other tasks, or if data would be lost. Its waiting tasks
    run on other workers in any case.

    Parameters
    ----------
    scheduler, worker
        Their states.
    name
        Partition of the worker.
    ended
        Keys of the tasks, which have already ended for the scheduler. The set may grow during the
        call.
    candidates
        Keys of all tasks that the worker may have been running, if it does not respond.
    recompute
        Whether other running tasks and results that cannot be copied may be computed again.
    recompute_if_silent
        The same, but only if the worker does not respond.
    patience_s
        Time in seconds to wait until other running tasks have finished.
    """
    running = f"running: worker {worker.name}"
    if worker.status not in (Status.running, Status.paused):
        return f"{running} is {worker.status.name}"
    was_running = worker.status is Status.running  # a paused worker gets no tasks anyway
    if was_running:
        stop_assigning(scheduler, worker)
    try:
        load = await _hand_over(scheduler, worker, name, candidates)
        deadline = time.monotonic() + patience_s
        while load is not None and ended < load.running.keys() and time.monotonic() < deadline:
            await asyncio.sleep(_CHECK_S)
            load = await request_load(scheduler, worker)
        if load is not None and ended.isdisjoint(load.running):
            _resume(scheduler, worker, was_running)
            return "ended"
        recompute = recompute or (recompute_if_silent and load is None)
        obstacle = await _obstacle(scheduler, worker, name, load, ended, candidates, recompute)
    except Exception:
        _resume(scheduler, worker, was_running)
        raise
    if obstacle:
        if load is None and was_running:
            _start(_resume_when_responding(scheduler, worker))
        else:
            _resume(scheduler, worker, was_running)
        return running + obstacle
    # Dask would count the death of the worker against these tasks.
    reschedule_tasks(scheduler, list(worker.processing))
    if await _await_for(restart_worker(scheduler, worker, RESTART_S), RESTART_S + ANSWER_S):
        return f"restarted: worker {worker.name}"
    return f"restarted: worker {worker.name}, which has not rejoined after {RESTART_S:g} s"


def _resume(scheduler: Any, worker: Any, was_running: bool) -> None:
    """Assign tasks to a worker again, unless it was paused before."""
    if was_running:
        resume_assigning(scheduler, worker)


async def await_end(scheduler: Any, worker: Any, key: Any, seconds: float) -> bool:
    """Wait until a worker no longer runs a task, and return whether this was within the time."""
    deadline = time.monotonic() + seconds
    while scheduler.workers.get(worker.address) is worker:
        load = await request_load(scheduler, worker)
        if load is not None and key not in load.running:
            return True
        if time.monotonic() > deadline:
            return False
        await asyncio.sleep(_CHECK_S)
    return True


async def _hand_over(scheduler: Any, worker: Any, name: str, candidates: Set[Any]) -> Load | None:
    """Move a worker's waiting tasks to other workers, and return its load afterwards."""
    load = await request_load(scheduler, worker)
    if load is None:
        waiting = [task for task in worker.processing if task.key not in candidates]
        reschedule_tasks(scheduler, [task for task in waiting if not is_bound(task)])
        return None
    hand_off_tasks(scheduler, worker, {name}, set())
    deadline = time.monotonic() + MOVE_S
    while time.monotonic() < deadline and any(
        task.key not in load.running and not is_bound(task) for task in worker.processing
    ):
        await asyncio.sleep(0.01)
    return await request_load(scheduler, worker)


async def _obstacle(
    scheduler: Any,
    worker: Any,
    name: str,
    load: Load | None,
    ended: Set[Any],
    candidates: Set[Any],
    recompute: bool,
) -> str:
    """Return why a worker must not be restarted, or "". Results are copied to other workers."""
    silent = " does not respond" if load is None else ""
    joined = f"{silent} and" if silent else ""
    running = candidates if load is None else load.running.keys()
    if not worker.nanny:
        return f"{joined} has no nanny to restart it"
    if running - ended and not recompute:
        return f"{joined} runs other tasks"
    if any(map(is_bound, worker.processing)):
        return f"{joined} has tasks that may only run there"
    if worker.actors:
        return f"{joined} holds an actor"
    if load is not None and load.holds_results:
        return " holds results that have not been fetched"
    if load is not None and only_copies(worker):
        await _await_for(copy_results(scheduler, [worker], name), COPY_S)
    lost = only_copies(worker)
    if any(task.run_spec is None for task in lost):
        return f"{joined} holds the only copy of scattered data"
    if lost and not recompute:
        return f"{joined} holds the only copy of a result"
    return ""


async def _resume_when_responding(scheduler: Any, worker: Any) -> None:
    """Assign tasks to a worker again as soon as it responds."""
    while scheduler.workers.get(worker.address) is worker:
        if await request_load(scheduler, worker) is not None:
            resume_assigning(scheduler, worker)
            return
        await asyncio.sleep(_CHECK_S)


_background: set[asyncio.Task[None]] = set()


def _start(coroutine: Coroutine[Any, Any, None]) -> None:
    """Run a coroutine in the background."""
    task = asyncio.ensure_future(coroutine)
    _background.add(task)
    task.add_done_callback(_background.discard)


class Load(NamedTuple):
    """Tasks and results that a worker reports about itself."""

    # {key: seconds for which the task has run}, including tasks that the scheduler has forgotten
    running: dict[Any, float]
    holds_results: bool  # whether the worker holds bytes that a client has not fetched yet


async def request_load(scheduler: Any, worker: Any) -> Load | None:
    """Request the load of a worker. Return None if the worker does not respond."""
    try:
        return await _await_for(call_worker(scheduler, worker.address, _load_here), ANSWER_S)
    except OSError:
        return None


async def _await_for(request: Coroutine[Any, Any, T], seconds: float) -> T | None:
    """Await a request, but return None if the given time has passed."""
    # `asyncio.wait_for` of Python 3.11 is not used, because it also waits until the canceled
    # request has ended, which may involve closing a connection to a worker that does not read.
    task = asyncio.ensure_future(request)
    await asyncio.wait([task], timeout=seconds)
    if task.done():
        return task.result()
    task.cancel()
    return None


def _load_here(dask_worker: Any = None) -> Load:
    return Load(running_times(dask_worker), holds_bytes())
