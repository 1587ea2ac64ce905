"""Orientation of surface normals.

Normals point to the scanner where its position is known. Otherwise, neighboring normals are
oriented consistently, so that the sign of a distance does not change within a surface.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np

from lidarfiles.open3d_access.neighbors import NeighborSearch, nearest_neighbors
from lidarsim.numerics.arrays import Bools, Floats, Indices, Ints
from lidarsim.numerics.random_numbers import hash_rows

from .survey_clouds import SurveyPoints

_NEIGHBORS = 8  # neighbors to which a point may be linked
_NEAREST = 4  # oriented points, the best of which determines the sign of another normal
_MIN_AGREEMENT = 0.3  # minimum agreement of two normals that determine each other's sign
_MIN_COSINE = 0.1  # minimum cosine of the incidence with which a scanner determines a sign
_LEVEL = 0.05  # normals with a smaller component along an axis do not point along it (3 degrees)
_MIN_MEAN = 0.3  # minimum length of the mean horizontal normal of a surface that is not round
_FLAT = 0.5  # minimum vertical component of the normals of floors and ceilings
_BOTH = 0.25  # minimum ratio of the areas of floor and ceiling in a surface that encloses a space


def thin_out(points: Floats, cell_m: float) -> Indices:
    """Return the row of one point in each cubic cell that contains points, in ascending order."""
    cells = np.floor(points / cell_m).astype(np.int64)
    _, rows = np.unique(hash_rows(*cells.T), return_index=True)
    return np.sort(rows)


def nearby_scanners(reference: SurveyPoints, rows: Indices, points: SurveyPoints) -> Floats | None:
    """Return the scanner positions of some reference points, of shape (n, 3).

    If no scanner position is known for the reference, those of the nearest points of A are
    returned, or None if A has none either. Single unknown positions are NaN.
    """
    if reference.has_scanners or not points.has_scanners:
        return reference.scanner_positions(rows)
    _, nearest = nearest_neighbors(reference.positions[rows], points.positions)
    return points.scanner_positions(nearest)


@dataclass(frozen=True, eq=False)
class OrientedPoints:
    """Points of surfaces with oriented normals."""

    points: Floats  # (n, 3)
    normals: Floats  # (n, 3)

    @cached_property
    def _search(self) -> NeighborSearch:
        return NeighborSearch(self.points)

    @classmethod
    def from_normals(
        cls, points: Floats, normals: Floats, scanners: Floats | None, spacing_m: float
    ) -> Self:
        """Orient the normals at some points.

        Parameters
        ----------
        points, normals
            Points and unit vectors. Shape (n, 3).
        scanners
            Position of the scanner that measured each point, or NaN if it is unknown. Shape (n, 3).
        spacing_m
            Approximate distance between neighboring points. Points that are farther apart than
            three times this distance belong to different surfaces.
        """
        cosines = _cosines(points, normals, scanners)
        links = _Links.between_neighbors(points, normals, 3 * spacing_m)
        links = links.with_scanner(cosines)
        surfaces, signs = _consistent_signs(links, len(points) + 1)
        oriented = signs[1:, None] * normals
        is_seen = surfaces[1:] == surfaces[0]
        oriented[is_seen] *= signs[0]
        defaults = _default_signs(points, oriented, surfaces[1:])
        oriented[~is_seen] *= defaults[~is_seen, None]
        return cls(points, oriented)

    def orient(self, points: Floats, normals: Floats, scanners: Floats | None) -> Floats:
        """Orient the normals at other points of the same surfaces. All shapes are (n, 3)."""
        cosines = _cosines(points, normals, scanners)
        _, rows = self._search.nearest(points, min(_NEAREST, len(self.points)))
        agreements, _ = _agreements(
            points[:, None] - self.points[rows], normals[:, None], self.normals[rows]
        )
        best = np.abs(agreements).argmax(axis=1)[:, None]
        agreement = np.take_along_axis(agreements, best, axis=1)[:, 0]
        decisive = np.where(np.abs(cosines) >= _MIN_COSINE, cosines, agreement)
        return np.where(decisive < 0, -1.0, 1.0)[:, None] * normals


def _cosines(points: Floats, normals: Floats, scanners: Floats | None) -> Floats:
    """Return the cosines between normals and directions to the scanner, or 0 if unknown."""
    if scanners is None:
        return np.zeros(len(points))
    directions = scanners - points
    lengths = np.linalg.norm(directions, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        cosines = np.einsum("ni,ni->n", directions, normals) / lengths
    return np.nan_to_num(cosines)


def _agreements(offsets: Floats, first: Floats, second: Floats) -> tuple[Floats, Floats]:
    """Return how well pairs of normals agree, and the weights of these values.

    The second normal is reflected at the plane halfway between both points. On a plane, a circle
    and a right angle, it is then parallel to the first normal (König and Gumhold 2009). The
    agreement is negative if one of the normals must be inverted. The weight is lower if the second
    point lies in the direction of the normals, because both points may belong to different
    surfaces. `offsets` are the vectors between the points. All shapes are (..., 3).
    """
    lengths = np.linalg.norm(offsets, axis=-1, keepdims=True)
    directions = offsets / np.maximum(lengths, 1e-12)
    along_first = (directions * first).sum(axis=-1)
    along_second = (directions * second).sum(axis=-1)
    agreements = (first * second).sum(axis=-1) - 2 * along_first * along_second
    return agreements, np.abs(agreements) - np.abs(along_first * along_second)


class _Links(NamedTuple):
    """Pairs of nodes whose signs depend on each other, the most reliable pair first."""

    first: Ints  # (k,)
    second: Ints  # (k,)
    signs: Floats  # (k,): -1 if one of both normals must be inverted, otherwise 1
    weights: Floats  # (k,)

    @classmethod
    def between_neighbors(cls, points: Floats, normals: Floats, reach_m: float) -> _Links:
        """Link neighboring points, which are numbered from 1."""
        count = min(_NEIGHBORS + 1, len(points))
        distances, rows = NeighborSearch(points).nearest(points, count)
        first = np.repeat(np.arange(len(points)), count)
        second = rows.reshape(-1)
        agreements, weights = _agreements(
            points[first] - points[second], normals[first], normals[second]
        )
        linked = (distances.reshape(-1) <= reach_m) & (np.abs(agreements) >= _MIN_AGREEMENT)
        linked &= first != second
        signs = np.sign(agreements[linked])
        return cls(first[linked] + 1, second[linked] + 1, signs, weights[linked])

    def with_scanner(self, cosines: Floats) -> _Links:
        """Link points to node 0, which represents the scanner, and sort all links."""
        seen = np.flatnonzero(np.abs(cosines) >= _MIN_COSINE)
        first = np.concatenate([self.first, np.zeros(len(seen), self.first.dtype)])
        second = np.concatenate([self.second, seen + 1])
        signs = np.concatenate([self.signs, np.sign(cosines[seen])])
        weights = np.concatenate([self.weights, 1 + np.abs(cosines[seen])])
        order = np.argsort(-weights, kind="stable")
        return _Links(first[order], second[order], signs[order], weights[order])


def _consistent_signs(links: _Links, count: int) -> tuple[Ints, Floats]:
    """Return the surface of each node, and a sign that makes its normal consistent with the others.

    The signs follow the links of a maximum spanning tree (Hoppe et al. 1992), which Borůvka's
    algorithm finds in a few passes: in each pass, every tree is joined to another tree by its most
    reliable link.
    """
    tree = np.arange(count)
    signs = np.ones(count)
    first, second, link_signs, _ = links
    while True:
        outer = tree[first] != tree[second]
        first, second, link_signs = first[outer], second[outer], link_signs[outer]
        if not len(first):
            return tree, signs
        tree_of_first, tree_of_second = tree[first], tree[second]
        link = np.full(count, len(first))
        np.minimum.at(link, tree_of_first, np.arange(len(first)))
        np.minimum.at(link, tree_of_second, np.arange(len(first)))
        roots = np.flatnonzero(link < len(first))
        link = link[roots]
        parent = np.arange(count)
        parent[roots] = np.where(
            tree_of_first[link] == roots, tree_of_second[link], tree_of_first[link]
        )
        to_parent = np.ones(count)
        to_parent[roots] = link_signs[link] * signs[first[link]] * signs[second[link]]
        # Two trees that chose the same link would be parents of each other.
        is_top = (parent[parent] == np.arange(count)) & (np.arange(count) < parent)
        parent[is_top] = np.flatnonzero(is_top)
        to_parent[is_top] = 1.0
        while (parent[parent] != parent).any():
            to_parent *= to_parent[parent]
            parent = parent[parent]
        signs *= to_parent[tree]
        tree = parent[tree]


def _default_signs(points: Floats, normals: Floats, surfaces: Ints) -> Floats:
    """Return the sign, for each point, with which its surface faces its default direction.

    Surfaces face up. Surfaces that are vertical on average face east or, if they are parallel to
    the east axis, north. If they have no direction on average, such as columns, they face outward.
    Surfaces with a floor and a ceiling, such as rooms and tunnels, face inward.
    """
    counts = np.maximum(np.bincount(surfaces), 1)

    def mean(values: Floats | Bools) -> Floats:
        return np.asarray(np.bincount(surfaces, values) / counts)

    offsets = points - np.stack([mean(axis) for axis in points.T], axis=1)[surfaces]
    x, y, z = (mean(axis) for axis in normals.T)
    outward = mean((offsets[:, :2] * normals[:, :2]).sum(axis=1))
    up, down = mean(normals[:, 2] > _FLAT), mean(normals[:, 2] < -_FLAT)
    encloses = np.minimum(up, down) > np.maximum(_BOTH * np.maximum(up, down), _LEVEL)
    inward = -mean(offsets[:, 2] * normals[:, 2])
    is_round = np.hypot(x, y) < _MIN_MEAN
    conditions = [encloses, np.abs(z) > _LEVEL, is_round, np.abs(x) > _LEVEL]
    decisive = np.select(conditions, [inward, z, outward, x], y)
    return np.where(decisive < 0, -1.0, 1.0)[surfaces]
