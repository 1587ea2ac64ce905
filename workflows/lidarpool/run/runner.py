"""Casts the jobs of a run: opens its store, starts its workers, and casts what is missing.

`Run` is what a survey, a campaign, a shard and a merge have in common. Each of these is a function
that calls the methods of `Run` in order and writes its own result: `cast_to_store` below for
results that stay in the store, `run_survey` in `report/output.py`, `run_campaign` in
`report/campaign_output.py`, and `merge` in `report/merging.py`, which casts nothing.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext, suppress
from typing import Any, Self, TypeVar

from lidarsim.base.errors import LidarError
from lidarsim.base.storage import Storage
from lidarsim.simulator.casting.scene_caster import check_backend_here

from ..base.shard import ALL
from ..datasets.dataset import DataSet
from ..datasets.job_table import JobRow
from ..plan import best
from ..scenario.build import Job
from ..scenario.empty_cloud import EMPTY, empty_cloud_reason, empty_jobs_warning
from .cluster.checks import slots_needed
from .cluster.cluster import Cluster, start_local
from .cluster.connection import StartedAhead
from .job_source import JobMaker, Jobs
from .options import RunOptions
from .pace import Pacer
from .pipeline.stage_messages import Receipt, ScanFrame
from .progress import Screen
from .run_loop import RunLoop
from .run_page import RunPage
from .run_result import RunResult
from .store.database import FILE
from .store.run_store import RunStore, remove_run

T = TypeVar("T")


def cast_to_store(
    jobs: Jobs,
    options: RunOptions,
    screen: Screen,
    page: RunPage,
    on_frame: Callable[[ScanFrame], None] | None = None,
    made_of: Mapping[str, Any] | None = None,
) -> RunResult:
    """Cast the only job of a run, and leave its points in the store of the run.

    `on_frame` is called with each frame in scan order. `made_of` is stored with the points, so that
    the shards of a survey can be merged.
    """
    with Run(jobs, options, screen, page, on_frame) as run:
        run.open_store()
        run.cast()
        return run.keep(made_of)


class Run:
    """The store and the workers of a run, as a context manager.

    Within the context, lock the destination of the result with `enter` if there is one, then call
    `open_store`, and `cast` unless all points are taken from elsewhere. `store`, `result` and
    `notes` then have what was committed.

    Parameters
    ----------
    jobs
        The jobs of the run.
    options
        Options of the run.
    screen, page
        Where progress and warnings are shown.
    on_frame
        Function that is called with each frame of the only job, in scan order.
    on_parts
        Function that is called with committed parts of the only job; it must return at once.
    dataset
        Data set to which the jobs of a campaign are written. Without it, the parts of the only job
        stay in the store.

    Raises
    ------
    LidarError
        If the store belongs to another run, the cluster lacks workers or software, or a task fails.
        The notes of errors and interrupts name the committed results.
    """

    def __init__(
        self,
        jobs: Jobs,
        options: RunOptions,
        screen: Screen,
        page: RunPage,
        on_frame: Callable[[ScanFrame], None] | None = None,
        *,
        on_parts: Callable[[Sequence[Receipt]], None] = lambda receipts: None,
        dataset: DataSet | None = None,
    ) -> None:
        self.jobs = jobs
        self.options = options
        self.screen = screen
        self.page = page
        self.dataset = dataset
        self._on_frame = on_frame
        self._on_committed = on_parts
        self._warnings = tuple(screen.warnings)  # about the scenario, before the run
        self._pacer = None if options.pace is None else Pacer(options.pace)
        self._unshown: list[Receipt] = []  # parts whose frames wait for their time
        self.started = time.monotonic()
        self._stack = ExitStack()
        self._cluster_stack = ExitStack()  # leaves the cluster
        self.store: RunStore
        self._local: StartedAhead | None = None  # workers of this machine, for this run
        self.cluster: Cluster | None = None  # stays None if nothing is left to be cast
        self.loop: RunLoop | None = None
        self._maker: JobMaker | None = None  # makes all jobs after the first

    def __enter__(self) -> Self:
        if (self.options.restart or self.options.overwrite) and self.resume:
            raise LidarError(
                "`restart` and `overwrite` cannot be combined with `resume`, `retry_failed` or "
                "`verify`, because they remove the run that these options continue."
            )
        self._stack.__enter__()
        return self

    def __exit__(self, *error: Any) -> bool | None:
        return self._stack.__exit__(*error)

    def enter(self, context: AbstractContextManager[T]) -> T:
        """Enter a context that ends with the run, after its cluster."""
        return self._stack.enter_context(context)

    def open_store(self) -> None:
        """Open the store, which may have points of an earlier run, and begin to start workers."""
        options = self.options
        # Workers start while this process prepares the run, unless nothing may be left to cast.
        if not self.resume:
            self._start_local()
        if options.restart and options.folder is not None:
            remove_run(options.folder)
        checking = "checking the points of the earlier run"
        with self.screen.status(checking) if self.continues_run else nullcontext():
            self.store = RunStore(
                self.jobs, options.backend, options.folder, options.scratch_dir, resume=self.resume
            )
        # A task of a batch queue resumes its shard whether the shard has begun or not.
        explained = self.store.committed_in_words or self.store.notes or self.jobs.shard != ALL
        if options.resume and self.store.only_job and not explained:
            location = options.out or options.folder
            self.store.notes.append(f"{location} contained no unfinished run to resume")
        self._stack.enter_context(self.store.kept_on_error())
        if self.store.only_job is not None:
            self.page.begun(self.store.only_job)

    def cast(self) -> None:
        """Cast all scans of the jobs that are not committed."""
        self._stack.enter_context(self._cluster_stack)
        if (first := self._first_job()) is not None:
            self._run_on_cluster(first)

    def leave_cluster(self) -> None:
        """Stop the workers of this run, or disconnect from a cluster, before the run ends."""
        self._cluster_stack.close()

    def warn_of_empty_jobs(self, rows: Iterable[JobRow]) -> list[str]:
        """Warn if jobs of a campaign have no points, and return the warning as notes."""
        empty = [row for row in rows if row.done and not row.points]
        if not empty:
            return []
        reason = ""
        with suppress(LidarError):  # a file that the job is made of may be gone
            job = self.jobs.job(empty[0].number)
            reason = empty_cloud_reason(job.scene, job.survey)
        warning = empty_jobs_warning(empty, reason)
        self.screen.warn(warning)
        return [warning]

    @property
    def continues_run(self) -> bool:
        """True if this run continues an unfinished run."""
        folder = self.options.folder
        return bool(self.resume and folder is not None and FILE in Storage.at(folder).sizes())

    @property
    def resume(self) -> bool:
        """True if this run may continue an earlier run."""
        return self.options.resume or self.options.retry_failed or self.options.verify

    def _start_local(self) -> None:
        """Begin to start workers on this machine, if the options say so."""
        if self.options.starts_workers:
            job = self.jobs.only_job
            planning = job is not None and job.planning is not None
            slots = slots_needed(self.options, planning=planning, writing=job is None)
            self._local = start_local(self.options, slots)
            self._stack.push(self._local)

    def _first_job(self) -> Job | None:
        """Return the first job that can be made, or None if all scans are cast."""
        if (only_job := self.store.only_job) is not None:
            return None if only_job.complete else only_job.job
        jobs = self.jobs
        db = self.store.db
        assert self.dataset is not None, "a campaign has one"
        numbers = (number for number in jobs.numbers if not db.ended(number))
        self._maker = JobMaker(jobs, numbers, self.dataset.columns)
        self._stack.callback(self._maker.close)
        while isinstance(entry := self._maker.take(wait=True), JobRow):
            self.store.end([entry])
            self.page.ended(entry)
        return entry

    def _run_on_cluster(self, first: Job) -> None:
        """Cast the remaining jobs, on a cluster with the slots that the first job needs."""
        store = self.store
        options = self.options
        enter = self._cluster_stack.enter_context
        if options.starts_workers:
            check_backend_here(store.backend or options.backend, store.advice)
        self.cluster = Cluster(first, store, options, self.screen, enter, self._local)
        self.page.follow(self.cluster.partitions, self.dataset)
        self.loop = RunLoop(
            self.cluster,
            store,
            self.page,
            self._maker,
            self.dataset,
            self._frame,
            self._on_parts,
        )
        with self.screen.progress() as show:
            self.loop.run(first, show)

    def _frame(self, frame: ScanFrame) -> None:
        if self._pacer is not None:
            self._pacer.wait(frame.time_ns)
            self._show_parts(frame.scan + 1)
        self.page.on_frame(frame)
        if self._on_frame is not None:
            self._on_frame(frame)

    def _on_parts(self, receipts: Sequence[Receipt]) -> None:
        if self._pacer is None:
            self.page.on_parts(receipts)
        else:
            self._unshown += receipts
        self._on_committed(receipts)

    def _show_parts(self, stop: int) -> None:
        """Show the parts up to a scan, whose frames are due."""
        due = sorted((part for part in self._unshown if part.first < stop), key=lambda p: p.first)
        if due:
            self._unshown = [part for part in self._unshown if part.first >= stop]
            self.page.on_parts(due)

    # -- what was committed --------------------------------------------------------------------

    def notes(self, job: Job | None = None) -> tuple[str, ...]:
        """Return the notes of the run, after the warnings about its scenario."""
        warnings = [*self._warnings]
        if job is not None and job.place_problem:
            warnings.append(job.place_problem)
        return tuple(dict.fromkeys([*warnings, *self.store.notes]))

    def result(self) -> RunResult:
        """Return the result of the only job, which is committed."""
        only_job = self.store.only_job
        loop = self.loop
        assert only_job is not None, "there is one"
        job = only_job.job
        trials = tuple(sorted(only_job.trials, key=lambda trial: trial.trial))
        times = loop.times if loop else {}
        points = only_job.points()
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
            hit_count=only_job.parts.hit_count,
            stages=loop.stages if loop else (),
            resumed=only_job.resumed,
            notes=self.notes(job),
            identity=self.store.identity,
            _hit_counts=only_job.hit_counts,
            sample_rays=only_job.sample_rays(),
            seconds=time.monotonic() - self.started if loop else 0.0,
            survey_seconds=times.get("survey", 0.0),
            planning_seconds=times.get("planning", 0.0),
            replayed=loop.replayed if loop else 0,
        )

    def _warn_of_empty_cloud(self, job: Job) -> None:
        """Warn that the only job has no points, and add a note unless the run is a shard."""
        shard = self.jobs.shard
        scans = None if shard == ALL else shard.scans(job.survey.scan_count)
        reason = empty_cloud_reason(job.scene, job.survey, scans)
        if shard != ALL:
            self.screen.warn(f"shard {shard} has no points: {reason}")
            return
        warning = f"{EMPTY}: {reason}"
        self.store.notes.append(warning)
        self.screen.warn(warning)

    def keep(self, made_of: Mapping[str, Any] | None = None) -> RunResult:
        """Return the result of the only job, whose points stay in the store.

        `made_of` is stored with the points.
        """
        result = self.result()
        if made_of is not None:
            self.store.db.set(made_of=json.dumps(made_of), notes=json.dumps(result.notes))
            self.store.save(force=True)
        self.page.finish(result.seconds, result)
        self.store.db.close()
        return result

    def result_is_in(self, location: object) -> None:
        """Add a note that the result is complete to any later error or interrupt."""

        def note(_: object, error: BaseException | None, __: object) -> None:
            if error is not None:
                error.add_note(f"The result in {location} is complete.")

        self._stack.push(note)
