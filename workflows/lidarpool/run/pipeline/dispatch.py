"""Dispatch batches to casting workers and collectors, and dispatch lost batches again.

Stage 1 (GENERATE) sends ranges of scans, which the dispatcher divides into batches. Stage 2
(INTERSECT) casts the batches on GPU workers, and stage 4 (COLLECT) writes them as parts.

The amount of work in flight is measured by the weight of batches (`policies.weight`). A small batch
has a weight of 1, and a task contains `per_task` small batches. A batch that fills half of the
memory of a task has half the weight of a full task.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Collection, Iterable, Mapping

from lidarfiles.parts.parts import part_name
from poolpart.task_locations import PartitionSnapshot

from . import policies
from .batches import Batch, BatchState, Outcome
from .casting_workers import CastingWorkers
from .failures import JobError
from .pipeline_job import PipelineJob
from .stage_messages import CollectOrder, ColumnsLost, Receipt, format_scans
from .stage_names import COLLECT, GENERATE, GPU, INTERSECT, LIDAR
from .task_records import TaskRecord

MIN_ADVICE_CHANGE = 0.2  # minimum relative change of the batch size that is sent to stage 1
PIECES = 16  # maximum number of pieces into which a batch that kills workers is divided


class Dispatcher:
    """Dispatcher of the batches of all jobs, which also isolates scans that kill workers.

    Parameters
    ----------
    workers
        Workers that cast the batches.
    collector_count
        Number of collectors, including those that are starting.
    mark
        Mark of the run, which is part of the file names of all parts.
    """

    def __init__(self, workers: CastingWorkers, collector_count: int, mark: str) -> None:
        self.batches: dict[tuple[int, int], Batch] = {}  # {(job, first scan): batch}
        self.failed: dict[PipelineJob, JobError] = {}  # failed jobs, until they are dropped
        self.advice = 1  # number of scans that stage 1 should send in each range
        self._workers = workers
        self._collector_count = collector_count
        self._mark = mark
        self._tasks: dict[str, list[Batch]] = {}  # {key of a casting task: uncommitted batches}
        self._batch_count = 0  # number of batches that have been created
        # Casting time in seconds and number of scans for each recently committed batch.
        self._recent_casts: deque[tuple[float, int]] = deque(maxlen=64)
        self._cast_seconds = 0.0  # casting time of all committed batches
        self._cast_scans = 0  # number of scans in all committed batches
        self.per_task = 1  # number of small batches in a casting task
        self.replayed = 0  # number of times that batches were offered again
        self.lost_workers: set[str] = set()  # addresses of workers that lost their batches
        # Batches that killed a worker alone before any batch of their job had been cast.
        self._first_deaths: dict[PipelineJob, list[Batch]] = {}

    def in_states(self, *states: BatchState) -> list[Batch]:
        """Return all batches in any of the given states."""
        return [batch for batch in self.batches.values() if batch.state in states]

    def _batches_of(self, job: PipelineJob) -> list[Batch]:
        return [batch for batch in self.batches.values() if batch.job is job]

    def _batches_within(self, receipt: Receipt) -> list[Batch]:
        """Return the uncommitted batches whose scans lie within a part.

        There are several batches if a batch was divided after its part had been written.
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
        """Maximum total weight of batches in flight, as defined by `policies.weight`."""
        slots = self._workers.slot_count
        return policies.max_weight_in_flight(slots, self._collector_count, self.per_task)

    def room(self, job: PipelineJob) -> float:
        """Return how many batches can still be added for a job, as their total weight.

        There is no room if the result is 0 or negative, or if too many batches have been created
        since the oldest batch of the job, because their scans have to be kept until it is done.
        """
        span = max((self._batch_count - batch.number for batch in self._batches_of(job)), default=0)
        if span >= policies.MAX_SPAN * self.max_weight:
            return 0
        return self.max_weight - policies.weight(self.batches.values(), self.per_task)

    def slots_wanted(self, scan_count: int) -> int:
        """Return how many casting slots to request for a number of scans, at least 1."""
        scan_s = self._cast_seconds / self._cast_scans if self._cast_scans else None
        return max(1, policies.slots_wanted(scan_count, scan_s))

    def _learn(self, records: list[tuple[PipelineJob, TaskRecord]]) -> None:
        """Adapt the sizes of batches and tasks to the casting times of committed batches.

        The `items` of each record are the scans in its batch.
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
        """Create batches for the scans in a range, except for scans that are already committed.

        Stage 1 has described these scans.
        """
        first = max(first, job.generated)  # stage 1 repeats scans after a restart
        if first < stop:
            job.trace("take", GENERATE, range(first, stop))
        job.generated = max(stop, job.generated)
        for missing_start, missing_stop in job.committed.parts.missing(first, stop):
            # The advice may be larger than the maximum size of a task for this job.
            for start in range(missing_start, missing_stop, job.scans_per_task):
                batch_stop = min(start + job.scans_per_task, missing_stop)
                number = self._batch_count
                self.batches[job.number, start] = Batch(job, start, batch_stop, number, number)
                self._batch_count += 1

    def offer(self) -> None:
        """Submit waiting batches to workers with room for further tasks."""
        waiting = sorted(
            self.in_states(BatchState.WAITING), key=lambda batch: (batch.order, batch.first)
        )
        if not waiting:
            return
        batches = [
            *waiting,
            *self.in_states(BatchState.CASTING, BatchState.CAST, BatchState.COLLECTING),
        ]
        chosen = policies.choose_offers(
            batches, self._workers.slots, self.max_weight, self.per_task
        )
        for task, worker in chosen:
            spans = [(batch.job.number, (batch.first, batch.stop)) for batch in task]
            key = self._workers.submit(spans, worker)
            self._tasks[key] = task
            for batch in task:
                batch.key = key
                batch.worker = worker
                batch.collector = ""
                batch.set_state(BatchState.CASTING)
                batch.job.trace("submit", INTERSECT, batch.scans)

    def check(self) -> None:
        """Update the batches whose casting tasks have finished.

        If the worker died or no longer has the scene, the batches are offered again. If casting
        failed in a task with several jobs, the batches are also offered again, but in a separate
        task for each job (`Outcome.SEPARATE_JOBS`). In a task with a single job, the job fails.
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
                    batch.set_state(BatchState.CAST)
                    batch.job.cast += len(batch)
                else:
                    self._offer_again(batch, outcome.value)
                    batch.single_job |= outcome is Outcome.SEPARATE_JOBS

    def reclaim_lost(self, locations: PartitionSnapshot) -> None:
        """Cast batches again whose workers are dead, unresponsive, late or paused."""
        prepared = len(self._workers.slots)
        late_s = policies.late_after_s(self._recent_casts)
        for batch in [*self.batches.values()]:
            if outcome := policies.find_loss(batch, locations, prepared, time.monotonic(), late_s):
                self._offer_again(batch, outcome.value)

    def _offer_again(
        self, batch: Batch, reason: str, state: BatchState = BatchState.WAITING
    ) -> None:
        """Change the state of a batch so that it is either cast or collected again."""
        if state is BatchState.WAITING:
            self._forget_task(batch)
        batch.set_state(state)
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
        """Separate a batch from its casting task, and release the task if it was the last batch."""
        key = batch.key
        batch.key = ""
        if (task_batches := self._tasks.get(key)) is not None:
            task_batches.remove(batch)
            if not task_batches:
                del self._tasks[key]
                self._workers.release_task(key)

    # -- batches that kill workers -----------------------------------------------------------

    def _blame(self, batch: Batch, stage: str, worker: str) -> None:
        """Attribute the death of a worker to a batch, which may be divided or condemned."""
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
                f"only {format_scans(batch.first, batch.stop)}"
                f"{self._workers.memory_clause(worker)}. See the logs of the {partition} workers."
            )
            self._remove(batch)
            self._fail_condemned(batch.job)

    def _fail_condemned(self, job: PipelineJob) -> None:
        if job.condemned and not self._batches_of(job):
            self.failed.setdefault(job, JobError("\n".join(job.condemned)))

    def _blame_scene(self, batch: Batch, worker: str) -> None:
        """Count the death of a worker before any batch of the job was cast.

        The cause may be the scene rather than the batch. A different batch is therefore tried next,
        and the job fails once several batches have killed a worker.
        """
        killers = self._first_deaths.setdefault(batch.job, [])
        # This batch may be a piece of an earlier one, which is then replaced.
        killers[:] = [k for k in killers if k.stop <= batch.first or batch.stop <= k.first]
        killers.append(batch)
        batch.order = self._batch_count
        self._batch_count += 1
        if len(killers) >= policies.MAX_KILLS:
            names = ", ".join(format_scans(killer.first, killer.stop) for killer in killers)
            error = JobError(
                f"{len(killers)} casting workers in a row died while casting their first batch "
                f"({names}){self._workers.memory_clause(worker)}. The scene may need more memory "
                "than they have. See their logs, or try a different backend."
            )
            self.failed.setdefault(batch.job, error)

    # -- stage 4 -----------------------------------------------------------------------------

    def assign(self, collectors: Mapping[str, str]) -> dict[str, list[CollectOrder]]:
        """Assign cast batches to collectors, and return the orders for each collector.

        `collectors` maps the names of running collectors to the addresses of their workers.
        """
        orders: dict[str, list[CollectOrder]] = {}
        if not (cast := self.in_states(BatchState.CAST)):
            return orders
        batches = [*cast, *self.in_states(BatchState.COLLECTING)]
        for task, name in policies.choose_handovers(batches, collectors):
            parts = []
            for batch in task:
                batch.collector = name
                number = batch.job.number
                first = batch.first
                batch.set_state(BatchState.COLLECTING)
                batch.job.trace("handon", COLLECT, batch.scans)
                part = part_name(self._mark, number, first, batch.stop)
                parts.append((number, (first, batch.stop), part))
            order = CollectOrder(task[0].key, task[0].worker, tuple(parts))
            orders.setdefault(name, []).append(order)
        return orders

    def recast_part(self, receipt: Receipt) -> None:
        """Cast the batches of a part again because the worker that held the part was lost."""
        self._recast_uncollected(self._batches_within(receipt), "its part was lost")

    def recast_columns(self, message: ColumnsLost) -> None:
        """Cast batches again because their columns could not be fetched."""
        # The message may come from a replaced collector, after the batches were offered again.
        task_batches = self._tasks.get(message.key, ())
        self._recast_uncollected([*task_batches], "its columns could not be fetched")

    def _recast_uncollected(self, batches: Iterable[Batch], reason: str) -> None:
        for batch in batches:
            if batch.state is BatchState.COLLECTING:
                self._offer_again(batch, reason)

    def release(self, committed: Iterable[tuple[PipelineJob, Receipt]]) -> None:
        """Remove the batches of committed parts, and adapt the size of further batches."""
        # {collector: earliest time at which one of its committed batches was assigned}
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
            # A collector processes its batches in order, so the time limit for its remaining
            # batches starts now.
            if waiting.collector in earliest_s and waiting.since >= earliest_s[waiting.collector]:
                waiting.set_state(BatchState.COLLECTING)
        self._learn(records)

    def reclaim_uncollected(self, died: Mapping[str, str], started: Collection[str]) -> None:
        """Reassign the batches of collectors that have died or restarted.

        Parameters
        ----------
        died
            Addresses of workers that died, by the name of their stage.
        started
            Names of the stages that were just started, and have not received earlier orders.
        """
        self.lost_workers.update(died.values())
        for batch in self.in_states(BatchState.COLLECTING):
            name = batch.collector
            if name in died or name in started:
                self._offer_again(batch, f"{name} was replaced", BatchState.CAST)
                if name in died:
                    self._blame(batch, COLLECT, died[name])
