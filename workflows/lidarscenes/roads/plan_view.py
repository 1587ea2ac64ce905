"""Evaluate the lines, arcs, spirals, and cubics that form road reference lines in plan.

Lines, arcs, and spirals are curves whose curvature varies linearly (clothoids). They are
integrated by five-point Gauss-Legendre quadrature over pieces that turn by at most half a radian,
with an error below 1e-12 of the length of a piece. Cubics are sampled, and their parameter is
looked up by arc length.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from math import ceil
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from lidarsim.io.allowance import Allowance
from lidarsim.numerics.arrays import Floats, Ints
from lidarsim.numerics.elementary import sin_cos
from lidarsim.numerics.vectors import hypot
from lidarsim.scene.files.scene_graph import MeshFileError

from .elements import read_non_negative, read_number

_MAX_TURN = 0.5  # maximum turn of a piece of a clothoid in radians
_CUBIC_PIECES = 16  # number of pieces of a cubic geometry, each with separate stations
_CUBIC_SAMPLES = 64  # samples per piece for computing arc lengths
_MIN_SPEED = 1e-3  # minimum ratio of the speeds along a cubic; slower cubics reverse direction
_LEAST_M = 1e-9  # shorter geometries are skipped
# Nodes and weights of five-point Gauss-Legendre quadrature from 0 to 1.
_NODES = np.array([-0.9061798459386640, -0.5384693101056831, 0.0]) / 2 + 0.5
_NODES = np.append(_NODES, 1 - _NODES[1::-1])
_WEIGHTS = np.array([0.2369268850561891, 0.4786286704993665, 0.5688888888888889]) / 2
_WEIGHTS = np.append(_WEIGHTS, _WEIGHTS[1::-1])


class PlanPoints(NamedTuple):
    """Points on reference lines in plan, and the headings there."""

    x: Floats  # (k,) in meters
    y: Floats  # (k,) in meters
    cosines: Floats  # (k,) cosines of the headings
    sines: Floats  # (k,) sines of the headings


class _Clothoid(NamedTuple):
    """A piece of a clothoid. Lines and arcs are special cases of clothoids."""

    start: float  # distance in the table, in meters
    x: float
    y: float
    heading: float  # rad
    curvature: float  # curvature at the start in 1/m
    growth: float  # change of the curvature per meter, in 1/m²


class _Cubic(NamedTuple):
    """A poly3 or paramPoly3 geometry that is sampled by arc length."""

    start: float  # distance in the table, in meters
    x: float
    y: float
    cosine: float  # cosine of the heading at the start
    sine: float
    distances: Floats  # (m,) distances of the samples from the start, in meters
    parameters: Floats  # (m,) parameters of the samples
    u: Floats  # (4,) coefficients along the heading
    v: Floats  # (4,) coefficients to the left


class PlanTable:
    """Table of all reference lines in a file, concatenated along a common distance.

    Roads are added with `add_road`. After `finish`, they can be evaluated together.
    """

    def __init__(self, allowance: Allowance) -> None:
        self._allowance = allowance
        self._clothoids: list[_Clothoid] = []
        self._cubics: list[_Cubic] = []
        self._bends: list[tuple[float, float]] = []  # start and largest curvature of each piece
        self._table = np.zeros((0, 6))
        self._starts = np.zeros(0)  # (p,) starts of all pieces
        self._kinds = np.zeros(0, np.int64)  # (p,) row of `_cubics`; -1 for a clothoid
        self._bend_table = np.zeros((0, 2))

    def add_road(self, geometries: Sequence[Element], offset: float, length: float) -> Floats:
        """Add a road's geometries to the table, starting at the distance `offset`.

        The result contains the starts of the geometries on the road. The last geometry ends with
        the road, which has a length of `length` meters.
        """
        starts = [read_non_negative(geometry, "s") for geometry in geometries]
        first = len(self._bends)
        for geometry, start, stop in zip(geometries, starts, [*starts[1:], length], strict=True):
            if stop - start > _LEAST_M:
                self._add_geometry(geometry, offset + start, stop - start)
        return np.array([start for start, _ in self._bends[first:]]) - offset

    def finish(self) -> None:
        """Prepare the table for evaluation."""
        clothoid_starts = [piece.start for piece in self._clothoids]
        starts = np.array(clothoid_starts + [piece.start for piece in self._cubics])
        order = np.argsort(starts, kind="stable")
        kinds = np.concatenate(
            [np.full(len(clothoid_starts), -1, np.int64), np.arange(len(self._cubics))]
        )
        self._starts = starts[order]
        self._kinds = kinds[order]
        self._table = np.full((len(starts), 6), 0.0)
        clothoids = np.fromiter(chain.from_iterable(self._clothoids), np.float64).reshape(-1, 6)
        self._table[self._kinds < 0] = clothoids[np.argsort(clothoids[:, 0], kind="stable")]
        bends = np.fromiter(chain.from_iterable(self._bends), np.float64).reshape(-1, 2)
        self._bend_table = bends[np.argsort(bends[:, 0], kind="stable")]

    def max_curvatures(self, starts: Floats, stops: Floats) -> Floats:
        """Return the largest curvature in 1/m in each interval. Each interval is within a piece."""
        row_indices = np.searchsorted(self._bend_table[:, 0], (starts + stops) / 2, "right") - 1
        return np.asarray(self._bend_table[np.maximum(row_indices, 0), 1])

    def points(self, distances: Floats, pieces: Floats) -> PlanPoints:
        """Return the points at the given distances in the table.

        `pieces` (k,) are the distances that select the pieces on which the points are evaluated.
        """
        row_indices = np.maximum(np.searchsorted(self._starts, pieces, "right") - 1, 0)
        points = self._clothoid_points(distances, row_indices)
        kinds = self._kinds[row_indices]
        for kind in np.unique(kinds[kinds >= 0]).tolist():
            mask = kinds == kind
            cubic_points = _cubic_points(self._cubics[kind], distances[mask])
            for array, values in zip(points, cubic_points, strict=True):
                array[mask] = values
        return points

    def _clothoid_points(self, distances: Floats, row_indices: Ints) -> PlanPoints:
        """Return the points on clothoids at the given distances in the table.

        The results are meaningless for rows that refer to cubics.
        """
        start, x, y, heading, curvature, growth = self._table[row_indices].T
        along = distances - start
        sines, cosines = sin_cos(heading + (curvature + growth / 2 * along) * along)
        x = x + cosines * along
        y = y + sines * along
        curved = np.flatnonzero((curvature != 0) | (growth != 0))
        steps = along[curved, None] * _NODES
        turned = curvature[curved, None] + growth[curved, None] / 2 * steps
        node_sines, node_cosines = sin_cos(heading[curved, None] + turned * steps)
        # Adding five products in a fixed order gives identical results on every processor.
        for array, origin, terms in (
            (x, self._table[row_indices[curved], 1], node_cosines * _WEIGHTS),
            (y, self._table[row_indices[curved], 2], node_sines * _WEIGHTS),
        ):
            mean = ((terms[:, 0] + terms[:, 4]) + (terms[:, 1] + terms[:, 3])) + terms[:, 2]
            array[curved] = origin + mean * along[curved]
        return PlanPoints(x, y, cosines, sines)

    def _add_geometry(self, geometry: Element, start: float, length: float) -> None:
        """Add a geometry with the given length, which may differ from the stated length."""
        shape = next((child for child in geometry if child.tag in _SHAPES), None)
        if shape is None:
            tags = ", ".join(child.tag for child in geometry) or "nothing"
            raise MeshFileError(
                f"contains <geometry> with {tags[:40]}; expected line, arc, spiral, poly3 or "
                "paramPoly3"
            )
        stated_length = read_non_negative(geometry, "length")
        if shape.tag in ("poly3", "paramPoly3"):
            self._add_cubic(geometry, shape, start, stated_length)
            return
        curvature = 0.0
        growth = 0.0
        if shape.tag == "arc":
            curvature = read_number(shape, "curvature")
        elif shape.tag == "spiral":
            curvature = read_number(shape, "curvStart", 0.0)
            growth = (read_number(shape, "curvEnd", 0.0) - curvature) / max(stated_length, _LEAST_M)
        self._add_clothoid(
            _Clothoid(start, *_origin(geometry), curvature=curvature, growth=growth), length
        )

    def _add_clothoid(self, clothoid: _Clothoid, length: float) -> None:
        """Add a clothoid, in pieces that turn by at most `_MAX_TURN`."""
        last = clothoid.curvature + clothoid.growth * length
        turn = max(abs(clothoid.curvature), abs(last)) * length
        self._allowance.reserve(int(min(turn / _MAX_TURN, 1e15)) * 500)
        count = max(1, ceil(turn / _MAX_TURN))
        piece = clothoid
        for k in range(count):
            following = clothoid.curvature + clothoid.growth * length * (k + 1) / count
            self._clothoids.append(piece)
            self._bends.append((piece.start, max(abs(piece.curvature), abs(following))))
            if k + 1 < count:
                piece = _next_piece(piece, length / count, following)

    def _add_cubic(self, geometry: Element, shape: Element, start: float, length: float) -> None:
        """Add a poly3 or paramPoly3 geometry."""
        u, v = _coefficients(shape)
        # Without pRange, parameters are normalized (ASAM OpenDRIVE 1.4 to 1.8).
        is_normalized = shape.tag == "paramPoly3" and shape.get("pRange") != "arcLength"
        count = 1 + _CUBIC_SAMPLES * _CUBIC_PIECES
        parameters = np.linspace(0, 1.0 if is_normalized else length, count)
        speeds = hypot(_slope(u, parameters), _slope(v, parameters))
        lengths = np.diff(parameters) * (speeds[1:] + speeds[:-1]) / 2
        distances = np.append(0, np.add.accumulate(lengths))
        if not (0 < distances[-1] < np.inf and speeds.min() > _MIN_SPEED * speeds.max()):
            raise MeshFileError(
                f"contains a <{shape.tag}> that has zero length or a point where its derivative "
                "is zero. Correct its parameters"
            )
        if is_normalized:  # scale so that the last parameter is at the end of the geometry
            distances = distances * (length / distances[-1])
        x, y, heading = _origin(geometry)
        sine, cosine = (float(value) for value in sin_cos(heading))
        self._cubics.append(
            _Cubic(
                start=start,
                x=x,
                y=y,
                cosine=cosine,
                sine=sine,
                distances=distances,
                parameters=parameters,
                u=u,
                v=v,
            )
        )
        bends = _curvatures(u, v, parameters)
        for first in range(0, count - 1, _CUBIC_SAMPLES):
            if distances[first] < length:
                bend = float(bends[first : first + _CUBIC_SAMPLES + 1].max())
                self._bends.append((start + float(distances[first]), bend))


_SHAPES = ("line", "arc", "spiral", "poly3", "paramPoly3")


def _origin(geometry: Element) -> tuple[float, float, float]:
    """Return the x, y, and heading at which a geometry starts."""
    return read_number(geometry, "x"), read_number(geometry, "y"), read_number(geometry, "hdg")


def _next_piece(piece: _Clothoid, step: float, curvature: float) -> _Clothoid:
    """Return the piece of a clothoid that starts `step` meters later with the given curvature."""
    table = np.array([piece])
    heading = piece.heading + (piece.curvature + piece.growth / 2 * step) * step
    steps = step * _NODES
    sines, cosines = sin_cos(table[0, 3] + (piece.curvature + piece.growth / 2 * steps) * steps)
    x = piece.x + step * sum((cosines * _WEIGHTS).tolist())
    y = piece.y + step * sum((sines * _WEIGHTS).tolist())
    return _Clothoid(piece.start + step, x, y, heading, curvature, piece.growth)


def _cubic_points(cubic: _Cubic, distances: Floats) -> PlanPoints:
    """Return the points on a cubic at the given distances in the table."""
    along = distances - cubic.start
    parameters = _parameters(cubic, along)
    u, v = (_value(coefficients, parameters) for coefficients in (cubic.u, cubic.v))
    du, dv = (_slope(coefficients, parameters) for coefficients in (cubic.u, cubic.v))
    speed = hypot(du, dv)
    cosines = (du * cubic.cosine - dv * cubic.sine) / speed
    sines = (du * cubic.sine + dv * cubic.cosine) / speed
    beyond = np.maximum(along - cubic.distances[-1], 0)  # continue straight after the end
    x = cubic.x + u * cubic.cosine - v * cubic.sine + beyond * cosines
    y = cubic.y + u * cubic.sine + v * cubic.cosine + beyond * sines
    return PlanPoints(x, y, cosines, sines)


def _parameters(cubic: _Cubic, along: Floats) -> Floats:
    """Return the parameters of a cubic at the given distances from its start.

    Beyond the end of the cubic, the parameters remain at the end.
    """
    sample_indices = np.searchsorted(cubic.distances, along, "right") - 1
    sample_indices = np.clip(sample_indices, 0, len(cubic.distances) - 2)
    gaps = cubic.distances[sample_indices + 1] - cubic.distances[sample_indices]
    fraction = np.clip((along - cubic.distances[sample_indices]) / gaps, 0, 1)
    steps = cubic.parameters[sample_indices + 1] - cubic.parameters[sample_indices]
    return np.asarray(cubic.parameters[sample_indices] + fraction * steps)


def _coefficients(shape: Element) -> tuple[Floats, Floats]:
    """Return a cubic's coefficients along the heading, and to the left of it."""
    if shape.tag == "poly3":
        u = [0.0, 1.0, 0.0, 0.0]
        v = [read_number(shape, name, 0.0) for name in "abcd"]
    else:
        u = [read_number(shape, f"{name}U", 0.0) for name in "abcd"]
        v = [read_number(shape, f"{name}V", 0.0) for name in "abcd"]
    return np.array(u), np.array(v)


def _curvatures(u: Floats, v: Floats, p: Floats) -> Floats:
    """Return a cubic's unsigned curvatures at the given parameters, in 1/m."""
    du = _slope(u, p)
    dv = _slope(v, p)
    speeds = hypot(du, dv)
    return np.abs(du * _bend(v, p) - dv * _bend(u, p)) / (speeds * speeds * speeds)


def _value(coefficients: Floats, p: Floats) -> Floats:
    a, b, c, d = coefficients
    return np.asarray(((d * p + c) * p + b) * p + a)


def _slope(coefficients: Floats, p: Floats) -> Floats:
    _, b, c, d = coefficients
    return np.asarray((3 * d * p + 2 * c) * p + b)


def _bend(coefficients: Floats, p: Floats) -> Floats:
    _, _, c, d = coefficients
    return np.asarray(2 * c + 6 * d * p)
