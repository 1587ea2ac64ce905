"""Sensor poses during a sweep, which are used to transform points between frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..motion.rotations import matrices, quaternions_of
from ..motion.trajectory import Pose, Trajectory, mounted_poses
from ..numerics.arrays import Floats, Floats32, Ints
from ..survey.survey import Survey
from .lidar_traits import LidarTraits

# Interval between stored poses. If a sensor accelerates at 10 m/s², the interpolation error is at
# most 5 µm.
KNOT_NS = 2e6
_MAX_KNOTS = 1000  # maximum number of intervals between knots in a sweep
_POSES = 100_000  # poses to compute at a time
STILL = np.zeros((0, 0, 7), np.float32)  # used if no sensor moves during a sweep


@dataclass(frozen=True, eq=False)
class FiringPoses:
    """Poses of a sensor or actor at k times during a sweep, usually the firing times of points."""

    position: Floats  # (3,), world coordinates at the start of the sweep, meters
    rotation: Floats  # (3, 3), from the sensor frame at the start of the sweep to the world frame
    # (3, k), displacement from `position` in the world frame, meters. None if the sensor is static.
    offsets: Floats | None = None
    quaternions: Floats | None = None  # (4, k), x, y, z, w of the rotation since the start
    # (3, k), displacement of the sensor between the two knots that enclose the time, meters.
    steps: Floats | None = None

    @property
    def positions(self) -> Floats:
        """World coordinates in meters.

        The shape is (k, 3), or (3,) if the sensor is static.
        """
        return self.position if self.offsets is None else self.position + self.offsets.T

    def select(self, rows: Any) -> FiringPoses:
        """Return the poses of the selected points."""
        if self.offsets is None:
            return self
        parts = (self.offsets, self.quaternions, self.steps)
        return FiringPoses(
            self.position, self.rotation, *(None if p is None else p[:, rows] for p in parts)
        )

    def to_body_frame(self, points: Floats) -> Floats:
        """Transform points from the world frame to the body frame at the time of each point."""
        return self.rotate_to_body_frame(points - self.positions)

    def to_world(self, points: Floats) -> Floats:
        """Transform points from the body frame at the time of each point to the world frame."""
        in_world: Floats = self.rotate_to_world(points) + self.positions
        return in_world

    def frames(self, count: int) -> tuple[Floats, Floats]:
        """Return the positions and rotation matrices, repeated `count` times for a static body.

        The arrays have shapes (count, 3) and (count, 3, 3).
        """
        positions = np.broadcast_to(self.positions, (count, 3))
        rotations = np.broadcast_to(self.rotation, (count, 3, 3))
        if self.quaternions is not None:
            rotations = rotations @ matrices(self.quaternions.T)
        return positions, rotations

    def move_to_start(self, points: Floats) -> Floats:
        """Move points with the body from the time of each point to the start of the sweep.

        The points are in world coordinates before and after.
        """
        at_start: Floats = self.to_body_frame(points) @ self.rotation.T + self.position
        return at_start

    def rotate_to_start(self, vectors: Floats) -> Floats:
        """Rotate vectors with the body from the time of each vector to the start of the sweep.

        The vectors are in the world frame before and after.
        """
        at_start: Floats = self.rotate_to_body_frame(vectors) @ self.rotation.T
        return at_start

    def rotate_to_body_frame(self, vectors: Floats) -> Floats:
        """Rotate vectors from the world frame to the body frame at the time of each vector."""
        inside: Floats = vectors @ self.rotation
        return inside if self.quaternions is None else _turned(inside, self.quaternions, -1.0)

    def rotate_to_world(self, vectors: Floats) -> Floats:
        """Rotate vectors from the body frame at the time of each vector to the world frame."""
        inside = vectors if self.quaternions is None else _turned(vectors, self.quaternions, 1.0)
        return inside @ self.rotation.T


@dataclass(frozen=True, eq=False)
class FlowFrames:
    """Sensor frames between which scene flow is defined, one pair for each of k points.

    The flow of a point is its position in the later frame minus its position in the current frame.
    """

    current: FiringPoses
    later: FiringPoses  # in the next sweep

    def flow(self, starts: Floats, ends: Floats) -> Floats:
        """Return the flow of points, given their current and later world positions."""
        flow: Floats = self.later.to_body_frame(ends) - self.current.to_body_frame(starts)
        return flow

    def end_points(self, starts: Floats, flow: Floats) -> Floats:
        """Return the later world positions of points, given their current positions and flow."""
        return self.later.to_world(self.current.to_body_frame(starts) + flow)


def _turned(vectors: Floats, quaternions: Floats, sign: float) -> Floats:
    """Rotate vectors by unit quaternions, or by their inverses if `sign` is -1.

    The vectors have shape (k, 3), and the quaternions have shape (4, k). The result is
    v + 2 w (q x v) + 2 q x (q x v), where q is the vector part of the quaternion (Rodrigues 1840).
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


def knot_count(longest_ns: float, knot_ns: float) -> int:
    """Return the number of knots per sweep, given the duration of the longest sweep.

    The interval between knots is at most `knot_ns`, unless the sweep is so long that the number of
    knots is limited.
    """
    return 1 + int(np.clip(np.ceil(longest_ns / knot_ns), 1, _MAX_KNOTS))


def relative_knots(displacements: Floats, rotations: Floats) -> Floats32:
    """Combine displacements and rotations since the start of each sweep into knots.

    Parameters
    ----------
    displacements
        Displacements since the start of the sweep, with shape (n, m, 3).
    rotations
        Rotations from the body frame to the world frame, with shape (n, m, 3, 3).

    Returns
    -------
    ndarray
        Knots with shape (n, m, 7), which consist of the displacement and the quaternion x, y, z, w
        of the rotation since the start of the sweep in the body frame.
    """
    shape = displacements.shape[:2]
    since = rotations[:, :1].swapaxes(2, 3) @ rotations
    quaternions = quaternions_of(since.reshape(-1, 3, 3)).reshape(*shape, 4)
    flips = (quaternions[:, 1:] * quaternions[:, :-1]).sum(axis=2) < 0
    quaternions[:, 1:] *= 1 - 2 * (np.cumsum(flips, axis=1)[..., None] % 2)
    return np.concatenate([displacements, quaternions], axis=2).astype(np.float32)


def compute_knots(survey: Survey, lidars: Sequence[LidarTraits], rotations: Floats) -> Floats32:
    """Compute the sensor poses at evenly spaced times during each sweep.

    The last knot is at the time of the last beam in the sweep. If a frozen sensor repeats a sweep,
    the knots are those of the earlier sweep, relative to the current pose of the sensor.

    Parameters
    ----------
    survey, lidars
        Survey and the traits of its sensors.
    rotations
        Rotations from the sensor frame to the world frame at the start of each sweep, with shape
        (n, 3, 3).

    Returns
    -------
    ndarray
        Knots with shape (n, m, 7). Each knot consists of the displacement since the start of the
        sweep, in meters in the world frame, and the quaternion x, y, z, w of the rotation since the
        start in the sensor frame. If no sensor moves, the result is `STILL`.
    """
    path = survey.reported_path
    if not path.moves:
        return STILL
    spans = [
        stop - start + lidar.firing_ns
        for (_, start, stop), lidar in zip(survey.sweeps_each, lidars, strict=True)
    ]
    count = knot_count(max(float(span.max(initial=0.0)) for span in spans), KNOT_NS)
    knots = np.empty((len(rotations), count, 7), np.float32)
    first = 0
    for number, span in enumerate(spans):
        stations, begins_ns = _cast_at(survey, number)
        for station in range(path.stations):
            rows = np.flatnonzero(stations == station)
            for part in np.array_split(rows, -(-len(rows) * count // _POSES) or 1):
                times_ns = begins_ns[part, None] + np.linspace(0, 1, count) * span[part, None]
                mount = survey.reported_mounts[number]
                knots[first + part] = _relative_poses(
                    path, station, times_ns, mount, rotations[first + part]
                )
        first += len(span)
    return knots


def _cast_at(survey: Survey, number: int) -> tuple[Ints, Floats]:
    """Return the stations and start times at which the sweeps of a sensor were measured.

    A frozen sensor sends a sweep that was measured earlier.

    Returns
    -------
    stations
        Station indices with shape (n,).
    begins_ns
        Start times in nanoseconds since the start of the station, with shape (n,).
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
    """Compute the knots of k sweeps for `compute_knots`.

    `times_ns` has shape (k, m). `sent_rotations` are the rotations from the sensor frame to the
    world frame at the start of each sweep that is sent, with shape (k, 3, 3). If the sensor is
    frozen, the sweep was measured earlier with a different rotation.
    """
    flat = np.minimum(times_ns.ravel(), path.duration_ns)
    positions, rotations = mounted_poses(path, station, mount, flat)
    positions = positions.reshape(*times_ns.shape, 3)
    rotations = rotations.reshape(*times_ns.shape, 3, 3)
    starts = rotations[:, :1]
    # The displacements are first converted to the sensor frame at the start of the measured sweep,
    # and then from the sensor frame at the start of the sent sweep to the world frame.
    displacement = (positions - positions[:, :1]) @ starts[:, 0]
    return relative_knots(displacement @ sent_rotations.transpose(0, 2, 1), rotations)


def interpolate_poses(
    knots: Floats32, position: Floats, rotation: Floats, shares: Floats
) -> FiringPoses:
    """Interpolate poses within a sweep.

    Parameters
    ----------
    knots
        Knots of the sweep, with shape (m, 7); see `compute_knots`.
    position, rotation
        Sensor pose at the start of the sweep, with shapes (3,) and (3, 3).
    shares
        Elapsed fractions of the sweep from 0 to 1, with shape (k,). For values slightly greater
        than 1, the poses are extrapolated.
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
    # Normalized linear interpolation is accurate enough for rotations that are 2 ms apart.
    interpolated[3:] /= np.sqrt((interpolated[3:] ** 2).sum(axis=0))
    return FiringPoses(position, rotation, interpolated[:3], interpolated[3:], steps[:3])
