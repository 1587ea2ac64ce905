"""Poses of sensors while they sweep, so that points can be moved between frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..motion.rotations import matrices, quaternions_of
from ..motion.trajectory import Pose, Trajectory, full_poses
from ..numerics.arrays import Floats, Floats32, Ints
from ..survey.survey import Survey
from .lidar_traits import LidarTraits

KNOT_NS = 2e6  # between stored poses: at 10 m/s², 5 µm from a straight line
_MAX_KNOTS = 1000  # limit for a sweep
_POSES = 100_000  # poses that are computed at a time
STILL = np.zeros((0, 0, 7), np.float32)  # knots of sensors that are static while they sweep


@dataclass(frozen=True, eq=False)
class FiringPoses:
    """Poses of a sensor or actor at the firings of points (k,) of a sweep, or at other times."""

    position: Floats  # (3,): at the start of the sweep, meters, world coordinates
    rotation: Floats  # (3, 3): from the sensor frame at the start to the world frame
    # (3, k): meters from `position`, in the world frame; None if the sensor is static.
    offsets: Floats | None = None
    quaternions: Floats | None = None  # (4, k): x, y, z, w of the rotations since the start
    # (3, k): motion of the sensor between the knots around the firing, meters.
    steps: Floats | None = None

    @property
    def positions(self) -> Floats:
        """Positions (k, 3), or (3,) of a static sensor, meters, world coordinates."""
        return self.position if self.offsets is None else self.position + self.offsets.T

    def select(self, rows: Any) -> FiringPoses:
        """Return the poses of selected points."""
        if self.offsets is None:
            return self
        parts = (self.offsets, self.quaternions, self.steps)
        return FiringPoses(
            self.position, self.rotation, *(None if p is None else p[:, rows] for p in parts)
        )

    def inward(self, points: Floats) -> Floats:
        """Convert points (k, 3) from the world to the sensor frame at the firing of each point."""
        return self.turned_inward(points - self.positions)

    def outward(self, points: Floats) -> Floats:
        """Convert points (k, 3) from the sensor frame at their firings to the world."""
        in_world: Floats = self.turned_outward(points) + self.positions
        return in_world

    def frames(self, count: int) -> tuple[Floats, Floats]:
        """Return positions (count, 3) and rotations (count, 3, 3), also of a static body."""
        positions = np.broadcast_to(self.positions, (count, 3))
        rotations = np.broadcast_to(self.rotation, (count, 3, 3))
        if self.quaternions is not None:
            rotations = rotations @ matrices(self.quaternions.T)
        return positions, rotations

    def to_start(self, points: Floats) -> Floats:
        """Move points (k, 3), in the world, with the body from their firings to the start."""
        at_start: Floats = self.inward(points) @ self.rotation.T + self.position
        return at_start

    def turned_to_start(self, vectors: Floats) -> Floats:
        """Rotate vectors (k, 3), in the world, with the body from their firings to the start."""
        at_start: Floats = self.turned_inward(vectors) @ self.rotation.T
        return at_start

    def turned_inward(self, vectors: Floats) -> Floats:
        """Rotate vectors (k, 3) from the world frame to the sensor frame at their firings."""
        inside: Floats = vectors @ self.rotation
        return inside if self.quaternions is None else _turned(inside, self.quaternions, -1.0)

    def turned_outward(self, vectors: Floats) -> Floats:
        """Rotate vectors (k, 3) from the sensor frame at their firings to the world frame."""
        inside = vectors if self.quaternions is None else _turned(vectors, self.quaternions, 1.0)
        return inside @ self.rotation.T


def _turned(vectors: Floats, quaternions: Floats, sign: float) -> Floats:
    """Rotate vectors (k, 3) by unit quaternions (4, k), or with sign -1 by their inverses: (k, 3).

    v + 2 w (q x v) + 2 q x (q x v), q the vector of the quaternion (Rodrigues, 1840).
    """
    a, b, c = sign * quaternions[:3]
    w = quaternions[3]
    x, y, z = vectors.T
    p = 2 * (b * z - c * y)
    q = 2 * (c * x - a * z)
    r = 2 * (a * y - b * x)
    rows = [
        x + w * p + (b * r - c * q),
        y + w * q + (c * p - a * r),
        z + w * r + (a * q - b * p),
    ]
    return np.stack(rows, axis=1)


def knots_in(longest_ns: float, knot_ns: float) -> int:
    """Return the number of knots of sweeps: one every `knot_ns` of the longest, within limits."""
    return 1 + int(np.clip(np.ceil(longest_ns / knot_ns), 1, _MAX_KNOTS))


def relative_knots(displacements: Floats, rotations: Floats) -> Floats32:
    """Return knots (n, m, 7): positions since the start of each sweep, and rotations.

    `displacements` (n, m, 3) are stored as they are; of the rotations (n, m, 3, 3) from the body's
    frame to the world, the quaternions x, y, z, w since the first, in the body's frame.
    """
    shape = displacements.shape[:2]
    since = rotations[:, :1].swapaxes(2, 3) @ rotations
    quaternions = quaternions_of(since.reshape(-1, 3, 3)).reshape(*shape, 4)
    flips = (quaternions[:, 1:] * quaternions[:, :-1]).sum(axis=2) < 0
    quaternions[:, 1:] *= 1 - 2 * (np.cumsum(flips, axis=1)[..., None] % 2)
    return np.concatenate([displacements, quaternions], axis=2).astype(np.float32)


def knots_of(survey: Survey, lidars: Sequence[LidarTraits], rotations: Floats) -> Floats32:
    """Return the poses of each sweep's sensor at times that divide the sweep evenly.

    The last knot is at the time of the last beam of the sweep. A sweep that a frozen sensor repeats
    has the poses of the older sweep, moved with the sensor like its points.

    Parameters
    ----------
    rotations
        (n, 3, 3): rotations from the sensor frame to the world frame at the start of each sweep.

    Returns
    -------
    (n, m, 7): position relative to the start of the sweep, meters, in the world frame; and
    quaternion x, y, z, w of the rotation since the start, in the sensor frame. `STILL` if no
    sensor moves while it sweeps.
    """
    path = survey.path
    if not path.moves:
        return STILL
    spans = [
        stop - start + lidar.firing_ns
        for (_, start, stop), lidar in zip(survey.sweeps_each, lidars, strict=True)
    ]
    count = knots_in(max(float(span.max(initial=0.0)) for span in spans), KNOT_NS)
    knots = np.empty((len(rotations), count, 7), np.float32)
    first = 0
    for number, span in enumerate(spans):
        stations, begins_ns = _cast_at(survey, number)
        for station in range(path.stations):
            rows = np.flatnonzero(stations == station)
            for part in np.array_split(rows, -(-len(rows) * count // _POSES) or 1):
                times_ns = begins_ns[part, None] + np.linspace(0, 1, count) * span[part, None]
                mount = survey.carried[number].mount
                knots[first + part] = _relative_poses(
                    path, station, times_ns, mount, rotations[first + part]
                )
        first += len(span)
    return knots


def _cast_at(survey: Survey, number: int) -> tuple[Ints, Floats]:
    """Return the stations and times at which the sweeps of a sensor were cast.

    A frozen sensor sends a sweep that was cast earlier.

    Returns
    -------
    stations
        (n,): stations.
    begins_ns
        (n,): starts of the sweeps, nanoseconds since the starts of their stations.
    """
    firsts, starts, _ = survey.sweeps_each[number]
    per_station = len(firsts) // survey.path.stations
    stations = np.arange(len(firsts)) // per_station
    begins_ns = starts - stations * survey.station_ns
    if survey.sensor_faults(number, "frozen"):
        for sweep, scan in enumerate(firsts.tolist()):
            spec = survey.sent_scan(scan)
            if spec.repeats is not None:
                stations[sweep] = spec.station
                begins_ns[sweep] = survey.begins_ns(spec.repeats[0]) - spec.start_ns
    return stations, begins_ns


def _relative_poses(
    path: Trajectory, station: int, times_ns: Floats, mount: Pose, sent_rotations: Floats
) -> Floats32:
    """Return the knots (k, m, 7) of sweeps at times (k, m), for `knots_of`.

    `sent_rotations` (k, 3, 3) are from the sensor frame at the starts of the sent sweeps to the
    world frame; they differ from the cast sweeps if the sensor is frozen.
    """
    flat = np.minimum(times_ns.ravel(), path.duration_ns)
    positions, rotations = full_poses(path, station, flat)
    shape = times_ns.shape
    positions = (positions + rotations @ np.array(mount.position)).reshape(*shape, 3)
    rotations = (rotations @ mount.rotation_matrix).reshape(*shape, 3, 3)
    starts = rotations[:, :1]
    # In the sensor frame at the start of the cast sweep, then of the sent sweep.
    displacement = (positions - positions[:, :1]) @ starts[:, 0]
    return relative_knots(displacement @ sent_rotations.transpose(0, 2, 1), rotations)


def poses_at(knots: Floats32, position: Floats, rotation: Floats, shares: Floats) -> FiringPoses:
    """Interpolate poses within a sweep.

    Parameters
    ----------
    knots
        (m, 7): knots of the sweep (`knots_of`).
    position, rotation
        (3,) and (3, 3): pose of the sensor at the start of the sweep.
    shares
        (k,): elapsed parts of the sweep, 0 to 1; just after the sweep, poses are extrapolated.
    """
    intervals = len(knots) - 1
    if intervals < 1:
        return FiringPoses(position, rotation)
    knot_position = shares * intervals
    knot = np.minimum(knot_position.astype(np.intp), intervals - 1)
    fraction = knot_position - knot
    starts = np.ascontiguousarray(knots[:-1].T, np.float64)
    steps = np.diff(np.asarray(knots.T, np.float64), axis=1).take(knot, axis=1)
    interpolated = starts.take(knot, axis=1) + steps * fraction
    # Between rotations 2 ms apart, a straight line is as good as an arc.
    interpolated[3:] /= np.sqrt((interpolated[3:] ** 2).sum(axis=0))
    return FiringPoses(position, rotation, interpolated[:3], interpolated[3:], steps[:3])
