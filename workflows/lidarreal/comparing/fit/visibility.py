"""Evidence of sensor motion, based on whether the points of one sweep are visible in another.

In a street, a sensor that moves parallel to the walls measures nearly the same ranges in each
sweep. Only parked cars and posts appear to move. Cars that drive past a stationary sensor look
similar. Therefore, a motion is judged by all objects that both sweeps see. These are objects that
the motion aligns, objects that are aligned without the motion, and objects that neither explains.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from lidarsim.numerics.arrays import Bools, Floats, Ints
from lidarsim.numerics.even_samples import even_indices

from .stack import SweepStack

# Range tolerance: its minimum, per standard deviation of the noise, and per meter of range.
_TOLERANCE_M = 0.05
_TOLERANCE_SIGMAS = 6.0
_TOLERANCE_PER_M = 0.01
# Number of rows and columns on either side of a direction in which an object would have returned.
_EMPTY_ROWS = 1
_EMPTY_COLUMNS = 3
_MAX_RANGE_SHARE = 0.7  # fraction of the largest ranges up to which an object would have returned
_MAX_POINTS = 20_000  # maximum number of points of a sweep to classify by the other sweep
_MAX_DISTANCE_M = 60.0  # farther objects are too small
_CLUSTER_M = 2.0  # points of one object are closer
_MIN_CLUSTER_POINTS = 3
_LONGEST_VEHICLE_M = 20.0  # longer objects do not move
_OWN_VEHICLE_M = 2.5  # distance from the sensor to its vehicle
_STAYED = 1  # index of the field of `Evidence`
WALL_OBJECTS = 3  # number of objects that a wall counts as

# Classes of a point in another sweep: on a surface, unknown, or in empty space that a ray passed.
_SURFACE = 1
_UNKNOWN = 0
_EMPTY = -1
_KNOWN = (_EMPTY, _SURFACE)


class RigidMotion(NamedTuple):
    """Sensor motion between two sweeps, in the sensor frame of the first sweep.

    Leading axes (…) index several motions.
    """

    shift: Floats  # (…, 3): meters
    yaw_rad: Floats  # (…)

    def to_first(self, points: Floats) -> Floats:
        """Transform points of the second sweep to the sensor frame of the first.

        Points of shape (n, 3) are converted to shape (…, n, 3).
        """
        return np.asarray(
            _rotate_about_z(points, self.yaw_rad[..., None]) + self.shift[..., None, :]
        )

    def to_second(self, points: Floats) -> Floats:
        """Transform points of the first sweep to the sensor frame of the second.

        Points of shape (n, 3) are converted to shape (…, n, 3).
        """
        return _rotate_about_z(points - self.shift[..., None, :], -self.yaw_rad[..., None])


def _rotate_about_z(points: Floats, yaw_rad: Floats) -> Floats:
    x, y, z = np.moveaxis(points, -1, 0)
    c = np.cos(yaw_rad)
    s = np.sin(yaw_rad)
    return np.stack([c * x - s * y, s * x + c * y, np.broadcast_to(z, (c * x).shape)], axis=-1)


@dataclass(frozen=True, eq=False)
class VisibilityImage:
    """Ranges of the closest and farthest surfaces around each direction of a sweep."""

    elevation_rad: Floats  # (r,): elevations of the rows, descending
    step_rad: float  # width of a column
    row_phase: Floats  # (r,): azimuths of pulses minus azimuths of columns, in steps
    points: Floats  # (n, 3): points on objects wider than a column, meters
    # (r - 1, c), meters: smallest and largest range in rows i and i + 1 and in the adjacent
    # columns. The range is inf if rays passed without a return, and -inf if it is unknown.
    lower_m: Floats
    upper_m: Floats
    empty_m: float  # rays without a return hit nothing up to this range
    tolerance_m: float

    @classmethod
    def from_sweep(cls, stack: SweepStack, number: int) -> VisibilityImage:
        """Create the image of one sweep in a stack."""
        ranges = stack.ranges[number].astype(np.float64)
        returned = np.isfinite(ranges)
        columns = ranges.shape[1]
        step_rad = 2 * np.pi / columns
        azimuth = np.arctan2(stack.directions[..., 1], stack.directions[..., 0])
        phase = (azimuth / step_rad - np.arange(columns) + columns / 2) % columns - columns / 2
        nearest = _reduce_row_pairs(
            _reduce_neighbors(np.where(returned, ranges, np.inf), np.minimum), np.minimum
        )
        farthest = _reduce_row_pairs(
            _reduce_neighbors(np.where(returned, ranges, -np.inf), np.maximum), np.maximum
        )
        is_unknown = ~np.isfinite(nearest) & ~_empty_around(returned | ~stack.covered[number])
        noise_m = float(np.quantile(stack.rough_sigma, 0.25))
        tolerance_m = max(_TOLERANCE_M, _TOLERANCE_SIGMAS * noise_m)
        wide = _is_wide(ranges, tolerance_m) & (ranges < _MAX_DISTANCE_M)
        points = (ranges[..., None] * stack.directions)[wide]
        return cls(
            elevation_rad=np.radians(stack.elevation_deg),
            step_rad=step_rad,
            row_phase=np.median(phase, axis=1),
            points=points[even_indices(len(points), _MAX_POINTS)],
            lower_m=np.where(is_unknown, -np.inf, nearest),
            upper_m=np.where(np.isfinite(nearest), farthest, nearest * np.where(is_unknown, -1, 1)),
            empty_m=_MAX_RANGE_SHARE * float(np.quantile(ranges[returned], 0.98)),
            tolerance_m=tolerance_m,
        )

    def classify_points(self, points: Floats) -> Ints:
        """Classify points in the sensor frame as `_SURFACE`, `_UNKNOWN` or `_EMPTY`."""
        x, y, z = np.moveaxis(points, -1, 0)
        across = np.hypot(x, y)
        distance = np.hypot(across, z)
        # Points without a row are outside the field of view.
        row = np.interp(
            -np.arctan2(z, across),
            -self.elevation_rad,
            np.arange(len(self.elevation_rad)),
            left=np.nan,
            right=np.nan,
        )
        in_view = np.isfinite(row)
        upper_row = np.clip(np.nan_to_num(row).astype(np.int64), 0, len(self.lower_m) - 1)
        azimuth_steps = np.arctan2(y, x) / self.step_rad - self.row_phase[upper_row]
        cell = upper_row, np.round(azimuth_steps).astype(np.int64) % self.lower_m.shape[1]
        lower_m = self.lower_m[cell]
        tolerance_m = self.tolerance_m + _TOLERANCE_PER_M * distance
        passed = distance < lower_m - tolerance_m
        passed &= np.isfinite(lower_m) | (distance < self.empty_m)
        surface_m = np.clip(distance, lower_m, self.upper_m[cell])
        met = np.abs(distance - surface_m) <= tolerance_m
        return np.where(in_view & passed, _EMPTY, np.where(in_view & met, _SURFACE, _UNKNOWN))


def _reduce_neighbors(values: Floats, reduce: np.ufunc) -> Floats:
    return np.asarray(
        reduce(reduce(values, np.roll(values, 1, axis=1)), np.roll(values, -1, axis=1))
    )


def _reduce_row_pairs(values: Floats, reduce: np.ufunc) -> Floats:
    """Combine each pair of adjacent rows with a function such as `np.minimum`.

    The result has shape (r - 1, c). A single row is returned unchanged.
    """
    return np.asarray(reduce(values[:-1], values[1:])) if len(values) > 1 else values


def _empty_around(returned: Bools) -> Bools:
    """Mark pairs of rows near which no cell has a return."""
    wide = returned.copy()
    for shift in range(1, _EMPTY_COLUMNS + 1):
        wide |= np.roll(returned, shift, axis=1) | np.roll(returned, -shift, axis=1)
    tall = wide.copy()
    for shift in range(1, _EMPTY_ROWS + 1):
        tall[shift:] |= wide[:-shift]
        tall[:-shift] |= wide[shift:]
    return ~(tall[:-1] | tall[1:]) if len(tall) > 1 else ~tall


def _is_wide(ranges: Floats, tolerance_m: float) -> Bools:
    """Mark cells with a neighbor in the same row that belongs to the same surface."""
    with np.errstate(invalid="ignore"):
        joined = np.abs(np.diff(ranges, axis=1, append=ranges[:, :1])) < (
            tolerance_m + _TOLERANCE_PER_M * ranges
        )
    return np.asarray(joined | np.roll(joined, 1, axis=1))


class Evidence(NamedTuple):
    """Numbers of objects that support a motion, a stationary sensor, or neither.

    Only objects that are visible in both sweeps are counted.
    """

    moved: int  # explained only by the motion
    stayed: int  # explained only by a stationary sensor
    unexplained: int  # explained by neither of them


@dataclass(frozen=True, eq=False)
class VisibilityPair:
    """Two sweeps, and the visibility of each sweep's points in the other sweep.

    The classes apply if the sensor is stationary.
    """

    first: VisibilityImage
    second: VisibilityImage
    seen_first: Ints  # (n,): classes of the first sweep's points in the second sweep
    seen_second: Ints  # (m,): classes of the second sweep's points in the first sweep

    @classmethod
    def from_images(cls, first: VisibilityImage, second: VisibilityImage) -> VisibilityPair:
        """Classify the points of each sweep using the image of the other sweep."""
        return cls(
            first,
            second,
            second.classify_points(first.points),
            first.classify_points(second.points),
        )

    def sample(self, count: int) -> tuple[Floats, Floats]:
        """Sample points of both sweeps in their sensor frames, in meters.

        If the sensor were stationary, the other sweep would see some points in empty space and
        others on surfaces. About `count` points of each kind are sampled evenly from both sweeps
        together.
        """
        seen = np.append(self.seen_first, self.seen_second)
        fractions = {kind: min(1.0, count / max((seen == kind).sum(), 1)) for kind in _KNOWN}
        samples = []
        for points, seen_points in (
            (self.first.points, self.seen_first),
            (self.second.points, self.seen_second),
        ):
            indices_by_kind = [np.flatnonzero(seen_points == kind) for kind in _KNOWN]
            chosen = [
                indices[even_indices(len(indices), round(fractions[kind] * len(indices)))]
                for kind, indices in zip(_KNOWN, indices_by_kind, strict=True)
            ]
            samples.append(points[np.concatenate(chosen)])
        return samples[0], samples[1]

    def score(self, motions: RigidMotion, first: Floats, second: Floats) -> Ints:
        """Score each motion by how well it aligns two sweeps.

        The score is the number of points on surfaces of the other sweep, minus the number in empty
        space.
        """
        seen_first = self.second.classify_points(motions.to_second(first)).sum(axis=-1)
        return np.asarray(
            seen_first + self.first.classify_points(motions.to_first(second)).sum(axis=-1)
        )

    def _seen_in_motion(self, motion: RigidMotion) -> tuple[Ints, Ints]:
        """Classify the points of each sweep using the other sweep, given a sensor motion."""
        in_second = motion.to_second(self.first.points)
        in_first = motion.to_first(self.second.points)
        return self.second.classify_points(in_second), self.first.classify_points(in_first)

    def evidence(self, motion: RigidMotion | None) -> Evidence:
        """Count the objects that support or contradict a motion.

        If `motion` is None, the objects that changed are counted.
        """
        at_rest = np.append(self.seen_first, self.seen_second)
        if motion is None:
            points = np.concatenate([self.first.points, self.second.points])
            nothing = np.zeros(len(points), bool)
            return count_objects(points, [nothing, nothing, at_rest == _EMPTY], _LONGEST_VEHICLE_M)
        in_motion = np.append(*self._seen_in_motion(motion))
        points = np.concatenate([self.first.points, motion.to_first(self.second.points)])
        kinds = [
            (at_rest == _EMPTY) & (in_motion == _SURFACE),
            (at_rest == _SURFACE) & (in_motion == _EMPTY),
            (at_rest == _EMPTY) & (in_motion == _EMPTY),
        ]
        return count_objects(points, kinds, _LONGEST_VEHICLE_M)

    def without_explained(self, motion: RigidMotion) -> VisibilityPair:
        """Return a copy in which changed points are unknown if a motion explains them."""
        seen_first, seen_second = (
            np.where((at_rest == _EMPTY) & (in_motion == _SURFACE), _UNKNOWN, at_rest)
            for at_rest, in_motion in zip(
                (self.seen_first, self.seen_second), self._seen_in_motion(motion), strict=True
            )
        )
        return replace(self, seen_first=seen_first, seen_second=seen_second)


def count_objects(points: Floats, kinds: Sequence[Bools], wide_m: float) -> Evidence:
    """Count the objects in a point cloud, classifying each by the majority of its points.

    `kinds` contains one mask for each field of `Evidence`. An object wider than `wide_m` in the top
    view counts as `WALL_OBJECTS` objects. An object close to the sensor may be the sensor's own
    vehicle, so it is no evidence of a stationary sensor.
    """
    from scipy.ndimage import label

    counted = np.any(kinds, axis=0)
    if not counted.any():
        return Evidence(0, 0, 0)
    positions = points[counted, :2]
    cells = np.floor(positions / _CLUSTER_M).astype(np.int64)
    cells -= cells.min(axis=0)
    occupied = np.zeros(cells.max(axis=0) + 1, bool)
    occupied[cells[:, 0], cells[:, 1]] = True
    labels, count = label(occupied, np.ones((3, 3)))
    cluster = labels[cells[:, 0], cells[:, 1]] - 1
    sizes = np.stack([np.bincount(cluster, kind[counted], count) for kind in kinds])
    kind = sizes.argmax(axis=0)
    lower = np.full((count, 2), np.inf)
    upper = np.full((count, 2), -np.inf)
    distance = np.full(count, np.inf)
    np.minimum.at(lower, cluster, positions)
    np.maximum.at(upper, cluster, positions)
    np.minimum.at(distance, cluster, np.linalg.norm(positions, axis=1))
    is_wide = np.linalg.norm(upper - lower, axis=1) > wide_m
    objects = np.where(is_wide, WALL_OBJECTS, 1)
    objects[sizes.max(axis=0) < _MIN_CLUSTER_POINTS] = 0
    objects[(kind == _STAYED) & (distance < _OWN_VEHICLE_M)] = 0
    return Evidence(*np.bincount(kind, objects, 3).astype(int).tolist())
