"""Estimate of the returns that a scene of surfels loses in gaps between surfels.

The points of a scanner are dense along each ring, but the rings are far apart. Surfels close gaps
of a few point spacings, so rays can pass between distant rings. The loss is estimated for rays from
the positions of the scanner in directions between its points. Rays from other positions are lost
more often, because they also reach surfaces that the scanner did not see.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from lidarsim.numerics.arrays import Bools, Floats, Ints

MAX_SCANNERS = 100  # with more positions, the sensor was moving, and its rings are unknown
_SAMPLE = 2000  # number of points around which rays are cast
_NEIGHBORS = 96  # number of angular neighbors of a point, which lie on several rings
_RAYS = 8  # number of rays around each sampled point
_SURFELS = 64  # number of angular neighbors among the surfels that are tested for each ray
_BLOCK = 250  # number of points that are processed at a time, which limits memory use
_CENTERED = 0.15  # maximum distance between a point and the mean of its neighbors, in radii
_SLACK = 0.1  # relative range tolerance for surfels in front of or behind the neighbors
_MIN_NEIGHBORHOODS = 50  # minimum number of neighborhoods for an estimate


def expected_loss(positions: Floats, scanners: Floats, corners: Floats) -> float | None:
    """Estimate the fraction of returns that are lost in gaps between surfels.

    Parameters
    ----------
    positions
        Points in meters. Shape (n, 3).
    scanners
        Position of the scanner for each point in meters, or NaN if it is unknown. Shape (n, 3).
    corners
        Corners of the surfels in meters. Shape (v, 4, 3).

    Returns
    -------
    float or None
        Share of the returns, from 0 to 1. The share is None if the scanner positions are unknown,
        if the sensor was moving, or if there are too few points.
    """
    known = np.flatnonzero(np.isfinite(scanners).all(axis=1))
    stations, owner = np.unique(np.round(scanners[known], 3), axis=0, return_inverse=True)
    if not 0 < len(stations) <= MAX_SCANNERS:
        return None
    rng = np.random.default_rng(0)
    fractions = [np.zeros(0)]
    for number, scanner in enumerate(stations):
        rows = known[owner.ravel() == number]
        count = max(1, round(_SAMPLE * len(rows) / len(known)))
        surfels = corners - scanner
        tree = _search_tree(_normalize(surfels.mean(axis=1)))
        for rays in _rays_between(positions[rows] - scanner, count, rng):
            nearest = _nearest(tree, rays.directions.reshape(-1, 3), min(_SURFELS, len(surfels)))
            fractions.append(1 - rays.covered_by(surfels[nearest]).mean(axis=1))
    lost = np.concatenate(fractions)
    return float(lost.mean()) if len(lost) >= _MIN_NEIGHBORHOODS else None


class _Rays(NamedTuple):
    """Rays from a scanner at the origin. Their directions lie between those of its points."""

    directions: Floats  # (k, _RAYS, 3), unit vectors
    nearest: Floats  # (k,), minimum range of the neighbors, meters
    farthest: Floats  # (k,), maximum range of the neighbors, meters

    def covered_by(self, corners: Floats) -> Bools:
        """Mark the rays that hit at least one of the surfels listed for them.

        `corners` has shape (k * _RAYS, s, 4, 3) and contains s surfels for each ray. The result has
        shape (k, _RAYS).
        """
        directions = self.directions.reshape(-1, 1, 3)
        half_lengths = (corners[:, :, 1] - corners[:, :, 0]) / 2
        half_widths = (corners[:, :, 2] - corners[:, :, 1]) / 2
        centers = corners.mean(axis=2)
        normals = np.cross(half_lengths, half_widths)
        with np.errstate(divide="ignore", invalid="ignore"):  # degenerate surfels
            distances = _dot(centers, normals) / _dot(directions, normals)
            offsets = distances[..., None] * directions - centers
            along = _dot(offsets, half_lengths) / _dot(half_lengths, half_lengths)
            across = _dot(offsets, half_widths) / _dot(half_widths, half_widths)
            hit = (np.abs(along) <= 1) & (np.abs(across) <= 1)
            hit &= distances >= (1 - _SLACK) * self.nearest.repeat(_RAYS)[:, None]
            hit &= distances <= (1 + _SLACK) * self.farthest.repeat(_RAYS)[:, None]
        covered: Bools = hit.any(axis=1).reshape(-1, _RAYS)
        return covered


def _rays_between(points: Floats, count: int, rng: np.random.Generator) -> Iterator[_Rays]:
    """Yield rays that pass close to about `count` random points.

    The scanner is at the origin. Points at the edge of the visible area, for example against the
    sky, are skipped. `points` has shape (n, 3).
    """
    points = points[points.any(axis=1)]
    if len(points) < _NEIGHBORS:
        return
    directions = _normalize(points)
    ranges = np.sqrt(_dot(points, points))
    tree = _search_tree(directions)
    # Evenly spaced points would repeatedly sample the same channels, because points are ordered by
    # firing.
    sampled = rng.permutation(directions)[:count]
    for start in range(0, len(sampled), _BLOCK):
        centers = sampled[start : start + _BLOCK]
        neighbors = _nearest(tree, centers, _NEIGHBORS)
        offsets = directions[neighbors] - centers[:, None]
        radii = np.sqrt(_dot(offsets, offsets).max(axis=1))
        mean = offsets.mean(axis=1)
        inside = np.flatnonzero(np.sqrt(_dot(mean, mean)) <= _CENTERED * radii)
        # Rays within half of the radius have neighbors on all sides.
        steps = rng.normal(size=(len(inside), _RAYS, 3))
        steps -= _dot(steps, centers[inside, None])[..., None] * centers[inside, None]
        steps *= np.sqrt(rng.random((len(inside), _RAYS)) / _dot(steps, steps))[..., None]
        rays = centers[inside, None] + radii[inside, None, None] / 2 * steps
        around = ranges[neighbors[inside]]
        yield _Rays(_normalize(rays), around.min(axis=1), around.max(axis=1))


def _normalize(vectors: Floats) -> Floats:
    """Scale vectors to length 1, leaving zero vectors unchanged.

    The vectors have shape (..., 3).
    """
    lengths = np.sqrt(_dot(vectors, vectors))[..., None]
    return np.divide(vectors, lengths, out=np.zeros_like(vectors), where=lengths > 0)


def _dot(first: Floats, second: Floats) -> Floats:
    products: Floats = (first * second).sum(axis=-1)
    return products


def _search_tree(points: Floats) -> Any:
    """Return Open3D's nearest neighbor search for the given points.

    The points have shape (n, 3).
    """
    from open3d.core import Tensor, nns

    tree = nns.NearestNeighborSearch(Tensor(np.ascontiguousarray(points)))
    tree.knn_index()
    return tree


def _nearest(tree: Any, positions: Floats, count: int) -> Ints:
    """Return the indices of the `count` points in a tree that are nearest to each position.

    `positions` has shape (k, 3), and the result has shape (k, count).
    """
    from open3d.core import Tensor

    indices, _ = tree.knn_search(Tensor(np.ascontiguousarray(positions)), count)
    found: Ints = indices.numpy()
    return found
