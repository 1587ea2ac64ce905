"""Poses of a carrier or of a sensor's head at each firing, and the motion until the next firing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

import raybeam.poses
from raybeam import Pattern, PoseMotion, pattern_rays

from ...base.arrays import Floats, Indices, Integers, Ints, owned
from ...base.vectors import into_axes, matmul
from ...motion.trajectory import Trajectory, velocities
from ...sensor import Sensor
from ...survey.survey import Mounted, ScanSpec
from .actor_trajectories import ActorTrajectories

RING_FIRINGS = 16  # firings whose rays `along_rings` orders by rings


@dataclass(frozen=True)
class Clock:
    """Firing times of rays, in nanoseconds, and the trajectories that are followed meanwhile.

    The times count from the start of the survey if the trajectories are of actors, and from the
    start of the station if the trajectory is of the carrier.
    """

    firing_starts: Floats  # (f,): start of each firing, nanoseconds
    delays: Floats  # (m,): of each of the m rays of a firing after its start, nanoseconds
    trajectories: ActorTrajectories  # trajectories of the actors, or of the carrier alone
    start: int = 0  # number of the ray that `times` counts from, 0 at the first firing
    subrays: int = 1  # sub-rays of a ray, as `times` numbers them

    def times(self, ray: Integers) -> Floats:
        """Return the firing times of sub-rays (n,), nanoseconds: (n,).

        Sub-ray k is of ray ``start + k // subrays``.
        """
        from . import surface_loops  # not before: numba takes half a second to import

        times_ns = np.empty(len(ray))
        surface_loops.firing_times(
            owned(ray, np.int64),
            self.start,
            self.subrays,
            owned(self.firing_starts),
            owned(self.delays),
            times_ns,
        )
        return times_ns

    def part(self, start: int, subrays: int) -> Clock:
        """Return a clock whose `times` takes sub-rays, from 0 at ray `start`, `subrays` a ray."""
        return replace(self, start=start, subrays=subrays)


@dataclass(frozen=True, eq=False)
class Firings:
    """Consecutive firings of a sensor at a station, or their repetitions, in the order of rays."""

    sensor: Sensor
    numbers: Ints  # (f,): counted from the start of the station
    spec: ScanSpec  # scan of the first firing

    @classmethod
    def from_scans(cls, sensor: Sensor, specs: Sequence[ScanSpec], repetitions: int = 1) -> Firings:
        """Return the firings of consecutive scans, the whole sequence `repetitions` times."""
        numbers = np.arange(specs[0].firings[0], specs[-1].firings[1], dtype=np.int64)
        if repetitions > 1:
            numbers = np.tile(numbers, repetitions)
        return cls(sensor, numbers, specs[0])

    def times(self, ray: Integers) -> Ints:
        """Return the firing times of rays (n,), nanoseconds since the survey's start: (n,).

        Rays are numbered from 0 at the first firing.
        """
        clock = Clock(
            self.sensor.begins_ns(self.numbers), self.sensor.beams.time_ns, ActorTrajectories()
        )
        times = clock.times(ray)
        return self.spec.start_ns + np.rint(times, out=times).astype(np.int64)


@dataclass(frozen=True)
class CastPoses:
    """Poses of rays for `RayCaster.scan`: of the sensor's head, or else of its carrier.

    Rotations are from the frame of the head or carrier to the scene frame.
    """

    positions: Floats  # (p, 3), or (3,) for all rays, meters
    rotations: Floats | None = None  # (p, 3, 3), or (3, 3) for all rays; None for the identity
    rays_per_pose: int | None = None  # None for a single pose
    motion: PoseMotion | None = None  # motion from each pose to the next
    clock: Clock | None = None  # clock of the actors; None without actors
    by_head: bool = False  # whether the poses are of the head
    carrier: Clock | None = None  # clock of a carrier that moves, for its velocities; else None
    station: int = 0  # station of the trajectory of `carrier`

    @cached_property
    def caster_arguments(self) -> dict[str, Any]:
        """Arguments of `RayCaster.scan` and `pattern_rays`."""
        if self.rays_per_pose is None:
            return {"positions": self.positions, "rotations": self.rotations}
        # `check_trajectory` has checked them: again would take a fortieth of the casting time.
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
        """Return the firing times of rays (n,) for actors, nanoseconds since the survey's start.

        Zeros without actors.
        """
        return np.zeros(len(ray)) if self.clock is None else self.clock.times(ray)

    def part(self, start: int, stop: int, subrays: int) -> CastPoses:
        """Return the poses of the sub-rays of rays `start` to `stop`, `subrays` of each ray.

        Sub-rays are numbered from 0 at ray `start`. The rays belong to complete poses: `start`
        is the first ray of a pose, and `stop` follows the last ray of a pose or of all rays.
        """
        rays_per_pose = self.rays_per_pose
        motion = self.motion
        clock = None if self.clock is None else self.clock.part(start, subrays)
        carrier = None if self.carrier is None else self.carrier.part(start, subrays)
        if rays_per_pose is None:
            return replace(self, clock=clock, carrier=carrier)
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
            carrier=carrier,
        )

    def drift(self, ray: Integers, origins: Floats) -> Floats:
        """Return the velocities of points of the carrier at origins of rays (n, 3), m/s: (n, 3).

        `ray` (n,) are the numbers of the rays, which have the times; origins and velocities are in
        the scene frame; zeros if the carrier stands. The motion of a rotating head is left out: a
        sensor corrects its own rotation.
        """
        if self.carrier is None:
            return np.zeros((len(ray), 3))
        (path,) = self.carrier.trajectories
        times = self.carrier.times(ray)
        velocity, rate = velocities(path, self.station, times)
        positions, _ = path.poses(self.station, times)
        return velocity + np.cross(rate, origins - positions)

    def rays(self, pattern: Pattern, ray: Integers, start: int = 0) -> tuple[Floats, Floats]:
        """Return origins and directions of rays (n,) of a pattern, in the scene frame: (n, 3) each.

        Origins are (1, 3) if all rays share one.

        Ray k is row ``start + k`` of the pattern, which repeats (`raybeam.pattern_rays`).
        """
        return pattern_rays(pattern, ray, start=start, **self.caster_arguments)


def along_rings(ray: Ints, channels: int) -> Indices:
    """Return the order of rays (n,) that puts neighbors along a ring behind each other.

    `ray` (n,) are numbers of rays, in the order of firings and channels. The rays of every
    `RING_FIRINGS` firings are ordered by channels, and within a channel as before: such neighbors
    are near each other in the scene.
    """
    ring = ray // (RING_FIRINGS * channels) * channels + ray % channels
    return np.argsort(ring.astype(np.uint16), kind="stable")  # uint16: a tenth of the time


def check_trajectory(path: Trajectory) -> None:
    """Check the first pose of each station of a trajectory, which may be a user's class.

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
    """Return the poses of a sensor's beams in firings `first` to `stop` of a station.

    If a head rotates all beams (`Sensor.spins`), the poses are of the head, and the rays of one
    firing serve for all firings. Otherwise the poses are of the carrier. A pose is at the time of
    the first beam of a firing. If all beams start at the same point of a head, the positions are
    this point's, `Sensor.center`, else of the head frame's origin.

    Later beams of a firing start from the carrier's position at the time of the beam: the carrier
    moves evenly from each firing to the next. A pose for each beam would take as long as casting.

    `motion` is None if the carrier stands, or if all beams of a firing are fired at once.
    `late_ns` nanoseconds are added to the times of the firings to find the carrier's poses.
    """
    sensor = carried.sensor
    firings = np.arange(first, stop + 1, dtype=np.int64)
    times = np.minimum(sensor.begins_ns(firings) + sensor.lead_ns + late_ns, path.duration_ns)
    positions, carrier_rotations = path.poses(station, times)
    positions = raybeam.poses.component_major(positions)
    carrier_rotations = (
        np.broadcast_to(np.eye(3), (len(times), 3, 3))
        if carrier_rotations is None
        else carrier_rotations
    )
    carrier_rotations = raybeam.poses.component_major(carrier_rotations)
    spins = sensor.spins(firings[:-1])
    rotations = carrier_rotations[:-1]
    if spins is not None:
        mount_position = carried.mount.position
        if any(mount_position):
            mount_positions = np.broadcast_to(mount_position, positions.shape)
            positions = positions + into_axes(mount_positions, carrier_rotations.transpose(0, 2, 1))
        rotations = _head_rotations(carried, rotations, spins)
    ray_positions = positions[:-1]
    if spins is not None and sensor.center is not None and sensor.center.any():
        center = np.broadcast_to(sensor.center, ray_positions.shape)
        ray_positions = ray_positions + into_axes(center, rotations.transpose(0, 2, 1))
    delays = (sensor.beams.time_ns - sensor.lead_ns) / 1e9
    if not path.moves or not delays.any():
        return CastPoses(ray_positions, rotations, sensor.channels, by_head=spins is not None)
    seconds = np.diff(times)[:, None] / 1e9
    seconds[seconds == 0] = np.inf  # a last firing at the very end: the carrier stands
    motion = PoseMotion(
        delays,
        np.diff(positions, axis=0) / seconds,
        _rotation_vectors(carrier_rotations[:-1], carrier_rotations[1:]) / seconds,
    )
    return CastPoses(ray_positions, rotations, sensor.channels, motion, by_head=spins is not None)


def _head_rotations(carried: Mounted, rotations: Floats, spins: Floats) -> Floats:
    """Return the rotations (k, 3, 3) from the head, turned to its azimuths, to the scene frame.

    `rotations` (k, 3, 3) are those from the carrier frame; `spins` (2, k) are the cosines and sines
    of the head's azimuths.
    """
    if carried.mount.rotation is not None:
        rotations = matmul(rotations, carried.mount.rotation)
    if carried.sensor.axes is not None:
        rotations = matmul(rotations, carried.sensor.axes)
    return rotated_about_z(rotations, spins)


def rotated_about_z(rotations: Floats, spins: Floats) -> Floats:
    """Return matrices (k, 3, 3) times rotations about z, of cosines and sines `spins` (2, k)."""
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
    """Return the rotation vectors (k, 3), radians, from matrices to close matrices (k, 3, 3).

    The vectors are in the scene frame, the target of the matrices. They are half the sum of the
    cross products of corresponding axes, whose length is the sine of the angle.
    """
    vectors = np.empty((3, len(earlier))).T
    for axis in range(3):
        second = (axis + 1) % 3
        third = (axis + 2) % 3
        cross = earlier[:, second] * later[:, third] - earlier[:, third] * later[:, second]
        vectors[:, axis] = ((cross[:, 0] + cross[:, 1]) + cross[:, 2]) / 2
    return vectors
