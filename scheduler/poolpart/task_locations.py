"""Current state of a partition on the scheduler: free slots, tasks and silent workers."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Any

from distributed import Client

from .adapting import max_slots, queued_jobs_of
from .workers import run_on_scheduler, silent_workers


@dataclass(frozen=True)
class TaskLocation:
    """One task on the scheduler."""

    state: str  # Dask's name of its state: waiting, no-worker, queued, processing, memory, erred, …
    workers: tuple[str, ...]  # addresses of workers that run it, or have its result
    deaths: int  # workers that died, unexpectedly, while the task was assigned to them
    long_running: bool = False  # it runs and has seceded
    started: bool = False  # a worker runs it, as of the worker's last heartbeat


@dataclass(frozen=True)
class PartitionSnapshot:
    """Members of a partition, their slots, and tasks, at a moment.

    Workers that take no tasks at the moment, because Dask has paused them for their memory or they
    are leaving, and silent ones have neither `free` nor `slots`.
    """

    members: frozenset[str] = frozenset()  # addresses of all workers of the partition
    # Members without a recent heartbeat: stopped, cut off or stuck. The scheduler itself considers
    # a worker dead after its ``worker-ttl``, five minutes.
    silent: frozenset[str] = frozenset()
    # {address: slots that no task holds or waits for}; below 0 with more tasks than slots.
    free: dict[str, int] = field(default_factory=dict)
    slots: int = 0  # free or not
    max_slots: int = 0  # slots, with the workers that `Partition.adapt` may start
    queued_jobs: int = 0  # jobs of such workers that wait in a queue, or start
    tasks: dict[str, TaskLocation] = field(default_factory=dict)  # {requested key: its known task}

    def is_unreachable(self, key: str) -> bool:
        """Return whether a task or its result is on silent workers only."""
        task = self.tasks.get(key)
        return task is not None and bool(task.workers) and self.silent.issuperset(task.workers)

    def is_long_running(self, key: str) -> bool:
        """Return whether a task runs and has seceded."""
        return key in self.tasks and self.tasks[key].long_running


def take_snapshot(client: Client, partition: str, keys: Collection[str] = ()) -> PartitionSnapshot:
    """Ask the scheduler about the slots of a partition and about tasks.

    Dask places a task by a worker's total resources, not by the free ones, and prefers the
    worker with the least work ahead; a worker whose only slot is held by a seceded task looks
    idle. A second long-running task there waits as long as the first runs. So choose the
    workers of long-running tasks yourself.
    """
    locations: PartitionSnapshot = run_on_scheduler(
        client, _look, partition=partition, keys=list(keys)
    )
    return locations


def _look(partition: str, keys: list[str], dask_scheduler: Any = None) -> PartitionSnapshot:
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
    """Count the resources held on a worker: Dask's own count is wrong after stealing."""
    held = ((task.resource_restrictions or {}).get(resource, 0) for task in worker.processing)
    return float(sum(held))
