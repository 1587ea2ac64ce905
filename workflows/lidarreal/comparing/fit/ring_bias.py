"""Estimate the range bias of each ring, using large planes that several rings cross."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidarfiles.open3d_access.open3d_module import load_open3d
from lidarsim.numerics.arrays import Bools, Floats, Indices, Ints
from lidarsim.numerics.even_samples import even_indices

from .estimates import Estimate, sandwich
from .smooth_surfaces import SmoothRays

_MAX_PLANES = 8
_PLANE_TOLERANCE_M = 0.05
_MIN_PLANE_RAYS = 300
_MAX_PLANE_POINTS = 20_000
_MIN_RING_RAYS = 20  # minimum number of rays of a ring on a plane
# Maximum median distance of points from their plane, relative to the tolerance.
_MAX_MEDIAN_OFFSET = 0.4
_MAX_DIRECTION_GAP = 0.1  # distance of neighboring directions of one piece of a plane
_OUTLIER_SIGMAS = 4.0  # points beyond this limit do not belong to their plane
_STRICT_SIGMAS = 2.0  # stricter limit; the change in the solution is used as an error of the planes


class _PlaneRays(NamedTuple):
    """Rays that hit large planes. Each of these planes is crossed by several rings.

    Both arrays have shape (n,).
    """

    rays: Indices  # indices into the rays
    plane: Ints  # numbers of the planes


def ring_bias(rays: SmoothRays, directions: Floats, error_m: Floats) -> dict[int, Estimate]:
    """Estimate how much the range bias of each row differs from the mean of all rows, in meters.

    Planes u · x = 1 and offsets b of the rows are fitted simultaneously to the ranges r of rays
    with directions d. The equation is 1 / r = u · d − b / r², multiplied by r². `error_m` is the
    standard deviation of each range in meters. A row that crosses only one plane gets no offset.
    Real surfaces are not perfectly plane, so the intervals include noise, and also the changes in
    the offsets if points far from their planes, or single planes, are left out (jackknife; Efron,
    1982).
    """
    if not len(rays.row):
        return {}
    chosen = _plane_rays(rays, directions)
    row_numbers, row_index = np.unique(rays.row[chosen.rays], return_inverse=True)
    if len(row_numbers) < 3:
        return {}
    _, plane = np.unique(chosen.plane, return_inverse=True)
    plane_count = plane.max() + 1
    error_m = error_m[chosen.rays]
    distance = rays.distance[chosen.rays]
    normals = np.eye(plane_count)[plane][:, :, None] * directions[chosen.rays][:, None]
    normals = normals.reshape(len(distance), -1) * distance[:, None] ** 2
    design = np.hstack([normals, -np.eye(len(row_numbers))[row_index]]) / error_m[:, None]
    offsets, variances = _solve_offsets(design, distance / error_m, plane)
    estimates = zip(row_numbers.tolist(), offsets, variances, strict=True)
    return {row: Estimate.from_variance(offset, variance) for row, offset, variance in estimates}


def _plane_rays(rays: SmoothRays, directions: Floats) -> _PlaneRays:
    """Select the rays of rings that cross at least two large planes.

    `directions` contains the unit directions of all `rays`. At most `_MAX_PLANE_POINTS` rays are
    considered, which are sampled evenly.
    """
    indices = even_indices(len(rays.row), _MAX_PLANE_POINTS)
    plane = _segment_planes(rays.distance[indices, None] * directions[indices])
    count = np.zeros((rays.row.max() + 1, plane.max() + 2), np.int64)
    np.add.at(count, (rays.row[indices], plane), 1)  # the last column is for points in no plane
    crosses_planes = (count[:, :-1] >= _MIN_RING_RAYS).sum(axis=1) > 1
    chosen = (plane >= 0) & crosses_planes[rays.row[indices]]
    return _PlaneRays(indices[chosen], plane[chosen])


def _solve_offsets(design: Floats, values: Floats, plane: Ints) -> tuple[Floats, Floats]:
    """Solve for the range offset of each row and its variance, with a mean offset of 0.

    The unknowns of `design`, with shape (n, 3 p + r), are the vectors u of p planes, followed by
    the offsets of r rows (see `ring_bias`). `plane` contains the plane of each equation, and
    `values` its right-hand side.
    """
    plane_count = plane.max() + 1
    first = 3 * plane_count
    row_count = design.shape[1] - first
    # A common offset of all rows cannot be distinguished from shifted planes, so the mean is 0.
    centered = np.eye(row_count) - 1 / row_count
    solution, inliers = _solve_without_outliers(design, values, _OUTLIER_SIGMAS)
    offsets = centered @ solution[first:]
    strict_solution, _ = _solve_without_outliers(design, values, _STRICT_SIGMAS)
    used = design[inliers]
    covariance = sandwich(used, values[inliers] - used @ solution)[first:, first:]
    shift = centered @ strict_solution[first:] - offsets
    replicates = [
        centered @ np.linalg.lstsq(design[chosen], values[chosen], rcond=None)[0][first:]
        for chosen in (inliers & (plane != number) for number in range(plane_count))
    ]
    variances = np.diag(centered @ covariance @ centered) + shift**2
    variances += (plane_count - 1) * np.var(replicates, axis=0)
    return offsets, variances


def _solve_without_outliers(
    design: Floats, values: Floats, max_sigmas: float
) -> tuple[Floats, Bools]:
    """Solve a least-squares problem, ignoring residuals beyond `max_sigmas` standard deviations.

    Returns the solution, and a mask of the equations that were used.
    """
    residuals = np.zeros(len(values))
    for _ in range(4):
        sizes = np.abs(residuals)
        inliers = sizes <= max_sigmas * 1.4826 * np.median(sizes)
        solution = np.linalg.lstsq(design[inliers], values[inliers], rcond=None)[0]
        residuals = values - design @ solution
    return solution, inliers


def _segment_planes(points: Floats) -> Ints:
    """Assign each point to a large plane, or -1 if it is on none."""
    o3d = load_open3d()
    o3d.utility.random.seed(0)
    plane = np.full(len(points), -1)
    remaining = np.arange(len(points))
    for _ in range(_MAX_PLANES):
        if len(remaining) < _MIN_PLANE_RAYS:
            break
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points[remaining]))
        (*normal, constant), _ = cloud.segment_plane(_PLANE_TOLERANCE_M, 3, 400)
        # Distance from the plane through all inliers.
        offset = np.abs(points[remaining] @ normal + constant)
        inliers = np.flatnonzero(offset < _PLANE_TOLERANCE_M)
        inlier_points = points[remaining[inliers]]
        directions = inlier_points / np.linalg.norm(inlier_points, axis=1)[:, None]
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(directions))
        # Aligned walls do not form an exact plane, so only the largest connected piece is used.
        piece = np.asarray(cloud.cluster_dbscan(_MAX_DIRECTION_GAP, 3))
        inliers = inliers[piece == np.bincount(piece + 1)[1:].argmax()]
        # Points that fill the slab evenly are a cross section of other surfaces.
        is_large = len(inliers) >= _MIN_PLANE_RAYS
        if is_large and np.median(offset[inliers]) < _MAX_MEDIAN_OFFSET * _PLANE_TOLERANCE_M:
            plane[remaining[inliers]] = plane.max() + 1
        remaining = np.delete(remaining, inliers)
    return plane
