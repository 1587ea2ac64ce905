"""Snapshot of a partition's slots, unresponsive workers, and selected tasks."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Any

from distributed import Client

from .adapting import max_slots, queued_jobs_of
from .workers import run_on_scheduler, silent_workers


@dataclass(frozen=True)
class TaskLocation:
    """State and workers of a task, as far as the scheduler knows."""

    state: str  # Dask's name, for example waiting, no-worker, queued, processing, memory or erred
    workers: tuple[str, ...]  # addresses of the workers that run the task or hold its result
    deaths: int  # number of workers that died unexpectedly while the task was assigned to them
    long_running: bool = False  # whether the task is running and has seceded
    started: bool = False  # whether the worker's last heartbeat listed the task as running


@dataclass(frozen=True)
class PartitionSnapshot:
    """Members, slots, and selected tasks of a partition at one point in time.

    `free` and `slots` do not include workers that currently accept no tasks: workers that Dask has
    paused because of their memory, workers that are leaving, and silent workers.
    """

    members: frozenset[str] = frozenset()  # addresses of all workers of the partition
    # Members without a recent heartbeat, because they are stopped, disconnected or stuck. The
    # scheduler itself only considers a worker dead after ``worker-ttl``, which is five minutes.
    silent: frozenset[str] = frozenset()
    # {address: number of free slots}. The number is negative if there are more tasks than slots.
    free: dict[str, int] = field(default_factory=dict)
    slots: int = 0  # total number of slots
    max_slots: int = 0  # total number of slots once all adaptive jobs have started
    queued_jobs: int = 0  # number of adaptive jobs that are queued or starting
    tasks: dict[str, TaskLocation] = field(default_factory=dict)  # requested tasks that exist

    def is_unreachable(self, key: str) -> bool:
        """Return whether a task and its result are only on workers that do not respond."""
        task = self.tasks.get(key)
        return task is not None and bool(task.workers) and self.silent.issuperset(task.workers)

    def is_long_running(self, key: str) -> bool:
        """Return whether a task is running and has seceded."""
        return key in self.tasks and self.tasks[key].long_running


def take_snapshot(client: Client, partition: str, keys: Collection[str] = ()) -> PartitionSnapshot:
    """Request a partition's current slots and the locations of the given tasks.

    Programs that run several long-running tasks need this to select workers themselves. Dask places
    a task according to the total resources of the workers, not the free ones, and prefers the
    worker with the least pending work. A worker whose only slot is occupied by a seceded task
    appears to be idle, and a second long-running task that is placed on it waits until the first
    one has finished.
    """
    locations: PartitionSnapshot = run_on_scheduler(
        client, _take_snapshot, partition=partition, keys=list(keys)
    )
    return locations


def _take_snapshot(
    partition: str, keys: list[str], dask_scheduler: Any = None
) -> PartitionSnapshot:
    workers = dask_scheduler.workers.values()
    members = [ws for ws in workers if ws.resources.get(partition)]
    addresses = frozenset(ws.address for ws in members)
    silent = addresses & silent_workers({ws.address: ws.last_seen for ws in workers})
    usable = [ws for ws in members if ws.status.name == "running" and ws.address not in silent]
    tasks = dask_scheduler.tasks
    slots = sum(int(ws.resources[partition]) for ws in usable)
    return PartitionSnapshot(
        members=addresses,
        silent=silent,
        free={ws.address: int(ws.resources[partition] - _in_use(ws, partition)) for ws in usable},
        slots=slots,
        max_slots=max(slots, max_slots(dask_scheduler, partition)),
        queued_jobs=queued_jobs_of(dask_scheduler, partition),
        tasks={key: _task_place(tasks[key]) for key in keys if key in tasks},
    )


def _task_place(task: Any) -> TaskLocation:
    worker = task.processing_on
    holders = task.who_has or ([worker] if worker else [])
    long_running = worker is not None and task in worker.long_running
    addresses = tuple(holder.address for holder in holders)
    started = worker is not None and task in worker.executing
    return TaskLocation(task.state, addresses, task.suspicious, long_running, started)


def _in_use(worker: Any, resource: str) -> float:
    """Count how much of a resource is in use, which Dask itself miscounts after work stealing."""
    held = ((task.resource_restrictions or {}).get(resource, 0) for task in worker.processing)
    return float(sum(held))
