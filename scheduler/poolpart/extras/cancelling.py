"""Cancel tasks, including tasks that are already running.

Dask does not stop a running function. Its thread continues and keeps the task's slot. The function
can check `cancelled`, or the worker process can be restarted if nothing else would be lost. The
scheduler decides this in two steps, as for idle workers in `adapting.py`: it stops assigning tasks
to the worker, and then asks the worker which tasks it runs.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Collection, Coroutine, Iterable, Mapping
from typing import Any, NamedTuple, TypeVar

from distributed import Client, Future, Status

from ..errors import PoolError
from ..fetch import holds_bytes
from ..internals.scheduler import (
    call_worker,
    cancel_keys,
    holds_nothing,
    requires_any,
    restart_worker,
    resume_assigning,
    stop_assigning,
)
from ..internals.worker import current_task, running_keys
from ..pipe_states import fail_pipes_of_killed_task
from ..workers import run_on_scheduler

T = TypeVar("T")
Outcomes = dict[Any, str]  # {task key: outcome}

ARRIVAL_S = 1.0  # time for submitted tasks to arrive, which use another connection
ANSWER_S = 5.0  # time for a worker to respond, which a function that holds the GIL can delay
RESTART_S = 60.0  # time for a restarted worker to rejoin


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
    tasks: Mapping[Any, Future], client: Client, name: str, restarts: bool
) -> Outcomes:
    """Cancel tasks of a partition on the scheduler, and return the outcome for each key.

    Tasks that had not started or had already finished are omitted from the result. If `restarts` is
    true, workers that only run these tasks are restarted.

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
    workers = {key: task.processing_on for key, task in known.items()}
    annotations = {key: task.annotations for key, task in known.items()}
    cancel_keys(scheduler, keys, client_id)
    kept = [key for key in known if key in scheduler.tasks]
    outcomes: Outcomes = dict.fromkeys(kept, "kept: another client needs its result")
    members = [worker for worker in scheduler.workers.values() if worker.resources.get(name)]
    loads = await asyncio.gather(*(_load(scheduler, worker) for worker in members))
    affected: dict[Any, list[Any]] = {}  # {worker: keys of canceled tasks that it runs}
    for worker, load in zip(members, loads, strict=True):
        if load is None:  # a canceled task may prevent the worker from responding
            silent = [key for key, at in workers.items() if at is worker and key not in outcomes]
            outcomes |= dict.fromkeys(silent, f"running: worker {worker.name} does not respond")
        elif running := [key for key in load.running if key in keys and key not in outcomes]:
            affected[worker] = running
    ends = (
        _restart_if_idle(scheduler, worker, running, restarts)
        for worker, running in affected.items()
    )
    for running, outcome in zip(affected.values(), await asyncio.gather(*ends), strict=True):
        outcomes |= dict.fromkeys(running, outcome)
        if outcome.startswith("restarted"):
            for key in running:
                fail_pipes_of_killed_task(scheduler, key, annotations.get(key))
    return outcomes, ""


async def _restart_if_idle(scheduler: Any, worker: Any, keys: Iterable[Any], restarts: bool) -> str:
    """Restart a worker if all of its tasks were canceled, and return the outcome."""
    still_running = f"running: worker {worker.name}"
    if not restarts:
        return still_running
    if not worker.nanny:
        return f"{still_running} has no nanny to restart it"
    if worker.status is not Status.running:
        return f"{still_running} is {worker.status.name}"
    # No task can arrive in between, because the event loop has not run since the checks above.
    stop_assigning(scheduler, worker)
    load = await _load(scheduler, worker)
    alone = load is not None and not load.holds_results and {*load.running} <= {*keys}
    if not alone or not holds_nothing(scheduler, worker):
        resume_assigning(scheduler, worker)
        return f"{still_running} holds other tasks or results"
    if await _await_for(restart_worker(scheduler, worker, RESTART_S), RESTART_S + ANSWER_S):
        return f"restarted: worker {worker.name}"
    return f"restarted: worker {worker.name}, which has not rejoined after {RESTART_S:g} s"


class _Load(NamedTuple):
    """Tasks and results that a worker reports about itself."""

    running: list[Any]  # keys of running tasks, including those that the scheduler has forgotten
    holds_results: bool  # whether the worker holds bytes that a client has not fetched yet


async def _load(scheduler: Any, worker: Any) -> _Load | None:
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


def _load_here(dask_worker: Any = None) -> _Load:
    return _Load(running_keys(dask_worker), holds_bytes())
