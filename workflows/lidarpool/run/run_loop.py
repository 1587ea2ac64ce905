"""The loop of a run: jobs are cast several at a time, committed and written, and paths planned.

A survey has a single job, which may have a planning: trials, tasks of the partition OTHER, that
search for a short path, beside the casting. A campaign has many jobs, which are written into a data
set.
"""

from __future__ import annotations

import time
import uuid
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from functools import partial
from operator import itemgetter
from typing import Any

from lidarsim.base.errors import LidarError
from lidarsim.base.words import listed, plural, rounded
from lidarsim.simulator.memory import MB, scans_that_fit

from ..base import timeline
from ..datasets.dataset import DataSet
from ..datasets.job_table import JobRow
from ..scenario.build import Job
from .cluster.cluster import Cluster
from .cluster.watch import Watch
from .job_source import JobMaker, failed_row
from .listener import Listener
from .pipeline.casting_workers import CastingWorkers
from .pipeline.failures import JobError
from .pipeline.long_stages import LongStages
from .pipeline.pipeline import Pipeline
from .pipeline.stage_names import GPU, LIDAR, OTHER
from .pipeline.task_book import StageTotals
from .planning_trials import TrialPump
from .progress import Progress, Show
from .store.job_under_way import JobUnderWay
from .store.run_store import RunStore
from .writer import JobFiles, JobWriter

PROGRESS_EVERY_S = 0.1
SAVE_EVERY_S = 1.0  # stores the number of frames handed out
LONGEST_PAUSE_S = 0.05  # while nothing moves
EXTRA_JOBS = 64  # jobs under way, at most, in addition to two for each GPU slot


class RunLoop:
    """Takes the jobs of a run through the pipeline: the first job, and the jobs of `maker`.

    Parameters
    ----------
    cluster
        Checked cluster with the partitions GPU, LIDAR and OTHER.
    store
        Database of the run, and storage of its parts.
    maker
        Makes the jobs of a campaign after the first; None for the single job of a survey.
    dataset
        Data set into which the jobs of a campaign are written; None for a survey, whose parts are
        kept.
    listener
        Object that is notified of the parts and frames of a survey, and whose page shows ended
        jobs.
    """

    def __init__(
        self,
        cluster: Cluster,
        store: RunStore,
        maker: JobMaker | None,
        dataset: DataSet | None,
        listener: Listener,
    ) -> None:
        self._cluster = cluster
        self._store = store
        self._maker = maker
        self._listener = listener
        self._page = listener.page
        options = cluster.options
        run_id = uuid.uuid4().hex[:8]
        mark = store.db.meta["mark"]
        stages = LongStages(
            cluster.partitions[LIDAR],
            run_id,
            cluster.software["lidarpool"],
            store.storage,
            mark,
            queue_capacity=options.queue_capacity,
            collectors=options.collectors,
            patience_s=options.worker_timeout_s,
        )
        gpus = cluster.partitions[GPU]
        workers = CastingWorkers(gpus, run_id, cluster.backend, cluster.software)
        self._pipeline = Pipeline(workers, stages, store.db, mark)
        self._writer: JobWriter | None = None
        if dataset is not None:
            self._writer = JobWriter(cluster.tasks(LIDAR), dataset, store, stages.probe)
        self._trials: TrialPump | None = None
        # Rows of the job table for jobs that have ended, and are not yet in the run's database.
        self._rows: list[JobRow] = []
        self._scans_begun = 0
        self._jobs_begun = 0
        self._remover = ThreadPoolExecutor(1, "remove")
        self._only_committed = False  # True once the only job is committed
        self.times: dict[str, float] = {}  # seconds: {"survey": …, "planning": …}
        self.stages: tuple[StageTotals, ...] = ()
        self.replayed = 0  # batches that were cast or sent more than once

    # -- jobs come and go --------------------------------------------------------------------

    @property
    def finished(self) -> bool:
        """True once all jobs have ended."""
        if self._maker is None:
            return self._only_committed
        return self._maker.ended and not self._store.under_way

    def step(self) -> bool:
        """Begin jobs, step pipeline and writer once, and commit ended jobs.

        Returns True after changes.

        LidarError if a failure concerns all jobs.
        """
        moved = self._admit()
        moved |= self._pipeline.step()
        for job, error in self._pipeline.take_ended():
            moved = True
            if error is not None:
                self._fail(job.number, error)
            elif self._writer is None:
                self._only_committed = True
            else:
                self._writer.add(self._files_of(self._store.under_way[job.number]))
        error_of_all: LidarError | None = None
        # A stage whose worker has died gets its slot first.
        slots = 0 if self._pipeline.stages.lacks_slot else self._cluster.spare
        more_to_come = bool(self._pipeline.jobs)
        for files, outcome in (
            () if self._writer is None else self._writer.step(slots, more_to_come=more_to_come)
        ):
            moved = True
            if isinstance(outcome, JobError):
                self._fail(files.row.number, outcome)
            elif isinstance(outcome, LidarError):
                error_of_all = outcome
            else:
                self._rows.append(outcome)
        self._commit()
        if error_of_all is not None:
            raise error_of_all
        return moved

    def _admit(self) -> bool:
        """Begin jobs that are ready, if there is room, and return True if any was begun."""
        moved = False
        max_under_way = EXTRA_JOBS + 2 * self._pipeline.workers.slot_count
        # Small jobs begin together, as many as have batches in one task, and go on together: then
        # they share messages and tasks.
        together = self._pipeline.dispatcher.per_task if self._pipeline.jobs else 1
        if self._maker is None or not self._maker.has(together):
            return False
        while self._pipeline.has_room and len(self._store.under_way) < max_under_way:
            if (entry := self._maker.take()) is None:
                break
            moved = True
            if isinstance(entry, JobRow):
                self._rows.append(entry)
            else:
                self._begin(entry)
        return moved

    def _begin(self, job: Job) -> None:
        """Begin a job, unless its scans are too large for the workers."""
        under_way = self._store.open_job(job)
        try:
            if self._writer is not None:  # the only job of a run was checked at the start
                self._cluster.check(job)
            self._add_to_pipeline(under_way)
        except JobError as error:  # too large for the workers, or it cannot be pickled
            self._fail(job.number, error)

    def _add_to_pipeline(self, job: JobUnderWay) -> None:
        """Add a job to the pipeline, begin its planning, and estimate the scans to come."""
        cluster = self._cluster
        is_only = self._writer is None
        planning = job.job.planning
        if is_only and planning is not None:
            self._trials = TrialPump(cluster.tasks(OTHER), planning, job.trials)
            self._trials.step()  # before the survey begins, so that no slot of OTHER stays idle
            # End the request for slots that was made before there were tasks: from now on, waiting
            # trials let an adaptive partition grow.
            self._trials.tasks.partition.request_slots(0)
        # Many jobs follow in a campaign, so that batches need not be divided among all slots.
        jobs_left = len(self._store.jobs.numbers) - self._store.db.ended_count
        self._pipeline.begin(
            job,
            scans_per_task=scans_that_fit(
                job.scene,
                job.survey,
                cluster.options.batch_mb * MB,
                on_device=cluster.backend == "cuda",
            ),
            scans_of_run=len(job.scans) * jobs_left,
            on_frame=partial(cluster.call, self._listener.frame) if is_only else None,
            on_parts=self._listener.parts if is_only else None,
        )
        self._jobs_begun += 1
        self._scans_begun += len(job.scans)
        to_come = max(0, jobs_left - len(self._store.under_way))
        self._pipeline.scans_to_come = to_come * self._scans_begun // self._jobs_begun

    def _files_of(self, under_way: JobUnderWay) -> JobFiles:
        """Return the input of the writer for a job whose scans are all committed."""
        job = under_way.job
        row = JobRow(
            number=job.number,
            name=job.name,
            split=job.split,
            values=dict(job.values),
            scans=job.survey.scan_count,
            sweeps=len(job.sweeps),
            rays=job.survey.ray_count,
            hits=under_way.parts.hit_count,
            # The casting times of an earlier run are not stored.
            seconds=None if under_way.resumed else under_way.seconds,
        )
        return JobFiles(row, under_way.points(), job.sweeps, job.made_of)

    def _fail(self, number: int, error: LidarError) -> None:
        """Record the row of a failed job, or raise the error if the run is a survey's."""
        if self._store.only_job is not None:
            raise error
        self._rows.append(failed_row(self._store.jobs, number, error))

    def _commit(self) -> None:
        """Commit the rows of ended jobs in the run's database, and remove the jobs' parts.

        The names, models and rates of their sensors are stored for the card of the data set.
        """
        rows = self._rows
        self._rows = []
        if not rows:
            return
        under_way = self._store.under_way  # jobs that could not be made are not in it
        ended = [(row, under_way[row.number]) for row in rows if row.number in under_way]
        self._store.name_sensors(
            (
                carried.name or "lidar",
                f"{sensor.model}, {rounded(1e9 / sensor.revolution_start_ns(1))} Hz",
            )
            for row, job in ended
            if row.done
            for carried in job.survey.carried
            for sensor in [carried.sensor]
        )
        self._store.end(rows)
        for row in rows:
            self._page.ended(row)
        self._remover.submit(self._remove, ended)

    def _remove(self, ended: Sequence[tuple[JobRow, JobUnderWay]]) -> None:
        """Remove the parts of jobs that have ended, after the page has read their points."""
        for row, job in ended:
            with suppress(LidarError, OSError):  # remaining files do no harm
                if row.done:
                    self._page.look(row, job)
            with suppress(LidarError, OSError):
                self._store.storage.remove([part.name for part in job.parts.ordered])

    def under_way(self) -> list[dict[str, Any]]:
        """Return the states of the jobs that are being cast, then of the jobs being written.

        `JobUnderWay.status` describes the fields of a state.
        """
        writing = {row.number for row in self._writer.jobs} if self._writer else set()
        jobs = [*self._store.under_way.values()]
        states = [job.status(is_writing=job.number in writing) for job in jobs]
        return sorted(states, key=itemgetter("writing"))

    # -- to the end --------------------------------------------------------------------------

    def run(self, first: Job, show: Show) -> None:
        """Cast, write and plan all jobs.

        On any error, all tasks have been stopped.

        `first` is the first job, and `show` is called with the progress.
        """
        cluster = self._cluster
        pipeline = self._pipeline
        try:
            with cluster.partitions_page(), cluster.stopping(self._stop):
                pipeline.open()
                self._loop(first, show)
                pipeline.finish()
        finally:
            if self._writer is not None:
                self._writer.close()
            self._remover.shutdown()
        self._save()
        self._store.save(force=True)
        self._store.tidy()
        tasks_beside = [beside.tasks for beside in (self._writer, self._trials) if beside]
        books = [pipeline.book, *(tasks.book for tasks in tasks_beside)]
        self.stages = tuple(totals for book in books for totals in book.stages.values())
        self._store.notes += pipeline.notes
        self.replayed = pipeline.dispatcher.replayed
        # The report of a survey has the number of repeated batches.
        if self._writer is not None and (lost := sorted(pipeline.dispatcher.lost_workers)):
            self._store.notes.append(
                f"{plural(len(lost), 'worker')} died, left or stopped responding "
                f"({listed(lost)}). Batches that were cast or sent again: {self.replayed:,}"
            )
        if self._writer is not None and self._writer.hidden:
            storage = self._writer.dataset.storage
            note = (
                f"no worker of partition {LIDAR} can access {storage}, so the driver wrote the "
                "data set"
            )
            self._store.notes.append(note)

    def _loop(self, first: Job, show: Show) -> None:
        """Step pipeline, writer and planning until all have finished, and show progress meanwhile.

        `step` steps the first two until the last job has ended; then the stages of the pipeline are
        closed, and the loop waits for their end.
        """
        pipeline = self._pipeline
        started = time.monotonic()
        pause_s = 0.0
        self._begin(first)  # and its trials
        timeline.mark(timeline.FIRST_BATCH)
        # Detects partitions without workers. The stages on LIDAR last as long as the run: workers
        # that take no more tasks are good enough there.
        watch = self._cluster.watch([GPU, OTHER] if self._trials else [GPU], lasting=[LIDAR])
        shown_at = saved_at = float("-inf")
        tasks_beside = [beside.tasks for beside in (self._writer, self._trials) if beside]
        while not (pipeline.stages.ended and (self._trials is None or "planning" in self.times)):
            moved = self._step_survey(started, watch)
            moved |= self._step_planning(started, watch)
            now_s = time.monotonic()
            if now_s - saved_at >= SAVE_EVERY_S:
                saved_at = now_s
                self._save()
            watch.look()
            if now_s - shown_at >= PROGRESS_EVERY_S or self.finished:
                shown_at = now_s
                self._show_progress(show, now_s - started)
            pause_s = 0.0 if moved else min(max(0.001, 2 * pause_s), LONGEST_PAUSE_S)
            if pipeline.stages.ended:
                time.sleep(pause_s)
            else:
                pipeline.wait(
                    pause_s, [future.key for tasks in tasks_beside for future in tasks.running]
                )
        self._store.notes += watch.notes

    def _step_survey(self, started: float, watch: Watch) -> bool:
        """Step pipeline and writer until all jobs have ended, and return True if anything moved.

        `started` is the time when the loop started, by the monotonic clock, seconds.
        """
        pipeline = self._pipeline
        if pipeline.stages.closed:
            return False
        moved = self.step()
        if pipeline.progress:
            timeline.mark(timeline.FIRST_RECEIPT)
        if self.finished:
            pipeline.close()
            self.times["survey"] = time.monotonic() - started
            timeline.mark(timeline.LAST_RECEIPT)
            watch.forget([GPU, LIDAR])
        return moved

    def _step_planning(self, started: float, watch: Watch) -> bool:
        """Step the trials until all have finished, and return True if anything moved."""
        if self._trials is None or "planning" in self.times:
            return False
        moved = self._trials.step()
        if self._trials.finished:
            self.times["planning"] = time.monotonic() - started
            timeline.mark(timeline.PLANNED)
            watch.forget([OTHER])
        return moved

    def _show_progress(self, show: Show, seconds: float) -> None:
        """Show the counts of the run and its time so far, at the terminal and on the page."""
        waits_for = LIDAR if self._pipeline.stages.waiting else ""
        progress = replace(self._progress(), seconds=seconds, waits_for=waits_for)
        self._cluster.call(show, progress)
        self._cluster.call(self._page.on_progress, progress, self.under_way)

    def _save(self) -> None:
        """Store finished trials, and the number of frames handed out, in the run's database."""
        if self._trials is not None and (only_job := self._store.only_job) is not None:
            self._store.db.add_trials(only_job, self._trials.trials[len(only_job.trials) :])
        self._store.save()

    def _progress(self) -> Progress:
        """Return the counts of the run, without its time."""
        if (job := self._store.only_job) is None:
            numbers = self._store.jobs.numbers
            ended = self._store.db.ended_count
            return Progress(jobs=len(numbers), jobs_done=ended)
        progress = replace(
            job.progress(),
            generated=job.generated - job.scans.start,
            cast=min(job.resumed + job.cast, len(job.scans)),
            replayed=job.offered_again,
        )
        if self._trials is None:
            return progress
        return replace(progress, trials_done=len(self._trials.trials))

    def _stop(self, reason: str) -> None:
        """Stop all tasks because of an error, as far as the cluster can be reached.

        `reason` is the error in words, which the stages get.
        """
        client = self._cluster.client
        pipeline = self._pipeline
        trials = self._trials
        steps: list[Callable[[], object]] = [lambda: pipeline.stop(reason), pipeline.finish]
        if trials is not None:
            steps.append(trials.tasks.cancel)
        for step in steps:
            # Dask would try for half a minute to reach a cluster that is gone.
            if client.status != "running":
                return
            with suppress(Exception):  # report the first error
                step()
