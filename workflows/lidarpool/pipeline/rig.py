"""The rig of a GPU worker: the scene with its ray caster, and the sensor.

A task bound to the worker makes it once in each process and keeps it in a table of this module;
casting tasks name it by a handle. A task's result would not work: Dask drops copies that no task
needs at an instant, and every new copy would build its tree again.
"""

from __future__ import annotations

import pickle
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import cloudpickle
import numpy as np
from distributed import get_worker

from poolpart import own_device
from raybeam import Pattern, ScanReturns

from ..base.tracing import trace
from ..scene.scene import Scene
from ..sensor import ScanSpec, Survey
from .echoes import PATTERN_RAYS, EchoCaster
from .motion import Clock, Poses, check_trajectory, poses_of_firings
from .returns import BatchReturns, turned
from .surfaces import Surfaces
from .world import World

UNUSED_S = 600.0  # a rig unused for so long is dropped when another is made


@dataclass(frozen=True, eq=False)
class RigPlan:
    """Description of a rig.

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
        """Bytes to send to workers, which check their version before they unpickle them."""
        # Sensors and columns of a user's script, including lambdas, are sent by value.
        return cloudpickle.dumps(self, protocol=5)


class Rig:
    """Scene, survey and a ray caster that is ready.

    Parameters
    ----------
    plan
        Its description.
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
        self._caster = World(plan.scene, plan.backend, threads, device)
        self.surfaces = Surfaces(plan.scene, tuple(plan.survey.materials))
        self._echoes: EchoCaster | None = None  # if plain casting is enough
        if EchoCaster.needed(plan.survey, self.surfaces):
            self._echoes = EchoCaster(self._caster, plan.scene, plan.survey, self.surfaces)
        check_trajectory(plan.survey.path)
        self._whole: list[Pattern | None] = []  # one period of each sensor's head
        self.by_head: list[bool] = []  # whether poses of each sensor are those of its head
        for number, sensor in enumerate(carried.sensor for carried in plan.survey.carried):
            period = sensor.period or 0
            fits = 0 < period * sensor.channels <= PATTERN_RAYS
            heads = sensor.spins(np.zeros(1, np.int64)) is not None
            self.by_head.append(heads and (plan.survey.path.moves or not fits))
            if self.by_head[-1]:
                period, fits = 1, True
            self._whole.append(self._pattern(number, 0, period) if fits else None)
            if self._echoes is not None and self._whole[-1] is not None:
                self._echoes.divide(sensor, self._whole[-1])

    def _pattern(self, number: int, first: int, stop: int) -> Pattern:
        """Rays of a sensor in its carrier's axes, or of one firing in its head's axes."""
        firings = np.arange(first, stop, dtype=np.int64)
        carried = self.survey.carried[number]
        if self.by_head[number]:
            sensor = carried.sensor
            return Pattern(sensor.ahead, sensor.beams.origin if sensor.centre is None else None)
        directions = carried.sensor.directions(firings).reshape(-1, 3)
        origins = carried.sensor.origins(firings)
        origins = None if origins is None else origins.reshape(-1, 3)
        directions = turned(directions, carried.mount.rotation)
        origins = None if origins is None else turned(origins, carried.mount.rotation)
        if any(carried.mount.position):
            origins = np.add(np.zeros(3) if origins is None else origins, carried.mount.position)
        return Pattern(directions, origins)

    def cast(self, first: int, stop: int) -> Iterator[BatchReturns]:
        """Cast scans `first` to `stop`; yields the returns for each station."""
        run: list[ScanSpec] = []
        for spec in map(self.survey.scan, range(first, stop)):
            here = (spec.sensor, spec.station, spec.firings[0])
            if run and here != (run[-1].sensor, run[-1].station, run[-1].firings[1]):
                yield self._cast(run)
                run = []
            run.append(spec)
        if run:
            yield self._cast(run)

    def _cast(self, specs: list[ScanSpec]) -> BatchReturns:
        number, path = specs[0].sensor, self.survey.path
        sensor, whole = self.survey.carried[number].sensor, self._whole[number]
        first, stop = specs[0].firings[0], specs[-1].firings[1]
        channels = sensor.channels
        if path.moves or self.by_head[number]:
            carried = self.survey.carried[number]
            poses = poses_of_firings(carried, path, specs[0].station, first, stop)
        else:
            pose = path.pose(specs[0].station)
            poses = Poses(np.array(pose.position), pose.rotation)
        if self.scene.actors:
            begins = sensor.begins_ns(np.arange(first, stop, dtype=np.int64)) + specs[0].start_ns
            poses = replace(poses, clock=Clock(begins, sensor.beams.time_ns))
        if whole is not None:
            pattern, start = whole, first * channels % len(whole)
        else:
            pattern, start = self._pattern(number, first, stop), 0
        window = (start, start + (stop - first) * channels)
        groups = np.array([spec.firings[0] - first for spec in specs]) * channels
        if self._echoes is not None:
            found: ScanReturns = self._echoes.scan(
                sensor, specs[0].scan, pattern, poses, window, groups
            )
        else:
            found = self._caster.returns(
                sensor, self.survey.keep_every, pattern, poses, window, groups
            )
        return BatchReturns(self, specs, found, pattern, start, poses)


class RigMissing(RuntimeError):  # noqa: N818 - reads as what happened
    """The worker has no such rig: it was restarted, or has dropped it."""


_rigs: dict[str, Rig] = {}  # {handle: the rig of this process}
_lock = threading.Lock()


def set_up(handle: str, packed: bytes) -> None:
    """Make a rig in this process, unless it exists; runs on a GPU worker."""
    with _lock:
        if handle in _rigs:
            return
        now = time.monotonic()
        for other in [h for h, rig in _rigs.items() if now - rig.used_at > UNUSED_S]:
            del _rigs[other]
        plan: RigPlan = pickle.loads(packed)  # noqa: S301 - of the run's own driver, by Dask
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
    """Drop a rig; no error if there is none."""
    _rigs.pop(handle, None)
