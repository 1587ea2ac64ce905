"""Find smooth surfaces in range images, and the rays that hit these surfaces in all sweeps."""

from __future__ import annotations

import warnings
from typing import NamedTuple

import numpy as np

from lidarsim.numerics.arrays import Bools, Floats, Indices, Ints

from .stack import MAX_KINK_M, SweepStack, finite_median

MIN_RANGE_M = 0.1  # closer points lie on the sensor's cover
_MAX_BEAM_ORIGIN_M = 0.1  # maximum distance of the beams' intersection from the sensor's origin
# Tangents of the angle of incidence. Beyond the first, a beam hits several surfaces. Beyond the
# second, direction noise increases mean ranges.
MAX_TANGENT = 5.7
FLAT_TANGENT = 1.7
MAX_KINK_PER_M = 0.001  # added to `MAX_KINK_M` for each meter of range
SCENE_TOLERANCE_M = 0.3  # maximum distance of recorded surfaces from those of the scene
# Direction noise that is assumed for outlier detection until it has been estimated.
ASSUMED_DIRECTION_NOISE_RAD = 0.002
MAX_SIGMAS = 6.0  # returns beyond this limit belong to moving objects
MIN_RETURN_SHARE = 0.8  # minimum fraction of a ray's returns that belong to the same surface


class SmoothSurfaces(NamedTuple):
    """Smooth surface in each cell of a range image.

    Arrays have shape (r, c).
    """

    azimuth_slope: Floats  # derivative of the range with respect to the azimuth, meters per radian
    slope: Floats  # gradient of the range with respect to the direction, meters per radian
    smooth: Bools  # whether the neighbors lie in one plane with the cell
    scaled_normal: Floats  # (r, c, 3): normal n of the plane, as n / (n · d) for the direction d


class CellNeighbors(NamedTuple):
    """Points in the cells next to each cell of a range image, in meters.

    Each array has shape (r, c, 3).
    """

    next_1: Floats
    previous_1: Floats
    next_2: Floats  # two columns away
    previous_2: Floats
    above: Floats
    below: Floats

    @classmethod
    def from_points(cls, points: Floats) -> CellNeighbors:
        """Find the neighbors of each cell's point.

        Columns wrap around, because they cover a full revolution.
        """
        row_numbers = np.arange(len(points))
        columns = (np.roll(points, shift, axis=1) for shift in (-1, 1, -2, 2))
        rings = (points[np.clip(row_numbers + shift, 0, row_numbers[-1])] for shift in (-1, 1))
        return cls(*columns, *rings)

    def normals(self) -> Floats:
        """Return surface normals of arbitrary length."""
        rise = self.above - self.below if len(self.above) > 2 else np.array([0, 0, 1.0])
        run = 2 * (self.next_2 - self.previous_2) + self.next_1 - self.previous_1
        return np.cross(run, rise)

    def are_coplanar(self, points: Floats, normal: Floats, tolerance_m: Floats) -> Bools:
        """Mark points whose neighbors lie in the tangent plane of the point.

        The tolerance applies to neighbors in adjacent columns. It is doubled for other neighbors.
        """
        means_1 = (self.next_1 + self.previous_1) / 2
        means_2 = (self.next_2 + self.previous_2) / 2
        coplanar = np.ones(points.shape[:2], bool)
        pairs = ((means_1, 1), (means_2, 2), (self.above, 2), (self.below, 2))
        for neighbors, tolerance_factor in pairs:
            offset = np.abs(((neighbors - points) * normal).sum(axis=-1))
            coplanar &= offset < tolerance_factor * tolerance_m
        return coplanar


def find_surfaces(stack: SweepStack, distance: Floats, error_m: Floats) -> SmoothSurfaces:
    """Compute the slopes of surfaces in a range image, and find their edges.

    `error_m` is the error of each range in meters.
    """
    points = distance[..., None] * stack.directions
    with np.errstate(invalid="ignore", divide="ignore"):
        beams = points - _beam_origins(points)
        length = np.linalg.norm(beams, axis=-1, keepdims=True)
        directions = beams / length
        neighbors = CellNeighbors.from_points(points)
        normal = neighbors.normals()
        # The range of a plane n · x = c in the direction d is c / (n · d).
        normal /= (normal * directions).sum(axis=-1, keepdims=True)
        gradient = length * (directions - normal)
        slope = np.linalg.norm(gradient, axis=-1)
        tolerance_m = MAX_KINK_M + MAX_KINK_PER_M * distance + 5 * error_m
        smooth = (slope < MAX_TANGENT * distance) & (distance > MIN_RANGE_M)
        smooth &= neighbors.are_coplanar(points, normal, tolerance_m)
    azimuth_slope = gradient[..., 1] * directions[..., 0] - gradient[..., 0] * directions[..., 1]
    return SmoothSurfaces(azimuth_slope, slope, smooth, normal)


def _beam_origins(points: Floats) -> Floats:
    """Return the origin of the beams in each row, in meters.

    The array has shape (r, 1, 3). The beams in a row intersect on the z axis, near the sensor's
    origin. Their height increases linearly with the distance from the axis, and the height at
    distance 0 is the origin.
    """
    with warnings.catch_warnings(action="ignore"):
        distance = np.hypot(points[..., 0], points[..., 1])
        height = points[..., 2]
        mean_distance = np.nanmean(distance, axis=1)
        offset = distance - np.nanmean(distance, axis=1, keepdims=True)
        tangent = np.nansum(offset * height, axis=1) / np.nansum(offset**2, axis=1)
        origin = np.nanmean(height, axis=1) - tangent * mean_distance
    plausible = np.abs(origin) < _MAX_BEAM_ORIGIN_M  # False for NaN
    return np.where(plausible, origin, 0)[:, None, None] * np.array([0, 0, 1.0])


class SmoothRays(NamedTuple):
    """Rays that hit smooth surfaces.

    All arrays have shape (k,).
    """

    row: Ints
    column: Ints
    distance: Floats  # mean of the ranges, meters
    slope: Floats  # meters per radian, see `SmoothSurfaces.slope`
    intensity: Floats  # mean; NaN if unknown
    return_counts: Ints  # number of sweeps with a return
    trials: Ints  # number of sweeps that cover the ray, see `SweepStack`
    variance: Floats  # variance of the range over all sweeps, in square meters
    freedom: Ints  # degrees of freedom of the variance, which is the number of returns minus 1

    def select(self, chosen: Bools | Indices) -> SmoothRays:
        """Select rays with a mask or with indices."""
        return SmoothRays._make(values[chosen] for values in self)


class _RayStatistics(NamedTuple):
    """Statistics of each ray's returns without outliers.

    All arrays have shape (k,).
    """

    mean_range: Floats  # meters
    mean_intensity: Floats
    variance: Floats  # variance of the range, square meters
    return_count: Ints


def select_smooth_rays(
    stack: SweepStack, sigma: Floats, direction_noise_rad: float, expected: Floats | None = None
) -> SmoothRays:
    """Select rays that are not close to edges, and compute the statistics of their returns.

    A return is an outlier if its range differs from the median of the ray by more than `MAX_SIGMAS`
    standard deviations. The standard deviation combines the range noise `sigma` in meters and the
    direction noise. Outliers, and rays with many outliers, are excluded. If the scene's ranges
    `expected` are known, slopes are derived from them.
    """
    median = finite_median(stack.ranges, 0)
    return_count = np.isfinite(stack.ranges).sum(axis=0)
    error_m = stack.rough_sigma / np.sqrt(np.maximum(return_count, 1))
    surfaces = find_surfaces(stack, median, error_m)
    slopes = surfaces.slope
    smooth = surfaces.smooth & stack.steady
    if expected is not None:
        slopes = find_surfaces(stack, expected, 0 * error_m).slope
        smooth &= np.abs(median - expected) < SCENE_TOLERANCE_M
    cell = np.nonzero(among_smooth(smooth))
    slope = slopes[cell]
    return_counts = return_count[cell]
    limit_m = MAX_SIGMAS * np.hypot(sigma[cell], direction_noise_rad * slope)
    limit_m = np.where(return_counts > 1, limit_m, np.inf)
    statistics = _ray_statistics(stack, cell, surfaces.azimuth_slope[cell], median[cell], limit_m)
    rays = SmoothRays(
        row=cell[0],
        column=cell[1],
        distance=statistics.mean_range,
        slope=slope,
        intensity=statistics.mean_intensity,
        return_counts=return_counts,
        trials=stack.trials[cell],
        variance=statistics.variance,
        freedom=statistics.return_count - 1,
    )
    count = statistics.return_count
    return rays.select(np.flatnonzero((count > 0) & (count >= MIN_RETURN_SHARE * return_counts)))


def among_smooth(smooth: Bools) -> Bools:
    """Mark smooth cells whose neighbors are smooth.

    Cells that are smooth by chance, such as in foliage, usually have none.
    """
    neighbors = np.sum([np.roll(smooth, shift, axis=1) for shift in (-2, -1, 1, 2)], axis=0)
    return np.asarray(smooth & (neighbors >= 3))


def _ray_statistics(
    stack: SweepStack,
    cell: tuple[Indices, ...],
    azimuth_slope: Floats,
    median: Floats,
    limit_m: Floats,
) -> _RayStatistics:
    """Compute the statistics of the returns within `limit_m` of their ray's median range.

    `cell` contains the row and column indices of the rays. Ranges are corrected for the azimuths of
    their pulses by `azimuth_slope` (see `SmoothSurfaces`). All distances are in meters.
    """
    row, column = cell
    ranges = stack.ranges[:, row, column].astype(np.float64)
    ranges -= azimuth_slope * stack.azimuth_offsets[:, row, column].astype(np.float64)
    intensities = stack.intensities[:, row, column].astype(np.float64)
    inliers = np.abs(ranges - median) <= limit_m
    inlier_count = inliers.sum(axis=0)
    divisor = np.maximum(inlier_count, 1)
    mean_range = np.where(inliers, ranges, 0).sum(axis=0) / divisor
    mean_intensity = np.where(inliers, intensities, 0).sum(axis=0) / divisor
    squares = np.where(inliers, (ranges - mean_range) ** 2, 0).sum(axis=0)
    return _RayStatistics(
        mean_range, mean_intensity, squares / np.maximum(inlier_count - 1, 1), inlier_count
    )
