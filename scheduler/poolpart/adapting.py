"""Partitions that grow with their work: how many slots are missing, and which jobs may end.

A plugin of the scheduler keeps a record of each partition: how many jobs the partition may have,
how many slots clients request, and when its workers last ran a task. Once a second, the process
that has the cluster object (`deploy/clusters.py`) reports its jobs, and receives how many to start
and which have ended.

The scheduler decides, because no task can arrive between the moment when the scheduler finds a
worker idle and the moment when the worker stops getting tasks. A job that waits in the queue is
cancelled in the same way: if its worker joins after all, the worker is sent away before it gets a
task.

A group of workers (`deploy/worker_groups.py`) has jobs without names: each worker is a job, named
when it joins. Such a job cannot be cancelled before it joins.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from distributed.diagnostics.plugin import SchedulerPlugin

from .errors import PoolError
from .fetch import holds_bytes
from .internals.scheduler import (
    accepts_tasks,
    call_worker,
    is_bound,
    is_idle,
    reject_worker,
    resume_assigning,
    retire_workers,
    stop_assigning,
    unrunnable_tasks,
)
from .internals.worker import has_running_tasks
from .rules import check_count

NAME = "poolpart-adapting"
IDLE_S = 60.0  # after which a job without work ends, by default
_ANSWER_S = 5.0  # seconds that an idle worker has to confirm that it runs no task
_LOST_S = 120.0  # without a report, after which the process that starts jobs counts as dead


@dataclass(frozen=True)
class JobBounds:
    """Number of jobs that a partition may have."""

    minimum: int
    maximum: int
    idle_s: float = IDLE_S

    @classmethod
    def validated(cls, name: str, minimum: Any, maximum: Any, idle_s: Any = IDLE_S) -> JobBounds:
        """Return checked bounds.

        Raises
        ------
        PoolError
            If a number is not possible.
        """
        check_count(f"the minimum of partition {name!r}", minimum, minimum=0)
        check_count(f"the maximum of partition {name!r}", maximum, minimum=max(1, minimum))
        if not isinstance(idle_s, int | float) or not 0 <= idle_s < math.inf:
            raise PoolError(
                f"Invalid value {idle_s!r} for `idle_s` of partition {name!r}. Expected a number "
                "of seconds, for example 60."
            )
        return cls(minimum, maximum, float(idle_s))


@dataclass(frozen=True)
class JobSpec:
    """Size of the jobs of a partition, and their number."""

    slots: int  # slots per worker
    workers: int = 1  # workers per job
    bounds: JobBounds | None = None  # None for a fixed number of jobs
    cancellable: bool = True  # before its workers have joined


@dataclass(frozen=True)
class JobAdvice:
    """Jobs of a partition that the cluster's process has to start and to forget."""

    jobs_to_start: int = 0
    jobs_to_forget: Sequence[str] = ()  # their workers have ended, or they are to be cancelled


@dataclass(frozen=True)
class GroupReport:
    """Report of the process that scales a group of workers."""

    size: int  # workers that the group was scaled to
    removed: Sequence[str] = ()  # names of workers that will not come back


@dataclass(frozen=True)
class GroupAdvice:
    """Order to the process that scales a group of workers."""

    size: int  # workers that the group shall have
    leaving: tuple[str, ...] = ()  # names of closed workers, to be removed from the group


@dataclass(frozen=True)
class _Decision:
    """What happens to the jobs of a partition."""

    advice: JobAdvice
    idle: dict[str, list[Any]]  # {job: states of its workers, which are to be closed}


@dataclass
class _Record:
    """State of a partition, with times from `time.monotonic`."""

    kind: JobSpec
    queued_jobs: int = 0  # jobs whose workers have not joined
    reported_at: float = 0.0  # when the process that starts jobs reported them
    missing_slots: float = 0.0  # at the last report
    superfluous_since: dict[str, float] = field(default_factory=dict)  # {queued job: time}
    leaving: set[str] = field(default_factory=set)  # closed workers that a group still has

    @property
    def is_current(self) -> bool:
        """Whether the process that starts jobs has reported them, and is not dead."""
        return time.monotonic() - self.reported_at <= _LOST_S


class AdaptivePartitions(SchedulerPlugin):
    """The record of partitions whose jobs a cluster object starts."""

    name = NAME

    def __init__(self, scheduler: Any) -> None:
        self.scheduler = scheduler
        self.records: dict[str, _Record] = {}  # {partition: its record}
        self.requested: dict[tuple[str, str], int] = {}  # {(partition, client): slots}
        self._busy_at: dict[str, float] = {}  # {address of a worker: when it last ran a task}
        self._cancelled: set[str] = set()  # names of workers of cancelled jobs, which are unique

    # -- hooks of the scheduler --------------------------------------------------------

    def add_worker(self, scheduler: Any, worker: str) -> None:
        """Begin to count idle time, or send a worker away whose job was cancelled meanwhile."""
        self._busy_at[worker] = time.monotonic()
        state = scheduler.workers[worker]
        if str(state.name) in self._cancelled:
            reject_worker(scheduler, state)

    def remove_worker(self, scheduler: Any, worker: str, **kwargs: Any) -> None:
        """Forget a worker."""
        self._busy_at.pop(worker, None)

    def transition(
        self, key: Any, start: str, finish: str, *args: Any, worker: str = "", **kwargs: Any
    ) -> None:
        """Note when a worker last ended a task: periodic looks would miss short tasks."""
        if start == "processing" and worker in self._busy_at:
            self._busy_at[worker] = time.monotonic()

    def remove_client(self, scheduler: Any, client: str) -> None:
        """Forget the requests of a client that has left."""
        for partition, requester in list(self.requested):
            if requester == client:
                del self.requested[partition, requester]

    # -- decisions ---------------------------------------------------------------------

    def group_jobs(self, name: str, report: GroupReport) -> dict[str, list[str]]:
        """Return {job: names of its workers} of a group: its members, and pending workers."""
        leaving = self.records[name].leaving
        leaving.difference_update(report.removed)
        members = [
            str(worker.name)
            for worker in self.scheduler.workers.values()
            if worker.resources.get(name) and str(worker.name) not in self._cancelled
        ]
        pending_count = report.size - len(leaving) - len(members)
        pending = [f"{name} pending {number}" for number in range(pending_count)]
        return {job: [job] for job in (*members, *pending)}

    def waiting_slots(self) -> dict[str, float]:
        """Return the slots that tasks without a worker wait for, by partition."""
        waiting: dict[str, float] = {}
        for task in unrunnable_tasks(self.scheduler):  # there may be 100,000
            if task.resource_restrictions and not is_bound(task):
                for name, slots in task.resource_restrictions.items():
                    waiting[name] = waiting.get(name, 0.0) + slots
        return waiting

    def missing_slots(self, name: str, waiting: float, limit: float) -> float:
        """Return the slots that a partition lacks, below 0 if its tasks leave slots unused.

        Tasks that are bound to a worker, or run for long there, hold its slots. All other tasks may
        run on any worker of the partition, also on a new worker.

        Parameters
        ----------
        name
            The partition.
        waiting
            Slots that tasks without a worker wait for.
        limit
            The result is at most this number of slots.
        """
        members = [
            worker
            for worker in self.scheduler.workers.values()
            if worker.resources.get(name) and accepts_tasks(worker)
        ]
        total = sum(worker.resources[name] for worker in members)
        free = 0.0
        movable = waiting
        for worker in members:
            held = 0.0
            for task in worker.processing:
                if movable >= limit + total:  # a worker may have thousands of tasks
                    return limit
                slots = (task.resource_restrictions or {}).get(name, 0)
                if is_bound(task) or task in worker.long_running:
                    held += slots
                else:
                    movable += slots
            free += max(0.0, worker.resources[name] - held)
        requested = sum(
            slots for (partition, _), slots in self.requested.items() if partition == name
        )
        return min(limit, max(movable - free, requested - total))

    def decide(
        self, name: str, jobs: Mapping[str, Sequence[str]], waiting: float
    ) -> _Decision | None:
        """Decide which jobs of a partition start and end, or None if their number is fixed.

        Parameters
        ----------
        name
            The partition.
        jobs
            {job: names of its workers}, the newest job last.
        waiting
            Slots that tasks without a worker wait for.
        """
        record = self.records[name]
        decided_at = time.monotonic()
        states = {str(worker.name): worker for worker in self.scheduler.workers.values()}
        present = {
            job: [states[worker] for worker in names if worker in states]
            for job, names in jobs.items()
        }
        running = {job: workers for job, workers in present.items() if workers}
        ended = [job for job, names in jobs.items() if self._cancelled.issuperset(names)]
        queued = [job for job, workers in present.items() if not workers and job not in ended]
        record.queued_jobs = len(queued)
        record.reported_at = decided_at
        bounds = record.kind.bounds
        if bounds is None:
            return None
        slots_per_job = record.kind.slots * record.kind.workers
        missing = self.missing_slots(name, waiting, float(bounds.maximum * slots_per_job))
        # Work that lasts for less than a second is done before a job begins.
        lasting = min(missing, record.missing_slots)
        record.missing_slots = missing

        def jobs_needed(slots: float) -> int:
            """Return the number of queued jobs that a number of missing slots asks for."""
            number = math.ceil(max(0.0, slots) / slots_per_job)
            lower = bounds.minimum - len(running)
            upper = bounds.maximum - len(running)
            return max(0, min(max(number, lower), upper))

        superfluous = queued[jobs_needed(missing) :] if record.kind.cancellable else []
        record.superfluous_since = {
            job: record.superfluous_since.get(job, decided_at) for job in superfluous
        }
        cancelled = [
            job
            for job, since in record.superfluous_since.items()
            if decided_at - since >= bounds.idle_s
        ]
        self._cancelled.update(worker for job in cancelled for worker in jobs[job])
        to_start = max(0, jobs_needed(lasting) - len(queued))
        # Jobs that have ended are named again: an earlier answer may not have arrived.
        advice = JobAdvice(to_start, [*cancelled, *ended])
        return _Decision(advice, self._idle(name, running, -missing / slots_per_job, bounds))

    def _idle(
        self, name: str, running: Mapping[str, Sequence[Any]], spare_jobs: float, bounds: JobBounds
    ) -> dict[str, list[Any]]:
        """Return the workers to close by job: of the jobs that have been idle for longest."""
        decided_at = time.monotonic()
        members = {
            job: workers
            for job, workers in running.items()
            if all(worker.resources.get(name) for worker in workers)
        }
        busy_at: dict[str, float] = {}
        for job, workers in members.items():
            for worker in workers:
                if not is_idle(self.scheduler, worker):
                    self._busy_at[worker.address] = decided_at
            busy_at[job] = max(
                self._busy_at.setdefault(worker.address, decided_at) for worker in workers
            )
        number = max(0, min(len(members) - bounds.minimum, math.floor(spare_jobs)))
        idle = [job for job in members if decided_at - busy_at[job] >= bounds.idle_s]
        idle.sort(key=busy_at.__getitem__)
        return {job: [*members[job]] for job in idle[:number]}

    async def close_idle(self, workers: Sequence[Any]) -> bool:
        """Close workers that no longer receive tasks.

        If a worker turns out to be busy, let all of them receive tasks again, and return False.
        """
        addresses = [worker.address for worker in workers]
        requests = (call_worker(self.scheduler, address, _is_busy) for address in addresses)
        try:
            busy = any(await asyncio.wait_for(asyncio.gather(*requests), _ANSWER_S))
        except (OSError, TimeoutError):  # stopped, or leaving by itself
            busy = True
        if not busy and await retire_workers(self.scheduler, workers):
            # The container of a worker of Kubernetes is started again until it is removed.
            self._cancelled.update(str(worker.name) for worker in workers)
            return True
        for worker in workers:
            resume_assigning(self.scheduler, worker)
            if worker.address in self._busy_at:
                self._busy_at[worker.address] = time.monotonic()
        return False


def _is_busy(dask_worker: Any = None) -> bool:
    """Return whether a worker runs a task, or holds data, unknown to its scheduler."""
    return has_running_tasks(dask_worker) or holds_bytes()


# -- requests of the process that starts jobs ----------------------------------------------


def add_partitions(kinds: Mapping[str, JobSpec], dask_scheduler: Any = None) -> None:
    """Create the records of partitions whose jobs a process starts."""
    record = _adaptation_of(dask_scheduler) or AdaptivePartitions(dask_scheduler)
    if NAME not in dask_scheduler.plugins:
        dask_scheduler.add_plugin(record)
    for name, kind in kinds.items():
        record.records[name] = _Record(kind)


async def advise_jobs(
    jobs: Mapping[str, Mapping[str, Sequence[str]]], dask_scheduler: Any = None
) -> dict[str, JobAdvice]:
    """Close idle workers, then return which jobs to start and which to forget, by partition.

    `jobs` maps each partition to its jobs, and each job to the names of its workers. Partitions
    with a fixed number of jobs are not in the result.
    """
    adaptation = _adaptation_of(dask_scheduler)
    if adaptation is None:
        return {}
    waiting = adaptation.waiting_slots()
    advice: dict[str, JobAdvice] = {}
    closing: list[tuple[str, str, list[Any]]] = []
    for name, jobs_of_partition in jobs.items():
        decision = adaptation.decide(name, jobs_of_partition, waiting.get(name, 0.0))
        if decision is None:
            continue
        advice[name] = decision.advice
        for job, workers in decision.idle.items():
            for worker in workers:  # one step of the event loop: no task can arrive before
                stop_assigning(dask_scheduler, worker)
            closing.append((name, job, workers))
    results = await asyncio.gather(*(adaptation.close_idle(workers) for *_, workers in closing))
    for (name, job, _), closed in zip(closing, results, strict=True):
        if closed:
            forgotten = [*advice[name].jobs_to_forget, job]
            advice[name] = replace(advice[name], jobs_to_forget=forgotten)
    return advice


async def advise_groups(
    reports: Mapping[str, GroupReport], dask_scheduler: Any = None
) -> dict[str, GroupAdvice]:
    """Close idle workers, then return the target sizes of the worker groups, by partition.

    Closed workers are listed again until a report confirms their removal, because an earlier
    response may have been lost.
    """
    adaptation = _adaptation_of(dask_scheduler)
    if adaptation is None:
        return {}
    jobs = {name: adaptation.group_jobs(name, report) for name, report in reports.items()}
    advice: dict[str, GroupAdvice] = {}
    for name, change in (await advise_jobs(jobs, dask_scheduler)).items():
        leaving = adaptation.records[name].leaving
        leaving.update(change.jobs_to_forget)
        size = len(jobs[name]) + change.jobs_to_start - len(change.jobs_to_forget)
        advice[name] = GroupAdvice(size, tuple(sorted(leaving)))
    return advice


# -- requests of clients, by `run_on_scheduler` ----------------------------------------------------


def set_bounds(name: str, bounds: JobBounds, dask_scheduler: Any = None) -> bool:
    """Change the number of jobs of a partition, or return False if no process starts its jobs."""
    record = _record(dask_scheduler, name)
    if record is not None:
        record.kind = replace(record.kind, bounds=bounds)
    return record is not None


def request_slots(name: str, slots: int, asking: str, dask_scheduler: Any = None) -> bool:
    """Request slots of a partition for a client, by its id, or end the request with 0 slots.

    Returns False if the partition does not adapt.
    """
    adaptation = _adaptation_of(dask_scheduler)
    # The last request of a client that was killed may come after it has left.
    if adaptation is None or asking not in dask_scheduler.clients:
        return False
    adaptation.requested.pop((name, asking), None)
    if slots:
        adaptation.requested[name, asking] = slots
    return slots_of_new_worker(dask_scheduler, name) > 0


def adaptive_names(dask_scheduler: Any = None) -> set[str]:
    """Return the names of adaptive partitions, which may have no workers."""
    adaptation = _adaptation_of(dask_scheduler)
    records = adaptation.records if adaptation else {}
    return {name for name, record in records.items() if record.kind.bounds is not None}


# -- for other modules, on the scheduler -----------------------------------------------------


def slots_of_new_worker(scheduler: Any, name: str) -> int:
    """Return the slots of a worker that may join a partition, or 0 if the partition is fixed."""
    return _upper_bound(scheduler, name)[1]


def max_running_tasks(scheduler: Any, name: str, slots: int) -> int:
    """Return the number of tasks that a partition runs at a time, now or with all its jobs.

    `slots` is the number of slots that each task takes.
    """
    workers = scheduler.workers.values()
    running = sum(int(worker.resources.get(name, 0)) // slots for worker in workers)
    max_workers, slots_per_worker = _upper_bound(scheduler, name)
    return max(running, max_workers * (slots_per_worker // slots))


def max_slots(scheduler: Any, name: str) -> int:
    """Return the slots of a partition with all its jobs, or 0 if the partition is fixed."""
    return math.prod(_upper_bound(scheduler, name))


def queued_jobs_of(scheduler: Any, name: str) -> int:
    """Return the number of jobs of an adaptive partition that wait in the queue, or start."""
    record = _record(scheduler, name)
    if record is None or record.kind.bounds is None:
        return 0
    return record.queued_jobs if record.is_current else 0


def expects_workers(scheduler: Any, name: str) -> bool:
    """Return whether jobs of a partition wait in a queue, start, or may be started."""
    record = _record(scheduler, name)
    if record is None or not record.is_current:
        return False
    return record.kind.bounds is not None or record.queued_jobs > 0


def _upper_bound(scheduler: Any, name: str) -> tuple[int, int]:
    """Return the number of workers with all jobs, and the slots of a worker, or (0, 0) if fixed."""
    record = _record(scheduler, name)
    if record is None or record.kind.bounds is None:
        return 0, 0
    return record.kind.bounds.maximum * record.kind.workers, record.kind.slots


def _adaptation_of(scheduler: Any) -> AdaptivePartitions | None:
    adaptation: AdaptivePartitions | None = scheduler.plugins.get(NAME)
    return adaptation


def _record(scheduler: Any, name: str) -> _Record | None:
    adaptation = _adaptation_of(scheduler)
    return adaptation.records.get(name) if adaptation else None
