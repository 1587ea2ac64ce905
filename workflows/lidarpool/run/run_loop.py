"""Main loop of a run, which casts, commits and writes jobs and runs planning trials.

A survey has a single job, which may include path planning. The planning trials are tasks on the
partition OTHER and run in parallel with casting. A campaign has many jobs, several of which are
cast at the same time, and writes them to a data set.
"""

from __future__ import annotations

import time
import uuid
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from operator import itemgetter
from typing import TYPE_CHECKING, Any

from lidarfiles.datasets.job_table import JobRow
from lidarscenario.job import Job
from lidarscenario.plan import Planning, Trial
from lidarsim.errors import LidarError
from lidarsim.simulator.memory import MB, scans_that_fit
from lidarsim.words import list_names, plural

from ..processes import timeline
from .cluster.cluster import Cluster
from .cluster.watch import Watch
from .committed import CommittedRun
from .job_source import JobProducer, failed_row
from .listener import Listener
from .pipeline.casting_workers import CastingWorkers
from .pipeline.failures import JobError
from .pipeline.long_stages import LongStages
from .pipeline.pipeline import Pipeline
from .pipeline.pipeline_job import PipelineJob
from .pipeline.stage_messages import Summaries
from .pipeline.stage_names import GPU, LIDAR, OTHER, SORT
from .planning_trials import TrialRunner
from .progress import Progress, Show
from .store.run_store import RunStore
from .store.stored_job import StoredJob
from .writer import DataSetWriter, WriteRequest

if TYPE_CHECKING:
    from lidarfiles.datasets.dataset import DataSet

PROGRESS_EVERY_S = 0.1
SAVE_EVERY_S = 1.0  # interval at which the number of delivered frames is stored
PLANNING_PAUSE_S = 0.02  # interval between checks of the trials after all jobs have ended
EXTRA_JOBS = 64  # maximum number of jobs in flight in addition to two per GPU slot


class RunLoop:
    """Main loop of a run, which moves the run's jobs through the pipeline.

    Parameters
    ----------
    cluster
        Checked cluster with the partitions GPU, LIDAR and OTHER.
    store
        Store of the run.
    maker
        Source of the jobs of a campaign after the first one, or None for a survey.
    dataset
        Data set that the jobs of a campaign are written to, or None for a survey, whose parts stay
        in the store.
    listener
        Listener that is notified of the committed parts and frames of a survey. Its page shows the
        jobs that have ended.
    """

    def __init__(
        self,
        cluster: Cluster,
        store: RunStore,
        maker: JobProducer | None,
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
        self._writer: DataSetWriter | None = None
        if dataset is not None:
            self._writer = DataSetWriter(cluster.tasks(LIDAR), dataset, store, stages.probe)
        self._trials: TrialRunner | None = None
        # Table rows of jobs that have ended but have not been committed to the run's database.
        self._rows: list[JobRow] = []
        self._jobs: dict[int, PipelineJob] = {}  # {number: job that is being cast or written}
        self._scans_begun = 0
        self._jobs_begun = 0
        self._scans_to_come = 0  # estimated number of scans in jobs that have not begun
        self._remover = ThreadPoolExecutor(1, "remove")
        self._only_committed = False  # True once the only job is committed
        self._times: dict[str, float] = {}  # duration of "survey" and "planning" in seconds

    def run(self, first: Job, show: Show) -> CommittedRun:
        """Run all jobs, starting with `first`, and return the committed results.

        The function `show` is called with the progress of the run. If an error occurs, all tasks
        are stopped before it is raised.
        """
        cluster = self._cluster
        pipeline = self._pipeline
        try:
            with cluster.partitions_page(), cluster.stop_on_error(self._stop):
                pipeline.open()
                self._loop(first, show)
                pipeline.finish()
        finally:
            if self._writer is not None:
                self._writer.close()
            self._remover.shutdown()
        self._save()
        self._store.save(force=True)
        self._store.remove_orphaned_parts()
        tasks_beside = [beside.tasks for beside in (self._writer, self._trials) if beside]
        books = [pipeline.book, *(tasks.book for tasks in tasks_beside)]
        self._store.notes += pipeline.notes
        replayed = pipeline.dispatcher.replayed
        # The report of a survey already includes the number of repeated batches.
        if self._writer is not None and (lost := sorted(pipeline.dispatcher.lost_workers)):
            self._store.notes.append(
                f"{plural(len(lost), 'worker')} died, left or stopped responding "
                f"({list_names(lost)}). Batches that were cast or sent again: {replayed:,}"
            )
        if self._writer is not None and self._writer.hidden:
            storage = self._writer.dataset.storage
            note = (
                f"no worker of partition {LIDAR} can access {storage}, so the driver wrote the "
                "data set"
            )
            self._store.notes.append(note)
        return CommittedRun(
            self._store,
            stages=tuple(totals for book in books for totals in book.stages.values()),
            seconds=time.monotonic() - self._store.opened_at,
            survey_seconds=self._times.get("survey", 0.0),
            planning_seconds=self._times.get("planning", 0.0),
            replayed=replayed,
        )

    def _loop(self, first: Job, show: Show) -> None:
        """Advance and display all jobs and the planning until everything has finished.

        Once the last job has ended, the pipeline stages are closed, and the loop waits until they
        have exited.
        """
        pipeline = self._pipeline
        started = time.monotonic()
        self._begin(first)  # and its trials
        timeline.record_step(timeline.FIRST_BATCH)
        # The stages on LIDAR run until the end, so their workers do not have to accept new tasks.
        watch = self._cluster.watch([GPU, OTHER] if self._trials else [GPU], lasting=[LIDAR])
        shown_at = saved_at = float("-inf")
        tasks_beside = [beside.tasks for beside in (self._writer, self._trials) if beside]
        while not (
            pipeline.stages.has_ended and (self._trials is None or "planning" in self._times)
        ):
            self._step_jobs(started, watch)
            self._step_planning(started, watch)
            now_s = time.monotonic()
            if now_s - saved_at >= SAVE_EVERY_S:
                saved_at = now_s
                self._save()
            watch.check()
            if now_s - shown_at >= PROGRESS_EVERY_S or self._finished:
                shown_at = now_s
                self._show_progress(show, now_s - started)
            if pipeline.stages.has_ended:
                time.sleep(PLANNING_PAUSE_S)
            else:
                pipeline.wait(future.key for tasks in tasks_beside for future in tasks.running)
        self._store.notes += watch.notes

    @property
    def _finished(self) -> bool:
        if self._maker is None:
            return self._only_committed
        return self._maker.ended and not self._store.in_flight

    def _step_jobs(self, started: float, watch: Watch) -> None:
        """Begin, cast, write and commit jobs as far as this is possible without waiting.

        Raise LidarError if a failure affects all jobs. `started` is the monotonic time in seconds
        at which the loop started.
        """
        pipeline = self._pipeline
        if pipeline.stages.is_closing:
            return
        self._admit()
        news = pipeline.step(self._scans_to_come)
        if self._writer is None and news.parts:
            self._listener.on_parts(news.parts)
        for job, summaries in news.frames:
            self._hand_out(job, summaries)
        for job, error in news.ended:
            if error is not None:
                self._fail(job.number, error)
            elif self._writer is None:
                self._only_committed = True
            else:
                self._writer.queue_job(self._write_request(job))
        error_of_all = self._write()
        self._commit()
        if error_of_all is not None:
            raise error_of_all
        if pipeline.progress:
            timeline.record_step(timeline.FIRST_RECEIPT)
        if self._finished:
            pipeline.close()
            self._times["survey"] = time.monotonic() - started
            timeline.record_step(timeline.LAST_RECEIPT)
            watch.remove_partitions([GPU, LIDAR])

    def _step_planning(self, started: float, watch: Watch) -> None:
        if self._trials is None or "planning" in self._times:
            return
        self._trials.step()
        if self._trials.is_finished:
            self._times["planning"] = time.monotonic() - started
            timeline.record_step(timeline.PLANNED)
            watch.remove_partitions([OTHER])

    def _save(self) -> None:
        if self._trials is not None and (only_job := self._store.only_job) is not None:
            new_trials = self._trials.trials[len(only_job.trials) :]
            self._store.db.add_trials(only_job.committed, new_trials)
        self._store.save()

    def _show_progress(self, show: Show, seconds: float) -> None:
        waits_for = LIDAR if self._pipeline.stages.waiting else ""
        progress = replace(self._progress(), seconds=seconds, waits_for=waits_for)
        self._cluster.call(show, progress)
        self._cluster.call(self._page.on_progress, progress, self._states)

    def _progress(self) -> Progress:
        if (stored := self._store.only_job) is None:
            job_count = len(self._store.jobs.numbers)
            return Progress(jobs=job_count, jobs_done=self._store.db.ended_count)
        casting = self._jobs[stored.job.number]
        trials = stored.trials if self._trials is None else self._trials.trials
        return replace(
            stored.progress(),
            generated=casting.generated - stored.scans.start,
            cast=min(stored.resumed + casting.cast, len(stored.scans)),
            replayed=self._pipeline.dispatcher.replayed,
            trials_done=len(trials),
        )

    def _states(self) -> list[dict[str, Any]]:
        """Return the states of jobs that are being cast, followed by those being written.

        See `RunPage.on_progress` for the fields of a state.
        """
        writing = {row.number for row in self._writer.jobs} if self._writer else set()
        pairs = [(self._store.in_flight[number], job) for number, job in self._jobs.items()]
        states = [
            {
                "name": stored.job.name,
                "values": stored.job.values,
                "stored": stored.parts.scans_done,
                "scans": len(stored.scans),
                "points": stored.parts.point_count,
                "seconds": casting.seconds,
                "writing": casting.number in writing,
            }
            for stored, casting in pairs
        ]
        return sorted(states, key=itemgetter("writing"))

    def _stop(self, reason: str) -> None:
        """Stop all tasks after an error if the cluster is still reachable."""
        client = self._cluster.client
        pipeline = self._pipeline
        trials = self._trials
        steps: list[Callable[[], object]] = [lambda: pipeline.stop(reason), pipeline.finish]
        if trials is not None:
            steps.append(trials.tasks.cancel)
        for step in steps:
            # Dask would spend half a minute trying to reach a cluster that no longer exists.
            if client.status != "running":
                return
            with suppress(Exception):  # the first error is reported instead
                step()

    # -- jobs --------------------------------------------------------------------------------

    def _hand_out(self, job: PipelineJob, summaries: Summaries) -> None:
        """Deliver the new frames of a job to the listener in scan order."""
        stored = self._store.in_flight[job.number]
        for frame in stored.frames(summaries):
            job.trace("frame", SORT, [frame.scan])
            self._cluster.call(self._listener.on_frame, frame)
            # If the user's callback raises an error, a resumed run delivers the frame again.
            stored.committed.advance_frames(frame.scan + 1)
            job.trace("release", SORT, [frame.scan])

    def _write(self) -> LidarError | None:
        """Advance the writer, and return an error if it affects all jobs."""
        if self._writer is None:
            return None
        # Stages whose workers have died take precedence over writing.
        slots = 0 if self._pipeline.stages.lacks_slot else self._cluster.spare
        error_of_all: LidarError | None = None
        for files, outcome in self._writer.step(slots, more_to_come=bool(self._pipeline.jobs)):
            if isinstance(outcome, JobError):
                self._fail(files.row.number, outcome)
            elif isinstance(outcome, LidarError):
                error_of_all = outcome
            else:
                self._rows.append(outcome)
        return error_of_all

    def _admit(self) -> None:
        """Begin the jobs that are ready, as long as the pipeline has room for them."""
        max_in_flight = EXTRA_JOBS + 2 * self._pipeline.workers.slot_count
        # Small jobs begin together, so that they can share tasks and messages.
        together = self._pipeline.dispatcher.per_task if self._pipeline.jobs else 1
        if self._maker is None or not self._maker.has_ready(together):
            return
        while self._pipeline.has_room and len(self._store.in_flight) < max_in_flight:
            if (entry := self._maker.pop()) is None:
                break
            if isinstance(entry, JobRow):
                self._rows.append(entry)
            else:
                self._begin(entry)

    def _begin(self, job: Job) -> None:
        """Add a job to the pipeline, and begin its planning.

        The job fails if its scans are too large for the workers, or if it cannot be pickled.
        """
        stored = self._store.open_job(job)
        try:
            if self._writer is not None:  # the job of a survey was checked at the start
                self._cluster.check(job)
            elif job.planning is not None:
                self._begin_planning(job.planning, stored.trials)
            self._cast(stored)
        except JobError as error:
            self._fail(job.number, error)

    def _begin_planning(self, planning: Planning, earlier_trials: Sequence[Trial]) -> None:
        self._trials = TrialRunner(self._cluster.tasks(OTHER), planning, earlier_trials)
        self._trials.step()  # before the survey begins, so that no slot of OTHER is idle
        # Withdraw the initial request for slots, because pending trials now cause an adaptive
        # partition to grow.
        self._trials.tasks.partition.request_slots(0)

    def _cast(self, stored: StoredJob) -> None:
        job = stored.job
        # In a campaign, further jobs use the remaining slots, so batches can be larger.
        jobs_left = len(self._store.jobs.numbers) - self._store.db.ended_count
        limit = self._cluster.options.batch_mb * MB
        on_device = self._cluster.backend == "cuda"
        self._jobs[job.number] = self._pipeline.add_job(
            stored.committed,
            job.scene,
            job.survey,
            scans_per_task=scans_that_fit(job.scene, job.survey, limit, on_device=on_device),
            scans_of_run=len(stored.scans) * jobs_left,
        )
        self._jobs_begun += 1
        self._scans_begun += len(stored.scans)
        to_come = max(0, jobs_left - len(self._store.in_flight))
        self._scans_to_come = to_come * self._scans_begun // self._jobs_begun

    def _write_request(self, casting: PipelineJob) -> WriteRequest:
        """Create a write request for a job whose scans have all been committed."""
        stored = self._store.in_flight[casting.number]
        job = stored.job
        row = JobRow(
            number=job.number,
            name=job.name,
            split=job.split,
            values=dict(job.values),
            scans=job.survey.scan_count,
            sweeps=len(job.sweeps),
            rays=job.survey.ray_count,
            hits=stored.parts.hit_count,
            # The casting time of scans from an earlier run is not known.
            seconds=None if stored.resumed else casting.seconds,
        )
        return WriteRequest(row, stored.points(), stored.sweeps(), job.input_files)

    def _fail(self, number: int, error: LidarError) -> None:
        """Record the row of a failed job, or raise the error if the run is a survey."""
        if self._store.only_job is not None:
            raise error
        self._rows.append(failed_row(self._store.jobs, number, error))

    def _commit(self) -> None:
        """Commit the rows of ended jobs to the run's database, and delete the jobs' parts."""
        rows = self._rows
        self._rows = []
        if not rows:
            return
        ended = self._store.commit_jobs(rows)  # excludes jobs that could not be created
        for row in rows:
            self._jobs.pop(row.number, None)
            self._page.on_job_end(row)
        self._remover.submit(self._remove, ended)

    def _remove(self, ended: Sequence[tuple[JobRow, StoredJob]]) -> None:
        """Delete the parts of ended jobs after the page has read their points."""
        for row, job in ended:
            with suppress(LidarError, OSError):  # leftover files are harmless
                if row.done:
                    self._page.on_job_written(row, job)
            with suppress(LidarError, OSError):
                self._store.storage.remove([part.name for part in job.parts.ordered])
