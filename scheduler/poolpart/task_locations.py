"""What the scheduler knows of a partition now: its tasks, free slots and silent workers."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field, replace
from typing import Any

from distributed import Client

from .remote import on_scheduler

SILENT_S = 20.0  # without a heartbeat; a stopped worker gives none, nor one whose GIL is held
_BEATS = 3  # heartbeats that a worker may miss at least


@dataclass(frozen=True)
class TaskPlace:
    """One task as the scheduler sees it.

    Parameters
    ----------
    state
        Dask's name of its state: waiting, no-worker, queued, processing, memory, erred, ….
    workers
        Addresses of those that run it, or have its result.
    deaths
        Workers that died, unexpectedly, while the task was assigned to them.
    """

    state: str
    workers: tuple[str, ...]
    deaths: int


@dataclass(frozen=True)
class Whereabouts:
    """Members of a partition, and tasks, at one moment.

    Parameters
    ----------
    slots
        Tasks that the partition runs at a time.
    members
        Addresses of all workers of the partition.
    silent
        Those of them that have sent no heartbeat for long: stopped, cut off or stuck. The
        scheduler itself takes a worker for dead after its ``worker-ttl``, five minutes.
    tasks
        {key: its place}, of those keys asked for that the scheduler knows.
    """

    slots: int = 0
    members: frozenset[str] = frozenset()
    silent: frozenset[str] = frozenset()
    tasks: dict[str, TaskPlace] = field(default_factory=dict)

    def out_of_reach(self, key: str) -> bool:
        """Whether a task runs, or its result lies, on silent workers only."""
        place = self.tasks.get(key)
        return place is not None and bool(place.workers) and self.silent.issuperset(place.workers)


def look_for_tasks(
    client: Client, resource: str, keys: Collection[str], patience_s: float | None = None
) -> Whereabouts:
    """Ask the scheduler about the workers of a partition and some tasks.

    Parameters
    ----------
    client
        Client of the cluster.
    resource
        Name of the partition.
    keys
        The tasks' keys.
    patience_s
        Seconds without a heartbeat that make a worker silent; by default `SILENT_S`.
    """
    members, silent, tasks = on_scheduler(
        client,
        _look_for_tasks,
        resource=resource,
        keys=list(keys),
        patience_s=SILENT_S if patience_s is None else patience_s,
    )
    places = {key: TaskPlace(*place) for key, place in tasks.items()}
    return Whereabouts(sum(members.values()), frozenset(members), frozenset(silent), places)


def silent_workers(scheduler: Any, patience_s: float) -> set[str]:
    """Addresses of workers without a heartbeat for so long; runs on the scheduler."""
    # The scheduler's own clock: where all have been silent for as long, it is the scheduler
    # that was stopped or busy, and they are about to be heard.
    now = max((ws.last_seen for ws in scheduler.workers.values()), default=0.0)
    # As Dask has it: in a large cluster they are rare.
    patience_s = max(patience_s, _BEATS * (1 + len(scheduler.workers) / 100))
    return {ws.address for ws in scheduler.workers.values() if now - ws.last_seen > patience_s}


def _look_for_tasks(
    resource: str, keys: list[str], patience_s: float, dask_scheduler: Any = None
) -> tuple[Any, ...]:
    workers = dask_scheduler.workers.values()
    members = {ws.address: int(n) for ws in workers if (n := ws.resources.get(resource))}
    silent = silent_workers(dask_scheduler, patience_s)
    tasks = {}
    for key in keys:
        task = dask_scheduler.tasks.get(key)
        if task is not None:
            holders = task.who_has or ([task.processing_on] if task.processing_on else [])
            places = tuple(ws.address for ws in holders)
            tasks[key] = (task.state, places, task.suspicious)
    return members, [address for address in members if address in silent], tasks


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
    known
        Those of the keys asked for that the scheduler has heard of.
    silent
        Addresses of those workers that give no sign of life, see `Whereabouts`.
    total
        Slots of the workers that take tasks at the moment, free or not.
    """

    free: dict[str, int]
    present: frozenset[str]
    running: frozenset[str]
    known: frozenset[str] = frozenset()
    silent: frozenset[str] = frozenset()
    total: int = 0

    def without(self, addresses: Collection[str]) -> Slots:
        """Leave out what is free on some workers."""
        free = {address: count for address, count in self.free.items() if address not in addresses}
        return replace(self, free=free)


def look_at_slots(client: Client, resource: str, keys: Collection[str] = ()) -> Slots:
    """See which slots of a partition are free.

    Dask places a task by a worker's total resources, not by what is free, and prefers the
    worker with the least work ahead; one whose only slot is held by a task that has seceded
    looks idle to it. A long-running task that lands there waits as long as the other runs.
    Whoever starts several of them should choose their workers.
    """
    free, total, *sets = on_scheduler(
        client, _look_at_slots, resource=resource, keys=list(keys), patience_s=SILENT_S
    )
    present, running, known, silent = map(frozenset, sets)
    return Slots(free, present, running, known, silent, total)


def _look_at_slots(
    resource: str, keys: list[str], patience_s: float, dask_scheduler: Any = None
) -> tuple[Any, ...]:
    silent = silent_workers(dask_scheduler, patience_s)
    members = [ws for ws in dask_scheduler.workers.values() if ws.resources.get(resource)]
    usable = [ws for ws in members if ws.status.name == "running" and ws.address not in silent]
    free = {ws.address: int(ws.resources[resource] - _in_use(ws, resource)) for ws in usable}
    total = sum(int(ws.resources[resource]) for ws in usable)
    known = [key for key in keys if key in dask_scheduler.tasks]
    running = [key for key in known if _runs_for_long(dask_scheduler.tasks[key])]
    return free, total, [ws.address for ws in members], running, known, list(silent)


def _runs_for_long(task: Any) -> bool:
    return task.processing_on is not None and task in task.processing_on.long_running


def _in_use(worker: Any, resource: str) -> float:
    """Count what the tasks on a worker hold: Dask's own count is off once one was stolen."""
    held = ((task.resource_restrictions or {}).get(resource, 0) for task in worker.processing)
    return float(sum(held))
