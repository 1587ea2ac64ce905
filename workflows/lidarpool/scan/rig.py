"""What a GPU worker needs for a survey: the scene with its ray caster, and the sensor.

It is the worker's own: made once in each process by a task that is bound to it, kept in a table
of this module, and named by a handle in the tasks that cast. A task's result would not do: Dask
drops the copies of a result that nobody needs at an instant, and every copy that came back would
build its tree anew.
"""

from __future__ import annotations

import pickle
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass

import cloudpickle
import numpy as np
from distributed import get_worker

from poolpart import own_device, trace
from raybeam import Pattern, RayCaster

from ..scene.scene import Scene
from ..sensor import ScanSpec, Survey
from .returns import BatchReturns

PATTERN_RAYS = 20_000_000  # kept for a whole period of the head; 24 bytes each
UNUSED_S = 600.0  # a rig that no run has used for so long goes when another is made


@dataclass(frozen=True, eq=False)
class RigPlan:
    """What rigs are made of.

    Parameters
    ----------
    scene, survey
        What is scanned, and how.
    backend
        Name of the ray-casting backend, the same on all workers.
    """

    scene: Scene
    survey: Survey
    backend: str

    def packed(self) -> bytes:
        """Bytes to send to workers: they look at their version before they open them."""
        # Sensors and columns of somebody's script, lambdas too, travel by value.
        return cloudpickle.dumps(self, protocol=5)


class Rig:
    """Scene, survey and a ray caster that is ready.

    Parameters
    ----------
    plan
        What it is made of.
    threads
        CPU threads to cast with; None for all cores.
    device
        Number of the CUDA device; None for the current one.
    """

    def __init__(
        self, plan: RigPlan, threads: int | None = None, device: int | None = None
    ) -> None:
        self.scene, self.survey = plan.scene, plan.survey
        self.used_at = time.monotonic()
        self._caster = RayCaster(
            plan.scene.vertices,
            plan.scene.faces,
            backend=plan.backend,
            threads=threads,
            device=device,
        )
        sensor = plan.survey.sensor
        self._whole: Pattern | None = None  # one period of the head
        if sensor.period is not None and sensor.period * sensor.channels <= PATTERN_RAYS:
            self._whole = self._pattern(0, sensor.period)

    def _pattern(self, first: int, stop: int) -> Pattern:
        firings = np.arange(first, stop, dtype=np.int64)
        sensor = self.survey.sensor
        origins = sensor.origins(firings)
        return Pattern(
            sensor.directions(firings).reshape(-1, 3),
            None if origins is None else origins.reshape(-1, 3),
        )

    def cast(self, first: int, stop: int) -> Iterator[BatchReturns]:
        """Cast scans `first` to `stop`: the returns of each run of them from one station."""
        run: list[ScanSpec] = []
        for spec in map(self.survey.scan, range(first, stop)):
            if run and (spec.station, spec.firings[0]) != (run[-1].station, run[-1].firings[1]):
                yield self._cast(run)
                run = []
            run.append(spec)
        if run:
            yield self._cast(run)

    def _cast(self, specs: list[ScanSpec]) -> BatchReturns:
        sensor, path = self.survey.sensor, self.survey.path
        first, stop = specs[0].firings[0], specs[-1].firings[1]
        channels, rays_per_pose = sensor.channels, None
        if path.moves:
            times = sensor.times_ns(np.arange(first, stop, dtype=np.int64)).min(axis=1)
            positions, rotations = path.poses(specs[0].station, times.astype(np.float64))
            rays_per_pose = channels
        else:
            pose = path.pose(specs[0].station)
            positions, rotations = np.array(pose.position), pose.rotation
        if self._whole is not None:
            pattern, start = self._whole, first % sensor.period * channels  # type: ignore[operator]
        else:
            pattern, start = self._pattern(first, stop), 0
        found = self._caster.scan(
            pattern,
            positions,
            rotations,
            window=(start, start + (stop - first) * channels),
            rays_per_pose=rays_per_pose,
            t_min=sensor.min_range_m,
            t_max=sensor.max_range_m,
            keep_every=self.survey.keep_every,
            groups=np.array([spec.firings[0] - first for spec in specs]) * channels,
            tally=True,
        )
        return BatchReturns(self, specs, found, pattern, start, positions, rotations, rays_per_pose)


class RigMissing(RuntimeError):  # noqa: N818 - reads as what happened
    """The worker has no such rig: it was restarted, or has dropped it."""


_rigs: dict[str, Rig] = {}  # {handle: the rig of this process}
_lock = threading.Lock()


def set_up(handle: str, packed: bytes) -> None:
    """Make a rig in this process, unless it is there; runs on a GPU worker."""
    with _lock:
        if handle in _rigs:
            return
        now = time.monotonic()
        for other in [h for h, rig in _rigs.items() if now - rig.used_at > UNUSED_S]:
            del _rigs[other]
        plan: RigPlan = pickle.loads(packed)
        worker = get_worker()
        _rigs[handle] = Rig(plan, threads=worker.state.nthreads, device=own_device())
        trace("intersect.built", run=handle, stage="intersect", scans=[])


def rig_of(handle: str) -> Rig:
    """Return a rig of this process.

    Raises
    ------
    RigMissing
        If there is none.
    """
    rig = _rigs.get(handle)
    if rig is None:
        raise RigMissing(f"This worker has no rig {handle!r}.")
    rig.used_at = time.monotonic()
    return rig


def drop_rig(handle: str) -> None:
    """Forget a rig; no error if there is none."""
    _rigs.pop(handle, None)
