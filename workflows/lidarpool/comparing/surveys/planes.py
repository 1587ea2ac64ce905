"""Signed distances from points to planes that are fitted to the nearest points of a cloud."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import Bools, Floats
from lidarsim.numerics.even_samples import even_indices

from ...open3d_access.neighbors import NeighborSearch
from .deviations import Deviations

_BATCH = 100_000  # points per batch, which limits the memory for their neighbors
_NEIGHBORS = 24  # maximum number of points that determine a plane
_MIN_NEIGHBORS = 6
_MIN_WIDTH = 0.2  # minimum width of a neighborhood relative to its length, to exclude lines
_SAMPLES = 2000
_LEVEL = 0.05  # normals with a smaller vertical component are horizontal (3 degrees)


class _Planes(NamedTuple):
    centers: Floats  # (n, 3)
    normals: Floats  # (n, 3)
    rms_m: Floats  # (n,): root mean square distance of the neighbors from the plane
    are_valid: Bools  # (n,)


def neighborhood_radius(points: Floats) -> float:
    """Return the radius in meters within which half of the points have at least 20 neighbors.

    It is rounded to two significant digits.
    """
    count = min(20, len(points) - 1)
    if count < _MIN_NEIGHBORS:
        raise LidarError(
            f"Planes require at least {_MIN_NEIGHBORS + 1} points, but a cloud has {len(points)}."
        )
    rows = even_indices(len(points), _SAMPLES)
    distance, _ = NeighborSearch(points).nearest(points[rows], count + 1)
    return float(f"{max(np.median(distance[:, -1]), 1e-4):.2g}")


def plane_deviations(
    points: Floats, reference: Floats, radius_m: float, max_distance_m: float
) -> Deviations:
    """Return the signed distances from points to planes through the reference.

    The plane for a point is fitted to the neighbors of the nearest reference point within
    `radius_m`, at most 24. Distances are positive above the plane. Vertical planes face east, or
    north if they are parallel to the east axis.

    Parameters
    ----------
    points, reference
        Points of A and B in world coordinates. Shapes (n, 3) and (m, 3).
    radius_m
        Maximum radius of the neighborhoods.
    max_distance_m
        Points farther than this from the reference have no counterpart.
    """
    search = NeighborSearch(reference, radius_m)
    origin = reference.mean(axis=0)
    distances, roughness = np.full((2, len(points)), np.nan)
    too_far = 0
    for start in range(0, len(points), _BATCH):
        batch = points[start : start + _BATCH]
        separation, nearest = search.nearest(batch)
        is_near = separation[:, 0] <= max_distance_m
        too_far += int(np.count_nonzero(~is_near))
        planes = _fit_planes(search, reference, nearest[is_near, 0], origin)
        signed = np.einsum("ni,ni->n", batch[is_near] - origin - planes.centers, planes.normals)
        rows = start + np.flatnonzero(is_near)[planes.are_valid]
        distances[rows] = signed[planes.are_valid]
        roughness[rows] = planes.rms_m[planes.are_valid]
    found = np.isfinite(distances)
    if not found.any():
        raise LidarError(
            f"None of the points of A has a plane in B within {max_distance_m:g} m. Increase "
            "`--max-distance`, or `--radius` if the points of B are sparse."
        )
    figures = {
        "radius_m": radius_m,
        "max_distance_m": max_distance_m,
        "plane_rms_m": float(np.median(roughness[found])),
        "without_counterpart": too_far,
        "without_plane": int(len(points) - found.sum() - too_far),
    }
    return Deviations(points[found], {"distance": distances[found]}, figures)


def _fit_planes(search: NeighborSearch, reference: Floats, rows: Floats, origin: Floats) -> _Planes:
    """Fit planes to the neighborhoods of reference points, relative to an origin."""
    index, counts = search.within(reference[rows], _NEIGHBORS)
    is_neighbor = np.arange(_NEIGHBORS) < counts[:, None]
    neighbors = reference[np.where(is_neighbor, index, 0)] - origin
    weights = is_neighbor[..., None]
    centers = (neighbors * weights).sum(axis=1) / np.maximum(counts, 1)[:, None]
    offsets = (neighbors - centers[:, None]) * weights
    squares, axes = np.linalg.eigh(offsets.swapaxes(1, 2) @ offsets)
    are_valid = (counts >= _MIN_NEIGHBORS) & (squares[:, 1] >= _MIN_WIDTH**2 * squares[:, 2])
    rms_m = np.sqrt(np.maximum(squares[:, 0], 0) / np.maximum(counts, 1))
    return _Planes(centers, orient_normals(axes[:, :, 0]), rms_m, are_valid)


def orient_normals(normals: Floats) -> Floats:
    """Orient normals so that they point up or, if they are horizontal, east or north.

    The shape is (n, 3).

    Examples
    --------
    >>> orient_normals(np.array([[0.6, 0, -0.8], [-1, 0, 0.01]])).tolist()
    [[-0.6, -0.0, 0.8], [1.0, -0.0, -0.01]]
    """
    x, y, z = normals.T
    decisive = np.where(np.abs(z) > _LEVEL, z, np.where(np.abs(x) > _LEVEL, x, y))
    return np.where(decisive < 0, -1.0, 1.0)[:, None] * normals
