"""A run on a cluster: the survey and, beside it, the planning, stepped in turn."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from typing import TypeVar

from distributed import Client
from distributed.client import FutureCancelledError
from distributed.comm.core import CommClosedError

from poolpart import (
    Backoff,
    Partition,
    PipeClosed,
    PipeFailed,
    PoolError,
    assign_devices,
)

from .checks import find_workers
from .deliveries import Deliveries
from .errors import LidarpoolError
from .plan import best
from .progress import Progress
from .result import Result
from .scan import GPU, LIDAR, OTHER, Frame, SurveyPump, SurveySetup
from .standstill import Standstill
from .task_book import TaskBook
from .trials import TrialPump
from .watch import Watch

T = TypeVar("T")

# What Dask raises, here or there, once the scheduler is gone.
_CLUSTER_LOST = (OSError, CommClosedError, FutureCancelledError, PipeClosed, PipeFailed)

PROGRESS_EVERY_S = 0.1
STANDING_S = 0.1  # from one look at a paused run to the next


class Run:
    """One run on one cluster, checked and ready to be driven.

    Parameters
    ----------
    client
        Client of the cluster.
    kept
        Where the deliveries go, and what an earlier run has left there.
    wants_pause
        Asked over and over; while it says yes, what is under way arrives and no more is begun.

    Raises
    ------
    LidarpoolError
        If the cluster lacks something.
    """

    def __init__(
        self, client: Client, kept: Deliveries, wants_pause: Callable[[], bool] = lambda: False
    ) -> None:
        job = kept.job
        self.client, self.job, self.kept = client, job, kept
        # For when it is lost; a client that was never connected is refused in a moment.
        self.address: str = getattr(client.scheduler, "address", "")
        try:
            planning, backend = job.planning is not None, kept.backend or job.backend
            pool, casting, kept.backend = find_workers(
                client, job.collectors, planning, backend, kept.advice
            )
            assign_devices(client, casting)  # all at once: those that see few of them choose first
        except LidarpoolError:
            raise
        except Exception as error:  # which one, depends on what was being asked
            if client.status != "running" or isinstance(error, CommClosedError):
                raise self._told_lost() from error
            raise
        self.partitions: dict[str, Partition] = pool.partitions()
        self.notes: list[str] = []
        if not any(worker.gpus for worker in casting):
            self.notes.append(
                f"no GPU in partition GPU: {len(casting)} CPU worker{'s' * (len(casting) > 1)} "
                f"cast{'s' * (len(casting) == 1)} the rays with {kept.backend}"
            )
        self.setup = SurveySetup(job.scene, job.survey.sensor, kept.backend)
        self.callers_error: BaseException | None = None  # raised by a callback
        self.standstill = Standstill(wants_pause, kept.sync)

    def _told_lost(self) -> LidarpoolError:
        return LidarpoolError(
            f"The cluster at {self.address} cannot be reached any more, or somebody cancelled "
            "the tasks of this run; it has ended without a result."
        )

    def drive(
        self,
        on_frame: Callable[[Frame], None] | None,
        on_progress: Callable[[Progress], None] | None,
    ) -> Result:
        """Run to the end; whatever is raised, everything has been stopped by then."""
        started = time.monotonic()
        pumps: list[SurveyPump | TrialPump] = []
        trials = None
        try:
            if self.job.planning is not None:  # first: no slot of OTHER waits for the survey
                trials = TrialPump(
                    self.client, self.partitions[OTHER], self.job.planning, self.kept.trials
                )
                pumps.append(trials)
                trials.step()
            survey = self._survey_pump(on_frame)
            pumps.append(survey)
            survey.start()
            times = self._loop(pumps, survey, trials, on_progress, started)
            for pump in pumps:
                pump.finish()
            self.notes += survey.notes
        except BaseException as error:
            # A client that loses its scheduler cancels all futures: tasks seem to be cancelled.
            # After some seconds it gives up and closes, and any call of it makes any error.
            lost = self.client.status != "running"
            reason = str(error) or type(error).__name__
            _stop(self.client, pumps, f"the run was stopped: {reason}")
            if error is self.callers_error:
                raise
            if isinstance(error, PoolError) and not lost:
                raise LidarpoolError(str(error)) from error
            if isinstance(error, _CLUSTER_LOST) or (lost and isinstance(error, Exception)):
                raise self._told_lost() from error
            raise
        self.kept.check()
        self.kept.save()
        return make_result(
            self.kept,
            books=[survey.book, *([trials.book] if trials else [])],
            seconds=time.monotonic() - started,
            survey_seconds=times[SurveyPump],
            planning_seconds=times.get(TrialPump, 0.0),
            replayed=survey.replayed,
            duplicates_dropped=survey.duplicates_dropped,
            notes=[*self.notes, *self._note_of_pauses()],
        )

    def _note_of_pauses(self) -> list[str]:
        """Say how long the run stood still, for whoever reads its times."""
        seconds = self.standstill.seconds
        return [f"the run was paused for {seconds:.0f} s, in its times too"] if seconds >= 1 else []

    def _survey_pump(self, on_frame: Callable[[Frame], None] | None) -> SurveyPump:
        def take(frame: Frame) -> None:
            if on_frame:
                self._call(on_frame, frame)
            # Only now: a frame that the caller failed on is handed to them again.
            self.kept.totals.take(frame)

        return SurveyPump(
            self.client,
            self.partitions,
            self.setup,
            self.job.survey,
            take,
            self.job.queue_capacity,
            self.job.collectors,
            self.kept.cloud,
            self.kept.totals.frames,
            scans_per_second=self.job.scans_per_second,
        )

    def _call(self, callback: Callable[[T], None], argument: T) -> None:
        """Call back the caller; an OSError of theirs must not be taken for the cluster's."""
        try:
            callback(argument)
        except BaseException as error:
            self.callers_error = error
            raise

    def _loop(
        self,
        pumps: list[SurveyPump | TrialPump],
        survey: SurveyPump,
        trials: TrialPump | None,
        on_progress: Callable[[Progress], None] | None,
        started: float,
    ) -> dict[type, float]:
        """Step the pumps until all have finished; returns when each did, in seconds."""
        pause = Backoff(least_s=0.001, most_s=0.05)
        watch = Watch(self.client, [GPU, OTHER] if trials else [GPU], lasting=[LIDAR])
        times: dict[type, float] = {}
        told = float("-inf")
        while len(times) < len(pumps):
            moved = False
            self.standstill.look(pumps)
            for pump in pumps:
                if not pump.finished:
                    moved |= pump.step()
                elif type(pump) not in times:
                    times[type(pump)] = time.monotonic() - started
                    watch.forget([OTHER] if pump is trials else [GPU, LIDAR])
            for trial in trials.trials[len(self.kept.trials) :] if trials else ():
                self.kept.add_trial(trial)
            self.kept.look()
            now = time.monotonic()
            watch.look(now)
            if on_progress and (now - told >= PROGRESS_EVERY_S or len(times) == len(pumps)):
                told = now
                self._call(on_progress, self._progress(survey, trials, now - started))
            if self.standstill.still:
                time.sleep(STANDING_S)
            elif moved:
                pause.reset()
            else:
                (time.sleep if survey.finished else survey.wait)(pause.next())
        return times

    def _progress(self, survey: SurveyPump, trials: TrialPump | None, seconds: float) -> Progress:
        return Progress(
            scans=self.job.survey.scan_count,
            generated=survey.generated.delivered,
            cast=survey.cast,
            framed=survey.frames.delivered,
            collected=survey.cloud.ledger.delivered,
            points=survey.cloud.point_count,
            trials=self.job.trials,
            trials_done=len(trials.trials) if trials else 0,
            seconds=seconds,
            replayed=survey.replayed,
            paused=self.standstill.still,
            waits_for=survey.waits_for,
        )


def make_result(
    kept: Deliveries,
    books: Sequence[TaskBook] = (),
    seconds: float = 0.0,
    survey_seconds: float = 0.0,
    planning_seconds: float = 0.0,
    replayed: int = 0,
    duplicates_dropped: int = 0,
    notes: Iterable[str] = (),
) -> Result:
    """Put the result together once everything has been delivered; see `Result`."""
    job = kept.job
    trials = tuple(sorted(kept.trials, key=lambda trial: trial.trial))
    return Result(
        points=kept.cloud.merge(job.survey.precision_m, job.scene.origin),
        hit_counts=kept.totals.hit_counts,
        sample_rays=kept.totals.sample_rays,
        plan=best(trials, job.planning) if job.planning else None,
        trials=trials,
        backend=kept.backend,
        rays=job.survey.ray_count,
        hits=kept.totals.hits,
        records=tuple(record for book in books for record in book.records),
        stages=tuple(totals for book in books for totals in book.stages.values()),
        seconds=seconds,
        survey_seconds=survey_seconds,
        planning_seconds=planning_seconds,
        replayed=replayed,
        duplicates_dropped=duplicates_dropped,
        resumed=kept.resumed,
        notes=(*kept.notes, *notes),
    )


def _stop(client: Client, pumps: list[SurveyPump | TrialPump], reason: str) -> None:
    """Stop what can be stopped; the cluster may be gone, and then nothing can."""
    for pump in pumps:
        for step in (lambda pump=pump: pump.stop(reason), pump.finish):
            try:
                # The first error is the one to tell of.
                with suppress(OSError, CommClosedError, FutureCancelledError, RuntimeError):
                    step()
            except Exception:
                if client.status == "running":
                    raise
