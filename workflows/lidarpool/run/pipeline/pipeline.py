"""The pipeline: it offers batches of all jobs, commits their parts and sorts their frames.

The driver and four stages exchange messages (`stage_messages.py`):

1. GENERATE describes scans: it finds out that the survey defines them, and reports ranges of scans,
   and the driver makes batches of the ranges;
2. INTERSECT casts batches on GPU workers, in short tasks;
3. SORT, the sorter, puts summaries of committed scans into scan order, for frames;
4. COLLECT, several collectors, writes the points of each batch as a part into storage.

A summary of a scan has its numbers of hits and points, and the ends of a few sample rays.

Everything happens in `step`, called repeatedly from one thread; no call in `step` waits for long.
A step calls nobody back: it returns the new parts, the next frames and the jobs that have ended.
There is one rule of recovery: uncommitted batches are offered again, and frames that were not
handed out are sorted again, whatever was lost. Messages that arrive twice do no harm: a second
receipt of a scan is ignored, and its part is the same file with the same bytes. The number of
batches in flight, and the distance of the last to the first, are limited: that bounds every queue,
and the memory of sorter and workers.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Protocol

from lidarsim.scene.scene import Scene
from lidarsim.survey.survey import Survey

from .casting_workers import CastingWorkers
from .committed_results import CommittedResults
from .dispatch import Dispatcher
from .failures import JobError
from .long_stages import LongStages
from .pipeline_job import PipelineJob
from .stage_messages import ColumnsLost, Description, Failed, Message, Receipt, ScanRange, Summaries
from .stage_names import COLLECT, GENERATE, SORT
from .task_book import TaskBook

STALL_S = 60.0  # time without frames of the sorter, after which it gets its summaries again
WAIT_S = 0.05  # wait for news while the driver is idle
LINGER_S = 0.004  # wait for more news after the first, for each job or batch of a task
MAX_LINGERS = 25  # jobs or batches that are counted for that wait
CLOSING_S = 0.001  # wait for news while the stages end
ANNOUNCED = 2  # jobs that stage 1 should have ahead at least, whatever their size


class Commits(Protocol):
    """Interface of the run's database, where parts are committed."""

    def commit(self, receipts: Iterable[tuple[CommittedResults, Receipt]]) -> list[Receipt]:
        """Commit parts of jobs, and return the parts that were not committed before."""
        ...

    def summaries(self, part: Receipt) -> bytes:
        """Return the summaries of a committed part's scans, bytes of a `summary_type` array."""
        ...


@dataclass
class PipelineNews:
    """What a step of the pipeline has achieved, for its caller to use in this order."""

    parts: list[Receipt] = field(default_factory=list)  # newly committed parts
    # Next scans of jobs with frames, to be handed out. Scans that were handed out may be included.
    frames: list[tuple[PipelineJob, Summaries]] = field(default_factory=list)
    # Jobs that have ended, each with its error or None.
    ended: list[tuple[PipelineJob, JobError | None]] = field(default_factory=list)


class Pipeline:
    """The driver's side of the four stages, which jobs pass on the partitions of a cluster.

    `workers` (stage 2) and `stages` (stages 1, 3 and 4) are the only access to Dask, so that tests
    can replace the cluster. Parts are committed in `commits`. The `mark`, a text of the run, is in
    the file names of all parts.
    """

    def __init__(
        self, workers: CastingWorkers, stages: LongStages, commits: Commits, mark: str
    ) -> None:
        self.workers = workers
        self.stages = stages
        self._commits = commits
        self.dispatcher = Dispatcher(workers, stages.collector_count, mark)
        self.jobs: dict[int, PipelineJob] = {}  # {number: a job that is being cast}
        # Times and workers of the batches of stage 2 and, after `finish`, of the long stages.
        self.book = TaskBook()
        self.progress = 0  # number of scans that were committed, plus scans that were sorted
        # {job: end of its scans}, in the order of stage 1, until stage 1 has described all
        self._announced: dict[int, int] = {}
        self._messages: list[Message] = []  # received since the last step
        self._news = PipelineNews()  # since the last step

    # -- jobs --------------------------------------------------------------------------------

    def begin(
        self,
        committed: CommittedResults,
        scene: Scene,
        survey: Survey,
        *,
        scans_per_task: int,
        scans_of_run: int = 0,
    ) -> PipelineJob:
        """Add a job to the pipeline. Committed scans of the job are not cast again.

        Parameters
        ----------
        committed
            Scans of the job, and its committed results.
        scene, survey
            Scene, and the sensors and scans of the survey.
        scans_per_task
            Scans that fit into the memory of a casting task.
        scans_of_run
            Scans of the jobs of the run that have not ended, if all are like this job.

        Raises
        ------
        JobError
            If the job cannot be sent to workers.
        """
        packed, scene_name = self.workers.add(committed.number, scene, survey)
        job = PipelineJob(
            committed=committed,
            run=self.stages.run,
            scene_name=scene_name,
            scans_per_task=scans_per_task,
            scans_of_run=max(scans_of_run, len(committed.scans)),
            packed=packed,
        )
        self.jobs[job.number] = job
        self._describe([job])
        self._sort_again([job])
        self._end_complete([job])
        return job

    @property
    def has_room(self) -> bool:
        """True if another job should begin, so that stage 1 always has scans to describe."""
        max_weight = self.dispatcher.max_weight
        advice = self.dispatcher.advice
        if len(self.jobs) >= max_weight:
            return False
        if len(self._announced) < ANNOUNCED:
            return True
        jobs = [self.jobs[number] for number in self._announced if number in self.jobs]
        to_come = sum(
            -(-(j.scans.stop - j.generated) // min(advice, j.scans_per_task)) for j in jobs
        )
        return len(self.dispatcher.batches) + to_come < max_weight

    def _end(self, job: PipelineJob, error: JobError | None = None) -> None:
        """Remove a job from the pipeline, and record its error or success."""
        self.dispatcher.drop(job)
        self.workers.remove(job.number)
        del self.jobs[job.number]
        # The sorter forgets a job once the last scan is framed: `until=1, framed=1`.
        if error is not None and job.committed.has_frames:
            self.stages.send(SORT, [Summaries(job.number, 0, 0, b"", framed=1, until=1)])
        self._news.ended.append((job, error))

    def _end_complete(self, jobs: Iterable[PipelineJob]) -> None:
        """End each job whose scans are all committed and, in a job with frames, sorted."""
        for job in jobs:
            if job.complete and job.number in self.jobs:
                self._end(job)

    @property
    def notes(self) -> list[str]:
        """Notes for the user."""
        return [*self.stages.notes, *self.workers.notes]

    # -- one step ----------------------------------------------------------------------------

    def open(self) -> None:
        """Start the stages. The caller must call `stop` on failure, and `finish` always."""
        self.stages.open()
        self._refresh(scans_to_come=0)

    def step(self, scans_to_come: int = 0) -> PipelineNews:
        """Process messages, workers and batches once, and return what has changed.

        `scans_to_come` is the estimated number of scans in jobs that are not begun yet.

        LidarError if a failure concerns all jobs.
        """
        messages = self._messages
        self._messages = []
        self._commit([message for message in messages if isinstance(message, Receipt)])
        for message in messages:
            self._handle(message)
        self.dispatcher.check()
        self._refresh(scans_to_come)
        for job, error in [*self.dispatcher.failed.items()]:
            self._end(job, error)
        for name, orders in self.dispatcher.assign(self.stages.collectors).items():
            self.stages.send(name, orders)
        self.dispatcher.offer()
        news = self._news
        self._news = PipelineNews()
        return news

    def wait(self, keys: Iterable[str] = ()) -> None:
        """Wait a moment for messages, or the end of a casting task or a Dask task of `keys`.

        The next `step` takes the messages.
        """
        if self.stages.closed:
            self._messages += self.stages.wait(CLOSING_S, [], scans=False)
            return
        # Small jobs and batches come in dozens, and while there are many, nobody waits for a single
        # one. Each step costs a millisecond or two, however few messages came.
        burst = max(len(self.jobs), self.dispatcher.per_task)  # messages that come together
        many_in_flight = 2 * len(self.dispatcher.batches) > self.dispatcher.max_weight
        self._messages += self.stages.wait(
            WAIT_S,
            [*self.workers.pending, *keys],
            scans=self._wants_scans,
            linger_s=LINGER_S * min(burst, MAX_LINGERS if many_in_flight else 1),
        )

    def _handle(self, message: Message) -> None:
        """Handle a message of a stage, except for receipts (`_commit`)."""
        if isinstance(message, ColumnsLost):
            self.dispatcher.recast_columns(message)
            return
        job = self.jobs.get(message.job)  # None if it has failed
        match message:
            case ScanRange():
                if message.stop == self._announced.get(message.job):
                    del self._announced[message.job]
                if job is not None and not job.condemned:
                    self.dispatcher.add_scans(job, message.first, message.stop)
            case Failed():
                if message.stage == GENERATE:
                    self._announced.pop(message.job, None)
                if job is not None:
                    self._end(job, JobError(f"Stage {message.stage} failed: {message.reason}"))
            case Summaries():
                if job is not None:
                    self._take_sorted(job, message)

    def _take_sorted(self, job: PipelineJob, summaries: Summaries) -> None:
        """Pass the next scans on as frames, and end a job after its last scan."""
        job.sorted_at = time.monotonic()
        if summaries.first <= job.sorted < summaries.stop:
            self.progress += summaries.stop - job.sorted
            job.sorted = summaries.stop
            self._news.frames.append((job, summaries))
            self._end_complete([job])

    def _commit(self, receipts: Sequence[Receipt]) -> None:
        """Commit the receipts of jobs in flight, and sort, record and report the new parts."""
        stored = [
            (self.jobs[receipt.job].committed, receipt)
            for receipt in receipts
            if receipt.job in self.jobs and self._is_stored(receipt)
        ]
        new = self._commits.commit(stored)
        if not new:
            return
        advice = self.dispatcher.advice
        self.dispatcher.release((self.jobs[receipt.job], receipt) for receipt in new)
        if self.dispatcher.advice != advice:
            self.stages.advise(self.dispatcher.advice)
        parts_of_jobs: dict[PipelineJob, list[Receipt]] = {}
        for receipt in new:
            job = self.jobs[receipt.job]
            if receipt.record is not None:
                self.book.add(receipt.record)
            job.trace("points", COLLECT, receipt.scans)
            parts_of_jobs.setdefault(job, []).append(receipt)
            self.progress += len(receipt.scans)
        for job, parts in parts_of_jobs.items():
            self._sort(job, parts)
        self._news.parts += new
        self._end_complete(parts_of_jobs)

    def _is_stored(self, receipt: Receipt) -> bool:
        """Return True if a part is in storage, and store a part that its worker holds."""
        if not receipt.held_at or self.stages.store_held(receipt):
            return True
        self.dispatcher.recast_part(receipt)
        return False

    # -- workers and stages ------------------------------------------------------------------

    def _refresh(self, scans_to_come: int) -> None:
        """Handle workers and stages that have joined, died or are silent, if the last check is old.

        LidarError if a stage has failed, or workers or slots are missing for too long.
        """
        if (locations := self.workers.refresh()) is not None:
            missing = sum(job.committed.missing_count for job in self.jobs.values())
            scan_count = scans_to_come + missing
            self.workers.request_slots(self.dispatcher.slots_wanted(scan_count))
            self.dispatcher.reclaim_lost(locations)
            since = time.monotonic() - STALL_S
            self._sort_again(job for job in self.jobs.values() if job.sorted_at < since)
        died, started = self.stages.refresh(self.progress)
        if died or started:
            self.dispatcher.reclaim_uncollected(died, started)
        if GENERATE in started:  # a new stage 1 has no orders
            self._announced.clear()
            self._describe(self.jobs.values())
        if SORT in started:
            self._sort_again(self.jobs.values())

    def _describe(self, jobs: Iterable[PipelineJob]) -> None:
        """Order stage 1 to describe the remaining scans of jobs, from `job.generated` on."""
        orders = [
            Description(job.number, job.packed, job.generated, job.scans.stop)
            for job in jobs
            if job.generated < job.scans.stop
        ]
        self._announced |= {order.job: order.stop for order in orders}
        if orders:
            self.stages.send(GENERATE, orders)

    @property
    def _wants_scans(self) -> bool:
        """True if the job that stage 1 describes has room for batches, or has ended.

        False if stage 1 has no orders. `wait` takes ranges of scans from stage 1 only if True.
        """
        # Stage 1 describes one job after the other, and `_announced` has the same order. While the
        # first job has no room, its scans and the scans of later jobs behind it stay in the pipe.
        # After the last scan the pipe is closed, which ends each wait at once: a driver that still
        # asked did so 700 times a second.
        for number in self._announced:
            job = self.jobs.get(number)
            return job is None or bool(job.condemned) or self.dispatcher.room(job) > 0
        return False

    def _sort(self, job: PipelineJob, receipts: Sequence[Receipt]) -> None:
        """Send the summaries of committed parts to the sorter, for jobs with frames.

        `_refresh` sends all again when the sorter starts.
        """
        if receipts and job.committed.has_frames:
            messages = [
                Summaries(
                    job.number,
                    part.first,
                    part.stop,
                    part.summaries,
                    framed=job.sorted,
                    until=job.scans.stop,
                )
                for part in receipts
            ]
            job.trace("handon", SORT, chain.from_iterable(m.scans for m in messages))
            self.stages.send(SORT, messages)

    def _sort_again(self, jobs: Iterable[PipelineJob]) -> None:
        """Send the sorter all summaries of jobs' committed scans that were not handed out."""
        for job in jobs:
            job.sorted_at = time.monotonic()
            if job.committed.has_frames:
                unsorted = job.committed.parts.reaching_past(job.sorted)
                summaries = self._commits.summaries
                parts = [replace(part, summaries=summaries(part)) for part in unsorted]
                self._sort(job, parts)

    # -- the end -----------------------------------------------------------------------------

    def close(self) -> None:
        """End the stages, once everything is committed."""
        self.workers.request_slots(0)  # the partition may shrink
        self.stages.close()

    def stop(self, reason: str) -> None:
        """End all stages at once. `finish` must follow."""
        for job in self.jobs.values():
            self.dispatcher.drop(job)
        self.stages.stop(reason)

    def finish(self) -> None:
        """Wait a moment for the stages to end, add their records to `book`, and clean up."""
        try:
            for record in self.stages.finish(self.workers.futures):
                self.book.add(record)
        finally:
            self.workers.release()
