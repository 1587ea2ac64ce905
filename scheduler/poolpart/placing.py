"""What the scheduler believes a worker to declare; this runs in its event loop."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Collection
from typing import Any

from .book import Resources


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
