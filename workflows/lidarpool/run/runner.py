"""A run of one or many jobs, from its options to its result: for commands and for Python.

The way through the driver: `Run.execute` locks the output, which may have the result already.
Workers of this machine begin to start while the `RunStore` is opened. For the first `Job` with
something left to be cast, it makes a `Cluster` and a `RunLoop`. The loop adds each job, as a
`JobUnderWay` of the store, to the `Pipeline`. Stage 1 sends ranges of scans; the `Dispatcher`
makes batches of them, asks `policies.offers` which worker gets them, and `CastingWorkers.submit`
gives them to that worker as a task. There `rigs.intersect` casts each batch by a `Rig`, as
`lidarsim/simulator/pulses.py` tells. The dispatcher sends a `CollectOrder` to a collector, which
stores the columns as a part and sends a `Receipt`; `Pipeline` commits it. Of a survey, stage 3
returns the `Summaries` of scans in order, and the pipeline hands a `ScanFrame` of each to
`on_frame`. The parts of a campaign's job whose scans are committed go to the `JobWriter`, and
`RunLoop` commits the job's row. The parts of a survey become the points of a `RunResult`.
`Output.finish` makes the result: files of a survey (`report/output.py`) or a campaign
(`report/campaign_output.py`).
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext, suppress
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

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
from .run_loop import Listeners, RunLoop
from .run_page import RunPage
from .run_result import RunResult
from .store.database import FILE
from .store.run_store import RunStore, remove_run

R = TypeVar("R")


class Output(Generic[R]):
    """Destination of the results of a run."""

    dataset: DataSet | None = None  # jobs are written into it; else the parts of the job stay
    casts = True  # False if missing scans are not to be cast

    def held(self) -> AbstractContextManager[object]:
        """Return a context that locks the destination."""
        return nullcontext()

    def begin(self, run: Run[R]) -> R | None:
        """Refuse files that must not be replaced, and return the result if no work is left."""
        return None

    def prepare(self) -> None:
        """Load what writes the results, so that a missing library is reported at the start."""

    def look(self, run: Run[R]) -> None:
        """Compare the output with the results of an earlier run in the store."""

    def on_parts(self, receipts: Sequence[Receipt]) -> None:
        """Note that parts of the only job were committed, and return at once."""

    def finish(self, run: Run[R]) -> R:
        """Write the last files, and return the result."""
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class StoredOutput(Output[RunResult]):
    """Points that stay in the run's store, with the sources of the job in `made_of`."""

    made_of: Mapping[str, Any] | None = None

    def finish(self, run: Run[RunResult]) -> RunResult:
        """Return the result of the only job."""
        result = run.result()
        if self.made_of is not None:
            made_of, notes = map(json.dumps, (self.made_of, result.notes))
            run.store.db.set(made_of=made_of, notes=notes)
            run.store.save(force=True)
        run.page.finish(result.seconds, result)
        run.store.db.close()
        return result


class Run(Generic[R]):
    """Casts the remaining jobs of a run, and has their output written.

    Call `execute` once. LidarError if the destination holds another result, the cluster lacks
    workers or software, or a task fails; the notes of errors and interrupts name the committed
    results.
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
        self.jobs = jobs
        self.options = options
        self.output = output
        self.screen = screen
        self.page = page
        self._on_frame = on_frame
        self._warnings = tuple(screen.warnings)  # about the scenario, before the run
        self._pacer = None if options.pace is None else Pacer(options.pace)
        self._unshown: list[Receipt] = []  # parts whose frames wait for their time
        self.started = time.monotonic()
        self.stack = ExitStack()
        self.cluster_stack = ExitStack()  # leaves the cluster
        self.store: RunStore
        self._local: StartedAhead | None = None  # workers of this machine, for this run
        self.cluster: Cluster | None = None  # stays None if nothing is left to be cast
        self.loop: RunLoop | None = None
        self._maker: JobMaker | None = None  # makes all jobs after the first

    def execute(self) -> R:
        """Cast remaining jobs, and return the result of the output."""
        with self.stack:
            self._lock_output()
            if (result := self.output.begin(self)) is not None:
                return result
            # Workers start while this process prepares the run, unless nothing may be left to cast.
            if self.output.casts and not self.resume:
                self._start_local()
            self._open_store()
            self.output.prepare()
            if (first := self._first_job()) is not None:
                self._run_on_cluster(first)
            return self.output.finish(self)

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
            self.stack.push(self._local)

    def _lock_output(self) -> None:
        if (self.options.restart or self.options.overwrite) and self.resume:
            raise LidarError(
                "`restart` and `overwrite` cannot be combined with `resume`, `retry_failed` or "
                "`verify`, because they remove the run that these options continue."
            )
        self.stack.enter_context(self.output.held())

    def _open_store(self) -> None:
        options = self.options
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
        self.stack.enter_context(self.store.kept_on_error())
        if self.store.only_job is not None:
            self.page.begun(self.store.only_job)
        self.output.look(self)
        self.stack.enter_context(self.cluster_stack)

    def _first_job(self) -> Job | None:
        """Return the first job that can be made, or None if all scans are cast."""
        if (only_job := self.store.only_job) is not None:
            return None if only_job.complete or not self.output.casts else only_job.job
        jobs = self.jobs
        dataset = self.output.dataset
        db = self.store.db
        assert dataset is not None, "a campaign has one"
        numbers = (number for number in jobs.numbers if not db.ended(number))
        self._maker = JobMaker(jobs, numbers, dataset.columns)
        self.stack.callback(self._maker.close)
        while isinstance(entry := self._maker.take(wait=True), JobRow):
            self.store.end([entry])
            self.page.ended(entry)
        return entry

    def _run_on_cluster(self, first: Job) -> None:
        """Cast the remaining jobs, on a cluster with the slots that the first job needs."""
        store = self.store
        options = self.options
        enter = self.cluster_stack.enter_context
        if options.starts_workers:
            check_backend_here(store.backend or options.backend, store.advice)
        self.cluster = Cluster(first, store, options, self.screen, enter, self._local)
        dataset = self.output.dataset
        self.page.follow(self.cluster.partitions, dataset)
        listeners = Listeners(self._frame, self._on_parts)
        self.loop = RunLoop(self.cluster, store, self.page, self._maker, dataset, listeners)
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
        self.output.on_parts(receipts)

    def _show_parts(self, stop: int) -> None:
        """Show the parts up to a scan, whose frames are due."""
        due = sorted((part for part in self._unshown if part.first < stop), key=lambda p: p.first)
        if due:
            self._unshown = [part for part in self._unshown if part.first >= stop]
            self.page.on_parts(due)

    # -- for outputs -------------------------------------------------------------------------

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
            replayed=only_job.offered_again,
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

    def result_is_in(self, location: object) -> None:
        """Add a note that the result is complete to any later error or interrupt."""

        def note(_: object, error: BaseException | None, __: object) -> None:
            if error is not None:
                error.add_note(f"The result in {location} is complete.")

        self.stack.push(note)
