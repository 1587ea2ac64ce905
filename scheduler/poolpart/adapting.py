"""Partitions that grow with their work: what they lack, and which of their jobs may end.

A plugin of the scheduler has the record: how many jobs each partition may have, what clients want
of it, and when its workers last had work. Once a second the process that has the cluster object
(`clusters.py`) says which jobs there are, and is told how many to start and which have ended. The
scheduler decides, since only there nothing happens between a look at a worker and its closing: in
the step in which a worker is found idle it stops getting tasks. A job that still waits in the queue
is cancelled in the same way: if its worker joins after all, it is sent away before it gets a task.
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
from .fetch import holds_for_driver
from .internals.scheduler import (
    call,
    is_bound,
    is_idle,
    reopen,
    retire,
    shut,
    takes_tasks,
    turn_away,
    waiting_for_workers,
)
from .internals.worker import has_running_tasks
from .rules import check_count

NAME = "poolpart-adapting"
IDLE_S = 60.0  # a job that is not needed for so long ends
_ANSWER_S = 5.0  # for an idle worker to say that it runs nothing
_LOST_S = 120.0  # without a word of the process that starts jobs: it is gone


@dataclass(frozen=True)
class Bounds:
    """How many jobs a partition may have."""

    minimum: int
    maximum: int
    idle_s: float = IDLE_S

    @classmethod
    def checked(cls, name: str, minimum: Any, maximum: Any, idle_s: Any = IDLE_S) -> Bounds:
        """Check them; PoolError that says what is wrong."""
        check_count(f"The minimum of partition {name!r}", minimum, least=0)
        check_count(f"The maximum of partition {name!r}", maximum, least=max(1, minimum))
        if not isinstance(idle_s, int | float) or not 0 <= idle_s < math.inf:
            raise PoolError(
                f"idle_s of partition {name!r} is {idle_s!r}; give seconds, such as 60."
            )
        return cls(minimum, maximum, float(idle_s))


@dataclass(frozen=True)
class JobKind:
    """What the jobs of a partition are like."""

    slots: int  # of a worker
    workers: int = 1  # of a job
    bounds: Bounds | None = None  # None: their number is fixed


@dataclass(frozen=True)
class Advice:
    """What the process that starts jobs has to do for a partition."""

    more: int = 0  # jobs to start
    ended: Sequence[str] = ()  # jobs to forget: workers that have ended, jobs to be cancelled


@dataclass
class _Record:
    """One partition."""

    kind: JobKind
    coming: int = 0  # jobs whose workers are not here
    heard: float = 0.0  # when the process that starts jobs said so
    lacked: float = 0.0  # slots that were missing at the last look
    needless: dict[str, float] = field(default_factory=dict)  # {coming job: needless since}


class Adaptation(SchedulerPlugin):
    """The record of partitions whose jobs a cluster object starts."""

    name = NAME

    def __init__(self, scheduler: Any) -> None:
        self.scheduler = scheduler
        self.records: dict[str, _Record] = {}  # by partition
        self.wants: dict[tuple[str, str], int] = {}  # {(partition, client): slots}
        self._used: dict[str, float] = {}  # {address: when the worker last had work}
        self._cancelled: set[str] = set()  # names of workers whose jobs were; no other has them

    # -- what happens on the scheduler -------------------------------------------------

    def add_worker(self, scheduler: Any, worker: str) -> None:
        """Begin to count idle time; send a worker away whose job was cancelled meanwhile."""
        self._used[worker] = time.monotonic()
        state = scheduler.workers[worker]
        if str(state.name) in self._cancelled:
            turn_away(scheduler, state)

    def remove_worker(self, scheduler: Any, worker: str, **kwargs: Any) -> None:
        """Forget a worker."""
        self._used.pop(worker, None)

    def transition(
        self, key: Any, start: str, finish: str, *args: Any, worker: str = "", **kwargs: Any
    ) -> None:
        """Note when a worker last ended a task: looks once a second would miss short ones."""
        if start == "processing" and worker in self._used:
            self._used[worker] = time.monotonic()

    def remove_client(self, scheduler: Any, client: str) -> None:
        """Forget what a client wanted."""
        for partition, other in list(self.wants):
            if other == client:
                del self.wants[partition, other]

    # -- looks ------------------------------------------------------------------------

    def waiting_slots(self) -> dict[str, float]:
        """Slots that tasks wait for without any worker, by partition."""
        waiting: dict[str, float] = {}
        for task in waiting_for_workers(self.scheduler):  # there may be 100,000
            if (asked := task.resource_restrictions) and not is_bound(task):
                for name, slots in asked.items():
                    waiting[name] = waiting.get(name, 0.0) + slots
        return waiting

    def lacking(self, name: str, waiting: float, enough: float) -> float:
        """Slots that a partition lacks, at most `enough`; below 0 slots that nobody needs.

        Tasks that are bound to a worker, or run for long there, take its slots; all others may run
        on any worker of the partition, also a new one.
        """
        total = free = 0.0
        movable = waiting
        everybody = self.scheduler.workers.values()
        members = [w for w in everybody if w.resources.get(name) and takes_tasks(w)]
        limit = enough + sum(worker.resources[name] for worker in members)
        for worker in members:
            slots = worker.resources[name]
            held = 0.0
            for task in worker.processing:
                if movable >= limit:  # it may have thousands
                    return enough
                takes = (task.resource_restrictions or {}).get(name, 0)
                if is_bound(task) or task in worker.long_running:
                    held += takes
                else:
                    movable += takes
            total += slots
            free += max(0.0, slots - held)
        wanted = sum(n for (partition, _), n in self.wants.items() if partition == name)
        return min(enough, max(movable - free, wanted - total))

    def decide(
        self, name: str, jobs: Mapping[str, Sequence[str]], waiting: float
    ) -> tuple[Advice, dict[str, list[Any]]] | None:
        """Decide about a partition; returns what to do, and workers to close, by job.

        None if the number of its jobs is fixed. `jobs` are the names of the workers of each job,
        the newest last.
        """
        record, now = self.records[name], time.monotonic()
        by_name = {str(worker.name): worker for worker in self.scheduler.workers.values()}
        workers = {job: [by_name[n] for n in names if n in by_name] for job, names in jobs.items()}
        begun = {job: group for job, group in workers.items() if group}
        gone = [job for job, names in jobs.items() if self._cancelled.issuperset(names)]
        queued = [job for job, group in workers.items() if not group and job not in gone]
        record.coming, record.heard = len(queued), now
        bounds = record.kind.bounds
        if bounds is None:
            return None
        each = record.kind.slots * record.kind.workers
        lacks = self.lacking(name, waiting, float(bounds.maximum * each))
        # What is still there at the next look: a moment's work is done before a job begins.
        steady, record.lacked = min(lacks, record.lacked), lacks

        def needed(slots: float) -> int:
            jobs = math.ceil(max(0.0, slots) / each)
            least, most = bounds.minimum - len(begun), bounds.maximum - len(begun)
            return max(0, min(max(jobs, least), most))

        needless = queued[needed(lacks) :]
        record.needless = {job: record.needless.get(job, now) for job in needless}
        cancelled = [j for j, since in record.needless.items() if now - since >= bounds.idle_s]
        self._cancelled.update(worker for job in cancelled for worker in jobs[job])
        more = max(0, needed(steady) - len(queued))
        # Also those of which an earlier answer did not arrive.
        return Advice(more, [*cancelled, *gone]), self._idle(
            name, begun, -lacks / each, bounds, now
        )

    def _idle(
        self,
        name: str,
        begun: Mapping[str, Sequence[Any]],
        spare: float,
        bounds: Bounds,
        now: float,
    ) -> dict[str, list[Any]]:
        """Choose workers to close, by job: those idle for longest, at most `spare` jobs."""
        since: dict[str, float] = {}
        ours = {j: g for j, g in begun.items() if all(w.resources.get(name) for w in g)}
        for job, group in ours.items():
            for worker in group:
                if not is_idle(self.scheduler, worker):
                    self._used[worker.address] = now
            since[job] = max(self._used.setdefault(w.address, now) for w in group)
        most = max(0, min(len(ours) - bounds.minimum, math.floor(spare)))
        idle = sorted((j for j in ours if now - since[j] >= bounds.idle_s), key=since.__getitem__)
        return {job: [*ours[job]] for job in idle[:most]}

    async def close_idle(self, workers: Sequence[Any]) -> bool:
        """Close workers that get no more tasks; False if one was busy after all, and all stay."""
        addresses = [worker.address for worker in workers]
        asking = (call(self.scheduler, address, _is_busy) for address in addresses)
        try:
            busy = any(await asyncio.wait_for(asyncio.gather(*asking), _ANSWER_S))
        except (OSError, TimeoutError):  # stopped, or leaving by itself
            busy = True
        if not busy and await retire(self.scheduler, workers):
            return True
        for worker in workers:
            reopen(self.scheduler, worker)
            if worker.address in self._used:
                self._used[worker.address] = time.monotonic()
        return False


def _is_busy(dask_worker: Any = None) -> bool:
    """Whether a worker has something that its scheduler does not know of."""
    return has_running_tasks(dask_worker) or holds_for_driver()


# -- requests of the process that starts jobs ----------------------------------------------


def begin(kinds: Mapping[str, JobKind], dask_scheduler: Any = None) -> None:
    """Make the record of partitions that are started."""
    record = _of(dask_scheduler) or Adaptation(dask_scheduler)
    if NAME not in dask_scheduler.plugins:
        dask_scheduler.add_plugin(record)
    for name, kind in kinds.items():
        record.records[name] = _Record(kind)


async def look(
    jobs: Mapping[str, Mapping[str, Sequence[str]]], dask_scheduler: Any = None
) -> dict[str, Advice]:
    """Advise the process that starts jobs; idle workers have been closed when this returns.

    `jobs` are the names of each job's workers, by partition. There is no advice on partitions
    whose number of jobs is fixed.
    """
    record = _of(dask_scheduler)
    if record is None:
        return {}
    waiting = record.waiting_slots()
    advice: dict[str, Advice] = {}
    closing: list[tuple[str, str, list[Any]]] = []
    for name, own in jobs.items():
        if (decided := record.decide(name, own, waiting.get(name, 0.0))) is None:
            continue
        advice[name], idle = decided
        for job, workers in idle.items():
            for worker in workers:  # before anything else can happen
                shut(dask_scheduler, worker)
            closing.append((name, job, workers))
    closed = await asyncio.gather(*(record.close_idle(workers) for *_, workers in closing))
    for (name, job, _), done in zip(closing, closed, strict=True):
        if done:
            advice[name] = Advice(advice[name].more, [*advice[name].ended, job])
    return advice


# -- requests of clients, by `on_scheduler` ----------------------------------------------------


def adapt(name: str, bounds: Bounds, dask_scheduler: Any = None) -> bool:
    """Let a partition have another number of jobs; False if nobody starts any for it."""
    record = _record(dask_scheduler, name)
    if record is not None:
        record.kind = replace(record.kind, bounds=bounds)
    return record is not None


def want(name: str, slots: int, asking: str, dask_scheduler: Any = None) -> bool:
    """Want slots of a partition, for a client; see `Partition.want`."""
    adaptation = _of(dask_scheduler)
    # The last request of a client that was killed may come after it has left.
    if adaptation is None or asking not in dask_scheduler.clients:
        return False
    adaptation.wants.pop((name, asking), None)
    if slots:
        adaptation.wants[name, asking] = slots
    return slots_of_new(dask_scheduler, name) > 0


def running_most(name: str, slots: int, dask_scheduler: Any = None) -> int:
    """Tasks of so many slots that a partition runs at a time, or will with all its jobs."""
    members = dask_scheduler.workers.values()
    here = sum(int(worker.resources.get(name, 0)) // slots for worker in members)
    workers, each = _at_most(dask_scheduler, name)
    return max(here, workers * (each // slots))


def adaptive_names(dask_scheduler: Any = None) -> set[str]:
    """Names of the partitions that grow with their work; they may be empty."""
    adaptation = _of(dask_scheduler)
    records = adaptation.records if adaptation else {}
    return {name for name, record in records.items() if record.kind.bounds is not None}


# -- for other requests, on the scheduler ----------------------------------------------------


def slots_of_new(scheduler: Any, name: str) -> int:
    """Slots of a worker that a partition may get; 0 if it has a fixed number of them."""
    return _at_most(scheduler, name)[1]


def slots_at_most(scheduler: Any, name: str) -> int:
    """Slots that a partition may come to have; 0 if it has a fixed number of workers."""
    return math.prod(_at_most(scheduler, name))


def jobs_coming(scheduler: Any, name: str) -> int:
    """Jobs of an adaptive partition that wait in the queue, or start; 0 if nobody starts them."""
    record = _record(scheduler, name)
    if record is None or record.kind.bounds is None or time.monotonic() - record.heard > _LOST_S:
        return 0
    return record.coming


def _at_most(scheduler: Any, name: str) -> tuple[int, int]:
    """Workers that an adaptive partition may have, and slots of each; 0 if it has others."""
    record = _record(scheduler, name)
    if record is None or record.kind.bounds is None:
        return 0, 0
    return record.kind.bounds.maximum * record.kind.workers, record.kind.slots


def _of(scheduler: Any) -> Adaptation | None:
    adaptation: Adaptation | None = scheduler.plugins.get(NAME)
    return adaptation


def _record(scheduler: Any, name: str) -> _Record | None:
    adaptation = _of(scheduler)
    return adaptation.records.get(name) if adaptation else None
