"""Stations along roads: where cross sections stand so that triangles keep to a tolerance.

What changes along a road is given in pieces, and may step where a piece starts. A station there
has values from before or from after the step, and a surface with a step has both stations.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lidarsim.base.allowance import Allowance
from lidarsim.base.arrays import AnyArray, Bools, Floats, Ints

GAP_M = 1e-6  # starts of pieces that are nearer to each other are one
HEIGHT_SHARE = 0.1  # tolerance of heights, as a share of the tolerance in plan
SAMPLES = 5  # points of an interval that measure its curvatures
_MAX_SAMPLED_M = 30.0  # length of an interval
_MAX_CUTS = 64  # parts of an interval that is longer
MAX_STEPS = 1e9  # limit for an interval; no memory holds as many
_GROUP_SIZE = 1 << 17  # coordinates of surfaces that are measured together
_STEP_SHARE = 0.01  # smallest step that gets two stations, as a share of the tolerance in plan
_MARGIN = 0.94  # share of tolerances, since the second differences of samples do not show all
_LEAST_WIDTH_M = 1e-4  # cells that are narrower show no slope across the road
_MAX_STEEPENING = 10.0  # steepening in a cell, where a road turns about a point of its surface
_FOLDED_SHARE = 0.3  # share of a cell; cells that are folded further keep no height
# Weights of the values of a parabola that extrapolate it: by a sample, and by half a sample.
_FROM_MIDDLE = np.array([3.0, -3.0, 1.0])
_FROM_PARTS = np.array([1.875, -1.25, 0.375])
_TWIST_SHARES = (0.1, 0.3, 0.5, 0.7, 0.9)  # across a cell, where the error of its twist is judged


@dataclass(frozen=True, eq=False)
class RoadStations:
    """Stations on a road.

    Attributes
    ----------
    s
        (k,): distances along the road, m.
    pieces
        (k,): distances in whose pieces the values are, m: `s`, or just before.
    """

    s: Floats
    pieces: Floats

    @classmethod
    def at(cls, distances: Floats) -> RoadStations:
        """Return stations at distances (k,), each after the steps there."""
        return cls(distances, distances)

    def __len__(self) -> int:
        return len(self.s)

    def select(self, station_selection: AnyArray | slice) -> RoadStations:
        """Return selected stations."""
        return RoadStations(self.s[station_selection], self.pieces[station_selection])


class SurfaceSamples(NamedTuple):
    """Stations at which a surface is measured, and the intervals that these belong to."""

    intervals: Intervals
    stations: RoadStations


class PlacedStations(NamedTuple):
    """The stations of a surface."""

    stations: RoadStations
    steps: Ints  # (j,): stations that the next follows at the same distance, after a step


@dataclass(frozen=True, eq=False)
class Intervals:
    """Intervals of a road, each with a single piece of every polynomial.

    Attributes
    ----------
    ends
        (n, 2): starts and stops, m.
    pieces
        (n, 2): distances in whose pieces the values at starts and stops are, m.
    has_lead
        Whether the first interval has no length. It is the end of what is before the surface: if
        the road steps where the surface starts, the surface starts with that step.
    """

    ends: Floats
    pieces: Floats
    has_lead: bool = False

    @classmethod
    def between(cls, start: float, stop: float, breaks: Floats) -> Intervals:
        """Return the intervals between two distances.

        Pieces start at the breaks (b,).
        """
        inside = np.sort(breaks[(breaks > start + GAP_M) & (breaks < stop - GAP_M)])
        is_far = inside[1:] - inside[:-1] > GAP_M
        count = np.count_nonzero(is_far) + 1 if len(inside) else 0
        ends = np.empty((count + 1, 2))
        pieces = np.empty((count + 1, 2))
        ends[0, 0] = start
        ends[-1, 1] = stop
        pieces[0, 0] = breaks[np.abs(breaks - start) <= GAP_M].max(initial=start)
        pieces[-1, 1] = breaks[np.abs(breaks - stop) <= GAP_M].min(initial=stop) - GAP_M / 2
        if count:
            # The first and the last of the breaks that are one.
            first = np.concatenate([inside[:1], inside[1:][is_far]])
            ends[1:, 0] = first
            ends[:-1, 1] = first
            pieces[:-1, 1] = first - GAP_M / 2
            pieces[1:, 0] = np.concatenate([inside[:-1][is_far], inside[-1:]])
        return cls(ends, pieces)

    def with_lead(self, breaks: Floats) -> Intervals:
        """Return the intervals after a lead, if pieces of the road start where they start."""
        start = self.ends[0, 0]
        at_start = breaks[np.abs(breaks - start) <= GAP_M]
        if not len(at_start) or start <= GAP_M:
            return self
        piece = at_start.min() - GAP_M / 2
        return Intervals(
            np.concatenate([[[start, start]], self.ends]),
            np.concatenate([[[piece, piece]], self.pieces]),
            has_lead=True,
        )

    def sampled(self, *, are_planes: bool) -> SurfaceSamples:
        """Return stations that measure the surface, in intervals that may be shorter.

        Of planes two samples in an interval show their steps.
        """
        if are_planes:
            return SurfaceSamples(self, self.samples(2))
        intervals = self._cut()
        return SurfaceSamples(intervals, intervals.samples(SAMPLES))

    def _cut(self) -> Intervals:
        """Return shorter intervals, whose samples show curvatures that change along the road."""
        spans = self.ends[:, 1] - self.ends[:, 0]
        if spans.max() <= _MAX_SAMPLED_M:
            return self
        counts = np.clip(np.ceil(spans / _MAX_SAMPLED_M), 1, _MAX_CUTS).astype(np.int64)
        interval_indices = np.repeat(np.arange(len(self)), counts)
        within = np.arange(len(interval_indices)) - np.repeat(np.cumsum(counts) - counts, counts)
        is_last = within + 1 == counts[interval_indices]
        lower = self.ends[interval_indices, 0] + spans[interval_indices] * (
            within / counts[interval_indices]
        )
        upper = np.where(is_last, self.ends[interval_indices, 1], np.append(lower[1:], 0.0))
        first = np.where(within == 0, self.pieces[interval_indices, 0], lower)
        last = np.where(is_last, self.pieces[interval_indices, 1], upper)
        return Intervals(
            np.stack([lower, upper], axis=1), np.stack([first, last], axis=1), self.has_lead
        )

    def __len__(self) -> int:
        return len(self.ends)

    def samples(self, count: int) -> RoadStations:
        """Return stations of each interval, (n * count,), from its start to its stop."""
        starts = self.ends[:, :1]
        s = starts + (self.ends[:, 1:] - starts) * np.linspace(0, 1, count)
        s[:, -1] = self.ends[:, 1]
        pieces = s.copy()
        pieces[:, 0] = self.pieces[:, 0]
        pieces[:, -1] = self.pieces[:, 1]
        return RoadStations(s.ravel(), pieces.ravel())

    def placed(self, counts: Ints, steps: Bools) -> PlacedStations:
        """Return stations that divide each interval into a number of parts.

        `steps` are True for intervals (n,) at whose stop the surface steps.
        """
        has_stop = steps.copy()
        has_stop[-1] = True
        counts = counts.copy()
        if self.has_lead:
            counts[0] = 0
        stations = counts + has_stop
        interval_indices = np.repeat(np.arange(len(counts)), stations)
        within = np.arange(len(interval_indices)) - np.repeat(
            np.cumsum(stations) - stations, stations
        )
        is_stop = within == counts[interval_indices]
        spans = self.ends[:, 1] - self.ends[:, 0]
        s = self.ends[interval_indices, 0] + spans[interval_indices] * (
            within / np.maximum(counts, 1)[interval_indices]
        )
        s[is_stop] = self.ends[interval_indices[is_stop], 1]
        pieces = np.where(within == 0, self.pieces[interval_indices, 0], s)
        pieces[is_stop] = self.pieces[interval_indices[is_stop], 1]
        return PlacedStations(RoadStations(s, pieces), np.flatnonzero(is_stop)[:-1])


class SampledSurface(NamedTuple):
    """A surface along a road at samples of intervals, which place its stations."""

    intervals: Intervals
    points: Floats  # (c, n * m, 3): columns of points, from right to left, at m samples each, m
    is_cell: Bools  # (c - 1,): whether there is a surface between a column and the next
    height_m: float  # tolerance of heights, m

    def is_step(self, sag_m: float) -> Bools:
        """Return True for the intervals (n,) at whose stop the surface steps."""
        count = len(self.intervals)
        if count < 2:
            return np.zeros(count, np.bool_)
        points = self.points.reshape(len(self.points), count, -1, 3)
        moves = points[:, 1:, 0] - points[:, :-1, -1]
        squares = (moves * moves).sum(axis=-1).max(axis=0, initial=0.0)
        return np.append(squares > (_STEP_SHARE * sag_m) ** 2, False)

    @property
    def is_measured(self) -> bool:
        """Whether the samples show curvatures: a plane has two samples in an interval."""
        return len(self.points) > 0 and self.points.shape[1] == SAMPLES * len(self.intervals)

    def parts(self) -> Iterator[SampledSurface]:
        """Yield the surface in parts of some intervals each, which take less memory."""
        count = len(self.points)
        points = self.points.reshape(count, len(self.intervals), -1, 3)
        step = max(1, _GROUP_SIZE // points[:, 0].size)
        for k in range(0, len(self.intervals), step):
            interval_range = slice(k, k + step)
            yield self._replace(
                intervals=Intervals(
                    self.intervals.ends[interval_range], self.intervals.pieces[interval_range]
                ),
                points=points[:, interval_range].reshape(count, -1, 3),
            )


def place_stations(
    surfaces: Sequence[SampledSurface], sag_m: float, allowance: Allowance, bytes_per_point: int
) -> list[PlacedStations]:
    """Return the stations of surfaces whose triangles are within a tolerance.

    Parameters
    ----------
    sag_m
        Tolerance in plan, m.
    bytes_per_point
        Memory that a point of the surfaces takes of the allowance, bytes.
    """
    surface_counts = _part_counts_in_groups(surfaces, sag_m)
    placed = []
    for surface in surfaces:
        counts = np.ones(len(surface.intervals))
        if surface.is_measured:
            counts = np.maximum(next(surface_counts), 1)
            columns = len(surface.points) + 2
            allowance.take((int(counts.sum()) + 2 * len(counts)) * columns * bytes_per_point)
        placed.append(
            surface.intervals.placed(np.ceil(counts).astype(np.int64), surface.is_step(sag_m))
        )
    return placed


def _part_counts_in_groups(surfaces: Sequence[SampledSurface], sag_m: float) -> Iterator[Floats]:
    """Yield the part counts of the surfaces that are measured, with the memory of few of them."""
    group: list[SampledSurface] = []
    size = 0
    for surface in surfaces:
        if surface.is_measured and surface.points.size > _GROUP_SIZE:
            yield from part_counts(group, sag_m)
            yield np.concatenate([part_counts([part], sag_m)[0] for part in surface.parts()])
            group = []
            size = 0
        elif surface.is_measured:
            group.append(surface)
            size += surface.points.size
            if size > _GROUP_SIZE:
                yield from part_counts(group, sag_m)
                group = []
                size = 0
    yield from part_counts(group, sag_m)


def part_counts(surfaces: Sequence[SampledSurface], sag_m: float) -> list[Floats]:
    """Return the numbers of parts (n,), not rounded, that the intervals of each surface need.

    Triangles between two cross sections differ from the surface by its bend along the road, which
    shrinks with the square of the distance, and by the twist between two columns, which shrinks
    with the distance. Both are measured in heights where the plan is the same: a curve whose chord
    is beside it by centimeters is also too high, by this times the slope across the road.
    """
    if not surfaces:
        return []
    points = np.concatenate([surface.points.reshape(-1, SAMPLES, 3) for surface in surfaces])
    x, y, z = np.moveaxis(points, -1, 0)
    columns = _Columns.from_surfaces(surfaces)
    beside, heights = _bend_errors(x, y, z, columns)
    twist = _twist_errors(x, y, z, columns)
    in_plan = np.sqrt(beside / (_MARGIN * sag_m))
    # Parts p for which heights / p² + twist / p is the tolerance.
    sizes = [len(surface.intervals) for surface in surfaces]
    tolerance = _MARGIN * np.repeat([surface.height_m for surface in surfaces], sizes)
    in_height = (twist + np.sqrt(twist * twist + 4 * heights * tolerance)) / (2 * tolerance)
    counts = np.nan_to_num(np.maximum(in_plan, in_height), nan=MAX_STEPS, posinf=MAX_STEPS)
    return np.split(np.minimum(counts, MAX_STEPS), np.cumsum(sizes)[:-1])


class _Columns(NamedTuple):
    """Columns of points of surfaces in intervals, one after another, and the cells between them."""

    size: int  # number of intervals
    intervals: Ints  # (r,): interval of each column
    right: Ints  # (q,): columns on the right of cells
    left: Ints  # (q,): columns on the left of cells

    @classmethod
    def from_surfaces(cls, surfaces: Sequence[SampledSurface]) -> _Columns:
        """Return the columns of surfaces."""
        intervals = []
        right = []
        left = []
        count = 0
        column_count = 0
        for surface in surfaces:
            size = len(surface.intervals)
            numbers = np.arange(size)
            intervals.append(np.tile(count + numbers, len(surface.points)))
            cells = (
                column_count + size * np.flatnonzero(surface.is_cell)[:, None] + numbers
            ).ravel()
            right.append(cells)
            left.append(cells + size)
            count += size
            column_count += size * len(surface.points)
        return cls(count, *(np.concatenate(arrays) for arrays in (intervals, right, left)))

    def largest_of_columns(self, values: Floats, ends: Floats) -> Floats:
        """Return the largest of values (r, k) of columns in each interval (n,), as `_largest`."""
        return self._largest(self.intervals, values, ends)

    def largest_of_cells(self, values: Floats, ends: Floats) -> Floats:
        """Return the largest of values (q, k) of cells in each interval (n,), as `_largest`."""
        return self._largest(self.intervals[self.right], values, ends)

    def _largest(self, intervals: Ints, values: Floats, ends: Floats) -> Floats:
        """Return the largest magnitude of the values in each of the n = `size` intervals: (n,).

        Row j of the values (m, k) has k samples along the interval `intervals[j]`, of (m,). `ends`
        (3,) are the weights of the first three values, which extrapolate to the start of the
        interval, and in reverse order of the last three, which extrapolate to its stop.
        """
        a, b, c = ends
        first = np.abs(a * values[:, 0] + b * values[:, 1] + c * values[:, 2])
        last = np.abs(a * values[:, -1] + b * values[:, -2] + c * values[:, -3])
        largest = np.maximum(np.abs(values).max(axis=1), np.maximum(first, last))
        result = np.zeros(self.size)
        np.maximum.at(result, intervals, largest)
        return result


def has_extent(points: Floats, faces: Ints) -> Bools:
    """Return False for triangles (f, 3) that are thinner than what the smallest step shows."""
    a, b, c = (points[faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    edges = np.stack([b - a, c - a, c - b])
    longest = (edges * edges).sum(axis=-1).max(axis=0)
    return np.asarray((normals * normals).sum(axis=-1) > (10 * GAP_M) ** 2 * longest)


def _bend_errors(x: Floats, y: Floats, z: Floats, columns: _Columns) -> tuple[Floats, Floats]:
    """Return the errors in plan and in height (n,) of triangles of whole intervals by bends."""
    # Half of the second differences, a quarter of the error of a whole interval: (r, 3).
    bends = [(v[:, 2:] + v[:, :-2]) / 2 - v[:, 1:-1] for v in (x, y, z)]
    along = [v[:, 2:] - v[:, :-2] for v in (x, y, z)]
    beside = columns.largest_of_columns(_beside(bends, along), _FROM_MIDDLE)
    sides = (columns.right, columns.left)
    across = [v[columns.left, 1:-1] - v[columns.right, 1:-1] for v in (x, y, z)]
    along_sides = [[v[column_indices] for v in along] for column_indices in sides]
    areas = [_cross(vectors, across) for vectors in along_sides]
    floor = np.maximum(np.abs(areas[0]), np.abs(areas[1])) / _MAX_STEEPENING
    is_wide = _is_wide(across)
    heights = np.zeros(columns.size)
    for column_indices, vectors, signed in zip(sides, along_sides, areas, strict=True):
        area = np.maximum(np.maximum(np.abs(signed), floor), 1e-30)
        errors = _determinant([v[column_indices] for v in bends], vectors, across) / area
        errors = np.where(is_wide, errors, 0.0)
        heights = np.maximum(heights, columns.largest_of_cells(errors, _FROM_MIDDLE))
    return 4 * beside, 4 * heights


def _twist_errors(x: Floats, y: Floats, z: Floats, columns: _Columns) -> Floats:
    """Return the errors in height (n,) of triangles by the twist of their cells."""
    along = [v[:, 1:] - v[:, :-1] for v in (x, y, z)]
    across = [(v[:, 1:] + v[:, :-1]) / 2 for v in (x, y, z)]
    across = [v[columns.left] - v[columns.right] for v in across]
    right, left = (
        [v[column_indices] for v in along] for column_indices in (columns.right, columns.left)
    )
    volumes = _determinant(right, across, left)
    areas = [_cross(right, across), _cross(left, across)]
    largest = np.maximum(np.abs(areas[0]), np.abs(areas[1]))
    # A cell that is folded where the road turns inside it has several heights at a position.
    folded = np.minimum(areas[0] * areas[1], 0) < -_FOLDED_SHARE * largest * largest
    floor = np.where(folded, largest, largest / _MAX_STEEPENING)
    errors = np.zeros_like(volumes)
    for share in _TWIST_SHARES:
        area = np.abs((1 - share) * areas[0] + share * areas[1])
        area = np.maximum(np.maximum(area, floor), 1e-30)
        errors = np.maximum(errors, 4 * share * (1 - share) * np.abs(volumes / area))
    return columns.largest_of_cells(np.where(_is_wide(across), errors, 0.0), _FROM_PARTS)


def _beside(bends: list[Floats], along: list[Floats]) -> Floats:
    """Return the parts of vectors in plan that are across their lines."""
    length = np.sqrt(along[0] * along[0] + along[1] * along[1])
    turned = np.abs(_cross(bends, along)) / np.maximum(length, 1e-30)
    # Lines that stand still in plan, where a road turns about them, have no direction.
    whole = np.sqrt(bends[0] * bends[0] + bends[1] * bends[1])
    return np.asarray(np.where(length > GAP_M, turned, whole))


def _cross(a: list[Floats], b: list[Floats]) -> Floats:
    """Return the upright components of vector products."""
    return np.asarray(a[0] * b[1] - a[1] * b[0])


def _determinant(a: list[Floats], b: list[Floats], c: list[Floats]) -> Floats:
    """Return the triple products of vectors."""
    return np.asarray(
        a[0] * (b[1] * c[2] - b[2] * c[1])
        + a[1] * (b[2] * c[0] - b[0] * c[2])
        + a[2] * (b[0] * c[1] - b[1] * c[0])
    )


def _is_wide(across: list[Floats]) -> Bools:
    """Return True for cells that are wide enough in plan to have a slope."""
    return np.asarray(across[0] * across[0] + across[1] * across[1] > _LEAST_WIDTH_M**2)
