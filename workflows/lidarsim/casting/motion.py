"""Poses of a platform or sensor head at each firing, and its motion until the next firing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

import raybeam.poses
from raybeam import Pattern, PoseMotion, pattern_rays

from ..motion.trajectory import Trajectory, velocities
from ..numerics.arrays import Floats, Indices, Integers, Ints, to_writable
from ..numerics.vectors import matmul, rotate_into_frames
from ..sensor import Sensor
from ..survey.survey import Mounted, ScanSpec
from .actor_trajectories import ActorTrajectories

RING_FIRINGS = 16  # number of firings whose rays `order_along_rings` sorts by ring


@dataclass(frozen=True)
class FiringClock:
    """Firing times of rays, and the trajectories that are evaluated at these times.

    Times are nanoseconds since the start of the survey for trajectories of actors, and since the
    start of the station for the trajectory of the platform.
    """

    firing_starts: Floats  # (f,): start of each firing, nanoseconds
    delays: Floats  # (m,): delay of each ray within a firing, nanoseconds
    trajectories: ActorTrajectories  # trajectories of the actors, or of the platform alone
    start: int = 0  # ray that sub-ray 0 of `times` belongs to; ray 0 is the first of the firings
    subrays: int = 1  # number of sub-rays per ray

    def times(self, ray: Integers) -> Floats:
        """Return the firing times of sub-rays in nanoseconds.

        Sub-ray k belongs to ray ``start + k // subrays``.
        """
        from . import surface_loops  # imported here because numba takes half a second to import

        times_ns = np.empty(len(ray))
        surface_loops.firing_times(
            to_writable(ray, np.int64),
            self.start,
            self.subrays,
            to_writable(self.firing_starts),
            to_writable(self.delays),
            times_ns,
        )
        return times_ns

    def for_subrays(self, start: int, subrays: int) -> FiringClock:
        """Return a clock for sub-rays. Sub-ray 0 is the first sub-ray of ray `start`."""
        return replace(self, start=start, subrays=subrays)


@dataclass(frozen=True, eq=False)
class Firings:
    """Consecutive firings of a sensor at one station, possibly repeated several times."""

    sensor: Sensor
    numbers: Ints  # (f,): firing numbers, counted from the start of the station
    spec: ScanSpec  # scan of the first firing

    @classmethod
    def from_scans(cls, sensor: Sensor, specs: Sequence[ScanSpec], repetitions: int = 1) -> Firings:
        """Return the firings of consecutive scans.

        The whole sequence is repeated `repetitions` times.
        """
        numbers = np.arange(specs[0].firings[0], specs[-1].firings[1], dtype=np.int64)
        if repetitions > 1:
            numbers = np.tile(numbers, repetitions)
        return cls(sensor, numbers, specs[0])

    def times(self, ray: Integers) -> Ints:
        """Return the firing times of rays in nanoseconds since the start of the survey.

        Rays are numbered from 0 at the first firing.
        """
        clock = FiringClock(
            self.sensor.begins_ns(self.numbers), self.sensor.beams.time_ns, ActorTrajectories()
        )
        times = clock.times(ray)
        return self.spec.start_ns + np.rint(times, out=times).astype(np.int64)


@dataclass(frozen=True)
class CastPoses:
    """Poses of the sensor's head or of its platform for `RayCaster.scan`.

    Rotations map the frame of the head or platform to the scene frame.
    """

    positions: Floats  # (p, 3), or (3,) for all rays, meters
    rotations: Floats | None = None  # (p, 3, 3), or (3, 3) for all rays; None for the identity
    rays_per_pose: int | None = None  # None for a single pose
    motion: PoseMotion | None = None  # motion from each pose to the next
    clock: FiringClock | None = None  # clock of the actors; None without actors
    by_head: bool = False  # whether the poses are poses of the head
    platform: FiringClock | None = None  # clock of a moving platform, to compute its velocity
    station: int = 0  # station in the trajectory of `platform`

    @cached_property
    def caster_arguments(self) -> dict[str, Any]:
        """Keyword arguments for `RayCaster.scan` and `pattern_rays`."""
        if self.rays_per_pose is None:
            return {"positions": self.positions, "rotations": self.rotations}
        # Use poses that `check_trajectory` has checked. Another check would cost 2.5 % of casting.
        return {
            "positions": raybeam.poses.Poses(
                self.positions, self.rotations, self.rays_per_pose, self.motion
            )
        }

    @property
    def actor_trajectories(self) -> ActorTrajectories:
        """Trajectories of the actors."""
        return ActorTrajectories() if self.clock is None else self.clock.trajectories

    def times(self, ray: Integers) -> Floats:
        """Return the firing times of rays, or zeros if there are no actors.

        Times are nanoseconds since the start of the survey.
        """
        return np.zeros(len(ray)) if self.clock is None else self.clock.times(ray)

    def for_subrays(self, start: int, stop: int, subrays: int) -> CastPoses:
        """Return the poses of rays `start` to `stop`, each divided into `subrays` sub-rays.

        Sub-rays are numbered from 0 at ray `start`. The range must consist of complete poses:
        `start` is the first ray of a pose, and `stop` follows the last ray of a pose or of all
        rays.
        """
        rays_per_pose = self.rays_per_pose
        motion = self.motion
        clock = None if self.clock is None else self.clock.for_subrays(start, subrays)
        platform = None if self.platform is None else self.platform.for_subrays(start, subrays)
        if rays_per_pose is None:
            return replace(self, clock=clock, platform=platform)
        poses = slice(start // rays_per_pose, -(-stop // rays_per_pose))
        if motion is not None:
            delays = np.repeat(motion.delays, subrays)
            motion = PoseMotion(delays, motion.velocities[poses], motion.rates[poses])
        rotations = None if self.rotations is None else self.rotations[poses]
        return replace(
            self,
            positions=self.positions[poses],
            rotations=rotations,
            rays_per_pose=rays_per_pose * subrays,
            motion=motion,
            clock=clock,
            platform=platform,
        )

    def platform_velocities(self, ray: Integers, origins: Floats) -> Floats:
        """Return the velocities of ray origins in m/s due to the motion of the platform.

        `ray` (n,) are ray numbers, which determine the times, and `origins` have shape (n, 3).
        Origins and velocities are in the scene frame. The velocities are zero if the platform is
        stationary. The rotation of the head is not included, because a sensor corrects for its own
        rotation.
        """
        if self.platform is None:
            return np.zeros((len(ray), 3))
        (path,) = self.platform.trajectories
        times = self.platform.times(ray)
        velocity, rate = velocities(path, self.station, times)
        positions, _ = path.poses(self.station, times)
        return velocity + np.cross(rate, origins - positions)

    def rays(self, pattern: Pattern, ray: Integers, start: int = 0) -> tuple[Floats, Floats]:
        """Return the origins and directions of a pattern's rays in the scene frame.

        Ray k is row ``start + k`` of the pattern, which repeats (`raybeam.pattern_rays`). Both
        arrays have shape (n, 3), but the origins have shape (1, 3) if all rays share one.
        """
        return pattern_rays(pattern, ray, start=start, **self.caster_arguments)


def order_along_rings(ray: Ints, channels: int) -> Indices:
    """Return an order of the rays in which those of the same ring are consecutive.

    `ray` (n,) are ray numbers sorted by firing and channel. Within each block of `RING_FIRINGS`
    firings, rays are sorted by channel and keep their order within a channel. Consecutive rays are
    then close to each other in the scene.
    """
    ring = ray // (RING_FIRINGS * channels) * channels + ray % channels
    return np.argsort(ring.astype(np.uint16), kind="stable")  # uint16: a tenth of the time


def check_trajectory(path: Trajectory) -> None:
    """Check the first pose of a trajectory at each of its stations.

    The trajectory may be of a user-defined class.

    Raises
    ------
    ValueError
        If a position is not finite or a rotation is invalid.
    """
    for station in range(path.stations):
        raybeam.poses.check_poses(*path.poses(station, np.zeros(1)), None, 0)


def poses_of_firings(
    carried: Mounted, path: Trajectory, station: int, first: int, stop: int, late_ns: float = 0.0
) -> CastPoses:
    """Return the poses of a sensor's beams for firings `first` to `stop` at a station.

    If a head rotates all beams (`Sensor.spins`), these are poses of the head, and the rays of one
    firing are valid for all firings. Otherwise they are poses of the platform. Each pose is taken
    at the time of the first beam in a firing. If all beams start at the same point of a head, the
    positions are those of this point (`Sensor.center`), otherwise of the origin of the head frame.

    Later beams of a firing start from the platform's position at their own time, which is
    interpolated linearly between firings. Computing a pose for each beam would take as long as
    casting.

    `motion` is None if the platform is stationary, or if all beams of a firing are fired at once.
    `late_ns` nanoseconds are added to the firing times to find the platform's poses.
    """
    sensor = carried.sensor
    firings = np.arange(first, stop + 1, dtype=np.int64)
    times = np.minimum(sensor.begins_ns(firings) + sensor.lead_ns + late_ns, path.duration_ns)
    positions, platform_rotations = path.poses(station, times)
    positions = raybeam.poses.component_major(positions)
    platform_rotations = (
        np.broadcast_to(np.eye(3), (len(times), 3, 3))
        if platform_rotations is None
        else platform_rotations
    )
    platform_rotations = raybeam.poses.component_major(platform_rotations)
    spins = sensor.spins(firings[:-1])
    rotations = platform_rotations[:-1]
    if spins is not None:
        mount_position = carried.mount.position
        if any(mount_position):
            mount_positions = np.broadcast_to(mount_position, positions.shape)
            positions = positions + rotate_into_frames(
                mount_positions, platform_rotations.transpose(0, 2, 1)
            )
        rotations = _head_rotations(carried, rotations, spins)
    ray_positions = positions[:-1]
    if spins is not None and sensor.center is not None and sensor.center.any():
        center = np.broadcast_to(sensor.center, ray_positions.shape)
        ray_positions = ray_positions + rotate_into_frames(center, rotations.transpose(0, 2, 1))
    delays = (sensor.beams.time_ns - sensor.lead_ns) / 1e9
    if not path.moves or not delays.any():
        return CastPoses(ray_positions, rotations, sensor.channels, by_head=spins is not None)
    seconds = np.diff(times)[:, None] / 1e9
    seconds[seconds == 0] = np.inf  # the last firing is at the very end; the platform stops
    motion = PoseMotion(
        delays,
        np.diff(positions, axis=0) / seconds,
        _rotation_vectors(platform_rotations[:-1], platform_rotations[1:]) / seconds,
    )
    return CastPoses(ray_positions, rotations, sensor.channels, motion, by_head=spins is not None)


def _head_rotations(carried: Mounted, rotations: Floats, spins: Floats) -> Floats:
    """Return the rotations from the head frame, at its current azimuths, to the scene frame.

    `rotations` (k, 3, 3) map the platform frame to the scene frame. `spins` (2, k) are the cosines
    and sines of the head's azimuths.
    """
    if carried.mount.rotation is not None:
        rotations = matmul(rotations, carried.mount.rotation)
    if carried.sensor.axes is not None:
        rotations = matmul(rotations, carried.sensor.axes)
    return rotated_about_z(rotations, spins)


def rotated_about_z(rotations: Floats, spins: Floats) -> Floats:
    """Multiply rotation matrices by rotations about the z axis.

    `spins` has the cosines and sines of the angles.
    """
    cos, sin = spins
    products = np.empty((3, 3, spins.shape[1])).transpose(2, 0, 1)
    for row in range(3):
        x = rotations[:, row, 0]
        y = rotations[:, row, 1]
        products[:, row, 0] = x * cos + y * sin
        products[:, row, 1] = y * cos - x * sin
    products[:, :, 2] = rotations[:, :, 2]
    return products


def _rotation_vectors(earlier: Floats, later: Floats) -> Floats:
    """Return the rotation vectors in radians between pairs of nearly equal rotations.

    The vectors (k, 3) are in the scene frame, the target frame of the matrices. Each vector is half
    the sum of the cross products of corresponding axes, and its length is the sine of the rotation
    angle.
    """
    vectors = np.empty((3, len(earlier))).T
    for axis in range(3):
        second = (axis + 1) % 3
        third = (axis + 2) % 3
        cross = earlier[:, second] * later[:, third] - earlier[:, third] * later[:, second]
        vectors[:, axis] = ((cross[:, 0] + cross[:, 1]) + cross[:, 2]) / 2
    return vectors
