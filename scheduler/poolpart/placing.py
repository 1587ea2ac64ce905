"""Where the scheduler places tasks: resources as it knows them, and tasks that it moves.

All of this runs in the scheduler's event loop. `hand_off` and `recall` use the protocol of work
stealing: the worker is asked, and gives a task up unless the task runs. `hand_off` names another
worker that gets the task. `recall` asks in the name of a worker that has left, so that the
scheduler sends the task nowhere, but decides anew where it goes.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable
from typing import Any

from distributed.core import Status
from distributed.scheduler import WorkerState

from .book import Resources

_NOBODY = "poolpart-nobody"  # name of the worker in whose name tasks are recalled


def show(scheduler: Any, worker: Any, resources: Resources) -> None:
    """Have tasks placed by these resources of a worker from now on, and wake those that waited.

    Parameters
    ----------
    scheduler
        The scheduler.
    worker
        Its state of the worker.
    resources
        All that the worker is to count as declaring.
    """
    for name in worker.resources.keys() - resources.keys():
        del worker.resources[name]
        scheduler.resources[name].pop(worker.address, None)
    # The scheduler's own method, since fences listen to it.
    scheduler.add_resources(worker.address, resources)
    recount(worker)
    wake(scheduler, worker)


def recount(worker: Any) -> None:
    """Count the resources in use anew.

    Dask forgets them when a worker declares something while it is busy, and counts a task
    that was moved by work stealing against the worker that it was moved from.
    """
    worker.used_resources = dict.fromkeys(worker.resources, 0)
    for task in worker.processing:
        for name, quantity in (task.resource_restrictions or {}).items():
            worker.used_resources[name] = worker.used_resources.get(name, 0) + quantity


def wake(scheduler: Any, worker: Any) -> None:
    """Send tasks that wait for such a worker to it, as the scheduler does when one joins.

    It does not when a running worker gets a resource: those tasks would wait for ever.
    """
    if worker in scheduler.running:
        scheduler.transitions(
            scheduler.bulk_schedule_unrunnable_after_adding_worker(worker),
            f"poolpart-{worker.address}-{time.time()}",
        )


def asks_for(task: Any, names: Collection[str]) -> bool:
    """Whether a task takes a slot of one of these partitions."""
    return not (task.resource_restrictions or {}).keys().isdisjoint(names)


def held_by(scheduler: Any, worker: Any, names: Collection[str]) -> list[str]:
    """Keys of a worker's tasks that need these resources of it, with those on their way there."""
    tasks = {task for task in worker.processing if asks_for(task, names)}
    if stealing := scheduler.extensions.get("stealing"):
        moves = stealing.in_flight.items()
        tasks |= {t for t, m in moves if m["thief"] is worker and asks_for(t, names)}
    return [task.key for task in tasks]


def hand_off(scheduler: Any, worker: Any, names: Collection[str], asked: set[Any]) -> None:
    """Move a worker's tasks that have not started to other members of their partition.

    By the protocol of work stealing: the worker is asked, and gives up what it has not
    started. A task that no other worker may take stays, and ends here.

    Parameters
    ----------
    scheduler, worker
        The scheduler, and its state of the worker.
    names
        The partitions that the worker leaves.
    asked
        Tasks that it was asked for already; added to.
    """
    stealing = scheduler.extensions.get("stealing")
    if stealing is None:
        return
    given: Counter[Any] = Counter()  # to whom; the scheduler counts a task when the worker agrees
    for task in list(worker.processing - worker.long_running):
        if task in asked or task.actor or not asks_for(task, names):
            continue
        asked.add(task)
        if others := (scheduler.valid_workers(task) or set()) - {worker}:
            thief = min(others, key=lambda o: (len(o.processing) + given[o]) / o.nthreads)
            given[thief] += 1
            stealing.move_task_request(task, worker, thief)


def recall(scheduler: Any, worker: Any, tasks: Iterable[Any]) -> list[Any]:
    """Ask a worker for tasks that it has not started; returns those that it was asked for.

    It is not asked for actors and long-running tasks, nor for tasks that are being stolen from it
    already.
    """
    stealing = scheduler.extensions.get("stealing")
    if stealing is None:
        return []
    asked = [
        task
        for task in tasks
        if not (task.actor or task in worker.long_running or task in stealing.in_flight)
    ]
    for task in asked:
        stealing.move_task_request(task, worker, _nobody(scheduler))
    return asked


def recalls_under_way(
    scheduler: Any, workers: Collection[Any], concerns: Callable[[Any], bool]
) -> bool:
    """Whether workers have yet to answer to `recall`.

    Or to a theft, from these workers or by them, of a task that `concerns` is true for.
    """
    stealing = scheduler.extensions.get("stealing")
    moves = stealing.in_flight.items() if stealing else ()
    return any(
        move["thief"].server_id == _NOBODY
        or (concerns(task) and not {move["thief"], move["victim"]}.isdisjoint(workers))
        for task, move in moves
    )


def forget_recalls(scheduler: Any) -> None:
    """Leave nothing of `recall` with work stealing."""
    if stealing := scheduler.extensions.get("stealing"):
        stealing.in_flight_tasks.pop(_nobody(scheduler), None)


def _nobody(scheduler: Any) -> Any:
    return WorkerState(
        address="tcp://0.0.0.0:0",
        status=Status.closed,
        pid=0,
        name=_NOBODY,
        nthreads=1,
        memory_limit=0,
        local_directory="",
        nanny=None,
        server_id=_NOBODY,
        scheduler=scheduler,
    )
