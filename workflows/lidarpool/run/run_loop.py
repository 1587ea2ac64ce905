"""Jobs on a cluster: cast several at a time, committed, written, and planned beside."""

from __future__ import annotations

import time
import uuid
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from functools import partial

from distributed.client import FutureCancelledError

from lidarsim.base.errors import LidarError
from lidarsim.simulator.memory import MB, scans_that_fit

from ..datasets.dataset import DataSet
from ..datasets.job_table import JobRow
from ..scenario.build import Job
from .cluster.cluster import Cluster
from .job_source import JobMaker, MadeJob, OneJob, failed_row
from .pipeline.batches import JobState
from .pipeline.casting_workers import CastingWorkers
from .pipeline.failures import JobError
from .pipeline.long_stages import LongStages
from .pipeline.messages import ScanFrame
from .pipeline.names import GPU, LIDAR, OTHER
from .pipeline.pipeline import RunDriver
from .pipeline.task_book import StageTotals
from .progress import Progress, Show
from .run_page import JobNow, RunPage
from .store.job_under_way import JobPoints
from .store.run_store import RunStore
from .trials import TrialPump
from .writer import JobFiles, JobWriter

PROGRESS_EVERY_S = 0.1
SAVE_EVERY_S = 1.0  # stores the number of frames handed out
LONGEST_PAUSE_S = 0.05  # while nothing moves
SPARE = 64  # jobs under way beside two for each GPU slot


class Run:
    """The jobs that are left of a run, on a cluster: the first one, and those of `maker`.

    They are written into a `dataset`; without one there is only one job, whose parts are kept, and
    whose frames `on_frame` is called with.
    """

    def __init__(
        self,
        cluster: Cluster,
        store: RunStore,
        page: RunPage,
        maker: JobMaker | None,
        dataset: DataSet | None,
        on_frame: Callable[[ScanFrame], None],
    ) -> None:
        self._cluster, self._store, self._page = cluster, store, page
        self._maker, self._on_frame = maker, on_frame
        options, run = cluster.options, uuid.uuid4().hex[:8]
        stages = LongStages(
            cluster.partitions[LIDAR],
            run,
            cluster.software["lidarpool"],
            store.storage,
            store.db.meta["mark"],
            queue_capacity=options.queue_capacity,
            collectors=options.collectors,
            patience_s=options.patience_s,
        )
        gpus = cluster.partitions[GPU]
        workers = CastingWorkers(gpus, run, cluster.backend, cluster.software)
        self._driver = RunDriver(workers, stages, store.db)
        self._writer: JobWriter | None = None
        if dataset is not None:
            self._writer = JobWriter(cluster.tasks(LIDAR), dataset, store, stages.probe)
        self._trials: TrialPump | None = None
        self._rows: list[JobRow] = []  # of jobs that have ended, and are not yet committed
        self._scans_begun = self._jobs_begun = 0
        self._remover = ThreadPoolExecutor(1, "remove")
        self.kept: JobState | None = None  # the job whose parts are kept, once it is committed
        self.times: dict[str, float] = {}  # seconds: {"survey": …, "planning": …}
        self.stages: tuple[StageTotals, ...] = ()

    # -- jobs come and go --------------------------------------------------------------------

    @property
    def finished(self) -> bool:
        """True once all jobs have ended."""
        if self._maker is None:
            return self.kept is not None
        return self._maker.ended and not self._store.under_way

    def step(self) -> bool:
        """Do what can be done now; returns whether there was anything to do.

        LidarError if something fails that all jobs need.
        """
        moved = self._admit()
        moved |= self._driver.step()
        for state, error in self._driver.take_ended():
            moved = True
            if error is not None:
                self._fail(state.number, error)
            elif self._writer is None:
                self.kept = state
            else:
                self._writer.add(self._files_of(state))
        for_all: LidarError | None = None
        # A stage whose worker has died gets its slot first.
        slots = 0 if self._driver.stages.lacks_slot else self._cluster.spare
        more = bool(self._driver.jobs)
        for files, made in () if self._writer is None else self._writer.step(slots, more=more):
            moved = True
            if isinstance(made, JobError):
                self._fail(files.row.number, made)
            elif isinstance(made, LidarError):
                for_all = made
            else:
                self._rows.append(made)
        self._commit()
        if for_all is not None:
            raise for_all
        return moved

    def _admit(self) -> bool:
        """Take on jobs that are ready, if there is room for them."""
        moved, most = False, SPARE + 2 * self._driver.workers.slot_count
        # Small jobs begin together, and go on together: then they share messages and tasks.
        together = self._driver.dispatcher.per_task if self._driver.jobs else 1
        if self._maker is None or not self._maker.has(together):
            return False
        while self._driver.has_room and len(self._store.under_way) < most:
            if (found := self._maker.take()) is None:
                break
            moved = True
            if isinstance(found, JobRow):
                self._rows.append(found)
            else:
                self._begin(found)
        return moved

    def _begin(self, made: MadeJob) -> None:
        points = self._store.points_of(made.job)
        points.sweeps = made.sweeps
        try:
            if self._writer is not None:  # else it was checked before anything was started
                self._cluster.check(made.job)
            self._cast(made.job, points)
        except JobError as error:  # too large for the workers, or it cannot be pickled
            self._fail(made.job.number, error)

    def _cast(self, job: Job, points: JobPoints) -> None:
        cluster, kept = self._cluster, self._writer is None
        if kept and job.planning is not None:
            self._trials = TrialPump(cluster.tasks(OTHER), job.planning, points.parts.trials)
            self._trials.step()  # first: no slot of OTHER waits for the survey
            self._trials.tasks.partition.want(0)  # from now on its trials wait for workers
        # Of a campaign's job many follow, so that its batches need not be divided among all.
        left = len(self._store.jobs.numbers) - self._store.db.ended_count
        self._driver.begin(
            job.number,
            job.scene,
            job.survey,
            fit=scans_that_fit(
                job.scene,
                job.survey,
                cluster.options.batch_mb * MB,
                on_device=cluster.backend == "cuda",
            ),
            in_all=len(points.parts.scans) * left,
            on_frame=partial(cluster.call, self._on_frame) if kept else None,
            read=points.points_of_scan,
            on_parts=self._page.on_parts if kept else None,
        )
        self._jobs_begun += 1
        self._scans_begun += len(points.parts.scans)
        to_come = max(0, left - len(self._store.under_way))
        self._driver.later = to_come * self._scans_begun // self._jobs_begun

    def _files_of(self, state: JobState) -> JobFiles:
        """Return what a job that is committed is written from."""
        points = self._store.under_way[state.number]
        job, sweeps = points.job, points.sweeps
        assert sweeps is not None, "of a data set"
        row = JobRow(
            number=job.number,
            name=job.name,
            split=job.split,
            values=dict(job.values),
            scans=job.survey.scan_count,
            sweeps=len(sweeps),
            rays=job.survey.ray_count,
            hits=points.parts.hits,
            seconds=state.seconds,
        )
        return JobFiles(row, points.points(), sweeps, job.made_of)

    def _fail(self, number: int, error: LidarError) -> None:
        """Note that a job has failed; if there is only one, so has the run."""
        if isinstance(self._store.jobs, OneJob):
            raise error
        self._rows.append(failed_row(self._store.jobs, number, error))

    def _commit(self) -> None:
        """Commit that jobs have ended, and remove what is left of them."""
        rows, self._rows = self._rows, []
        if not rows:
            return
        made = self._store.under_way  # a job that could not be made has no points
        left = [(row, made[row.number]) for row in rows if row.number in made]
        self._store.name_sensors(
            (carried.name or "lidar", f"{sensor.model}, {1e9 / sensor.turn_ns(1):.3g} Hz")
            for row, points in left
            if row.done
            for carried in points.job.survey.carried
            for sensor in [carried.sensor]
        )
        self._store.end(rows)
        for row in rows:
            self._page.ended(row)
        self._remover.submit(self._remove, left)

    def _remove(self, ended: Sequence[tuple[JobRow, JobPoints]]) -> None:
        for row, points in ended:
            with suppress(LidarError, OSError):  # what is left does no harm
                if row.done:
                    self._page.look(row, points)
            with suppress(LidarError, OSError):
                self._store.storage.remove([part.name for part in points.parts.ordered])

    def under_way(self) -> list[JobNow]:
        """List the jobs that are being cast, and then those that are being written."""
        writing = {row.number: row for row in self._writer.jobs} if self._writer else {}
        jobs = [
            JobNow(
                name=points.job.name,
                values=points.job.values,
                stored=points.parts.scans_done,
                scans=len(points.parts.scans),
                points=points.parts.point_count,
                seconds=0.0 if state is None else state.seconds,
                writing=number in writing,
            )
            for number, points in [*self._store.under_way.items()]
            for state in [self._driver.jobs.get(number)]
        ]
        return sorted(jobs, key=lambda job: job.writing)

    # -- to the end --------------------------------------------------------------------------

    def cast(self, first: MadeJob, show: Show) -> None:
        """Do all jobs; on any error, everything has been stopped."""
        cluster, driver = self._cluster, self._driver
        try:
            with cluster.partitions_page(), cluster.stopping(self._stop):
                driver.open()
                self._loop(first, show)
                driver.finish()
        finally:
            if self._writer is not None:
                self._writer.close()
            self._remover.shutdown()
        self._save()
        self._store.save(now=True)
        self._store.tidy()
        others = [one.tasks.book for one in (self._writer, self._trials) if one is not None]
        books = [driver.book, *others]
        self.stages = tuple(totals for book in books for totals in book.stages.values())
        self._store.notes += driver.notes
        if self._writer is not None and self._writer.hidden:
            place = self._writer.dataset.place
            note = f"no worker of {LIDAR} sees {place}: the driver wrote the data set"
            self._store.notes.append(note)

    def _loop(self, first: MadeJob, show: Show) -> None:
        """Step everything until all have finished."""
        driver, started, pause_s = self._driver, time.monotonic(), 0.0
        self._begin(first)  # and its trials
        watch = self._cluster.watch([GPU, OTHER] if self._trials else [GPU], lasting=[LIDAR])
        told = saved = float("-inf")
        beside = [one.tasks for one in (self._writer, self._trials) if one is not None]
        while not (driver.stages.ended and (self._trials is None or "planning" in self.times)):
            moved = False
            if not driver.stages.closed:
                moved = self.step()
                if self.finished:
                    driver.close()
                    self.times["survey"] = time.monotonic() - started
                    watch.forget([GPU, LIDAR])
            if self._trials is not None and "planning" not in self.times:
                moved |= self._trials.step()
                if self._trials.finished:
                    self.times["planning"] = time.monotonic() - started
                    watch.forget([OTHER])
            now = time.monotonic()
            if now - saved >= SAVE_EVERY_S:
                saved = now
                self._save()
            watch.look()
            if now - told >= PROGRESS_EVERY_S or self.finished:
                told = now
                waits_for = LIDAR if driver.stages.waiting else ""
                at = replace(self._progress(), seconds=now - started, waits_for=waits_for)
                self._cluster.call(show, at)
                self._cluster.call(self._page.on_progress, at, self.under_way)
            pause_s = 0.0 if moved else min(max(0.001, 2 * pause_s), LONGEST_PAUSE_S)
            if driver.stages.ended:
                time.sleep(pause_s)
            else:
                driver.wait(pause_s, [future.key for one in beside for future in one.running])
        self._store.notes += watch.notes

    def _save(self) -> None:
        if self._trials is not None and (only := self._store.only) is not None:
            done = len(only.parts.trials)
            self._store.db.add_trials(only.job.number, self._trials.trials[done:])
        self._store.save()

    def _progress(self) -> Progress:
        if (points := self._store.only) is None:
            numbers, ended = self._store.jobs.numbers, self._store.db.ended_count
            return Progress(jobs=len(numbers), jobs_done=ended)
        progress = points.progress()
        if self._trials is not None:
            progress = replace(progress, trials_done=len(self._trials.trials))
        if (state := self._driver.jobs.get(points.job.number, self.kept)) is None:
            return progress
        cast = min(points.resumed + state.cast, progress.scans)
        replayed = state.offered_again
        generated = state.generated - state.parts.scans.start
        return replace(progress, generated=generated, cast=cast, replayed=replayed)

    def _stop(self, reason: str) -> None:
        """Stop everything, as far as the cluster can be reached."""
        client, driver, trials = self._cluster.client, self._driver, self._trials
        steps: list[Callable[[], object]] = [lambda: driver.stop(reason), driver.finish]
        if trials is not None:
            steps.append(trials.tasks.cancel)
        for step in steps:
            # Dask would try for half a minute to reach a cluster that is gone.
            if client.status != "running":
                return
            try:
                # Report the first error. A client that has lost its scheduler cancels its futures
                # before any call fails.
                with suppress(OSError, FutureCancelledError, RuntimeError):
                    step()
            except Exception:
                if client.status == "running":
                    raise
