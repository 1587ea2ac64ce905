"""Gaps between surfels: the share of returns that a scene of points is expected to lose.

A scanner has many points along a ring, and few across. Surfels close gaps of a few spacings, so
that rays pass between distant rings. The share is estimated for rays from the positions of the
scanner between its points. Rays from elsewhere are lost more often, because they also meet surfaces
that the scanner did not see.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from lidarsim.numerics.arrays import Bools, Floats, Ints

MAX_SCANNERS = 100  # more positions are those of a moving sensor, whose rings are not known
_SAMPLE = 2000  # points around which rays are tried
_NEIGHBORS = 96  # in angle, as seen by the scanner: on several rings
_RAYS = 8  # for each of these points
_SURFELS = 64  # that may cover a ray: the nearest in angle
_BLOCK = 250  # points at a time, to bound the memory
_CENTERED = 0.15  # largest distance of the mean of neighbors from their middle, in radii
_SLACK = 0.1  # of ranges: surfels this far before or behind the points cover rays
_MIN_NEIGHBORHOODS = 50  # fewer tell too little


def expected_loss(positions: Floats, scanners: Floats, corners: Floats) -> float | None:
    """Return the share of returns between points that pass between surfels, 0 to 1.

    Parameters
    ----------
    positions
        The points (n, 3), meters.
    scanners
        Position of the scanner of each point (n, 3), meters; NaN where unknown.
    corners
        Corners of the surfels (v, 4, 3), meters.

    Returns
    -------
    The share, or None if positions of the scanner are not known, or are those of a moving sensor,
    or if there are too few points.
    """
    known = np.flatnonzero(np.isfinite(scanners).all(axis=1))
    places, owner = np.unique(np.round(scanners[known], 3), axis=0, return_inverse=True)
    if not 0 < len(places) <= MAX_SCANNERS:
        return None
    rng = np.random.default_rng(0)
    shares = [np.zeros(0)]
    for number, scanner in enumerate(places):
        rows = known[owner.ravel() == number]
        count = max(1, round(_SAMPLE * len(rows) / len(known)))
        surfels = corners - scanner
        tree = _tree(_directions(surfels.mean(axis=1)))
        for rays in _rays_between(positions[rows] - scanner, count, rng):
            nearest = _nearest(tree, rays.directions.reshape(-1, 3), min(_SURFELS, len(surfels)))
            shares.append(1 - rays.covered_by(surfels[nearest]).mean(axis=1))
    lost = np.concatenate(shares)
    return float(lost.mean()) if len(lost) >= _MIN_NEIGHBORHOODS else None


class _Rays(NamedTuple):
    """Rays from a scanner at zero, between its points."""

    directions: Floats  # (k, _RAYS, 3), of length 1
    nearest: Floats  # (k,): of the points around, meters
    farthest: Floats  # (k,): of the points around, meters

    def covered_by(self, corners: Floats) -> Bools:
        """Return whether rays (k, _RAYS) meet one of their surfels (k · _RAYS, s, 4, 3)."""
        directions = self.directions.reshape(-1, 1, 3)
        half_lengths = (corners[:, :, 1] - corners[:, :, 0]) / 2
        half_widths = (corners[:, :, 2] - corners[:, :, 1]) / 2
        centers = corners.mean(axis=2)
        normals = np.cross(half_lengths, half_widths)
        with np.errstate(divide="ignore", invalid="ignore"):  # surfels without an area
            distances = _dots(centers, normals) / _dots(directions, normals)
            offsets = distances[..., None] * directions - centers
            along = _dots(offsets, half_lengths) / _dots(half_lengths, half_lengths)
            across = _dots(offsets, half_widths) / _dots(half_widths, half_widths)
            hit = (np.abs(along) <= 1) & (np.abs(across) <= 1)
            hit &= distances >= (1 - _SLACK) * self.nearest.repeat(_RAYS)[:, None]
            hit &= distances <= (1 + _SLACK) * self.farthest.repeat(_RAYS)[:, None]
        covered: Bools = hit.any(axis=1).reshape(-1, _RAYS)
        return covered


def _rays_between(points: Floats, count: int, rng: np.random.Generator) -> Iterator[_Rays]:
    """Yield rays around about `count` of the points (n, 3) of a scanner at zero.

    Rays near the edge of what the scanner saw, against the sky, are left out.
    """
    points = points[points.any(axis=1)]
    if len(points) < _NEIGHBORS:
        return
    directions = _directions(points)
    ranges = np.sqrt(_dots(points, points))
    tree = _tree(directions)
    # At random, because points in the order of firings repeat the same channels at even steps.
    sampled = rng.permutation(directions)[:count]
    for start in range(0, len(sampled), _BLOCK):
        middles = sampled[start : start + _BLOCK]
        neighbors = _nearest(tree, middles, _NEIGHBORS)
        offsets = directions[neighbors] - middles[:, None]
        radii = np.sqrt(_dots(offsets, offsets).max(axis=1))
        mean = offsets.mean(axis=1)
        inside = np.flatnonzero(np.sqrt(_dots(mean, mean)) <= _CENTERED * radii)
        # Half of the radius: neighbors are on all sides.
        steps = rng.normal(size=(len(inside), _RAYS, 3))
        steps -= _dots(steps, middles[inside, None])[..., None] * middles[inside, None]
        steps *= np.sqrt(rng.random((len(inside), _RAYS)) / _dots(steps, steps))[..., None]
        rays = middles[inside, None] + radii[inside, None, None] / 2 * steps
        around = ranges[neighbors[inside]]
        yield _Rays(_directions(rays), around.min(axis=1), around.max(axis=1))


def _directions(vectors: Floats) -> Floats:
    """Return vectors (…, 3) of length 1, or zero for zero."""
    lengths = np.sqrt(_dots(vectors, vectors))[..., None]
    return np.divide(vectors, lengths, out=np.zeros_like(vectors), where=lengths > 0)


def _dots(first: Floats, second: Floats) -> Floats:
    """Return the products of vectors along the last axis."""
    products: Floats = (first * second).sum(axis=-1)
    return products


def _tree(points: Floats) -> Any:
    """Return a search tree of Open3D for the nearest of points (n, 3)."""
    from open3d.core import Tensor, nns

    tree = nns.NearestNeighborSearch(Tensor(np.ascontiguousarray(points)))
    tree.knn_index()
    return tree


def _nearest(tree: Any, places: Floats, count: int) -> Ints:
    """Return the indices (k, count) of the points of a tree nearest to places (k, 3)."""
    from open3d.core import Tensor

    indices, _ = tree.knn_search(Tensor(np.ascontiguousarray(places)), count)
    found: Ints = indices.numpy()
    return found
