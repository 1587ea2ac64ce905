"""Where tasks are and how they fared, and which workers give no sign of life."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Any

from distributed import Client
from distributed.scheduler import heartbeat_interval

from .remote import on_scheduler

SILENT_S = 20.0  # without a heartbeat; a stopped worker gives none, nor one whose GIL is held
_BEATS = 3  # heartbeats that a worker may miss at least; in a large cluster they are rare


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
        _look,
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
    patience_s = max(patience_s, _BEATS * heartbeat_interval(len(scheduler.workers)))
    return {ws.address for ws in scheduler.workers.values() if now - ws.last_seen > patience_s}


def _look(
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
