"""Adaptive partitions, whose number of jobs depends on the amount of work.

A scheduler plugin stores a record of each partition, with the allowed number of jobs, the slots
that clients request, and the time when its workers last ran a task. Jobs are started by the process
with the cluster object (see `deploy/clusters.py`). Once per second, this process reports its jobs,
and the scheduler replies with the number of jobs to start and the jobs that have ended.

The scheduler makes these decisions because no task can arrive between the moment when it finds a
worker idle and the moment when it stops assigning tasks to that worker. Jobs that wait in a queue
are canceled in the same way. If the worker of a canceled job joins after all, it is rejected before
it receives a task.

In a worker group (see `deploy/worker_groups.py`), each worker is a job, and has no name before it
joins. Therefore, such a job cannot be canceled before it joins.

If jobs of other users wait in a queue, the process with the cluster object reports how many jobs
the partitions that use the queue should release together. Until the next report, these partitions
start no further jobs, and as many of their jobs are drained (see `draining.py`).
"""

from __future__ import annotations

import asyncio
import logging
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from distributed.diagnostics.plugin import SchedulerPlugin

from .draining import DrainingJobs
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
from .partition_stats import SharedQueue
from .rules import check_count

logger = logging.getLogger(__name__)

NAME = "poolpart-adapting"
IDLE_S = 60.0  # default time without work after which a job ends
YIELD_IDLE_S = 5.0  # maximum of this time while jobs of other users wait
_ANSWER_S = 5.0  # time for an idle worker to confirm that it runs no task
_LOST_S = 120.0  # time without a report after which the process that starts jobs counts as dead


@dataclass(frozen=True)
class JobBounds:
    """Minimum and maximum number of jobs in an adaptive partition."""

    minimum: int
    maximum: int
    idle_s: float = IDLE_S  # time without work after which a job ends

    @classmethod
    def from_user_values(
        cls, name: str, minimum: Any, maximum: Any, idle_s: Any = IDLE_S
    ) -> JobBounds:
        """Create job bounds from values that a user has passed.

        Raises
        ------
        PoolError
            If a value is invalid.
        """
        check_count(f"the minimum of partition {name!r}", minimum, minimum=0)
        check_count(f"the maximum of partition {name!r}", maximum, minimum=max(1, minimum))
        if not isinstance(idle_s, int | float) or not 0 <= idle_s < math.inf:
            raise PoolError(
                f"Invalid value {idle_s!r} for `idle_s` of partition {name!r}. Expected a number "
                "of seconds, for example 60."
            )
        return cls(minimum, maximum, float(idle_s))

    def while_others_wait(self) -> JobBounds:
        """Return the bounds that apply while jobs of other users wait.

        A single job may run even if the minimum is 0. Otherwise, the partition would never make
        progress in a queue in which jobs always wait.
        """
        return JobBounds(self.minimum, max(1, self.minimum), min(self.idle_s, YIELD_IDLE_S))


@dataclass(frozen=True)
class JobSpec:
    """Size of a partition's jobs, and how many jobs the partition may have."""

    slots: int  # slots per worker
    workers: int = 1  # workers per job
    bounds: JobBounds | None = None  # None for a fixed number of jobs
    cancellable: bool = True  # whether a job can be canceled before its workers have joined


@dataclass(frozen=True)
class JobAdvice:
    """Instructions on one partition, for the process that has the cluster object."""

    jobs_to_start: int = 0
    jobs_to_forget: Sequence[str] = ()  # jobs to cancel, and jobs whose workers were closed
    closed_jobs: int = 0  # number of running jobs that were closed for this advice


@dataclass(frozen=True)
class QueueReport:
    """Report on a queue, sent to the scheduler by the process that starts the jobs."""

    partitions: Sequence[str]  # names of the partitions that yield to other users in this queue
    # Number of running jobs to release together, or None if no jobs of other users wait.
    to_release: int | None = None
    waiting: int | None = 0  # number of waiting jobs of other users, or None if it is unknown
    problem: str = ""  # reason why the queue cannot be listed


@dataclass(frozen=True)
class GroupReport:
    """Report on a worker group, sent to the scheduler by the process that scales the group."""

    size: int  # number of workers that the group was last scaled to
    removed: Sequence[str] = ()  # names of workers that were removed and will not return


@dataclass(frozen=True)
class GroupAdvice:
    """Instructions for the process that scales a worker group."""

    size: int  # number of workers that the group should have
    leaving: tuple[str, ...] = ()  # names of closed workers to remove from the group


@dataclass(frozen=True)
class _Decision:
    """Decision about a partition's jobs."""

    advice: JobAdvice
    idle: dict[str, list[Any]]  # {job to close: states of its workers}


@dataclass
class _Record:
    """State of an adaptive partition. All times are values of `time.monotonic`."""

    spec: JobSpec
    draining: DrainingJobs
    queued_jobs: int = 0  # number of jobs whose workers have not joined
    reported_at: float = 0.0  # time of the last report
    missing_slots: float = 0.0  # number of missing slots at the last report
    superfluous_since: dict[str, float] = field(default_factory=dict)  # {queued job: time}
    leaving: set[str] = field(default_factory=set)  # closed workers that the group still lists
    queue: QueueReport | None = None  # last report on the queue, if the partition yields
    drained_at: float = 0.0  # time when a job was last selected for release

    @property
    def is_current(self) -> bool:
        """Whether the process that starts the jobs has sent a report recently."""
        return time.monotonic() - self.reported_at <= _LOST_S


class AdaptivePartitions(SchedulerPlugin):
    """Scheduler plugin that keeps a record of each partition whose workers are started as jobs."""

    name = NAME

    def __init__(self, scheduler: Any) -> None:
        self.scheduler = scheduler
        self.records: dict[str, _Record] = {}  # records by partition
        self.requested: dict[tuple[str, str], int] = {}  # {(partition, client): slots}
        self._busy_at: dict[str, float] = {}  # {worker address: time when it last ran a task}
        self._cancelled: set[str] = set()  # names of the workers of canceled jobs, never reused

    # -- hooks of the scheduler --------------------------------------------------------

    def add_worker(self, scheduler: Any, worker: str) -> None:
        """Start measuring a worker's idle time, or reject the worker if its job was canceled."""
        self._busy_at[worker] = time.monotonic()
        state = scheduler.workers[worker]
        if str(state.name) in self._cancelled:
            reject_worker(scheduler, state)

    def remove_worker(self, scheduler: Any, worker: str, **kwargs: Any) -> None:
        """Delete the idle time of a worker that has left."""
        self._busy_at.pop(worker, None)

    def transition(
        self, key: Any, start: str, finish: str, *args: Any, worker: str = "", **kwargs: Any
    ) -> None:
        """Record when a worker last finished a task. Periodic checks would miss short tasks."""
        if start == "processing" and worker in self._busy_at:
            self._busy_at[worker] = time.monotonic()

    def remove_client(self, scheduler: Any, client: str) -> None:
        """Delete the slot requests of a client that has left."""
        for partition, requester in list(self.requested):
            if requester == client:
                del self.requested[partition, requester]

    # -- decisions ---------------------------------------------------------------------

    def group_jobs(self, name: str, report: GroupReport) -> dict[str, list[str]]:
        """Return the jobs of a worker group, and the workers of each job, for `decide`.

        Each member counts as a job. Each worker that has not joined yet also counts as a job, under
        a placeholder name.
        """
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
        """For each partition, count the slots requested by tasks that have no worker yet."""
        waiting: dict[str, float] = {}
        for task in unrunnable_tasks(self.scheduler):  # there may be 100,000
            if task.resource_restrictions and not is_bound(task):
                for name, slots in task.resource_restrictions.items():
                    waiting[name] = waiting.get(name, 0.0) + slots
        return waiting

    def missing_slots(self, name: str, waiting: float, limit: float) -> float:
        """Return how many slots a partition lacks. The number is negative if slots are unused.

        Tasks that are bound to a worker, or that have seceded there, occupy slots of that worker.
        All other tasks can run on any worker of the partition, including a new one.

        Parameters
        ----------
        name
            Name of the partition.
        waiting
            Number of slots that tasks without a worker request.
        limit
            Upper limit of the result.
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
                # Stop early, since a worker may have thousands of tasks.
                if movable >= limit + total:
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
        self,
        name: str,
        jobs: Mapping[str, Sequence[str]],
        waiting: float,
        to_drain: int | None = None,
    ) -> _Decision | None:
        """Decide which of a partition's jobs to start and which to end.

        Parameters
        ----------
        name
            Name of the partition.
        jobs
            Names of the workers of each job, by job. The newest job is last.
        waiting
            Number of slots that tasks without a worker request.
        to_drain
            Number of running jobs to drain for jobs of other users, or None if no such jobs wait.

        Returns
        -------
        _Decision or None
            None if the number of jobs is fixed.
        """
        record = self.records[name]
        running, queued, ended = self._job_states(jobs)
        record.queued_jobs = len(queued)
        record.reported_at = time.monotonic()
        bounds = record.spec.bounds
        if bounds is None:
            return None
        if to_drain is not None:
            bounds = bounds.while_others_wait()
        drained = self._drain(name, running, min(to_drain or 0, len(running) - bounds.maximum))
        slots_per_job = record.spec.slots * record.spec.workers
        missing = self.missing_slots(name, waiting, float(bounds.maximum * slots_per_job))
        # Work that takes less than a second is finished before a new job starts.
        lasting = min(missing, record.missing_slots)
        record.missing_slots = missing

        def jobs_needed(slots: float) -> int:
            """Return how many queued jobs are needed to provide the missing slots."""
            number = math.ceil(max(0.0, slots) / slots_per_job)
            lower = bounds.minimum - len(running)
            upper = bounds.maximum - len(running)
            return max(0, min(max(number, lower), upper))

        cancelled = self._cancel(record, queued[jobs_needed(missing) :], bounds.idle_s)
        self._cancelled.update(worker for job in cancelled for worker in jobs[job])
        to_start = max(0, jobs_needed(lasting) - len(queued))
        # Jobs that have ended are listed in each reply, because an earlier reply may be lost.
        advice = JobAdvice(to_start, [*cancelled, *ended])
        assigned = {job: workers for job, workers in running.items() if job not in record.draining}
        idle = self._idle(name, assigned, -missing / slots_per_job, bounds)
        return _Decision(advice, drained | idle)

    def jobs_to_drain(
        self, jobs: Mapping[str, Mapping[str, Sequence[str]]], queues: Sequence[QueueReport]
    ) -> dict[str, int]:
        """Return the number of jobs to drain, for partitions in whose queue other jobs wait."""
        numbers: dict[str, int] = {}
        for queue in queues:
            for name in queue.partitions:
                self.records[name].queue = queue
            if queue.to_release is not None:
                numbers |= self._divide_releases(jobs, queue)
        return numbers

    def _divide_releases(
        self, jobs: Mapping[str, Mapping[str, Sequence[str]]], queue: QueueReport
    ) -> dict[str, int]:
        """Divide the jobs to release among the partitions that share a queue.

        Jobs that are already being drained are kept, followed by jobs without tasks. After that,
        the partitions take turns.
        """
        loads: dict[str, list[int]] = {}
        for name in queue.partitions:
            record = self.records[name]
            running, *_ = self._job_states(jobs[name])
            if record.spec.bounds is not None:
                most = len(running) - record.spec.bounds.while_others_wait().maximum
                loads[name] = record.draining.loads(running)[: max(0, most)]
        counts = dict.fromkeys(loads, 0)

        def order(name: str) -> tuple[int, int, float, int]:
            """Return the key by which the partition that drains the next job is selected."""
            load = loads[name][counts[name]]
            return min(load, 1), counts[name], self.records[name].drained_at, load

        for _ in range(queue.to_release or 0):
            candidates = [name for name in loads if counts[name] < len(loads[name])]
            if not candidates:
                break
            counts[min(candidates, key=order)] += 1
        return counts

    def _job_states(
        self, jobs: Mapping[str, Sequence[str]]
    ) -> tuple[dict[str, list[Any]], list[str], list[str]]:
        """Return running jobs with the states of their workers, queued jobs, and ended jobs."""
        states = {str(worker.name): worker for worker in self.scheduler.workers.values()}
        present = {
            job: [states[worker] for worker in names if worker in states]
            for job, names in jobs.items()
        }
        running = {job: workers for job, workers in present.items() if workers}
        ended = [job for job, names in jobs.items() if self._cancelled.issuperset(names)]
        queued = [job for job, workers in present.items() if not workers and job not in ended]
        return running, queued, ended

    @staticmethod
    def _cancel(record: _Record, superfluous: Sequence[str], idle_s: float) -> list[str]:
        """Return the queued jobs that have not been needed for some time, and must be canceled."""
        decided_at = time.monotonic()
        jobs = superfluous if record.spec.cancellable else ()
        record.superfluous_since = {
            job: record.superfluous_since.get(job, decided_at) for job in jobs
        }
        return [
            job for job, since in record.superfluous_since.items() if decided_at - since >= idle_s
        ]

    def _drain(
        self, name: str, running: Mapping[str, Sequence[Any]], count: int
    ) -> dict[str, list[Any]]:
        """Drain jobs, and return those that have finished, and the states of their workers."""
        draining = self.records[name].draining
        before = len(draining)
        finished = draining.update(running, max(0, count))
        if len(draining) > before:
            self.records[name].drained_at = time.monotonic()
            logger.info(
                "Partition %r releases %d of %d jobs, because jobs of other users wait.",
                name,
                len(draining),
                len(running),
            )
        return finished

    def _idle(
        self, name: str, running: Mapping[str, Sequence[Any]], spare_jobs: float, bounds: JobBounds
    ) -> dict[str, list[Any]]:
        """Return the jobs to close and their workers, starting with the longest idle job.

        `spare_jobs` is the number of jobs that the partition does not need at the moment.
        """
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
        """Close workers to which no more tasks are assigned.

        If one of them turns out to be busy, all of them receive tasks again, and the result is
        False.
        """
        addresses = [worker.address for worker in workers]
        requests = (call_worker(self.scheduler, address, _is_busy) for address in addresses)
        try:
            busy = any(await asyncio.wait_for(asyncio.gather(*requests), _ANSWER_S))
        except (OSError, TimeoutError):  # the worker is stopped, or is leaving on its own
            busy = True
        if not busy and await retire_workers(self.scheduler, workers):
            # Kubernetes restarts the container of a closed worker until the container is removed.
            self._cancelled.update(str(worker.name) for worker in workers)
            return True
        for worker in workers:
            resume_assigning(self.scheduler, worker)
            if worker.address in self._busy_at:
                self._busy_at[worker.address] = time.monotonic()
        return False


def _is_busy(dask_worker: Any = None) -> bool:
    """Return whether a worker runs a task, or holds data that no client has fetched yet.

    The scheduler may not know about either.
    """
    return has_running_tasks(dask_worker) or holds_bytes()


# -- requests of the process that starts jobs ----------------------------------------------


def add_partitions(specs: Mapping[str, JobSpec], dask_scheduler: Any = None) -> None:
    """Create a record for each partition whose workers are started as jobs."""
    record = _adaptation_of(dask_scheduler) or AdaptivePartitions(dask_scheduler)
    if NAME not in dask_scheduler.plugins:
        dask_scheduler.add_plugin(record)
    for name, spec in specs.items():
        record.records[name] = _Record(spec, DrainingJobs(dask_scheduler, name))


async def advise_jobs(
    jobs: Mapping[str, Mapping[str, Sequence[str]]],
    queues: Sequence[QueueReport] = (),
    dask_scheduler: Any = None,
) -> dict[str, JobAdvice]:
    """Close idle workers, and return advice on each partition's jobs.

    `jobs` maps each partition to its jobs, and each job to the names of its workers. `queues`
    contains a report on each queue in which partitions yield to other users. Partitions with a
    fixed number of jobs are omitted from the result.
    """
    adaptation = _adaptation_of(dask_scheduler)
    if adaptation is None:
        return {}
    waiting = adaptation.waiting_slots()
    to_drain = adaptation.jobs_to_drain(jobs, queues)
    advice: dict[str, JobAdvice] = {}
    closing: list[tuple[str, str, list[Any]]] = []
    for name, jobs_of_partition in jobs.items():
        decision = adaptation.decide(
            name, jobs_of_partition, waiting.get(name, 0.0), to_drain.get(name)
        )
        if decision is None:
            continue
        advice[name] = decision.advice
        for job, workers in decision.idle.items():
            for worker in workers:  # in the same step of the event loop, so no task can arrive
                stop_assigning(dask_scheduler, worker)
            closing.append((name, job, workers))
    results = await asyncio.gather(*(adaptation.close_idle(workers) for *_, workers in closing))
    for (name, job, _), closed in zip(closing, results, strict=True):
        if closed:
            part = advice[name]
            advice[name] = replace(
                part,
                jobs_to_forget=[*part.jobs_to_forget, job],
                closed_jobs=part.closed_jobs + 1,
            )
    return advice


async def advise_groups(
    reports: Mapping[str, GroupReport], dask_scheduler: Any = None
) -> dict[str, GroupAdvice]:
    """Close idle workers, and return the size that each partition's worker group should have.

    Closed workers are listed in each response until a report confirms their removal, because an
    earlier response may have been lost.
    """
    adaptation = _adaptation_of(dask_scheduler)
    if adaptation is None:
        return {}
    jobs = {name: adaptation.group_jobs(name, report) for name, report in reports.items()}
    advice: dict[str, GroupAdvice] = {}
    for name, change in (await advise_jobs(jobs, dask_scheduler=dask_scheduler)).items():
        leaving = adaptation.records[name].leaving
        leaving.update(change.jobs_to_forget)
        size = len(jobs[name]) + change.jobs_to_start - len(change.jobs_to_forget)
        advice[name] = GroupAdvice(size, tuple(sorted(leaving)))
    return advice


# -- requests of clients, sent by `run_on_scheduler` -------------------------------------------


def set_bounds(name: str, bounds: JobBounds, dask_scheduler: Any = None) -> bool:
    """Change the allowed number of jobs, and return whether the partition has jobs at all."""
    record = _record(dask_scheduler, name)
    if record is not None:
        record.spec = replace(record.spec, bounds=bounds)
    return record is not None


def request_slots(name: str, slots: int, client_id: str, dask_scheduler: Any = None) -> bool:
    """Replace a client's request for slots in a partition, or end it if `slots` is 0.

    The result is False if the partition is not adaptive.
    """
    adaptation = _adaptation_of(dask_scheduler)
    # The last request of a client that was killed may arrive after the client was removed.
    if adaptation is None or client_id not in dask_scheduler.clients:
        return False
    adaptation.requested.pop((name, client_id), None)
    if slots:
        adaptation.requested[name, client_id] = slots
    return slots_of_new_worker(dask_scheduler, name) > 0


def adaptive_names(dask_scheduler: Any = None) -> set[str]:
    """Return the names of adaptive partitions, including those without workers."""
    adaptation = _adaptation_of(dask_scheduler)
    records = adaptation.records if adaptation else {}
    return {name for name, record in records.items() if record.spec.bounds is not None}


# -- functions for other modules, on the scheduler -------------------------------------------


def slots_of_new_worker(scheduler: Any, name: str) -> int:
    """Return how many slots a new worker would add, or 0 if the partition is not adaptive."""
    return _upper_bound(scheduler, name)[1]


def max_running_tasks(scheduler: Any, name: str, slots: int) -> int:
    """Return how many tasks a partition can run at a time once all of its jobs have started.

    `slots` is the number of slots that each task takes.
    """
    workers = scheduler.workers.values()
    running = sum(int(worker.resources.get(name, 0)) // slots for worker in workers)
    max_workers, slots_per_worker = _upper_bound(scheduler, name)
    return max(running, max_workers * (slots_per_worker // slots))


def max_slots(scheduler: Any, name: str) -> int:
    """Return the number of slots if all allowed jobs run, or 0 if the partition is not adaptive."""
    return math.prod(_upper_bound(scheduler, name))


def queued_jobs_of(scheduler: Any, name: str) -> int:
    """Return the number of an adaptive partition's jobs that are queued or starting."""
    record = _record(scheduler, name)
    if record is None or record.spec.bounds is None:
        return 0
    return record.queued_jobs if record.is_current else 0


def shared_queue_of(scheduler: Any, name: str) -> SharedQueue | None:
    """Return the state of the queue in which a partition yields to other users, or None."""
    record = _record(scheduler, name)
    if record is None or record.queue is None or not record.is_current:
        return None
    return SharedQueue(record.queue.waiting, len(record.draining), record.queue.problem)


def expects_workers(scheduler: Any, name: str) -> bool:
    """Return whether any job of a partition is queued, is starting, or can be started."""
    record = _record(scheduler, name)
    if record is None or not record.is_current:
        return False
    return record.spec.bounds is not None or record.queued_jobs > 0


def _upper_bound(scheduler: Any, name: str) -> tuple[int, int]:
    """Return the maximum number of workers and the number of slots per worker.

    Both are 0 if the partition is not adaptive.
    """
    record = _record(scheduler, name)
    if record is None or record.spec.bounds is None:
        return 0, 0
    return record.spec.bounds.maximum * record.spec.workers, record.spec.slots


def _adaptation_of(scheduler: Any) -> AdaptivePartitions | None:
    adaptation: AdaptivePartitions | None = scheduler.plugins.get(NAME)
    return adaptation


def _record(scheduler: Any, name: str) -> _Record | None:
    adaptation = _adaptation_of(scheduler)
    return adaptation.records.get(name) if adaptation else None
