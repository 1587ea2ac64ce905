"""Poses of a carrier at each firing, and its motion until the next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

import raybeam.poses
from raybeam import Pattern, PoseMotion, pattern_rays

from ..base.arrays import Floats, Indices, Integers, Ints, owned
from ..base.vectors import into_axes, matmul
from ..sensor import Mounted, ScanSpec, Sensor, Trajectory
from ..sensor.trajectory import velocities
from .actor_trajectories import ActorTrajectories

RING = 16  # neighbours along a ring


@dataclass(frozen=True)
class Clock:
    """Firing times of rays, in nanoseconds, and what moves then.

    Actors move by times since the survey's start, a carrier by those since its station's.
    """

    firing_starts: Floats  # (f,): of each firing
    delays: Floats  # (m,): of each ray of a firing
    trajectories: ActorTrajectories  # of the actors, or that of the carrier
    start: int = 0  # first ray
    subrays: int = 1  # of each ray

    def times(self, ray: Integers) -> Floats:
        """Return the firing times of rays (n,): (n,)."""
        from . import surface_loops  # not before: numba takes half a second to import

        out = np.empty(len(ray))
        tables = (owned(self.firing_starts), owned(self.delays))
        surface_loops.times(owned(ray, np.int64), self.start, self.subrays, *tables, out)
        return out


@dataclass(frozen=True, eq=False)
class Firings:
    """Consecutive firings of a sensor at a station, maybe several times; rays are numbered so."""

    sensor: Sensor
    numbers: Ints  # (f,): from the start of the station
    spec: ScanSpec  # of the first of them

    @classmethod
    def from_scans(cls, sensor: Sensor, specs: Sequence[ScanSpec], times: int = 1) -> Firings:
        """Return the firings of consecutive scans, so many times in turn."""
        numbers = np.arange(specs[0].firings[0], specs[-1].firings[1], dtype=np.int64)
        return cls(sensor, np.tile(numbers, times), specs[0])

    def times(self, ray: Integers) -> Ints:
        """Return the firing times of rays (n,), nanoseconds since the survey's start: (n,)."""
        clock = Clock(
            self.sensor.begins_ns(self.numbers), self.sensor.beams.time_ns, ActorTrajectories()
        )
        times = clock.times(ray)
        return self.spec.start_ns + np.rint(times, out=times).astype(np.int64)


@dataclass(frozen=True)
class CastPoses:
    """Poses of rays for `RayCaster.scan`: of the sensor's head, or else of its carrier."""

    positions: Floats
    rotations: Floats | None = None
    rays_per_pose: int | None = None
    motion: PoseMotion | None = None
    clock: Clock | None = None
    by_head: bool = False
    carrier: Clock | None = None  # if it moves; for its velocities
    station: int = 0  # of the carrier

    @cached_property
    def caster_arguments(self) -> dict[str, Any]:
        """Arguments of `RayCaster.scan` and `pattern_rays`."""
        if self.rays_per_pose is None:
            return {"positions": self.positions, "rotations": self.rotations}
        # Not checked again, see `check_trajectory`: that would take a fortieth of the casting time.
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
        """Return firing times of rays, nanoseconds since the survey's start; for actors."""
        return np.zeros(len(ray)) if self.clock is None else self.clock.times(ray)

    def part(self, start: int, stop: int, subrays: int) -> CastPoses:
        """Poses of the sub-rays of rays `start` to `stop`; `start` is the first of a pose."""
        each = self.rays_per_pose
        motion = self.motion
        clock, carrier = (
            None if one is None else replace(one, start=start, subrays=subrays)
            for one in (self.clock, self.carrier)
        )
        if each is None:
            return replace(self, clock=clock, carrier=carrier)
        poses = slice(start // each, -(-stop // each))
        if motion is not None:
            late = np.repeat(motion.delays, subrays)
            motion = PoseMotion(late, motion.velocities[poses], motion.rates[poses])
        rotations = None if self.rotations is None else self.rotations[poses]
        return replace(
            self,
            positions=self.positions[poses],
            rotations=rotations,
            rays_per_pose=each * subrays,
            motion=motion,
            clock=clock,
            carrier=carrier,
        )

    def drift(self, ray: Integers, origins: Floats) -> Floats:
        """Velocities of the carrier at starts of rays (n, 3), m/s: (n, 3).

        A beam starts from a fixed point of the carrier: what a head that turns adds is left out,
        because a sensor knows it.
        """
        if self.carrier is None:
            return np.zeros((len(ray), 3))
        (path,), times = self.carrier.trajectories, self.carrier.times(ray)
        velocity, rate = velocities(path, self.station, times)
        places, _ = path.poses(self.station, times)
        return velocity + np.cross(rate, origins - places)

    def rays(self, pattern: Pattern, ray: Integers, start: int = 0) -> tuple[Floats, Floats]:
        """Origins and directions of rays of a pattern, see `pattern_rays`."""
        return pattern_rays(pattern, ray, start=start, **self.caster_arguments)


def along_rings(beam: Ints, channels: int) -> Indices:
    """Order beams so that some neighbours along a ring follow each other, in narrow groups."""
    ring = beam // (RING * channels) * channels + beam % channels
    return np.argsort(ring.astype(np.uint16), kind="stable")  # which takes a tenth of the time


def check_trajectory(path: Trajectory) -> None:
    """Check the first poses of a trajectory, which may be a user's, before it is used.

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
    """Poses of a sensor's beams in firings `first` to `stop`.

    If a head turns all beams, they are poses of the head, and the rays of one firing serve for
    all. Else they are poses of the carrier.

    Later beams of a firing start from the carrier's position at their time: it moves evenly from
    each firing to the next. A pose for each beam would cost as much as casting it.

    There is no motion if the carrier stands, or if all beams of a firing are fired at once. The
    carrier is where it is `late_ns` nanoseconds after the firings' own times.
    """
    sensor = carried.sensor
    firings = np.arange(first, stop + 1, dtype=np.int64)
    times = np.minimum(sensor.begins_ns(firings) + sensor.lead_ns + late_ns, path.duration_ns)
    positions, turns = path.poses(station, times)
    positions = raybeam.poses.by_number(positions)
    turns = np.broadcast_to(np.eye(3), (len(times), 3, 3)) if turns is None else turns
    turns = raybeam.poses.by_number(turns)
    spins = sensor.spins(firings[:-1])
    rotations = turns[:-1]
    if spins is not None:
        mount = carried.mount
        if any(mount.position):
            seat = np.broadcast_to(mount.position, positions.shape)
            positions = positions + into_axes(seat, turns.transpose(0, 2, 1))
        if mount.rotation is not None:
            rotations = matmul(rotations, mount.rotation)
        if sensor.axes is not None:
            rotations = matmul(rotations, sensor.axes)
        rotations = spun(rotations, spins)
    places = positions[:-1]
    if spins is not None and sensor.centre is not None and sensor.centre.any():
        centre = np.broadcast_to(sensor.centre, places.shape)
        places = places + into_axes(centre, rotations.transpose(0, 2, 1))
    delays = (sensor.beams.time_ns - sensor.lead_ns) / 1e9
    if not path.moves or not delays.any():
        return CastPoses(places, rotations, sensor.channels, by_head=spins is not None)
    seconds = np.diff(times)[:, None] / 1e9
    seconds[seconds == 0] = np.inf  # a last firing at the very end: it stands
    velocities = np.diff(positions, axis=0) / seconds
    rates = _turned_by(turns[:-1], turns[1:]) / seconds
    motion = PoseMotion(delays, velocities, rates)
    return CastPoses(places, rotations, sensor.channels, motion, by_head=spins is not None)


def spun(rotations: Floats, spins: Floats) -> Floats:
    """Products of matrices (k, 3, 3) and turns about z, their cosines and sines (2, k)."""
    (cos, sin), out = spins, np.empty((3, 3, spins.shape[1])).transpose(2, 0, 1)
    for row in range(3):
        x = rotations[:, row, 0]
        y = rotations[:, row, 1]
        out[:, row, 0] = x * cos + y * sin
        out[:, row, 1] = y * cos - x * sin
    out[:, :, 2] = rotations[:, :, 2]
    return out


def _turned_by(before: Floats, after: Floats) -> Floats:
    """Rotation vectors (k, 3), radians, between matrices (k, 3, 3) that differ by little.

    Half the sum of the cross products of the axes before and after: the sine of the angle.
    """
    out = np.empty((3, len(before))).T
    for axis in range(3):
        one = (axis + 1) % 3
        other = (axis + 2) % 3
        cross = before[:, one] * after[:, other] - before[:, other] * after[:, one]
        out[:, axis] = ((cross[:, 0] + cross[:, 1]) + cross[:, 2]) / 2
    return out
