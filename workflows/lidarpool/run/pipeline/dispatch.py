"""Dispatches batches to casting workers and collectors, and offers lost batches again.

Stage 1 (GENERATE) sends ranges of scans. The dispatcher makes batches of the ranges. Stage 2
(INTERSECT) casts batches on GPU workers. Stage 4 (COLLECT) writes them as parts. A batch is
WAITING, CASTING, CAST or COLLECTING (`BatchState`). Amounts of work are weights: a task takes
`per_task` small batches, each of weight 1, and a batch that fills half of a task's memory has the
weight of half a task (`policies.weight`).
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Collection, Iterable, Mapping

from poolpart.task_locations import PartitionSnapshot

from ...columns.parts import part_name
from . import policies
from .batches import Batch, BatchState, Outcome
from .casting_workers import CastingWorkers
from .failures import JobError
from .pipeline_job import PipelineJob
from .stage_messages import CollectOrder, ColumnsLost, Receipt, scans_in_words
from .stage_names import COLLECT, GENERATE, GPU, INTERSECT, LIDAR
from .task_records import TaskRecord

MIN_ADVICE_CHANGE = 0.2  # relative change of the advice that is worth a message to stage 1
PIECES = 16  # batches, at most, that a batch is divided into when its worker has died with it alone


class Dispatcher:
    """Dispatches the batches of all jobs, and isolates scans that kill their workers.

    Jobs that cannot be cast are in `failed`, until they are dropped.

    Parameters
    ----------
    workers
        Workers that cast the batches.
    collector_count
        Number of collectors, including those that are starting.
    mark
        Text of the run, which is in the file names of all parts.
    """

    def __init__(self, workers: CastingWorkers, collector_count: int, mark: str) -> None:
        self.batches: dict[tuple[int, int], Batch] = {}  # {(job, first scan): batch}
        self.failed: dict[PipelineJob, JobError] = {}
        self.advice = 1  # scans of a batch, which each range from stage 1 should have
        self._workers = workers
        self._collector_count = collector_count
        self._mark = mark
        self._tasks: dict[str, list[Batch]] = {}  # {key of a casting task: uncommitted batches}
        self._batch_count = 0  # batches so far
        # Casting time in seconds and number of scans of each of the last committed batches.
        self._recent_casts: deque[tuple[float, int]] = deque(maxlen=64)
        self._cast_seconds = 0.0  # casting time of all committed batches
        self._cast_scans = 0  # scans of all committed batches
        self.per_task = 1  # small batches that are cast in one task
        self.replayed = 0  # batches that were offered again, of all jobs
        self.lost_workers: set[str] = set()  # addresses of workers whose batches were lost
        # {job: batches that killed a worker, tried alone before any batch of the job was cast}
        self._first_deaths: dict[PipelineJob, list[Batch]] = {}

    def in_states(self, *states: BatchState) -> list[Batch]:
        """Return the batches that are in any of the given states."""
        return [batch for batch in self.batches.values() if batch.state in states]

    def _batches_of(self, job: PipelineJob) -> list[Batch]:
        return [batch for batch in self.batches.values() if batch.job is job]

    def _batches_within(self, receipt: Receipt) -> list[Batch]:
        """Return the uncommitted batches whose scans are all in a part.

        There are several if the batch was divided after its part was written.
        """
        first = receipt.first
        stop = receipt.stop
        exact_match = self.batches.get((receipt.job, first))
        if exact_match is not None and exact_match.stop == stop:
            return [exact_match]
        return [
            batch
            for batch in self.batches.values()
            if batch.job.number == receipt.job and first <= batch.first and batch.stop <= stop
        ]

    # -- amount of work in flight -----------------------------------------------------------

    @property
    def max_weight(self) -> int:
        """Largest permitted weight of the batches in flight (`policies.weight`)."""
        slots = self._workers.slot_count
        return policies.max_under_way(slots, self._collector_count, self.per_task)

    def room(self, job: PipelineJob) -> float:
        """Return the weight of further batches of a job that may be in flight, if positive.

        The job has no room if many batches of any jobs are younger than the oldest batch of this
        job: the sorter, and the memory, would have to hold their scans.
        """
        span = max((self._batch_count - batch.number for batch in self._batches_of(job)), default=0)
        if span >= policies.MAX_SPAN * self.max_weight:
            return 0
        return self.max_weight - policies.weight(self.batches.values(), self.per_task)

    def slots_wanted(self, scan_count: int) -> int:
        """Return the number of casting slots that `scan_count` scans are worth, at least 1."""
        scan_s = self._cast_seconds / self._cast_scans if self._cast_scans else None
        return max(1, policies.slots_wanted(scan_count, scan_s))

    def _learn(self, records: list[tuple[PipelineJob, TaskRecord]]) -> None:
        """Update the sizes of batches and tasks from casting times.

        Each record is of one batch: its casting time, and in `items` its number of scans.
        """
        for job, record in records:
            job.seconds += record.seconds
            self._recent_casts.append((record.seconds, record.items))
            self._cast_seconds += record.seconds
            self._cast_scans += record.items
        slots = self._workers.slot_count
        self.per_task = policies.batches_per_task(self._recent_casts, slots)
        for job, _ in records[-1:]:
            advice = policies.scans_per_batch(
                self._recent_casts, job.scans_per_task, job.scans_of_run, slots
            )
            if abs(advice - self.advice) > MIN_ADVICE_CHANGE * self.advice:
                self.advice = advice

    # -- casting ---------------------------------------------------------------------------

    def add_scans(self, job: PipelineJob, first: int, stop: int) -> None:
        """Make batches of the uncommitted scans in a range that stage 1 has sent."""
        first = max(first, job.generated)  # a restarted generator repeats scans
        if first < stop:
            job.trace("take", GENERATE, range(first, stop))
        job.generated = max(stop, job.generated)
        for missing_start, missing_stop in job.committed.parts.missing(first, stop):
            # The advised size may exceed the memory of this job's casting tasks.
            for start in range(missing_start, missing_stop, job.scans_per_task):
                batch_stop = min(start + job.scans_per_task, missing_stop)
                number = self._batch_count
                self.batches[job.number, start] = Batch(job, start, batch_stop, number, number)
                self._batch_count += 1

    def offer(self) -> None:
        """Offer waiting batches to workers that have room."""
        waiting = sorted(
            self.in_states(BatchState.WAITING), key=lambda batch: (batch.order, batch.first)
        )
        if not waiting:
            return
        batches = [
            *waiting,
            *self.in_states(BatchState.CASTING, BatchState.CAST, BatchState.COLLECTING),
        ]
        chosen = policies.offers(batches, self._workers.slots, self.max_weight, self.per_task)
        for task, worker in chosen:
            spans = [(batch.job.number, (batch.first, batch.stop)) for batch in task]
            key = self._workers.submit(spans, worker)
            self._tasks[key] = task
            for batch in task:
                batch.key = key
                batch.worker = worker
                batch.collector = ""
                batch.move(BatchState.CASTING)
                batch.job.trace("submit", INTERSECT, batch.scans)

    def check(self) -> None:
        """Update the batches of casting tasks that have ended.

        If the worker died or no longer has the job's scene, the batches are offered again. If
        casting has failed, and the task had batches of several jobs, they are offered again, too,
        each in a task with batches of one job only (`Outcome.SEPARATE_JOBS`). With batches of a
        single job, the job fails.
        """
        for key, task_batches in [*self._tasks.items()]:
            if task_batches[0].state is not BatchState.CASTING:
                continue
            try:
                outcome = self._workers.outcome(key, task_batches[0].worker)
            except JobError as error:
                self.failed.setdefault(task_batches[0].job, error)
                continue
            if outcome is Outcome.PENDING:
                continue
            for batch in [*task_batches]:
                if outcome is Outcome.DONE:
                    batch.move(BatchState.CAST)
                    batch.job.cast += len(batch)
                else:
                    self._offer_again(batch, outcome.value)
                    batch.single_job |= outcome is Outcome.SEPARATE_JOBS

    def reclaim_lost(self, locations: PartitionSnapshot) -> None:
        """Offer batches again whose workers died, are silent or late, or take no tasks."""
        prepared = len(self._workers.slots)
        late_s = policies.late_after_s(self._recent_casts)
        for batch in [*self.batches.values()]:
            if outcome := policies.loss(batch, locations, prepared, time.monotonic(), late_s):
                self._offer_again(batch, outcome.value)

    def _offer_again(
        self, batch: Batch, reason: str, state: BatchState = BatchState.WAITING
    ) -> None:
        """Queue a batch to be cast again, or only to be collected again."""
        if state is BatchState.WAITING:
            self._forget_task(batch)
        batch.move(state)
        self.replayed += 1
        if reason in (Outcome.DIED.value, Outcome.GONE.value):
            self.lost_workers.add(batch.worker)
        batch.job.trace("replay", INTERSECT, batch.scans, reason=reason)
        if reason == Outcome.DIED.value:
            self._blame(batch, INTERSECT, batch.worker)

    def _remove(self, batch: Batch) -> None:
        self._forget_task(batch)
        del self.batches[batch.job.number, batch.first]

    def drop(self, job: PipelineJob) -> None:
        """Remove all batches of a job that has ended."""
        for batch in self._batches_of(job):
            self._remove(batch)
        self._first_deaths.pop(job, None)
        self.failed.pop(job, None)

    def _forget_task(self, batch: Batch) -> None:
        """Detach a batch from its casting task, and end the task after its last batch."""
        key = batch.key
        batch.key = ""
        if (task_batches := self._tasks.get(key)) is not None:
            task_batches.remove(batch)
            if not task_batches:
                del self._tasks[key]
                self._workers.forget(key)

    # -- poison batches ----------------------------------------------------------------------

    def _blame(self, batch: Batch, stage: str, worker: str) -> None:
        """Count the death of a worker against its batch, and divide or condemn the batch."""
        batch.deaths[stage] += 1
        kills = policies.kills_alone(batch, stage)
        if stage == INTERSECT and not batch.job.cast and kills > 0:
            self._blame_scene(batch, worker)
        if kills > 0 and len(batch) > 1:
            self._remove(batch)
            for first in range(batch.first, batch.stop, -(-len(batch) // PIECES)):
                stop = min(first - (-len(batch) // PIECES), batch.stop)
                piece = Batch(batch.job, first, stop, batch.number, batch.order)
                piece.deaths[stage] = policies.SUSPECT_DEATHS
                self.batches[batch.job.number, first] = piece
        elif kills >= policies.MAX_KILLS:
            partition = GPU if stage == INTERSECT else LIDAR
            batch.job.condemned.append(
                f"{policies.MAX_KILLS} workers in a row died in stage {stage} while they processed "
                f"only {scans_in_words(batch.first, batch.stop)}"
                f"{self._workers.memory_clause(worker)}. See the logs of the {partition} workers."
            )
            self._remove(batch)
            self._fail_condemned(batch.job)

    def _fail_condemned(self, job: PipelineJob) -> None:
        """Fail a job that has condemned batches, once no batch of the job is left."""
        if job.condemned and not self._batches_of(job):
            self.failed.setdefault(job, JobError("\n".join(job.condemned)))

    def _blame_scene(self, batch: Batch, worker: str) -> None:
        """Count a death with a batch alone before any batch of the job was cast.

        The scene itself may kill the workers. Another batch is tried next, and the job fails once
        several batches have killed a worker.
        """
        killers = self._first_deaths.setdefault(batch.job, [])
        # Not those that overlap with this batch: it is a piece of them.
        killers[:] = [k for k in killers if k.stop <= batch.first or batch.stop <= k.first]
        killers.append(batch)
        batch.order = self._batch_count
        self._batch_count += 1
        if len(killers) >= policies.MAX_KILLS:
            names = ", ".join(scans_in_words(killer.first, killer.stop) for killer in killers)
            error = JobError(
                f"{len(killers)} casting workers in a row died while casting their first batch "
                f"({names}){self._workers.memory_clause(worker)}. The scene may need more memory "
                "than they have. See their logs, or try a different backend."
            )
            self.failed.setdefault(batch.job, error)

    # -- stage 4 -----------------------------------------------------------------------------

    def assign(self, collectors: Mapping[str, str]) -> dict[str, list[CollectOrder]]:
        """Assign batches that were cast to collectors, and return the orders of each collector.

        `collectors` maps the name of each running collector to the address of its worker.
        """
        orders: dict[str, list[CollectOrder]] = {}
        if not (cast := self.in_states(BatchState.CAST)):
            return orders
        batches = [*cast, *self.in_states(BatchState.COLLECTING)]
        for task, name in policies.handovers(batches, collectors):
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
        return orders

    def recast_part(self, receipt: Receipt) -> None:
        """Cast the batches of a part again, which was lost with the worker that held the part."""
        self._recast_uncollected(self._batches_within(receipt), "its part was lost")

    def recast_columns(self, message: ColumnsLost) -> None:
        """Cast batches again whose columns could not be fetched."""
        # A replaced collector may report a batch that was offered again.
        task_batches = self._tasks.get(message.key, ())
        self._recast_uncollected([*task_batches], "its columns could not be fetched")

    def _recast_uncollected(self, batches: Iterable[Batch], reason: str) -> None:
        """Offer the COLLECTING batches again, to be cast, and skip batches in any further state."""
        for batch in batches:
            if batch.state is BatchState.COLLECTING:
                self._offer_again(batch, reason)

    def release(self, committed: Iterable[tuple[PipelineJob, Receipt]]) -> None:
        """Remove the batches of committed parts, and learn from their casting tasks."""
        # {collector: the earliest time at which it was assigned one of the committed batches}
        earliest_s: dict[str, float] = {}
        records = []
        for job, receipt in committed:
            for batch in self._batches_within(receipt):
                since = min(batch.since, earliest_s.get(batch.collector, batch.since))
                earliest_s[batch.collector] = since
                self._remove(batch)
            self._fail_condemned(job)
            if receipt.record is not None:
                records.append((job, receipt.record))
        waiting_batches = [*self.in_states(BatchState.COLLECTING)] if earliest_s else []
        for waiting in waiting_batches:
            # A collector takes its batches in order. Batches behind the committed batches had to
            # wait: the time after which they are late starts now.
            if waiting.collector in earliest_s and waiting.since >= earliest_s[waiting.collector]:
                waiting.move(BatchState.COLLECTING)
        self._learn(records)

    def reclaim_uncollected(self, died: Mapping[str, str], started: Collection[str]) -> None:
        """Take back the batches of collectors, to be collected by another collector.

        `died` are the collectors whose workers died, {name: address of the worker}; `started` are
        the names of stages that were started now, which do not know earlier orders.
        """
        self.lost_workers.update(died.values())
        for batch in self.in_states(BatchState.COLLECTING):
            name = batch.collector
            if name in died or name in started:
                self._offer_again(batch, f"{name} was replaced", BatchState.CAST)
                if name in died:
                    self._blame(batch, COLLECT, died[name])
