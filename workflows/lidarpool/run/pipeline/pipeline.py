"""Driver side of the pipeline, which offers batches, commits parts and sorts frames.

The driver exchanges messages (`stage_messages.py`) with four stages:

1. GENERATE describes scans. It checks that the survey defines them and sends ranges of scans, which
   the driver divides into batches.
2. INTERSECT casts batches on GPU workers in short tasks.
3. SORT, the sorter, puts the summaries of committed scans in scan order for frames. A summary
   contains the number of hits and points in a scan, and the end points of a few sample rays.
4. COLLECT, which consists of several collectors, writes the points of each batch to the storage as
   a part.

Everything happens in `step`, which is called repeatedly from a single thread and never waits for
long. A step returns the new parts, the next frames and the jobs that have ended.

There is only one recovery rule. Whatever was lost, uncommitted batches are offered again, and
frames that have not been delivered are sorted again. Duplicate messages are harmless, because a
second receipt of a scan is ignored, and its part is the same file with the same bytes.

The number of batches in flight is limited, and so is the distance between the oldest and the newest
batch. This bounds every queue and the memory of the sorter and the workers.
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

STALL_S = 60.0  # time without frames after which the summaries are sent to the sorter again
WAIT_S = 0.05  # time to wait for messages while the driver is idle
LINGER_S = 0.004  # time to wait for further messages, per job or per batch in a task
MAX_LINGERS = 25  # maximum number of jobs or batches that are counted for this time
CLOSING_S = 0.001  # time to wait for messages while the stages are shutting down
ANNOUNCED = 2  # minimum number of jobs that stage 1 has orders for


class Commits(Protocol):
    """Protocol of the database to which parts are committed."""

    def commit(self, receipts: Iterable[tuple[CommittedResults, Receipt]]) -> list[Receipt]:
        """Commit parts of jobs, and return those that had not been committed before."""
        ...

    def summaries(self, part: Receipt) -> bytes:
        """Return the scan summaries of a part as the bytes of a `summary_type` array."""
        ...


@dataclass
class PipelineNews:
    """Results of a pipeline step. They must be processed in the order of the fields."""

    parts: list[Receipt] = field(default_factory=list)  # newly committed parts
    # Next scans to deliver as frames. They may include scans that have already been delivered.
    frames: list[tuple[PipelineJob, Summaries]] = field(default_factory=list)
    # Jobs that have ended, and their errors or None.
    ended: list[tuple[PipelineJob, JobError | None]] = field(default_factory=list)


class Pipeline:
    """Driver side of the pipeline, whose four stages process the scans of jobs.

    Only `workers` and `stages` access Dask, so that tests can replace the cluster.

    Parameters
    ----------
    workers
        GPU workers, for stage 2.
    stages
        Long-running stages 1, 3 and 4.
    commits
        Database that parts are committed to.
    mark
        Mark of the run, which is part of the file names of all parts.
    """

    def __init__(
        self, workers: CastingWorkers, stages: LongStages, commits: Commits, mark: str
    ) -> None:
        self.workers = workers
        self.stages = stages
        self._commits = commits
        self.dispatcher = Dispatcher(workers, stages.collector_count, mark)
        self.jobs: dict[int, PipelineJob] = {}  # {number: job that is being cast}
        # Records of the casting tasks and, after `finish`, of the long stages.
        self.book = TaskBook()
        self.progress = 0  # number of committed scans plus number of sorted scans
        # {job: one past its last scan} for jobs that stage 1 has not completely described, in the
        # order in which stage 1 processes them.
        self._announced: dict[int, int] = {}
        self._messages: list[Message] = []  # messages received since the last step
        self._news = PipelineNews()  # results since the last step

    # -- jobs --------------------------------------------------------------------------------

    def add_job(
        self,
        committed: CommittedResults,
        scene: Scene,
        survey: Survey,
        *,
        scans_per_task: int,
        scans_of_run: int = 0,
    ) -> PipelineJob:
        """Add a job to the pipeline, excluding the scans that are already committed.

        Parameters
        ----------
        committed
            Scans of the job and its committed results.
        scene, survey
            Scene and survey of the job.
        scans_per_task
            Number of scans that fit in the memory of a casting task.
        scans_of_run
            Estimated number of scans in all jobs of the run that have not ended.

        Raises
        ------
        JobError
            If the job cannot be sent to workers.
        """
        packed, scene_name = self.workers.register_job(committed.number, scene, survey)
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
        """Remove a job from the pipeline, and report its error or success."""
        self.dispatcher.drop(job)
        self.workers.remove(job.number)
        del self.jobs[job.number]
        # These values cause the sorter to discard the job, as after its last scan.
        if error is not None and job.committed.has_frames:
            self.stages.send(SORT, [Summaries(job.number, 0, 0, b"", framed=1, until=1)])
        self._news.ended.append((job, error))

    def _end_complete(self, jobs: Iterable[PipelineJob]) -> None:
        for job in jobs:
            if job.is_complete and job.number in self.jobs:
                self._end(job)

    @property
    def notes(self) -> list[str]:
        """Notes for the user of the run."""
        return [*self.stages.notes, *self.workers.notes]

    # -- one step ----------------------------------------------------------------------------

    def open(self) -> None:
        """Start the stages.

        The caller must always call `finish` at the end, and `stop` before it on failure.
        """
        self.stages.open()
        self._refresh(scans_to_come=0)

    def step(self, scans_to_come: int = 0) -> PipelineNews:
        """Process messages, workers and batches once, and return the results.

        Parameters
        ----------
        scans_to_come
            Estimated number of scans in jobs that have not begun yet.

        Raises
        ------
        LidarError
            If a failure affects all jobs.
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
        """Wait briefly for messages, for casting tasks, or for the tasks in `keys`.

        The next `step` processes the messages.
        """
        if self.stages.is_closing:
            self._messages += self.stages.wait(CLOSING_S, [], scans=False)
            return
        # Each step takes one or two milliseconds, even with few messages. If many small jobs or
        # batches are in flight, wait for several messages, because none of them is urgent.
        burst = max(len(self.jobs), self.dispatcher.per_task)  # messages that arrive together
        many_in_flight = 2 * len(self.dispatcher.batches) > self.dispatcher.max_weight
        self._messages += self.stages.wait(
            WAIT_S,
            [*self.workers.pending, *keys],
            scans=self._wants_scans,
            linger_s=LINGER_S * min(burst, MAX_LINGERS if many_in_flight else 1),
        )

    def _handle(self, message: Message) -> None:
        """Handle a message from a stage, except for receipts, which `_commit` handles."""
        if isinstance(message, ColumnsLost):
            self.dispatcher.recast_columns(message)
            return
        job = self.jobs.get(message.job)  # None if the job has failed
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
        """Report the next scans of a job as frames, and end the job after its last scan."""
        job.sorted_at = time.monotonic()
        if summaries.first <= job.sorted < summaries.stop:
            self.progress += summaries.stop - job.sorted
            job.sorted = summaries.stop
            self._news.frames.append((job, summaries))
            self._end_complete([job])

    def _commit(self, receipts: Sequence[Receipt]) -> None:
        """Commit receipts of jobs in flight, and sort and report the newly committed parts."""
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
            self.stages.set_message_scans(self.dispatcher.advice)
        parts_of_jobs: dict[PipelineJob, list[Receipt]] = {}
        for receipt in new:
            job = self.jobs[receipt.job]
            if receipt.record is not None:
                self.book.add_task(receipt.record)
            job.trace("points", COLLECT, receipt.scans)
            parts_of_jobs.setdefault(job, []).append(receipt)
            self.progress += len(receipt.scans)
        for job, parts in parts_of_jobs.items():
            self._sort(job, parts)
        self._news.parts += new
        self._end_complete(parts_of_jobs)

    def _is_stored(self, receipt: Receipt) -> bool:
        """Store a part if only a worker holds it, and return whether it is in the storage."""
        if not receipt.held_at or self.stages.store_held(receipt):
            return True
        self.dispatcher.recast_part(receipt)
        return False

    # -- workers and stages ------------------------------------------------------------------

    def _refresh(self, scans_to_come: int) -> None:
        """Handle changes of workers and stages, unless they were checked recently.

        Raise LidarError if a stage has failed, or if workers or slots have been missing for too
        long.
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
        if GENERATE in started:  # stage 1 has lost its orders
            self._announced.clear()
            self._describe(self.jobs.values())
        if SORT in started:
            self._sort_again(self.jobs.values())

    def _describe(self, jobs: Iterable[PipelineJob]) -> None:
        """Instruct stage 1 to describe the remaining scans of each job.

        These scans start at `job.generated`.
        """
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
        """Whether `wait` should receive ranges of scans from stage 1.

        True if the job that stage 1 is describing has room for batches or has ended.
        """
        # Stage 1 describes the jobs in the order of `_announced`. While the first job has no room,
        # its scans and those of later jobs remain in the pipe. The pipe is closed after the last
        # scan, and waiting for a closed pipe would return immediately, 700 times per second.
        for number in self._announced:
            job = self.jobs.get(number)
            return job is None or bool(job.condemned) or self.dispatcher.room(job) > 0
        return False

    def _sort(self, job: PipelineJob, receipts: Sequence[Receipt]) -> None:
        """Send the summaries of committed parts to the sorter if the job has frames.

        When the sorter is restarted, `_refresh` sends all summaries again.
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
        """Send the summaries of all committed but unsorted scans to the sorter."""
        for job in jobs:
            job.sorted_at = time.monotonic()
            if job.committed.has_frames:
                unsorted = job.committed.parts.reaching_past(job.sorted)
                summaries = self._commits.summaries
                parts = [replace(part, summaries=summaries(part)) for part in unsorted]
                self._sort(job, parts)

    # -- the end -----------------------------------------------------------------------------

    def close(self) -> None:
        """Shut down the stages after all results have been committed."""
        self.workers.request_slots(0)  # allows an adaptive partition to shrink
        self.stages.close()

    def stop(self, reason: str) -> None:
        """Stop all stages immediately. The caller must then call `finish`."""
        for job in self.jobs.values():
            self.dispatcher.drop(job)
        self.stages.stop(reason)

    def finish(self) -> None:
        """Wait briefly for the stages to exit, add their records to `book`, and clean up."""
        try:
            for record in self.stages.finish(self.workers.futures):
                self.book.add_task(record)
        finally:
            self.workers.release()
