"""A rig combines a scene, its ray casters and the sensors of a survey."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from raybeam import Pattern

from ..casting.actor_trajectories import ActorTrajectories
from ..casting.actor_visibility import ActorVisibility
from ..casting.motion import CastPoses, FiringClock, Firings, check_trajectory, poses_of_firings
from ..casting.ray_chunks import ray_chunks
from ..casting.scene_caster import SceneCaster, casters_of_sensors, move_instances
from ..casting.surfaces import SceneSurfaces
from ..columns.actor_rays import NO_ACTOR_RAYS
from ..errors import LidarError
from ..motion.trajectory import Trajectory
from ..numerics.arrays import Floats, Floats32, Integers, Ints32, Records
from ..numerics.vectors import rotate
from ..pulses.pulses import PulseCaster
from ..pulses.returns import require_column
from ..scene.actors import Actor
from ..scene.scene import Scene
from ..sensor import Sensor
from ..survey.survey import ScanSpec, Survey
from .points.batch_points import BatchPoints
from .points.device_columns import DeviceColumns, DevicePoints

# Largest number of rays in a period of the head that are stored, at 24 bytes each. Directions
# repeat after each period.
PATTERN_RAYS = 20_000_000
IMAGE_RAYS = 1 << 20  # number of rays of range images that are cast at a time
MAX_PATTERNS = 8  # number of ray patterns that are stored for the next images


class _Rays(NamedTuple):
    """Rays of a sensor that are computed once and then cast repeatedly."""

    pattern: Pattern | None  # one firing, or one period of the head; None if the rays do not repeat
    # True if the rays are one firing in the head frame, with a pose for each firing. Otherwise they
    # are in the platform frame.
    by_head: bool = False


class CentralRays(NamedTuple):
    """Central rays of n pulses in the scene frame, up to the first surface."""

    origins: Floats  # (3, n), meters
    directions: Floats  # (3, n), unit vectors
    ranges: Floats  # (n,), meters; inf if there is no surface within the range of the sensor
    triangles: Ints32  # (n,), numbered as in `StoredTriangles`; -1 without a surface


def rays_repeat(sensor: Sensor, moves: bool) -> tuple[bool, bool]:
    """Return whether a sensor's rays repeat, and whether the poses of its head rotate them.

    `moves` states whether the platform moves. Rays that are cast by head are the rays of one firing
    in the head frame, with a pose for each firing. Other repeated rays are the rays of one head
    period in the platform frame.
    """
    fits = 0 < (sensor.period or 0) * sensor.channels <= PATTERN_RAYS
    by_head = sensor.spins(np.zeros(1, np.int64)) is not None and (moves or not fits)
    return fits or by_head, by_head


class Rig:
    """A scene, a survey and ray casters, ready to cast scans of the survey.

    The arguments `backend`, `threads` and `device` are passed to `RayCaster`.
    """

    def __init__(
        self,
        scene: Scene,
        survey: Survey,
        backend: str = "auto",
        threads: int | None = None,
        device: int | None = None,
    ) -> None:
        options = {"backend": backend, "threads": threads, "device": device}
        self._assemble(scene, survey, options, ())

    def _assemble(
        self,
        scene: Scene,
        survey: Survey,
        options: dict[str, Any],
        known_casters: Sequence[SceneCaster],
    ) -> None:
        """Set all attributes, and build trees unless `known_casters` already have them."""
        self.scene = scene
        self.survey = survey
        self.options = options
        self._actor_trajectories = ActorTrajectories.from_actors(scene.actors)
        wavelengths = {carried.sensor.optics.simulated_nm for carried in survey.mounted_sensors}
        # These parts are public so that other tools can inspect them.
        self.surfaces = SceneSurfaces(scene, tuple(survey.materials), sorted(wavelengths))
        # Casters by sensor number.
        self.scene_casters = casters_of_sensors(
            scene, survey, self.surfaces, known_casters, **options
        )
        self._prepare()
        check_trajectory(survey.path)
        # {(sensor number, whether the platform moves): rays}
        self._repeated_rays: dict[tuple[int, bool], _Rays] = {}
        # {(sensor number, first firing, stop of firings): rays}
        self._patterns: dict[tuple[int, int, int], Pattern] = {}
        for number in range(len(survey.mounted_sensors)):
            self._rays_of_sensor(number, survey.path.moves)

    def _rays_of_sensor(self, number: int, moves: bool) -> _Rays:
        """Return the repeated rays of a sensor, computing them on first use.

        `moves` states whether the platform moves.
        """
        rays = self._repeated_rays.get((number, moves))
        if rays is None:
            sensor = self.survey.mounted_sensors[number].sensor
            repeats, by_head = rays_repeat(sensor, moves)
            rays = _Rays(None)
            if by_head:
                origin = sensor.beams.origin if sensor.center is None else None
                pattern = Pattern(sensor.beam_directions, origin, step=sensor.ring_step)
                rays = _Rays(pattern, by_head=True)
            elif repeats:
                rays = _Rays(self._pattern_of_firings(number, 0, sensor.period or 0))
            self._repeated_rays[number, moves] = rays
        return rays

    def with_survey(self, scene: Scene, survey: Survey) -> Rig:
        """Return a rig for a different survey of the same scene, possibly with different actors.

        Both rigs share the tree of the static bodies.
        """
        rig = copy(self)
        rig._assemble(scene, survey, self.options, self.scene_casters)
        return rig

    def with_actors(self, actors: tuple[Actor, ...]) -> Rig:
        """Return a rig in which the actors follow new trajectories.

        Both rigs share their trees.
        """
        rig = copy(self)
        rig.scene = self.scene.with_actors(actors)
        rig._actor_trajectories = ActorTrajectories.from_actors(actors)
        return rig

    def check_actors(self, begin_ns: float, end_ns: float) -> None:
        """Raise LidarError unless the trajectories of all actors cover a time interval.

        The interval is given in nanoseconds since the start of the survey.
        """
        moving = np.flatnonzero([trajectory.moves for trajectory in self._actor_trajectories])
        try:
            times = np.repeat([begin_ns, end_ns], len(moving)).astype(np.float64)
            self._actor_trajectories.poses(np.tile(moving, 2), times)
        except LidarError:
            for number in moving:
                self.scene.actors[number].check(begin_ns, end_ns)  # raises an error with the name
            raise

    def with_moved_instances(self, owners: Integers, positions: Floats, rotations: Floats) -> Rig:
        """Return a rig in which the instances of the given objects have moved to new poses.

        `owners` are k distinct object numbers. The poses are positions (k, 3) and rotations
        (k, 3, 3), as in `Scene.with_instance_poses`. The trees are shared and modified, so this rig
        must not be used afterwards, and no cast may be in progress.
        """
        assert self.scene.instances is not None
        instance_indices, index = self.scene.instances.rows_of(owners)
        rig = copy(self)
        rig.scene = scene = self.scene.with_instance_poses(
            instance_indices, positions[index], rotations[index]
        )
        assert scene.instances is not None
        rig.surfaces = surfaces = self.surfaces.with_moved_instances(scene)
        move_instances(rig.scene_casters, surfaces, scene.instances, instance_indices)
        rig.pulse_casters = [
            pulses.with_moved_instances(scene, surfaces) for pulses in self.pulse_casters
        ]
        rig._device = self._device and self._device.with_moved_instances(scene, surfaces)
        return rig

    def _prepare(self) -> None:
        """Create the casters of pulses and of device columns, which depend on the surfaces.

        Columns are computed on a CUDA device if the device casts the rays and no sensor has steps.
        """
        casters = self.scene_casters
        scene = self.scene
        survey = self.survey
        surfaces = self.surfaces
        self.pulse_casters = [
            PulseCaster(number, caster, scene, survey, surfaces)
            for number, caster in enumerate(casters)
        ]
        self._visibilities = [
            ActorVisibility(scene, survey, number, caster, surfaces.triangles)
            for number, caster in enumerate(casters)
            if survey.actor_visibility and scene.actors
        ]
        self._device: DeviceColumns | None = None
        if casters[0].on_device and not any(pulses.steps for pulses in self.pulse_casters):
            self._device = DeviceColumns(casters, scene, survey, surfaces)

    @property
    def backend(self) -> str:
        """Name of the ray-casting backend in use."""
        return self.scene_casters[0].backend

    @property
    def device_lost(self) -> bool:
        """Whether the CUDA device stopped responding to this process after an error."""
        return self.scene_casters[0].caster.device_lost

    def pattern(self, number: int, first: int, stop: int) -> Pattern:
        """Return a sensor's rays in firings `first` to `stop`, in the platform frame.

        The rays are sorted by firing and beam. Firings are counted from the start of the station.
        """
        firings = np.arange(first, stop, dtype=np.int64)
        carried = self.survey.mounted_sensors[number]
        mount = carried.mount
        origins = carried.sensor.origins(firings)
        directions = rotate(carried.sensor.directions(firings).reshape(-1, 3), mount.rotation)
        if origins is not None:
            origins = rotate(origins.reshape(-1, 3), mount.rotation)
        if any(mount.position):
            origins = np.add(np.zeros(3) if origins is None else origins, mount.position)
        return Pattern(directions, origins, step=carried.sensor.ring_step)

    def cast(self, first: int, stop: int) -> Iterator[BatchPoints | DevicePoints]:
        """Cast scans `first` to `stop` of the survey, and yield the returns of each group.

        A group consists of consecutive scans that share a sensor and a station. A frozen sensor
        casts the older scans that it sends again (`Survey.sent_scan`).
        """
        specs: list[ScanSpec] = []  # scans of the current group
        for spec in map(self.survey.sent_scan, range(first, stop)):
            sequence = (spec.sensor, spec.station, spec.firings[0], spec.repeats)
            last = specs[-1] if specs else spec
            if specs and sequence != (last.sensor, last.station, last.firings[1], last.repeats):
                yield self.returns(specs, self.survey.path)
                specs = []
            specs.append(spec)
        if specs:
            yield self.returns(specs, self.survey.path)

    def returns(
        self, specs: list[ScanSpec], path: Trajectory, late_ns: float = 0.0, *, tally: bool = True
    ) -> BatchPoints | DevicePoints:
        """Cast consecutive scans of one sensor at one station, and return their points.

        For a firing `t` nanoseconds after the start of the station, the platform has the pose of
        `path` at time `t + late_ns`, and actors have their poses at the time of the firing. If
        `tally` is set, the hits of each triangle are counted.
        """
        number = specs[0].sensor
        sensor = self.survey.mounted_sensors[number].sensor
        channels = sensor.channels
        first = specs[0].firings[0]
        firings, pattern, poses, window = self._rays_of_scans(specs, path, late_ns)
        start = window[0]
        groups = np.array([spec.firings[0] - first for spec in specs]) * channels
        if self._device is not None:
            points = self._device.returns(specs, pattern, poses, window, groups)
            return replace(points, actor_rays=self._actor_rays(specs, pattern, poses, window))
        scanned = self.pulse_casters[number].scan(
            specs[0].scan + specs[0].random_offset,  # scan number in the keys of random numbers
            pattern,
            poses,
            window,
            groups,
            firings,
            tally=tally,
        )
        return BatchPoints(
            self.scene,
            self.survey,
            self.surfaces,
            specs,
            scanned,
            pattern=pattern,
            start=start,
            poses=poses,
            actor_rays=self._actor_rays(specs, pattern, poses, window),
        )

    def central_rays(self, first: int, stop: int) -> Iterator[CentralRays]:
        """Cast the central rays of scans `first` to `stop`, which must share a sensor and station.

        Effects such as noise, weather and faults do not apply. Pulses that the platform blocks are
        omitted.
        """
        specs = [self.survey.scan(scan) for scan in range(first, stop)]
        caster = self.scene_casters[specs[0].sensor]
        sensor = self.survey.mounted_sensors[specs[0].sensor].sensor
        _, pattern, poses, window = self._rays_of_scans(specs, self.survey.path, 0.0)
        for chunk in ray_chunks(sensor, specs, pattern, poses, window):
            hits = caster.scan(chunk.pattern, chunk.poses, **chunk.limits)
            ranges = np.full(len(chunk.scan), np.inf)
            ranges[hits.ray] = hits.distance
            triangles = np.full(len(chunk.scan), -1, np.int32)
            triangles[hits.ray] = hits.triangle
            rays = chunk.computed_rays()[:, chunk.allowed]
            allowed = chunk.allowed
            yield CentralRays(rays[:3], rays[3:], ranges[allowed], triangles[allowed])

    def _rays_of_scans(
        self, specs: list[ScanSpec], path: Trajectory, late_ns: float
    ) -> tuple[Firings, Pattern, CastPoses, tuple[int, int]]:
        """Return the firings of consecutive scans, and their rays as rows of a pattern with poses.

        The last value contains the first pattern row of the rays, and one past the last.
        """
        number = specs[0].sensor
        repeated, by_head = self._rays_of_sensor(number, path.moves)
        sensor = self.survey.mounted_sensors[number].sensor
        channels = sensor.channels
        first = specs[0].firings[0]
        stop = specs[-1].firings[1]
        firings = Firings.from_scans(sensor, specs)
        poses = self._poses(firings, path, late_ns, by_head=by_head)
        self.scene_casters[number].ensure_trees(poses.positions)
        if repeated is not None:
            pattern = repeated
            start = first * channels % len(repeated)  # pattern row of the first ray
        else:
            pattern = self.pattern(number, first, stop)
            start = 0
        return firings, pattern, poses, (start, start + (stop - first) * channels)

    def _actor_rays(
        self, specs: list[ScanSpec], pattern: Pattern, poses: CastPoses, window: tuple[int, int]
    ) -> Records:
        """Return the visibility records of actors in scans, or none if they are not required."""
        if not self._visibilities:
            return NO_ACTOR_RAYS
        return self._visibilities[specs[0].sensor].count(specs, pattern, poses, window)

    def _poses(
        self, firings: Firings, path: Trajectory, late_ns: float, *, by_head: bool
    ) -> CastPoses:
        """Return the poses of consecutive firings along a path, with the clocks of moving bodies.

        If `by_head` is set, these are poses of the head, otherwise of the platform. `late_ns`
        nanoseconds are added to the firing times to find the platform's poses, but not for actors.
        """
        spec = firings.spec
        carried = self.survey.mounted_sensors[spec.sensor]
        if path.moves or by_head:
            first = spec.firings[0]
            stop = first + len(firings.numbers)
            poses = poses_of_firings(carried, path, spec.station, first, stop, late_ns)
        else:
            pose = path.pose(spec.station)
            poses = CastPoses(np.array(pose.position), pose.rotation)
        poses = self._with_actor_clock(poses, firings)
        if path.moves:
            firing_starts = carried.sensor.begins_ns(firings.numbers) + late_ns
            platform = FiringClock(
                firing_starts, carried.sensor.beams.time_ns, ActorTrajectories((path,))
            )
            poses = replace(poses, platform=platform, station=spec.station)
        return poses

    def _with_actor_clock(self, poses: CastPoses, firings: Firings) -> CastPoses:
        """Add the clock of the actors to the poses of firings, if there are actors."""
        if not self.scene.actors:
            return poses
        sensor = firings.sensor
        firing_starts = sensor.begins_ns(firings.numbers) + firings.spec.start_ns
        clock = FiringClock(firing_starts, sensor.beams.time_ns, self._actor_trajectories)
        return replace(poses, clock=clock)

    def ranges(
        self, specs: list[ScanSpec], positions: Floats, rotations: Floats | None
    ) -> Floats32:
        """Return the ranges that the same firings measure from each of several static poses.

        `specs` are consecutive scans of one station. Their scan numbers, which seed random numbers,
        increase from pose to pose. The poses are positions (k, 3) in meters and rotations (k, 3, 3)
        from the platform frame to the scene frame. They are not checked here. The result is a
        float32 array of shape (k, firings, channels) with the range of the nearest reported return
        in meters, or inf if there is no return.
        """
        number = specs[0].sensor
        sensor = self.survey.mounted_sensors[number].sensor
        first = specs[0].firings[0]
        self.scene_casters[number].ensure_trees(positions)
        pattern = self._pattern_of_firings(number, first, specs[-1].firings[1])
        rays = len(pattern)
        ranges_m = np.full((len(positions), rays), np.inf, np.float32)
        poses_per_block = max(1, IMAGE_RAYS // max(rays, 1))
        for begin in range(0, len(positions), poses_per_block):
            block = slice(begin, begin + poses_per_block)
            poses = CastPoses(
                positions[block], None if rotations is None else rotations[block], rays
            )
            image = ranges_m[block].reshape(-1)
            self._cast_images(specs, pattern, poses, begin * len(specs), image)
        return ranges_m.reshape(len(positions), -1, sensor.channels)

    def _cast_images(
        self,
        specs: list[ScanSpec],
        pattern: Pattern,
        poses: CastPoses,
        first_scan: int,
        image: Floats32,
    ) -> None:
        """Write to `image` the ranges that the same firings measure from each pose.

        `pattern` has the rays of the firings in the platform frame. `image` has shape (poses *
        rays,), with all rays of the first pose first. `first_scan` is added to the scan number of
        `specs[0]` to seed the random numbers.
        """
        rays = len(pattern)
        count = len(image) // rays
        sensor = self.survey.mounted_sensors[specs[0].sensor].sensor
        firings = Firings.from_scans(sensor, specs, count)
        poses = self._with_actor_clock(poses, firings)
        if self._device is not None:
            self._device.write_ranges(specs[0].sensor, pattern, poses, image)
            return
        first = specs[0].firings[0]
        scan_rays = np.array([spec.firings[0] - first for spec in specs]) * sensor.channels
        returns = (
            self.pulse_casters[specs[0].sensor]
            .scan(
                specs[0].scan + specs[0].random_offset + first_scan,
                pattern,
                poses,
                (0, len(image)),
                (rays * np.arange(count)[:, None] + scan_rays).reshape(-1),
                firings,
                tally=False,
            )
            .returns
        )
        assert returns.reported is not None  # the steps have set the ranges of reported returns
        nearest = require_column(returns.number) == 1
        if nearest.all():
            image[returns.ray] = returns.reported
        else:
            image[returns.ray[nearest]] = returns.reported[nearest]

    def _pattern_of_firings(self, number: int, first: int, stop: int) -> Pattern:
        """Return the rays of firings in the platform frame, and cache them."""
        sensor = self.survey.mounted_sensors[number].sensor
        if sensor.period:
            stop = first % sensor.period + stop - first
            first = first % sensor.period
        pattern = self._patterns.get((number, first, stop))
        if pattern is None:
            if len(self._patterns) >= MAX_PATTERNS:
                self._patterns.clear()
            pattern = self._patterns[number, first, stop] = self.pattern(number, first, stop)
        return pattern
