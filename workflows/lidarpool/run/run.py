"""A run on a cluster: steps the survey and the planning in turn."""

from __future__ import annotations

import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar

from distributed import Client
from distributed.client import FutureCancelledError
from distributed.comm.core import CommClosedError

from poolpart import (
    Partition,
    PipeClosed,
    PipeFailed,
    PoolError,
)

from ..base.errors import LidarpoolError
from ..pipeline import GPU, LIDAR, OTHER, CastingWorkers, Frame, LongStages, RigPlan, SurveyDriver
from ..pipeline.task_book import TaskBook
from ..plan import best
from ..simulator.memory import MB, scans_that_fit
from .checks import find_workers, gpu_note, want_nothing
from .progress import Progress
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


class Run:
    """One run on one cluster, checked and ready to be driven.

    `tell` is called every few seconds with a message while the run waits, and `waiting` says how
    long to wait for workers at the start. LidarpoolError if the cluster lacks something.
    """

    def __init__(
        self, client: Client, store: RunStore, tell: Callable[[str], None], waiting: Waiting
    ) -> None:
        job = store.job
        self.client, self.job, self.store = client, job, store
        self._tell = tell
        # For errors about a lost cluster; a client that was never connected is refused below.
        self.address: str = getattr(client.scheduler, "address", "")
        try:
            pool, casting, backend, software = find_workers(
                client,
                job,
                store.backend or job.backend,
                store.advice,
                store.casting if store.resumed else {},
                waiting,
                job.survey.scan_count - store.resumed,
            )
            store.backend, store.casting = backend, software
        except LidarpoolError:
            want_nothing(client, (GPU, LIDAR, OTHER))
            raise
        except Exception as error:  # the kind depends on the request
            if client.status != "running" or isinstance(error, CommClosedError):
                raise self._told_lost() from error
            raise
        self._pool = pool
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

    def drive(
        self, on_frame: Callable[[Frame], None], on_progress: Callable[[Progress], None]
    ) -> RunResult:
        """Run to the end; on any error, everything has been stopped."""
        started = time.monotonic()
        pumps: list[SurveyDriver | TrialPump] = []
        trials = None
        try:
            if self.job.planning is not None:  # first: no slot of OTHER waits for the survey
                trials = TrialPump(
                    self.client,
                    self.partitions[OTHER],
                    self.job.planning,
                    self.store.casting["lidarpool"],
                    self.store.db.trials,
                )
                pumps.append(trials)
                trials.step()
                self.partitions[OTHER].want(0)  # from now on its trials wait for workers
            survey = self._survey_driver(on_frame)
            pumps.append(survey)
            survey.start()
            times = self._loop(pumps, survey, trials, on_progress, started)
            for pump in pumps:
                pump.finish()
            want_nothing(self.client, self.partitions)
            self.notes += survey.notes
        except BaseException as error:
            # A client that loses its scheduler cancels all futures, so tasks look cancelled.
            # After some seconds it gives up and closes, and any call of it makes any error.
            lost = _is_lost(self.client, error)
            reason = str(error) or type(error).__name__
            _stop(self.client, pumps, f"the run was stopped: {reason}")
            want_nothing(self.client, self.partitions)
            if error is self.callers_error:
                raise
            if isinstance(error, PoolError) and not lost:
                raise LidarpoolError(str(error)) from error
            if isinstance(error, _CLUSTER_LOST) or (lost and isinstance(error, Exception)):
                raise self._told_lost() from error
            raise
        self.store.save(now=True)
        self.store.tidy()
        return make_result(
            self.store,
            [survey.book, *([trials.book] if trials else [])],
            self.notes,
            seconds=time.monotonic() - started,
            survey_seconds=times[SurveyDriver],
            planning_seconds=times.get(TrialPump, 0.0),
            replayed=survey.offered_again,
        )

    def _survey_driver(self, on_frame: Callable[[Frame], None]) -> SurveyDriver:
        job, store = self.job, self.store
        run, plan = uuid.uuid4().hex[:8], RigPlan(job.scene, job.survey, store.backend)
        return SurveyDriver(
            CastingWorkers(self.client, self.partitions[GPU], run, plan, store.casting),
            LongStages(
                self.client,
                self.partitions[LIDAR],
                run,
                store.casting["lidarpool"],
                job.survey,
                store.storage,
                queue_capacity=job.queue_capacity,
                collectors=job.collectors,
                patience_s=job.patience_s,
            ),
            job.survey,
            store.db,
            store.storage,
            store.points_of_scan,
            partial(self._call, on_frame),
            store.on_parts,
            scans_that_fit(
                job.scene, job.survey, job.batch_mb * MB, on_device=store.backend == "cuda"
            ),
        )

    def _call(self, callback: Callable[[T], None], argument: T) -> None:
        """Call a callback of the caller; its OSError must not look like the cluster's."""
        try:
            callback(argument)
        except BaseException as error:
            self.callers_error = error
            raise

    def _loop(
        self,
        pumps: list[SurveyDriver | TrialPump],
        survey: SurveyDriver,
        trials: TrialPump | None,
        on_progress: Callable[[Progress], None],
        started: float,
    ) -> dict[type, float]:
        """Step the pumps until all have finished; returns the time of each, in seconds."""
        pause_s = 0.0
        watch = Watch(
            self.client,
            [GPU, OTHER] if trials else [GPU],
            lasting=[LIDAR],
            patience_s=self.job.patience_s,
            tell=self._tell,
        )
        times: dict[type, float] = {}
        told = saved = float("-inf")
        while len(times) < len(pumps):
            moved = False
            for pump in pumps:
                if not pump.finished:
                    moved |= pump.step()
                elif type(pump) not in times:
                    times[type(pump)] = time.monotonic() - started
                    watch.forget([OTHER] if pump is trials else [GPU, LIDAR])
            for trial in trials.trials[len(self.store.db.trials) :] if trials else ():
                self.store.db.add_trial(trial)
            now = time.monotonic()
            if now - saved >= SAVE_EVERY_S:
                saved = now
                self.store.save()
            watch.look(now)
            if now - told >= PROGRESS_EVERY_S or len(times) == len(pumps):
                told = now
                self._call(on_progress, self._progress(survey, trials, now - started))
            pause_s = 0.0 if moved else min(max(0.001, 2 * pause_s), LONGEST_PAUSE_S)
            (time.sleep if survey.finished else survey.wait)(pause_s)
        self.notes += watch.notes
        return times

    def _progress(self, survey: SurveyDriver, trials: TrialPump | None, seconds: float) -> Progress:
        return replace(
            self.store.progress(),
            generated=survey.generated,
            cast=min(self.store.resumed + survey.cast, self.job.survey.scan_count),
            trials_done=len(trials.trials) if trials else 0,
            seconds=seconds,
            replayed=survey.offered_again,
            waits_for=survey.waits_for,
        )


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
        records=tuple(record for book in books for record in book.records),
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


def _stop(client: Client, pumps: list[SurveyDriver | TrialPump], reason: str) -> None:
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
