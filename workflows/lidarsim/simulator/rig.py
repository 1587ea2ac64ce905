"""A rig: a scene with its ray casters, and the sensors of a survey, ready to cast."""

from __future__ import annotations

from collections.abc import Iterator
from copy import copy
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from raybeam import Pattern

from ..base.arrays import Floats, Floats32
from ..base.errors import LidarError
from ..base.vectors import turned
from ..scene.actors import Actor
from ..scene.scene import Scene
from ..sensor import Pose, ScanSpec, Sensor, Survey, Trajectory
from .actor_trajectories import ActorTrajectories
from .device import DeviceColumns, DevicePoints
from .motion import CastPoses, Clock, Firings, check_trajectory, poses_of_firings
from .points import BatchPoints
from .pulses import PulseCaster
from .scene_caster import SceneCaster
from .surfaces import Surfaces

PATTERN_RAYS = 20_000_000  # rays of a head's period that are kept; 24 bytes each
IMAGE_RAYS = 1 << 20  # rays of images that are cast at a time
KEPT = 8  # turns whose rays are kept for the next images


class _Rays(NamedTuple):
    """Rays of a sensor that are made once."""

    pattern: Pattern | None  # some firings, or one period of the head; None if that is too long
    # Whether they are one firing in the axes of the head, each firing with a pose of its own; else
    # they are in the axes of the carrier.
    by_head: bool = False


def rays_repeat(sensor: Sensor, moves: bool) -> tuple[bool, bool]:
    """Whether a sensor's rays are made once and cast again and again, and whether by its head.

    By the head they are one firing, and each firing has a pose of its own.
    """
    fits = 0 < (sensor.period or 0) * sensor.channels <= PATTERN_RAYS
    by_head = sensor.spins(np.zeros(1, np.int64)) is not None and (moves or not fits)
    return fits or by_head, by_head


class Rig:
    """Scene, survey and a ray caster that is ready; `backend` and the like as of `RayCaster`."""

    def __init__(
        self,
        scene: Scene,
        survey: Survey,
        backend: str = "auto",
        threads: int | None = None,
        device: int | None = None,
    ) -> None:
        options = {"backend": backend, "threads": threads, "device": device}
        self._assemble(scene, survey, options, None)

    def _assemble(
        self, scene: Scene, survey: Survey, options: dict[str, Any], like: SceneCaster | None
    ) -> None:
        self.scene = scene
        self.survey = survey
        self.options = options
        self._ways = ActorTrajectories.of(scene.actors)
        wavelengths = {carried.sensor.optics.wavelength_nm for carried in survey.carried}
        self._surfaces = Surfaces(scene, tuple(survey.materials), sorted(wavelengths))
        self._caster = SceneCaster(scene, self._surfaces, like, **options)
        self._device: DeviceColumns | None = None
        self._see()
        check_trajectory(survey.path)
        self._made: dict[tuple[int, bool], _Rays] = {}  # {(sensor, whether it moves): rays}
        self._firings: dict[tuple[int, int, int], Pattern] = {}  # {(sensor, first, stop): rays}
        for number in range(len(survey.carried)):
            self._repeated(number, survey.path.moves)

    def _repeated(self, number: int, moves: bool) -> _Rays:
        """Rays of a sensor that are cast again and again, made on first use."""
        made = self._made.get((number, moves))
        if made is None:
            sensor = self.survey.carried[number].sensor
            repeats, by_head = rays_repeat(sensor, moves)
            made = _Rays(None)
            if by_head:
                origin = sensor.beams.origin if sensor.centre is None else None
                pattern = Pattern(sensor.ahead, origin)
                made = _Rays(pattern, by_head=True)
            elif repeats:
                made = _Rays(self._rays_of(number, 0, sensor.period or 0))
            self._made[number, moves] = made
        return made

    def with_survey(self, scene: Scene, survey: Survey) -> Rig:
        """Return a rig of another survey of the same scene, perhaps with other actors.

        The tree of all that stands still is shared.
        """
        rig = copy(self)
        rig._assemble(scene, survey, self.options, self._caster)
        return rig

    def with_actors(self, actors: tuple[Actor, ...]) -> Rig:
        """Return the same rig with other trajectories of the actors; the trees are shared."""
        rig = copy(self)
        rig.scene = self.scene.with_actors(actors)
        rig._ways = ActorTrajectories.of(actors)
        return rig

    def check_actors(self, begin_ns: float, end_ns: float) -> None:
        """Check that the trajectories of actors cover a time; LidarError if not."""
        moving = np.flatnonzero([way.moves for way in self._ways])
        try:
            times = np.repeat([begin_ns, end_ns], len(moving)).astype(np.float64)
            self._ways.poses(np.tile(moving, 2), times)
        except LidarError:
            for number in moving:
                self.scene.actors[number].check(begin_ns, end_ns)  # which names it
            raise

    def moved(self, owner: int, pose: Pose) -> Rig:
        """Return the same rig with the instances of an object at a pose, see `Scene.moved`.

        The trees are shared: this rig must not cast any more, and no cast may be under way.
        """
        rig = copy(self)
        rig.scene = self.scene.moved(owner, pose)
        shared = rig.scene.instances
        assert shared is not None
        rows = np.flatnonzero(shared.owner == owner)
        rig._surfaces = self._surfaces.moved(rig.scene, rows)
        rig._caster.place(rig._surfaces, shared, rows)
        rig._see()
        return rig

    def _see(self) -> None:
        """Make what depends on where the surfaces are."""
        given = self._caster, self.scene, self.survey, self._surfaces
        self._pulses = [PulseCaster(number, *given) for number in range(len(self.survey.carried))]
        if self._device is not None:
            self._device = self._device.moved(self.scene, self._surfaces)
        elif self._caster.caster.on_device and not any(pulses.steps for pulses in self._pulses):
            self._device = DeviceColumns(*given)

    @property
    def backend(self) -> str:
        """Name of the ray-casting backend in use."""
        return self._caster.backend

    def pattern(self, number: int, first: int, stop: int) -> Pattern:
        """Rays of firings `first` to `stop` of a sensor, in the axes of its carrier."""
        firings = np.arange(first, stop, dtype=np.int64)
        carried = self.survey.carried[number]
        mount = carried.mount
        origins = carried.sensor.origins(firings)
        directions = turned(carried.sensor.directions(firings).reshape(-1, 3), mount.rotation)
        if origins is not None:
            origins = turned(origins.reshape(-1, 3), mount.rotation)
        if any(mount.position):
            origins = np.add(np.zeros(3) if origins is None else origins, mount.position)
        return Pattern(directions, origins)

    def cast(self, first: int, stop: int) -> Iterator[BatchPoints | DevicePoints]:
        """Cast scans `first` to `stop` of the survey; yields the returns for each station."""
        run: list[ScanSpec] = []
        for spec in map(self.survey.sent_scan, range(first, stop)):
            here = (spec.sensor, spec.station, spec.firings[0], spec.repeats)
            last = run[-1] if run else spec
            if run and here != (last.sensor, last.station, last.firings[1], last.repeats):
                yield self.returns(run, self.survey.path)
                run = []
            run.append(spec)
        if run:
            yield self.returns(run, self.survey.path)

    def returns(
        self, specs: list[ScanSpec], path: Trajectory, late_ns: float = 0.0, *, tally: bool = True
    ) -> BatchPoints | DevicePoints:
        """Cast scans of one station, the firings of each following those of the one before.

        The carrier is `late_ns` further on its path than the firings' own times say. Hits of each
        triangle are counted if `tally`.
        """
        number = specs[0].sensor
        survey = self.survey
        whole, by_head = self._repeated(number, path.moves)
        carried = survey.carried[number]
        channels = carried.sensor.channels
        first = specs[0].firings[0]
        stop = specs[-1].firings[1]
        if path.moves or by_head:
            poses = poses_of_firings(carried, path, specs[0].station, first, stop, late_ns)
        else:
            pose = path.pose(specs[0].station)
            poses = CastPoses(np.array(pose.position), pose.rotation)
        fired = Firings.from_scans(carried.sensor, specs)
        poses = self._timed(poses, fired)
        if path.moves:
            begins = carried.sensor.begins_ns(fired.numbers) + late_ns
            carrier = Clock(begins, carried.sensor.beams.time_ns, ActorTrajectories((path,)))
            poses = replace(poses, carrier=carrier, station=specs[0].station)
        if whole is not None:
            pattern = whole
            start = first * channels % len(whole)
        else:
            pattern = self.pattern(number, first, stop)
            start = 0
        window = (start, start + (stop - first) * channels)
        groups = np.array([spec.firings[0] - first for spec in specs]) * channels
        if self._device is not None:
            return self._device.returns(specs, pattern, poses, window, groups)
        scan = specs[0].scan + specs[0].ahead
        found = self._pulses[number].scan(scan, pattern, poses, window, groups, fired, tally=tally)
        return BatchPoints(self.scene, survey, self._surfaces, specs, found, pattern, start, poses)

    def _timed(self, poses: CastPoses, fired: Firings) -> CastPoses:
        """Return poses of firings with the times that actors need."""
        if not self.scene.actors:
            return poses
        begins = fired.sensor.begins_ns(fired.numbers) + fired.spec.start_ns
        return replace(poses, clock=Clock(begins, fired.sensor.beams.time_ns, self._ways))

    def ranges(
        self, specs: list[ScanSpec], positions: Floats, rotations: Floats | None
    ) -> Floats32:
        """Cast the same firings from many poses of a carrier that stands.

        `specs` are scans of one station; the next pose has the numbers that follow theirs. The
        poses, (k, 3) and (k, 3, 3), have been checked. Returns float32 (k, firings, channels):
        ranges of the nearest reported returns, metres; inf where there are none.
        """
        number = specs[0].sensor
        sensor = self.survey.carried[number].sensor
        first = specs[0].firings[0]
        stop = specs[-1].firings[1]
        pattern = self._rays_of(number, first, stop)
        begin_rays = np.array([spec.firings[0] - first for spec in specs]) * sensor.channels
        rays = len(pattern)
        out = np.full((len(positions), rays), np.inf, np.float32)
        each = max(1, IMAGE_RAYS // max(rays, 1))  # poses that are cast at a time
        for begin in range(0, len(positions), each):
            block = slice(begin, begin + each)
            image = out[block].reshape(-1)
            count = len(image) // rays
            poses = CastPoses(
                positions[block], None if rotations is None else rotations[block], rays
            )
            fired = Firings.from_scans(sensor, specs, count)
            poses = self._timed(poses, fired)
            groups = (rays * np.arange(count)[:, None] + begin_rays).reshape(-1)
            scan = specs[0].scan + specs[0].ahead + begin * len(specs)
            window = (0, len(image))
            caster = self._pulses[number]
            found = caster.scan(scan, pattern, poses, window, groups, fired, tally=False).returns
            assert found.reported is not None  # of kept returns
            nearest = found.number == 1
            image[found.ray[nearest]] = found.reported[nearest]
        return out.reshape(len(positions), -1, sensor.channels)

    def _rays_of(self, number: int, first: int, stop: int) -> Pattern:
        """Rays of some firings in the axes of the carrier."""
        sensor = self.survey.carried[number].sensor
        if sensor.period:
            stop = first % sensor.period + stop - first
            first = first % sensor.period
        made = self._firings.get((number, first, stop))
        if made is None:
            if len(self._firings) >= KEPT:
                self._firings.clear()
            made = self._firings[number, first, stop] = self.pattern(number, first, stop)
        return made
