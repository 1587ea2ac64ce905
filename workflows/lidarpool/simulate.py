"""A whole run: the survey and, beside it, the planning, on one cluster."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import nullcontext, suppress
from typing import TypeVar

import numpy as np
from distributed import Client
from distributed.client import FutureCancelledError
from distributed.comm.core import CommClosedError
from numpy.typing import NDArray

from poolpart import (
    Backoff,
    Partition,
    PipeClosed,
    PipeFailed,
    PoolError,
    assign_devices,
)

from .checks import check_backend_here, check_counts, check_precision, common_backend, survey_pool
from .connection import local_client
from .errors import LidarpoolError
from .plan import Planning
from .progress import Progress
from .result import Result
from .scan import GPU, LIDAR, OTHER, Frame, SurveyPump, SurveySetup
from .scene import Scene
from .survey import Survey
from .trials import TrialPump
from .watch import Watch

T = TypeVar("T")

# What Dask raises, here or there, once the scheduler is gone.
_CLUSTER_LOST = (OSError, CommClosedError, FutureCancelledError, PipeClosed, PipeFailed)

PROGRESS_EVERY_S = 0.1
SAMPLE_RAYS = 400  # kept for the pictures


def simulate(
    scene: Scene,
    survey: Survey,
    planning: Planning | None = None,
    *,
    client: Client | None = None,
    backend: str = "auto",
    on_frame: Callable[[Frame], None] | None = None,
    on_progress: Callable[[Progress], None] | None = None,
    queue_capacity: int = 10,
    collectors: int = 2,
    gpu_workers: int | None = None,
    other_workers: int | None = None,
    tls: bool = False,
) -> Result:
    """Scan a scene on a partitioned cluster and plan a path meanwhile.

    Parameters
    ----------
    scene, survey
        What to scan, and how; poses in the scene's local coordinates.
    planning
        A path to plan on the OTHER partition while the survey runs; None for none.
    client
        Client of a cluster whose workers declare the resources GPU, LIDAR and OTHER. Without
        one, a local cluster is started on the loopback interface and stopped in the end.
    backend
        Ray-casting backend of stage 2: auto, cuda, embree or numpy.
    on_frame
        Called with each frame, in scan order, while the survey runs. It is called in this
        thread: while it takes its time the pipeline waits, and nothing is lost.
    on_progress
        Called some ten times a second with how far things are.
    queue_capacity
        Items that stage 1 may be ahead of stage 2.
    collectors
        Tasks of stage 4.
    gpu_workers, other_workers
        Workers of a local cluster; by default what suits the machine.
    tls
        Encrypt the traffic of a local cluster, with a certificate made for it.

    Returns
    -------
    Result
        The same survey gives the same cloud on any cluster.

    Raises
    ------
    LidarpoolError
        If the cluster lacks something or a task fails; one or two lines say which and what to
        do. KeyboardInterrupt passes through once everything has been stopped.

    Examples
    --------
    >>> from lidarpool import Scene, Survey, simulate
    >>> if __name__ == "__main__":                                     # doctest: +SKIP
    ...     result = simulate(Scene.seed(), Survey(poses=[(0, 0, 1)]))
    ...     print(len(result.cloud), "points")
    """
    check_precision(scene, survey)
    check_counts(
        queue_capacity=queue_capacity,
        collectors=collectors,
        gpu_workers=gpu_workers,
        other_workers=other_workers,
    )
    if client is None:
        check_backend_here(backend)
    with (
        local_client(
            gpu_workers=gpu_workers, collectors=collectors, other_workers=other_workers, tls=tls
        )
        if client is None
        else nullcontext(client) as client
    ):
        run = _Run(client, scene, survey, planning, backend, queue_capacity, collectors)
        return run.drive(on_frame, on_progress)


class _Run:
    """One run on one cluster, checked and ready to be driven."""

    def __init__(
        self,
        client: Client,
        scene: Scene,
        survey: Survey,
        planning: Planning | None,
        backend: str,
        queue_capacity: int,
        collectors: int,
    ) -> None:
        pool = survey_pool(client, collectors, planning is not None)
        self.client, self.scene, self.survey, self.planning = client, scene, survey, planning
        self.queue_capacity, self.collectors = queue_capacity, collectors
        self.partitions: dict[str, Partition] = pool.partitions()
        casting = [worker for worker in pool if worker.resources.get(GPU)]
        self.backend = common_backend(client, backend, casting)
        self.notes: list[str] = []
        if not any(worker.gpus for worker in casting):
            self.notes.append(
                f"no GPU in partition GPU: {len(casting)} CPU worker{'s' * (len(casting) > 1)} "
                f"cast{'s' * (len(casting) == 1)} the rays with {self.backend}"
            )
        self.setup = SurveySetup(scene, survey.sensor, self.backend, assign_devices(casting))
        self.hit_counts = np.zeros(len(scene.faces), np.int64)
        self.samples: list[NDArray[np.float32]] = []
        self.hits = 0
        self.callers_error: BaseException | None = None  # raised by a callback

    def drive(
        self,
        on_frame: Callable[[Frame], None] | None,
        on_progress: Callable[[Progress], None] | None,
    ) -> Result:
        """Run to the end; whatever is raised, everything has been stopped by then."""
        started = time.monotonic()

        def take(frame: Frame) -> None:
            self._take(frame)
            if on_frame:
                self._call(on_frame, frame)

        pumps: list[SurveyPump | TrialPump] = []
        trials = None
        try:
            if self.planning is not None:  # first, so that no slot of OTHER waits for the survey
                trials = TrialPump(self.client, self.partitions[OTHER], self.planning)
                pumps.append(trials)
                trials.step()
            survey = SurveyPump(
                self.client,
                self.partitions,
                self.setup,
                self.survey,
                take,
                self.queue_capacity,
                self.collectors,
            )
            pumps.append(survey)
            survey.start()
            times = self._loop(pumps, survey, trials, on_progress, started)
            for pump in pumps:
                pump.finish()
        except BaseException as error:
            reason = str(error) or type(error).__name__
            _stop(pumps, f"the run was stopped: {reason}")
            if error is self.callers_error:
                raise
            if isinstance(error, PoolError):
                raise LidarpoolError(str(error)) from error
            if isinstance(error, _CLUSTER_LOST):
                raise LidarpoolError(
                    f"The cluster at {self.client.scheduler.address} cannot be reached any more, "
                    "or somebody cancelled the tasks of this run; it has ended without a result."
                ) from error
            raise
        return self._result(survey, trials, started, times)

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
        pause = Backoff(least_s=0.001, most_s=0.016)
        watch = Watch(self.client, {GPU, LIDAR} | ({OTHER} if trials else set()))
        times: dict[type, float] = {}
        told = float("-inf")
        while len(times) < len(pumps):
            moved = False
            for pump in pumps:
                if not pump.finished:
                    moved |= pump.step()
                elif type(pump) not in times:
                    times[type(pump)] = time.monotonic() - started
            now = time.monotonic()
            watch.look(now)
            if on_progress and (now - told >= PROGRESS_EVERY_S or len(times) == len(pumps)):
                told = now
                self._call(on_progress, self._progress(survey, trials, now - started))
            if moved:
                pause.reset()
            else:
                pause.sleep()
        return times

    def _take(self, frame: Frame) -> None:
        np.add.at(self.hit_counts, frame.triangles, frame.counts)
        self.hits += frame.hits
        every = max(1, 4 * self.survey.scan_count // SAMPLE_RAYS)
        if frame.scan % every == 0 and len(frame.samples):
            starts = np.broadcast_to(
                np.asarray(frame.pose.position, np.float32), frame.samples.shape
            )
            self.samples.append(np.stack([starts, frame.samples], axis=1))

    def _progress(self, survey: SurveyPump, trials: TrialPump | None, seconds: float) -> Progress:
        return Progress(
            scans=self.survey.scan_count,
            generated=survey.generated.delivered,
            cast=survey.cast,
            framed=survey.frames.delivered,
            collected=survey.cloud.ledger.delivered,
            points=survey.cloud.point_count,
            trials=self.planning.trials if self.planning else 0,
            trials_done=len(trials.trials) if trials else 0,
            seconds=seconds,
        )

    def _result(
        self, survey: SurveyPump, trials: TrialPump | None, started: float, times: dict[type, float]
    ) -> Result:
        samples = np.concatenate(self.samples) if self.samples else np.empty((0, 2, 3), np.float32)
        return Result(
            points=survey.cloud.merge(self.survey.precision_m, self.scene.origin),
            hit_counts=self.hit_counts,
            sample_rays=samples,
            plan=trials.plan() if trials else None,
            trials=tuple(trials.trials) if trials else (),
            backend=self.backend,
            rays=self.survey.ray_count,
            hits=self.hits,
            records=tuple(survey.records + (trials.records if trials else [])),
            seconds=time.monotonic() - started,
            survey_seconds=times[SurveyPump],
            planning_seconds=times.get(TrialPump, 0.0),
            replayed=survey.replayed,
            duplicates_dropped=survey.duplicates_dropped,
            resumed=0,
            notes=tuple(self.notes),
        )


def _stop(pumps: list[SurveyPump | TrialPump], reason: str) -> None:
    """Stop what can be stopped; the cluster may be gone, and then nothing can."""
    for pump in pumps:
        for step in (lambda pump=pump: pump.stop(reason), pump.finish):
            # The first error is the one to tell of.
            with suppress(OSError, CommClosedError, FutureCancelledError, RuntimeError):
                step()
