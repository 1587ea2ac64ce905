"""Boxes of moving objects over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from lidarsim.numerics.arrays import Bools, Floats, Ints

_MAX_BEYOND_S = 0.15  # maximum time before the first and after the last pose
_SPEED_S = 0.05  # time before and after, between which a speed is measured
_MARGIN_M = 0.1  # margin around a box, since boxes are tight or inaccurate
_TICK_S = 0.01  # time step of approximate positions
_BOTTOM_M = 0.05  # Points closer to the underside of a box belong to the ground.


@dataclass(frozen=True, eq=False)
class ObjectTrack:
    """Box of a moving object, and its poses over time.

    The origin of the object frame is the center of the underside of the box, and x points forward.

    Attributes
    ----------
    number
        Number of the object, which is unique in the recording.
    kind
        Type of the object, such as "Car". Empty if it is unknown.
    size
        Length, width and height in meters. Float64 array of shape (3,).
    times_s
        Times of the poses in seconds, in ascending order. Float64 array of shape (k,).
    positions
        Origin of the object frame in the world frame at these times, in meters. Float64 array of
        shape (k, 3).
    yaw
        Angle of the x axis from the x axis of the world, in radians, without jumps. Float64 array
        of shape (k,).
    stands_before, stands_after
        Whether the object is stationary before the first and after the last pose.
    """

    number: int
    kind: str
    size: Floats
    times_s: Floats
    positions: Floats
    yaw: Floats
    stands_before: bool = False
    stands_after: bool = False

    def __len__(self) -> int:
        return len(self.times_s)

    @cached_property
    def _curves(self) -> tuple[Any, Any]:
        from scipy.interpolate import Akima1DInterpolator

        values = np.column_stack([self.positions, self.yaw])
        if len(self) < 3:
            return None, values
        return Akima1DInterpolator(self.times_s, values, method="makima"), values

    def is_present(self, times_s: Floats) -> Bools:
        """Mark the times, of shape (n,), at which the pose of the object is known."""
        first_s = -np.inf if self.stands_before else self.times_s[0] - _MAX_BEYOND_S
        last_s = np.inf if self.stands_after else self.times_s[-1] + _MAX_BEYOND_S
        return np.asarray((times_s >= first_s) & (times_s <= last_s))

    def poses(self, times_s: Floats) -> tuple[Floats, Floats]:
        """Return the positions and yaw angles at given times, of shapes (n, 3) and (n,).

        Before the first and after the last pose, the object is stationary or has a constant
        velocity.
        """
        curve, values = self._curves
        inside_s = np.clip(times_s, *self.times_s[[0, -1]])
        if curve is None:
            found = np.stack([np.interp(inside_s, self.times_s, column) for column in values.T], 1)
        else:
            found = curve(inside_s)
        if len(self) > 1:
            for end, inner, stands in (
                (0, 1, self.stands_before),
                (-1, -2, self.stands_after),
            ):
                if stands:
                    continue
                slope = (values[inner] - values[end]) / (self.times_s[inner] - self.times_s[end])
                beyond_s = times_s - self.times_s[end]
                is_beyond = beyond_s < 0 if end == 0 else beyond_s > 0
                found[is_beyond] += beyond_s[is_beyond, None] * slope
        return found[:, :3], found[:, 3]

    def speed_m_s(self, time_s: float) -> float:
        """Return the horizontal speed at a given time in m/s."""
        positions, _ = self.poses(np.array([time_s - _SPEED_S, time_s + _SPEED_S]))
        return float(np.hypot(*(positions[1] - positions[0])[:2]) / (2 * _SPEED_S))

    def to_object(self, points: Floats, times_s: Floats) -> Floats:
        """Transform points from the world frame to the object frame at their times.

        The points have shape (n, 3), and the times have shape (n,).
        """
        positions, yaw = self.poses(times_s)
        return rotate_z(points - positions, -yaw)

    def contains(self, local: Floats, margin_m: float = _MARGIN_M) -> Bools:
        """Mark the points that lie in the box. The points are in the object frame."""
        half = self.size[:2] / 2 + margin_m
        inside = (np.abs(local[:, :2]) <= half).all(axis=1)
        height = local[:, 2]
        return np.asarray(inside & (height > _BOTTOM_M) & (height <= self.size[2] + margin_m))

    def rows_near(self, points: Floats, times_s: Floats, reach_m: float) -> Ints:
        """Return the rows of the points that may be close to the object at their times.

        Omitted points are farther than `reach_m` from the vertical axis of the object frame, or the
        object is not present. The points have shape (n, 3), and the times have shape (n,).
        """
        rows = np.flatnonzero(self.is_present(times_s))
        if not len(rows):
            return rows
        positions, error_m = self._approximate_positions(times_s[rows])
        offsets = points[rows, :2] - positions
        return rows[np.einsum("ij,ij->i", offsets, offsets) < (reach_m + error_m) ** 2]

    def rows_toward(self, origins: Floats, ends: Floats, times_s: Floats, reach_m: float) -> Ints:
        """Return the rows of the rays that may pass close to the object at their times.

        `origins` and `ends` are positions on the rays, of shape (n, 3). Omitted rays keep a
        distance of `reach_m` from the vertical axis of the object frame, or the object is not
        present.
        """
        rows = np.flatnonzero(self.is_present(times_s))
        if not len(rows):
            return rows
        positions, error_m = self._approximate_positions(times_s[rows])
        toward = positions - origins[rows, :2]
        directions = (ends[rows] - origins[rows])[:, :2]
        length_2 = np.maximum(np.einsum("ij,ij->i", directions, directions), 1e-12)
        along = np.maximum(np.einsum("ij,ij->i", toward, directions), 0.0) / length_2
        apart = toward - along[:, None] * directions
        return rows[np.einsum("ij,ij->i", apart, apart) < (reach_m + error_m) ** 2]

    def _approximate_positions(self, times_s: Floats) -> tuple[Floats, float]:
        """Return horizontal positions at rounded times, and the maximum error in meters.

        Looking up a table is much faster than evaluating the curve at millions of times.
        """
        first_s = float(times_s.min())
        tick = ((times_s - first_s) / _TICK_S).astype(np.int64)
        ticks_s = np.asarray(first_s + _TICK_S * np.arange(int(tick.max()) + 2), np.float64)
        positions = self.poses(ticks_s)[0][:, :2]
        steps_m = np.linalg.norm(np.diff(positions, axis=0), axis=1)
        return positions[tick], 2 * float(steps_m.max())

    def select(self, rows: Bools | slice) -> ObjectTrack:
        """Select poses with a mask or a slice."""
        return replace(
            self, times_s=self.times_s[rows], positions=self.positions[rows], yaw=self.yaw[rows]
        )

    @property
    def distance_m(self) -> float:
        """Greatest horizontal distance between the first pose and another pose, in meters."""
        offsets = self.positions[:, :2] - self.positions[0, :2]
        return float(np.linalg.norm(offsets, axis=1).max())


def rotate_z(vectors: Floats, angles: Floats) -> Floats:
    """Rotate vectors about the z axis, by an angle in radians for each vector."""
    cos, sin = np.cos(angles), np.sin(angles)
    x, y, z = vectors.T
    return np.stack([cos * x - sin * y, sin * x + cos * y, z], axis=1)


def in_any_box(
    tracks: Sequence[ObjectTrack], points: Floats, times_s: Floats, margin_m: float = _MARGIN_M
) -> Bools:
    """Mark points in the world frame that are in the box of an object at their times."""
    inside = np.zeros(len(points), bool)
    for track in tracks:
        reach_m = float(np.hypot(*track.size[:2])) / 2 + 2 * margin_m
        rows = track.rows_near(points, times_s, reach_m)
        if len(rows):
            inside[rows] |= track.contains(track.to_object(points[rows], times_s[rows]), margin_m)
    return inside
