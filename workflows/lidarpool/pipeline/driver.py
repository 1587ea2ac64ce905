"""The driver of a run: it offers batches of all jobs, commits parts and hands out frames.

Everything happens in `step`, called repeatedly from one thread; nothing in it waits for long. There
is one rule of recovery: uncommitted batches are offered again, and frames that were not handed out
are sorted again, whatever was lost. What arrives twice does no harm: a second receipt of a scan is
ignored, and its part is the same file with the same bytes. The number of batches under way, and the
distance of the last to the first, are limited: that bounds every queue, and the memory of sorter
and workers.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from itertools import chain

import cloudpickle

from poolpart import TaskRecord

from ..base.storage import Storage
from ..columns.cloud import Cloud
from ..scene.scene import Scene
from ..sensor import Survey
from . import policies
from .casting import Casting
from .collecting import Collecting
from .database import RunDatabase
from .failures import JobError, sending
from .jobs import JobState
from .long_stages import LongStages
from .messages import ColumnsLost, Failed, Frame, Message, Receipt, ScanRange, Summaries
from .names import COLLECT, GENERATE, SORT
from .rigs import RigPlan
from .task_book import TaskBook
from .workers import CastingWorkers

STALL_S = 60.0  # without news from the sorter; then it gets its summaries again
WAIT_S = 0.02  # for news, where there is nothing else to do
CLOSING_S = 0.001  # longest wait while the stages end
ADVISED_AGAIN = 0.2  # change of the scans in an item of stage 1 that is worth a request
ANNOUNCED = 2  # jobs that stage 1 should have before it, however large they are


class RunDriver:
    """Runs jobs on the partitions of a cluster.

    `workers` and `stages` are all that it asks of Dask, so that tests can play the cluster. What is
    committed in `db` is not cast again, and `storage` is where parts go.
    """

    def __init__(
        self, workers: CastingWorkers, stages: LongStages, db: RunDatabase, storage: Storage
    ) -> None:
        self._workers, self._stages, self._db = workers, stages, db
        self._casting = Casting(workers, stages.collector_count)
        self._collecting = Collecting(stages, storage, db.meta["mark"], self._casting)
        self.batches = self._casting.batches
        self.jobs: dict[int, JobState] = {}  # those under way
        self.book = TaskBook()  # of stage 2
        self.progress = 0  # a number that grows when something is committed or handed out
        self.later = 0  # scans of jobs that are not begun yet
        self._advice = 1  # scans that stage 1 was told to put into an item
        self._announced: dict[int, int] = {}  # {job: scans}, in the order of stage 1, until taken
        self._ended: list[tuple[JobState, JobError | None]] = []  # since they were asked for

    # -- jobs --------------------------------------------------------------------------------

    def begin(
        self,
        number: int,
        scene: Scene,
        survey: Survey,
        *,
        fit: int,
        in_all: int = 0,
        on_frame: Callable[[Frame], None] | None = None,
        read: Callable[[int], Cloud] | None = None,
        on_parts: Callable[[list[Receipt]], None] | None = None,
    ) -> JobState:
        """Take a job on; JobError if it cannot be sent to workers.

        So many scans `fit` into the memory of a casting task; `in_all` are those of the whole run,
        where many jobs are like this one. `on_frame` is called with each frame, in scan order, in
        the driver's thread; without it there are no frames, and the job is complete when all of it
        is committed. Frames read their points with `read`. `on_parts` is called with parts that
        were committed.
        """
        with sending():
            packed = cloudpickle.dumps(survey, protocol=5)
        name = self._workers.add(number, RigPlan(scene, packed, self._workers.backend))
        parts = self._db.job(number, survey.scan_count)
        parts.has_frames = on_frame is not None
        job = self.jobs[number] = JobState(
            self._stages.run,
            number,
            survey,
            parts,
            packed,
            name,
            fit,
            max(in_all, survey.scan_count),
            on_frame,
            read,
            on_parts,
        )
        self._describe([job])
        self._sort_again([job])
        self._end_complete([job])
        return job

    @property
    def has_room(self) -> bool:
        """Whether another job should begin, so that stage 1 always has scans to describe."""
        if len(self.jobs) >= self._casting.most:
            return False
        if len(self._announced) < ANNOUNCED:
            return True
        jobs = [self.jobs[number] for number in self._announced if number in self.jobs]
        to_come = sum(job.batches_to_come(self._advice) for job in jobs)
        return len(self.batches) + to_come < self._casting.most

    def take_ended(self) -> list[tuple[JobState, JobError | None]]:
        """Return the jobs that are complete, or failed by an error, since the last call."""
        ended, self._ended = self._ended, []
        return ended

    def _end(self, job: JobState, error: JobError | None = None) -> None:
        """Do nothing more for a job."""
        self._casting.drop(job)
        self._workers.remove(job.number)
        del self.jobs[job.number]
        if error is not None and job.parts.has_frames:  # the sorter forgets what it has of it
            self._stages.send(SORT, [Summaries(job.number, 0, 0, b"", framed=1, scan_count=1)])
        self._ended.append((job, error))

    def _end_complete(self, jobs: Iterable[JobState]) -> None:
        for job in jobs:
            if job.complete and job.number in self.jobs:
                self._end(job)

    # -- state -------------------------------------------------------------------------------

    @property
    def slot_count(self) -> int:
        """Tasks that all workers cast at a time; at least 1."""
        return self._workers.slot_count

    @property
    def lacks_slot(self) -> bool:
        """Whether a stage whose worker has died waits for a free slot."""
        return self._stages.lacks_slot

    @property
    def waiting(self) -> bool:
        """Whether the stages wait for slots that other runs hold."""
        return self._stages.waiting

    @property
    def notes(self) -> list[str]:
        """Notes for the user."""
        return [*self._stages.notes, *self._workers.notes, *self._collecting.notes]

    # -- one step ----------------------------------------------------------------------------

    def open(self) -> None:
        """Start the stages; after this `stop` and `finish` must be called."""
        self._stages.open()
        self._look()

    def step(self) -> bool:
        """Do what can be done now; returns whether there was anything to do.

        LidarpoolError if something fails that all jobs need.
        """
        messages = self._stages.receive()
        moved = bool(messages)
        self._commit([message for message in messages if isinstance(message, Receipt)])
        for message in messages:
            self._take(message)
        moved |= self._casting.check()
        self._look()
        for job, error in [*self._casting.failed.items()]:
            self._end(job, error)
            moved = True
        moved |= self._collecting.hand_over()
        moved |= self._casting.offer()
        return moved

    def wait(self, seconds: float) -> None:
        """Wait until there may be something to do, at most so long."""
        if self.closed:
            self._stages.wait(min(seconds, CLOSING_S), [], scans=False)
        else:
            seconds, keys = max(seconds, WAIT_S), self._workers.pending
            self._stages.wait(seconds, keys, scans=self._wants_scans)

    def _take(self, message: Message) -> None:
        if isinstance(message, ColumnsLost):
            self._collecting.lost(message)
            return
        job = self.jobs.get(message.job)  # None if it has failed
        match message:
            case ScanRange():
                if message.stop == self._announced.get(message.job):
                    del self._announced[message.job]
                if job is not None and not job.condemned:
                    for first, stop in job.take(message.first, message.stop):
                        self.batches.add(job, first, stop)
            case Failed():
                if message.stage == GENERATE:
                    self._announced.pop(message.job, None)
                if job is not None:
                    self._end(job, JobError(f"stage {message.stage} failed: {message.reason}"))
            case Summaries():
                if job is not None:
                    self.progress += job.hand_out(message)
                    self._end_complete([job])

    def _commit(self, receipts: Sequence[Receipt]) -> None:
        """Commit the receipts of jobs under way, and learn from them."""
        mine = [receipt for receipt in receipts if receipt.job in self.jobs]
        new = self._db.commit(self._collecting.stored(mine))
        if not new:
            return
        self._collecting.release(new)
        self._learn([(r, record) for r in new if (record := r.record) is not None])
        of_jobs: dict[JobState, list[Receipt]] = {}
        for receipt in new:
            job = self.jobs[receipt.job]
            job.trace("points", COLLECT, range(receipt.first, receipt.stop))
            of_jobs.setdefault(job, []).append(receipt)
            self.progress += receipt.stop - receipt.first
        for job, parts in of_jobs.items():
            self._sort(job, parts)
            if job.on_parts is not None:
                job.on_parts(parts)
        self._end_complete(of_jobs)

    def _learn(self, records: Sequence[tuple[Receipt, TaskRecord]]) -> None:
        """Record casting tasks, and advise stage 1 on the scans in one item."""
        for receipt, record in records:
            self.book.add(record)
            self.jobs[receipt.job].learn(record)
        self._casting.learn(record for _, record in records)
        for receipt, last in records[-1:]:
            job, seconds, scans = self.jobs[receipt.job], last.seconds, last.items
            if receipt.stop == job.survey.scan_count and scans < self._advice:
                # The rest of a job says how fast it was cast, and nothing about larger ones.
                seconds, scans = seconds * self._advice / scans, self._advice
            wanted = policies.scans_per_batch(seconds, scans, job.fit, job.in_all, self.slot_count)
            if abs(wanted - self._advice) > ADVISED_AGAIN * self._advice:  # it is a request
                self._advice = wanted
                self._stages.advise(wanted)

    # -- looking after workers and stages ------------------------------------------------------

    def _look(self) -> None:
        """From time to time, handle workers and stages that have joined, died or are silent.

        LidarpoolError if a stage has failed, or workers or slots are missing for too long.
        """
        if (seen := self._workers.look()) is not None:
            left = self.later + sum(job.left for job in self.jobs.values())
            self._workers.want(self._casting.slots_wanted(left))
            self._casting.leave_workers(seen)
            stalled = [
                job for job in self.jobs.values() if time.monotonic() - job.sorted_at > STALL_S
            ]
            self._sort_again(stalled)
        changes = self._stages.look(self.progress)
        self._collecting.look(changes)
        if GENERATE in changes.started:  # a stage that was started gets all that it needs
            self._announced.clear()
            self._describe(self.jobs.values())
        if SORT in changes.started:
            self._sort_again(self.jobs.values())

    def _describe(self, jobs: Iterable[JobState]) -> None:
        """Have stage 1 describe what is left of jobs; an absent one is told when it is started."""
        left = [job for job in jobs if not job.is_described]
        self._announced |= {job.number: job.survey.scan_count for job in left}
        if left:
            self._stages.send(GENERATE, [job.description for job in left])

    @property
    def _wants_scans(self) -> bool:
        """Whether the next job of stage 1 wants scans, or is none any more."""
        # Those of others are behind them in the pipe: a job gets no more than it has room for.
        for number in self._announced:
            job = self.jobs.get(number)
            return job is None or bool(job.condemned) or self._casting.room(job) > 0
        return False

    def _sort(self, job: JobState, parts: Sequence[Receipt]) -> None:
        """Send parts to the sorter if they have frames; an absent one gets them when it starts."""
        if parts and job.parts.has_frames:
            messages = job.summaries(parts)
            job.trace("handon", SORT, chain.from_iterable(m.scans for m in messages))
            self._stages.send(SORT, messages)

    def _sort_again(self, jobs: Iterable[JobState]) -> None:
        """Send the sorter all that was not handed out of jobs."""
        for job in jobs:
            job.wait_for_sorter()
            if job.parts.has_frames:
                self._sort(job, job.parts.unframed())

    # -- the end -----------------------------------------------------------------------------

    def close(self) -> None:
        """Let all stages end: everything is committed."""
        self._workers.want(0)
        self._stages.close()

    @property
    def closed(self) -> bool:
        """Whether the stages were told to end."""
        return self._stages.closed

    @property
    def ended(self) -> bool:
        """True once all stages have exited after `close`, or the shutdown timeout has elapsed."""
        return self._stages.ended

    def stop(self, reason: str) -> None:
        """End all stages at once; `finish` does the rest."""
        for job in self.jobs.values():
            self._casting.drop(job)
        self._stages.stop(reason)

    def finish(self) -> list[TaskRecord]:
        """Wait a moment for the stages to end, and clean up scheduler and storage.

        Returns the records of the stages whose workers can be reached.
        """
        try:
            return self._stages.finish(self._workers.futures)
        finally:
            self._workers.release()
