"""Conducts a run from its place to its result: a survey or many, for commands and for Python."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager, ExitStack, nullcontext, suppress
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from lidarsim.base.errors import LidarError
from lidarsim.base.storage import Storage
from lidarsim.simulator.scene_caster import check_backend_here

from ..base.shard import ALL
from ..datasets.dataset import DataSet
from ..datasets.job_table import JobRow
from ..plan import best
from ..scenario.build import Job
from ..scenario.campaign import CampaignSpec
from ..scenario.empty_cloud import EMPTY, empty_cloud_reason, empty_jobs_warning
from .cluster.cluster import Cluster
from .job_source import JobMaker, Jobs, MadeJob, OneJob
from .options import RunOptions
from .pipeline.messages import ScanFrame
from .progress import Screen
from .run_loop import Run
from .run_page import RunPage
from .run_result import RunResult
from .store.database import FILE
from .store.run_store import RunStore, remove_run

R = TypeVar("R")


class Output(Generic[R]):
    """Where what a run makes goes."""

    dataset: DataSet | None = None  # that jobs are written into; else the only job's parts stay
    casts = True  # whether scans that are missing are cast

    def held(self) -> AbstractContextManager[object]:
        """Lock the place while the body runs."""
        return nullcontext()

    def begin(self, conductor: Conductor[R]) -> R | None:
        """Refuse what must not be replaced; returns the result if nothing is left to do."""
        return None

    def look(self, conductor: Conductor[R]) -> None:
        """Compare what is there with what the store says is done."""

    def finish(self, conductor: Conductor[R]) -> R:
        """Write what is to be written in the end, and return the result."""
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class Kept(Output[RunResult]):
    """Nothing is written: the points stay in the run's store, and what they are `made_of`."""

    made_of: Mapping[str, Any] | None = None

    def finish(self, conductor: Conductor[RunResult]) -> RunResult:
        """Return the result of the only job."""
        result = conductor.result()
        if self.made_of is not None:
            made_of, notes = map(json.dumps, (self.made_of, result.notes))
            conductor.store.db.set(made_of=made_of, notes=notes)
            conductor.store.save(now=True)
        conductor.page.finish(result.seconds, result)
        conductor.store.db.close()
        return result


class Conductor(Generic[R]):
    """Does what is left of a run, and has its output written.

    Call it once. LidarError if the place holds something else, the cluster lacks something, or
    a task fails; its notes, and those of an interrupt, say what was kept.
    """

    def __init__(
        self,
        jobs: Jobs,
        options: RunOptions,
        output: Output[R],
        screen: Screen,
        page: RunPage,
        on_frame: Callable[[ScanFrame], None] | None = None,
    ) -> None:
        self.jobs, self.options, self.output = jobs, options, output
        self.screen, self.page, self._on_frame = screen, page, on_frame
        self.started = time.monotonic()
        self.stack, self.cluster_stack = ExitStack(), ExitStack()  # the latter of the cluster
        self.store: RunStore
        self.cluster: Cluster | None = None  # stays None if nothing is left to be cast
        self.run: Run | None = None
        self._maker: JobMaker | None = None  # of all jobs but the first

    def __call__(self) -> R:
        """Do it."""
        with self.stack:
            self._hold_place()
            if (result := self.output.begin(self)) is not None:
                return result
            self._open_store()
            if (first := self._first_job()) is not None:
                self._cast(first)
            return self.output.finish(self)

    def warn_of_empty_jobs(self, rows: Iterable[JobRow]) -> list[str]:
        """Warn if jobs of a campaign have no points; returns the warning, for notes."""
        empty = [row for row in rows if row.done and not row.points]
        if not empty:
            return []
        reason = ""
        with suppress(LidarError):  # a file that the job is made of may be gone
            job = self.jobs.job(empty[0].number) if isinstance(self.jobs, CampaignSpec) else None
            reason = empty_cloud_reason(job.scene, job.survey) if job else ""
        warning = empty_jobs_warning(empty, reason)
        self.screen.warn(warning)
        return [warning]

    @property
    def goes_on(self) -> bool:
        """Whether this run goes on with an unfinished one."""
        place = self.options.folder
        return bool(self.resume and place is not None and FILE in Storage.at(place).sizes())

    @property
    def resume(self) -> bool:
        """Whether it may go on with an earlier run."""
        return self.options.resume or self.options.retry_failed or self.options.verify

    def _hold_place(self) -> None:
        if (self.options.fresh or self.options.overwrite) and self.resume:
            raise LidarError(
                "fresh and overwrite remove what resume, retry_failed and verify go on with."
            )
        self.stack.enter_context(self.output.held())

    def _open_store(self) -> None:
        options = self.options
        if options.fresh and options.folder is not None:
            remove_run(options.folder)
        checking = "checking the points of the earlier run"
        with self.screen.status(checking) if self.goes_on else nullcontext():
            place = options.folder, options.parts
            self.store = RunStore(self.jobs, options.backend, *place, resume=self.resume)
        told = self.store.kept or self.store.notes or self.jobs.shard != ALL  # of a queue's task
        if options.resume and self.store.only and not told:
            self.store.notes.append(f"there was nothing to resume in {options.out or place[0]}")
        self.stack.enter_context(self.store.kept_on_error())
        if self.store.only is not None:
            self.page.begun(self.store.only)
        self.output.look(self)
        self.stack.enter_context(self.cluster_stack)

    def _first_job(self) -> MadeJob | None:
        """Wait for a job that can be made; None if nothing is left to be cast."""
        if (only := self.store.only) is not None:
            return None if only.complete or not self.output.casts else MadeJob(only.job)
        jobs, dataset, db = self.jobs, self.output.dataset, self.store.db
        assert not isinstance(jobs, OneJob) and dataset is not None, "it is a campaign"
        left = (number for number in jobs.numbers if not db.ended(number))
        self._maker = JobMaker(jobs, left, dataset.columns)
        self.stack.callback(self._maker.close)
        while isinstance(found := self._maker.take(wait=True), JobRow):
            self.store.end([found])
            self.page.ended(found)
        return found

    def _cast(self, first: MadeJob) -> None:
        """Cast what is left, on a cluster with the slots that the first job needs."""
        store, options, enter = self.store, self.options, self.cluster_stack.enter_context
        if options.own:
            check_backend_here(store.backend or options.backend, store.advice)
        self.cluster = Cluster(first.job, store, options, self.screen, enter)
        dataset = self.output.dataset
        self.page.follow(self.cluster.partitions, dataset)
        self.run = Run(self.cluster, store, self.page, self._maker, dataset, self._frame)
        with self.screen.progress() as show:
            self.run.cast(first, show)

    def _frame(self, frame: ScanFrame) -> None:
        self.page.on_frame(frame)
        if self._on_frame is not None:
            self._on_frame(frame)

    # -- for outputs -------------------------------------------------------------------------

    def result(self) -> RunResult:
        """Return the result of the only job, which is committed."""
        only, run = self.store.only, self.run
        assert only is not None, "there is one"
        job = only.job
        trials = tuple(sorted(only.parts.trials, key=lambda trial: trial.trial))
        times, points = run.times if run else {}, only.points()
        if not len(points):
            self._warn_of_empty_cloud(job)
        return RunResult(
            scene=job.scene,
            survey=job.survey,
            planning=job.planning,
            points=points,
            plan=best(trials, job.planning) if job.planning else None,
            trials=trials,
            backend=self.store.backend,
            rays=job.survey.ray_count,
            hits=only.parts.hits,
            stages=run.stages if run else (),
            resumed=only.resumed,
            notes=tuple(self.store.notes),
            identity=self.store.identity,
            _hit_counts=only.hit_counts,
            sample_rays=only.sample_rays(),
            seconds=time.monotonic() - self.started if run else 0.0,
            survey_seconds=times.get("survey", 0.0),
            planning_seconds=times.get("planning", 0.0),
            replayed=run.kept.offered_again if run and run.kept else 0,
        )

    def _warn_of_empty_cloud(self, job: Job) -> None:
        """Warn that the only job has no points; a whole survey also has a note."""
        shard = self.jobs.shard
        scans = None if shard == ALL else shard.scans(job.survey.scan_count)
        reason = empty_cloud_reason(job.scene, job.survey, scans)
        if shard != ALL:
            self.screen.warn(f"shard {shard} has no points: {reason}")
            return
        warning = f"{EMPTY}: {reason}"
        self.store.notes.append(warning)
        self.screen.warn(warning)

    def result_is_in(self, place: object) -> None:
        """Have any later error or interrupt say that the result is complete."""

        def note(_: object, error: BaseException | None, __: object) -> None:
            if error is not None:
                error.add_note(f"The result in {place} is complete.")

        self.stack.push(note)
