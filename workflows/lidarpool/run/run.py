"""A run on a cluster: steps the surveys and the planning in turn."""

from __future__ import annotations

import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import replace
from functools import partial
from typing import Any, Protocol, TypeVar

from distributed import Client
from distributed.client import FutureCancelledError
from distributed.comm.core import CommClosedError

from poolpart import Partition, PipeClosed, PipeFailed, PoolError

from ..base.errors import LidarpoolError
from ..base.storage import Storage
from ..pipeline import (
    GPU,
    LIDAR,
    OTHER,
    CastingWorkers,
    Crew,
    Frame,
    LongStages,
    RigPlan,
    SurveyDriver,
)
from ..pipeline.task_book import TaskBook
from ..plan import best
from ..simulator.memory import MB, scans_that_fit
from .checks import check_memory, find_workers, gpu_note, want_nothing
from .job import Job
from .page import Page
from .progress import Show
from .result import RunResult
from .store import RunStore
from .trials import TrialPump
from .watch import Waiting, Watch

T = TypeVar("T")

# Errors that Dask raises once the scheduler is gone.
_CLUSTER_LOST = (OSError, CommClosedError, FutureCancelledError, PipeClosed, PipeFailed)

PROGRESS_EVERY_S = 0.1
SAVE_EVERY_S = 1.0  # stores the number of frames handed out
LOST_S = 0.5  # for a client to notice that its scheduler is gone
LONGEST_PAUSE_S = 0.05  # while nothing moves


class Kept(Protocol):
    """What a run has kept of the workers that cast."""

    backend: str  # empty until known
    casting: dict[str, str]  # their software, empty until known

    @property
    def advice(self) -> str:
        """Advice if the backend is not available, for the end of a message."""

    @property
    def resumed(self) -> int:
        """Scans of an earlier run."""


class Surveys(Protocol):
    """What a run casts, one survey or many."""

    @property
    def finished(self) -> bool:
        """True once all is committed, handed out and written."""

    @property
    def progress(self) -> int:
        """A number that grows when something is committed."""

    def step(self) -> bool:
        """Do what can be done now; returns whether there was anything to do."""


class Cluster:
    """A cluster that can run some jobs: checked, and ready for the crews of runs.

    `job` is what it is checked for, and `kept` says what earlier runs cast with. `tell` is called
    every few seconds with a message while the run waits, and `waiting` says how long to wait for
    workers at the start. Slots `needed` are by default those of the job, and so many scans are
    `left`. LidarpoolError if the cluster lacks something.
    """

    def __init__(
        self,
        client: Client,
        job: Job,
        kept: Kept,
        tell: Callable[[str], None],
        waiting: Waiting,
        needed: Mapping[str, int] | None = None,
        left: int | None = None,
    ) -> None:
        self.client, self.job, self._tell, self._kept = client, job, tell, kept
        # For errors about a lost cluster; a client that was never connected is refused below.
        self.address: str = getattr(client.scheduler, "address", "")
        try:
            pool, casting, backend, software = find_workers(
                client,
                job,
                kept.backend or job.backend,
                kept.advice,
                kept.casting if kept.resumed else {},
                waiting,
                needed,
                left,
            )
            kept.backend, kept.casting = backend, software
        except LidarpoolError:
            want_nothing(client, (GPU, LIDAR, OTHER))
            raise
        except Exception as error:  # the kind depends on the request
            if client.status != "running" or isinstance(error, CommClosedError):
                raise self._told_lost() from error
            raise
        self._pool, self._casting = pool, casting
        names = sorted({name for worker in pool for name in worker.partitions})
        self.partitions = {name: Partition(name, client) for name in names}
        note = gpu_note(pool, casting, backend)
        self.notes: list[str] = [note] if note else []
        self.callers_error: BaseException | None = None  # raised by a callback

    def _told_lost(self) -> LidarpoolError:
        return LidarpoolError(
            f"The cluster at {self.address} cannot be reached any more, or somebody cancelled "
            "the tasks of this run; it has ended without a result."
        )

    @contextmanager
    def partitions_page(self) -> Iterator[None]:
        """Show the page of partitions while the body runs, and print its address.

        Does nothing if the scheduler serves no pages.
        """
        with suppress(PoolError):
            self._tell(f"partitions page: {self._pool.page()}")
        try:
            yield
        finally:
            if self.client.status == "running":
                with suppress(PoolError, *_CLUSTER_LOST):
                    self._pool.leave_page()

    def check(self, job: Job) -> None:
        """Check that the workers have memory for another job; LidarpoolError if not."""
        for worker in self._casting:
            if worker.memory:
                each = worker.memory / max(1, worker.resources[GPU])
                check_memory(job, self._kept.backend, each, f"the GPU worker at {worker.address}")

    def crew(self, storage: Storage, mark: str) -> Crew:
        """Make the crew of a run, which keeps parts in `storage`."""
        job, run = self.job, uuid.uuid4().hex[:8]
        software = self._kept.casting
        return Crew(
            CastingWorkers(self.client, self.partitions[GPU], run, self._kept.backend, software),
            LongStages(
                self.client,
                self.partitions[LIDAR],
                run,
                software["lidarpool"],
                storage,
                mark,
                queue_capacity=job.queue_capacity,
                collectors=job.collectors,
                patience_s=job.patience_s,
            ),
        )

    def driver(
        self, crew: Crew, store: RunStore, on_frame: Callable[[Frame], None], job: str = "0",
        folder: str = "", in_all: int = 0,
    ) -> SurveyDriver:  # fmt: skip
        """Make the driver of a survey; `folder` is that of its parts in the crew's storage."""
        given = store.job
        backend = self._kept.backend
        fit = scans_that_fit(
            given.scene, given.survey, self.job.batch_mb * MB, on_device=backend == "cuda"
        )
        return SurveyDriver(
            crew.seat(job, RigPlan(given.scene, given.survey, backend), folder),
            given.survey,
            store.db,
            store.storage,
            store.points_of_scan,
            partial(self.call, on_frame),
            store.on_parts,
            fit,
            in_all,
        )

    def call(self, callback: Callable[[T], None], argument: T) -> None:
        """Call a callback of the caller; its OSError must not look like the cluster's."""
        try:
            callback(argument)
        except BaseException as error:
            self.callers_error = error
            raise

    def run(
        self,
        crew: Crew,
        surveys: Callable[[], Surveys],
        trials: TrialPump | None,
        save: Callable[[], None],
        on_progress: Callable[[Surveys, float], None],
    ) -> dict[str, float]:
        """Run to the end; on any error, everything has been stopped.

        `surveys` is called once the stages are starting. `save` is called once a second, and
        `on_progress` ten times, with the seconds so far.

        Returns
        -------
        Seconds that the survey and the trials took: {"survey": …, "planning": …}.
        """
        try:
            if trials is not None:  # first: no slot of OTHER waits for the survey
                trials.step()
                self.partitions[OTHER].want(0)  # from now on its trials wait for workers
            crew.open()
            times = self._loop(crew, surveys(), trials, save, on_progress)
            self.stages = TaskBook()
            for record in crew.finish():
                self.stages.add(record)
            if trials is not None:
                trials.finish()
            want_nothing(self.client, self.partitions)
            self.notes += crew.notes
            return times
        except BaseException as error:
            # A client that loses its scheduler cancels all futures, so tasks look cancelled.
            # After some seconds it gives up and closes, and any call of it makes any error.
            lost = _is_lost(self.client, error)
            reason = str(error) or type(error).__name__
            _stop(
                self.client, [crew, *([trials] if trials else [])], f"the run was stopped: {reason}"
            )
            want_nothing(self.client, self.partitions)
            if error is self.callers_error:
                raise
            if isinstance(error, PoolError) and not lost:
                raise LidarpoolError(str(error)) from error
            if isinstance(error, _CLUSTER_LOST) or (lost and isinstance(error, Exception)):
                raise self._told_lost() from error
            raise

    def _loop(
        self,
        crew: Crew,
        surveys: Surveys,
        trials: TrialPump | None,
        save: Callable[[], None],
        on_progress: Callable[[Surveys, float], None],
    ) -> dict[str, float]:
        """Step everything until all have finished; returns the time of each, in seconds."""
        started, pause_s = time.monotonic(), 0.0
        watch = Watch(
            self.client,
            [GPU, OTHER] if trials else [GPU],
            lasting=[LIDAR],
            patience_s=self.job.patience_s,
            tell=self._tell,
        )
        times: dict[str, float] = {}
        told = saved = float("-inf")
        while not (crew.ended and (trials is None or "planning" in times)):
            moved = False
            if not crew.closed:
                crew.look(surveys.progress)
                moved = surveys.step()
                if surveys.finished:
                    crew.close()
                    times["survey"] = time.monotonic() - started
                    watch.forget([GPU, LIDAR])
            if trials is not None and "planning" not in times:
                moved |= trials.step()
                if trials.finished:
                    times["planning"] = time.monotonic() - started
                    watch.forget([OTHER])
            now = time.monotonic()
            if now - saved >= SAVE_EVERY_S:
                saved = now
                save()
            watch.look(now)
            if now - told >= PROGRESS_EVERY_S or surveys.finished:
                told = now
                on_progress(surveys, now - started)
            pause_s = 0.0 if moved else min(max(0.001, 2 * pause_s), LONGEST_PAUSE_S)
            (time.sleep if crew.ended else crew.wait)(pause_s)
        self.notes += watch.notes
        return times


def drive(
    client: Client,
    store: RunStore,
    tell: Callable[[str], None],
    waiting: Waiting,
    *,
    own: bool,
    on_frame: Callable[[Frame], None],
    page: Page,
    show: Show,
) -> tuple[RunResult, Cluster]:
    """Run one job on a cluster to the end; on any error, everything has been stopped.

    With `own` there is no page of partitions. `page` is told what is done, once it knows the job.
    LidarpoolError if the cluster lacks something.
    """
    started, job = time.monotonic(), store.job
    left = job.survey.scan_count - store.resumed
    cluster = Cluster(client, job, store, tell, waiting, left=left)
    store.on_parts = page.on_parts
    page.follow(cluster.partitions)
    trials = None
    if job.planning is not None:
        software = store.casting["lidarpool"]
        partition = cluster.partitions[OTHER]
        trials = TrialPump(client, partition, job.planning, software, store.db.trials)
    crew = cluster.crew(store.storage, store.db.meta["mark"])
    drivers: list[SurveyDriver] = []

    def take(frame: Frame) -> None:
        page.on_frame(frame)
        on_frame(frame)

    def surveys() -> SurveyDriver:
        drivers.append(cluster.driver(crew, store, take))
        return drivers[0]

    def save() -> None:
        for trial in trials.trials[len(store.db.trials) :] if trials else ():
            store.db.add_trial(trial)
        store.save()

    def on_progress(_: Surveys, seconds: float) -> None:
        survey = drivers[0]
        progress = replace(
            store.progress(),
            generated=survey.generated,
            cast=min(store.resumed + survey.cast, job.survey.scan_count),
            trials_done=len(trials.trials) if trials else 0,
            seconds=seconds,
            replayed=survey.offered_again,
            waits_for=LIDAR if crew.stages.waiting else "",
        )
        cluster.call(show, progress)
        cluster.call(lambda progress: page.on_progress(progress, list), progress)

    with nullcontext() if own else cluster.partitions_page():
        times = cluster.run(crew, surveys, trials, save, on_progress)
    save()
    store.save(now=True)
    store.tidy()
    books = [drivers[0].book, cluster.stages, *([trials.book] if trials else [])]
    result = make_result(
        store,
        books,
        [*cluster.notes, *drivers[0].notes],
        seconds=time.monotonic() - started,
        survey_seconds=times["survey"],
        planning_seconds=times.get("planning", 0.0),
        replayed=drivers[0].offered_again,
    )
    return result, cluster


def make_result(
    store: RunStore, books: Sequence[TaskBook] = (), notes: Iterable[str] = (), **figures: Any
) -> RunResult:
    """Make the result once all is committed; `figures` are other fields of `RunResult`."""
    job = store.job
    trials = tuple(sorted(store.db.trials, key=lambda trial: trial.trial))
    return RunResult(
        scene=job.scene,
        survey=job.survey,
        planning=job.planning,
        points=store.points(),
        plan=best(trials, job.planning) if job.planning else None,
        trials=trials,
        backend=store.backend,
        rays=job.survey.ray_count,
        hits=store.db.hits,
        stages=tuple(totals for book in books for totals in book.stages.values()),
        resumed=store.resumed,
        notes=(*store.notes, *notes),
        identity=store.identity,
        _hit_counts=store.hit_counts,
        sample_rays=store.sample_rays(),
        **figures,
    )


def _is_lost(client: Client, error: BaseException) -> bool:
    """Whether the scheduler is gone: a call may fail a moment before the client knows."""
    until = time.monotonic() + LOST_S
    while (
        client.status == "running" and isinstance(error, _CLUSTER_LOST) and time.monotonic() < until
    ):
        time.sleep(0.01)
    return client.status != "running"


def _stop(client: Client, pumps: Sequence[Crew | TrialPump], reason: str) -> None:
    """Stop everything, as far as the cluster can be reached."""
    if client.status != "running":  # Dask would try for half a minute to reach it
        return
    for pump in pumps:
        for step in (lambda pump=pump: pump.stop(reason), pump.finish):
            try:
                # Report the first error.
                with suppress(OSError, CommClosedError, FutureCancelledError, RuntimeError):
                    step()
            except Exception:
                if client.status == "running":
                    raise
