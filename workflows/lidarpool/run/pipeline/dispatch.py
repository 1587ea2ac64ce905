"""Batches on their way through stages 2 and 4: who casts and stores them, and which come again."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Protocol

from poolpart.task_locations import TaskLocations

from ...columns.parts import part_name
from . import policies
from .batches import Batch, BatchState, Outcome
from .casting_workers import CastingWorkers
from .failures import JobError
from .messages import CollectOrder, ColumnsLost, Receipt, scans_in_words
from .names import COLLECT, GENERATE, GPU, INTERSECT, LIDAR
from .pipeline_job import PipelineJob
from .placement import TaskRecord

ADVISED_AGAIN = 0.2  # change of the scans in an item of stage 1 that is worth a request
PIECES = 16  # a failing batch is divided into so many


class Stages(Protocol):
    """Stages 1 and 4, as a dispatcher asks them."""

    collector_count: int  # wanted; some may be starting

    @property
    def collectors(self) -> Mapping[str, str]:
        """Collectors that take orders: {name: address of the worker}."""
        ...

    def advise(self, scans: int) -> None:
        """Have stage 1 put so many scans into an item from now on."""
        ...

    def send(self, name: str, messages: Sequence[CollectOrder]) -> None:
        """Send orders to a collector."""
        ...


class Dispatcher:
    """Has batches of all jobs cast and stored, and judges those with which workers die.

    Files of parts have the run's `mark`. Jobs that cannot be cast are in `failed`, until they are
    dropped.
    """

    def __init__(self, workers: CastingWorkers, stages: Stages, mark: str) -> None:
        self.batches: dict[tuple[int, int], Batch] = {}  # {(job, first scan): batch}
        self.failed: dict[PipelineJob, JobError] = {}
        self.advice = 1  # scans that stage 1 was told to put into an item
        self._workers = workers
        self._stages = stages
        self._mark = mark
        self._tasks: dict[str, list[Batch]] = {}  # {key of a casting task: its batches left}
        self._count = 0  # of batches so far
        self._last: deque[tuple[float, int]] = deque(maxlen=64)  # casting time and scans of batches
        self._total = (0.0, 0)  # casting time of scans, and their number
        self.per_task = 1  # small batches of a task
        # {job: batches that were tried alone before any was cast, each with a worker that died}
        self._first_deaths: dict[PipelineJob, list[Batch]] = {}

    def at(self, *places: BatchState) -> list[Batch]:
        """Batches in some states."""
        return [batch for batch in self.batches.values() if batch.place in places]

    def _of(self, job: PipelineJob) -> list[Batch]:
        return [batch for batch in self.batches.values() if batch.job is job]

    def _within(self, receipt: Receipt) -> list[Batch]:
        """Batches whose scans are all in a part."""
        job = receipt.job
        first = receipt.first
        stop = receipt.stop
        found = self.batches.get((job, first))
        if found is not None and found.stop == stop:
            return [found]
        there = (batch for batch in self.batches.values() if batch.job.number == job)
        return [batch for batch in there if first <= batch.first and batch.stop <= stop]

    # -- how much --------------------------------------------------------------------------

    @property
    def most(self) -> int:
        """Batches that may be under way, by weight."""
        slots = self._workers.slot_count
        collectors = self._stages.collector_count
        return policies.most_under_way(slots, collectors, self.per_task)

    def room(self, job: PipelineJob) -> float:
        """Batches that may be taken of a job, by weight; none far ahead of its oldest."""
        # How many batches the newest of all is ahead of the oldest of the job.
        span = max((self._count - batch.number for batch in self._of(job)), default=0)
        if span >= policies.SPAN * self.most:
            return 0
        return self.most - policies.weight(self.batches.values(), self.per_task)

    def slots_wanted(self, left: int) -> int:
        """Slots that so many scans are worth; at least 1."""
        seconds, scans = self._total
        return max(1, policies.slots_wanted(left, seconds / scans if scans else None))

    def _learn(self, records: list[tuple[PipelineJob, TaskRecord]]) -> None:
        """Take account of casting times, and advise stage 1 on the scans in one item."""
        for job, record in records:
            job.seconds += record.seconds
            self._last.append((record.seconds, record.items))
            self._total = (self._total[0] + record.seconds, self._total[1] + record.items)
        slots = self._workers.slot_count
        self.per_task = policies.batches_per_task(self._last, slots)
        for job, _ in records[-1:]:
            wanted = policies.scans_per_batch(
                self._last, job.scans_per_task, job.scans_of_run, slots
            )
            if abs(wanted - self.advice) > ADVISED_AGAIN * self.advice:  # it is a request
                self.advice = wanted
                self._stages.advise(wanted)

    # -- casting ---------------------------------------------------------------------------

    def take(self, job: PipelineJob, first: int, stop: int) -> None:
        """Take scans from stage 1; those that are not committed become batches."""
        first = max(first, job.generated)  # a restarted generator repeats some
        if first < stop:
            job.trace("take", GENERATE, range(first, stop))
        job.generated = max(stop, job.generated)
        for at, end in job.parts.missing(first, stop):
            for begin in range(
                at, end, job.scans_per_task
            ):  # the size was advised for another job perhaps
                batch = Batch(
                    job, begin, min(begin + job.scans_per_task, end), self._count, self._count
                )
                self.batches[job.number, begin] = batch
                self._count += 1

    def offer(self) -> bool:
        """Offer waiting batches to workers that have room."""
        waiting = sorted(self.at(BatchState.WAITING), key=lambda batch: (batch.order, batch.first))
        if not waiting:
            return False
        there = [*waiting, *self.at(BatchState.CASTING, BatchState.CAST, BatchState.COLLECTING)]
        chosen = policies.offers(there, self._workers.slots, self.most, self.per_task)
        for task, worker in chosen:
            spans = [(batch.job.number, (batch.first, batch.stop)) for batch in task]
            key = self._workers.cast(spans, worker)
            self._tasks[key] = task
            for batch in task:
                batch.key = key
                batch.worker = worker
                batch.collector = ""
                batch.move(BatchState.CASTING)
                batch.job.trace("submit", INTERSECT, batch.scans)
        return bool(chosen)

    def check(self) -> bool:
        """Look which casting tasks have ended."""
        moved = False
        for key, left in [*self._tasks.items()]:
            if left[0].place is not BatchState.CASTING:
                continue
            try:
                outcome = self._workers.outcome(key, left[0].worker)
            except JobError as error:
                self.failed.setdefault(left[0].job, error)
                continue
            for batch in [*left] if outcome is not Outcome.PENDING else ():
                moved = True
                if outcome is Outcome.DONE:
                    batch.move(BatchState.CAST)
                    batch.job.cast += len(batch)
                else:
                    self._again(batch, outcome.value)
                    batch.divided |= outcome is Outcome.DIVIDE
        return moved

    def leave_workers(self, seen: TaskLocations) -> None:
        """Offer batches again whose workers died, are silent, late, or take no tasks."""
        prepared = len(self._workers.slots)
        late_s = policies.late_after_s(self._last)
        for batch in [*self.batches.values()]:
            if why := policies.loss(batch, seen, prepared, time.monotonic(), late_s):
                self._again(batch, why.value)

    def _again(self, batch: Batch, reason: str, place: BatchState = BatchState.WAITING) -> None:
        """Return a batch to be cast again, or only to be collected again."""
        if place is BatchState.WAITING:
            self._forget(batch)
        batch.move(place)
        batch.job.offered_again += 1
        batch.job.trace("replay", INTERSECT, batch.scans, reason=reason)
        if reason == Outcome.DIED.value:
            self._blame(batch, INTERSECT, batch.worker)

    def _remove(self, batch: Batch) -> None:
        self._forget(batch)
        del self.batches[batch.job.number, batch.first]

    def drop(self, job: PipelineJob) -> None:
        """Remove all batches of a job that has ended."""
        for batch in self._of(job):
            self._remove(batch)
        self._first_deaths.pop(job, None)
        self.failed.pop(job, None)

    def _forget(self, batch: Batch) -> None:
        """Drop a batch's casting task, unless others of the same task need it."""
        key = batch.key
        batch.key = ""
        if (left := self._tasks.get(key)) is not None:
            left.remove(batch)
            if not left:
                del self._tasks[key]
                self._workers.forget(key)

    # -- poison batches ----------------------------------------------------------------------

    def _blame(self, batch: Batch, stage: str, worker: str) -> None:
        """Count the death of a worker against its batches, see `policies.kills`."""
        batch.deaths[stage] += 1
        kills = policies.kills(batch, stage)
        if stage == INTERSECT and not batch.job.cast and kills > 0:
            self._blame_scene(batch, worker)
        if kills > 0 and len(batch) > 1:
            self._remove(batch)
            for first in range(batch.first, batch.stop, -(-len(batch) // PIECES)):
                stop = min(first - (-len(batch) // PIECES), batch.stop)
                piece = Batch(batch.job, first, stop, batch.number, batch.order)
                piece.deaths[stage] = policies.SUSPECT_DEATHS
                self.batches[batch.job.number, first] = piece
        elif kills >= policies.KILLS_MOST:
            partition = GPU if stage == INTERSECT else LIDAR
            batch.job.condemned.append(
                f"{scans_in_words(batch.first, batch.stop)} kills the worker that runs stage "
                f"{stage}: {policies.KILLS_MOST} workers died, one after the other, with no other "
                f"scan in that stage{self._workers.words_on_memory(worker)}. Look into the logs of "
                f"the {partition} workers."
            )
            self._remove(batch)
            self._judge(batch.job)

    def _judge(self, job: PipelineJob) -> None:
        """Let a job with condemned batches fail once it has no others."""
        if job.condemned and not self._of(job):
            self.failed.setdefault(job, JobError("\n".join(job.condemned)))

    def _blame_scene(self, batch: Batch, worker: str) -> None:
        """Count a death with a batch alone, before any was cast: it may be the scene that kills.

        The next to be tried is another batch. The job fails once several have killed.
        """
        deaths = self._first_deaths.setdefault(batch.job, [])
        deaths[:] = [o for o in deaths if o.stop <= batch.first or batch.stop <= o.first] + [batch]
        batch.order = self._count
        self._count = self._count + 1
        if len(deaths) >= policies.KILLS_MOST:
            names = ", ".join(scans_in_words(one.first, one.stop) for one in deaths)
            error = JobError(
                f"Casting workers die whatever they cast first: {len(deaths)} died, one "
                f"after the other, with nothing but {names}"
                f"{self._workers.words_on_memory(worker)}. The scene may need more memory than "
                "they have: look into their logs, or try another backend."
            )
            self.failed.setdefault(batch.job, error)

    # -- stage 4 -----------------------------------------------------------------------------

    def hand_over(self) -> bool:
        """Assign batches that were cast to collectors."""
        if not (cast := self.at(BatchState.CAST)):
            return False
        orders: dict[str, list[CollectOrder]] = {}  # {collector: its message}
        there = [*cast, *self.at(BatchState.COLLECTING)]
        for task, name in policies.handovers(there, self._stages.collectors):
            parts = []
            for batch in task:
                batch.collector = name
                number = batch.job.number
                first = batch.first
                batch.move(BatchState.COLLECTING)
                batch.job.trace("handon", COLLECT, batch.scans)
                part = part_name(self._mark, number, first, batch.stop)
                parts.append((number, (first, batch.stop), part))
            order = CollectOrder(task[0].key, task[0].worker, tuple(parts))
            orders.setdefault(name, []).append(order)
        for name, messages in orders.items():
            self._stages.send(name, messages)
        return bool(orders)

    def lost_part(self, receipt: Receipt) -> None:
        """Have the batches of a part cast again that was lost with the worker that held it."""
        self._collect_in_vain(self._within(receipt), "its part was lost")

    def lost(self, message: ColumnsLost) -> None:
        """Have batches cast again whose columns could not be fetched."""
        # A replaced collector may report a batch that was offered again.
        left = self._tasks.get(message.key, ())
        self._collect_in_vain([*left], "its columns could not be fetched")

    def _collect_in_vain(self, batches: Iterable[Batch], reason: str) -> None:
        for batch in batches:
            if batch.place is BatchState.COLLECTING:
                self._again(batch, reason)

    def release(self, committed: Iterable[tuple[PipelineJob, Receipt]]) -> None:
        """Remove the batches of committed parts, and learn from their casting tasks."""
        waited: dict[str, float] = {}  # {collector: when it was given the first of them}
        records = []
        for job, receipt in committed:
            for batch in self._within(receipt):
                since = min(batch.since, waited.get(batch.collector, batch.since))
                waited[batch.collector] = since
                self._remove(batch)
            self._judge(job)
            if receipt.record is not None:
                records.append((job, receipt.record))
        for other in self.at(BatchState.COLLECTING) if waited else ():
            # Those behind them had to wait.
            if other.collector in waited and other.since >= waited[other.collector]:
                other.move(BatchState.COLLECTING)
        self._learn(records)

    def leave_collectors(self, died: Mapping[str, str], started: Collection[str]) -> None:
        """Take back the batches of collectors that died, {name: address}, or were replaced."""
        for batch in self.at(BatchState.COLLECTING):
            name = batch.collector
            if name in died or name in started:
                self._again(batch, f"{name} was replaced", BatchState.CAST)
                if name in died:
                    self._blame(batch, COLLECT, died[name])
