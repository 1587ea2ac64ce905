"""Which slots of a partition are free, as the scheduler sees it."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

from distributed import Client

from . import whereabouts
from .remote import on_scheduler
from .whereabouts import silent_workers


@dataclass(frozen=True)
class Slots:
    """Slots of a partition at one moment.

    Parameters
    ----------
    free
        Slots that no task holds or waits for, by address of the worker; below 0 where more
        tasks were given to a worker than it has slots for. Workers that take no tasks at the
        moment, or give no sign of life, are left out.
    present
        Addresses of all workers of the partition.
    running
        Those of the keys asked for whose tasks run for long, that is, have seceded.
    silent
        Addresses of those workers that give no sign of life, see `Whereabouts`.
    """

    free: dict[str, int]
    present: frozenset[str]
    running: frozenset[str]
    silent: frozenset[str] = frozenset()


def look_at_slots(client: Client, resource: str, keys: Collection[str] = ()) -> Slots:
    """See which slots of a partition are free.

    Dask places a task by a worker's total resources, not by what is free, and prefers the
    worker with the least work ahead; one whose only slot is held by a task that has seceded
    looks idle to it. A long-running task that lands there waits as long as the other runs.
    Whoever starts several of them should choose their workers.
    """
    free, *sets = on_scheduler(
        client, _look, resource=resource, keys=list(keys), patience_s=whereabouts.SILENT_S
    )
    return Slots(free, *map(frozenset, sets))


def _look(
    resource: str, keys: list[str], patience_s: float, dask_scheduler: Any = None
) -> tuple[Any, ...]:
    silent = silent_workers(dask_scheduler, patience_s)
    members = [ws for ws in dask_scheduler.workers.values() if ws.resources.get(resource)]
    free = free_slots(dask_scheduler, resource, patience_s)
    running = []
    for key in keys:
        task = dask_scheduler.tasks.get(key)
        if task is not None and task.processing_on and task in task.processing_on.long_running:
            running.append(key)
    return free, [ws.address for ws in members], running, list(silent)


def usable_members(scheduler: Any, resource: str, patience_s: float | None = None) -> list[Any]:
    """Workers of a partition that take tasks and are heard of; runs on the scheduler."""
    patience_s = whereabouts.SILENT_S if patience_s is None else patience_s
    silent = silent_workers(scheduler, patience_s)
    return [
        ws
        for ws in scheduler.workers.values()
        if ws.resources.get(resource) and ws.status.name == "running" and ws.address not in silent
    ]


def free_slots(scheduler: Any, resource: str, patience_s: float | None = None) -> dict[str, int]:
    """Slots of a partition that are free, by address of the worker; runs on the scheduler."""
    members = usable_members(scheduler, resource, patience_s)
    return {ws.address: int(ws.resources[resource] - _in_use(ws, resource)) for ws in members}


def _in_use(worker: Any, resource: str) -> float:
    """Count what the tasks on a worker hold: Dask's own count is off once one was stolen."""
    held = ((task.resource_restrictions or {}).get(resource, 0) for task in worker.processing)
    return float(sum(held))
