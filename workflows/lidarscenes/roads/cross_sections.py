"""Place cross sections along roads so that the triangles between them are within a tolerance.

Everything that varies along a road is defined in pieces, and may step where a piece starts. At a
step, a station has values from either before or after the step, and a surface has both stations.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lidarsim.io.allowance import Allowance
from lidarsim.numerics.arrays import AnyArray, Bools, Floats, Ints

GAP_M = 1e-6  # starts of pieces that are closer together count as one
HEIGHT_SHARE = 0.1  # height tolerance as a fraction of the tolerance in plan
SAMPLES = 5  # points in an interval for measuring curvatures
_MAX_SAMPLED_M = 30.0  # maximum length of a sampled interval
_MAX_CUTS = 64  # maximum number of parts of a longer interval
MAX_STEPS = 1e9  # maximum number of parts of an interval, more than fit into memory
_GROUP_SIZE = 1 << 17  # number of coordinates that are measured together
_STEP_SHARE = 0.01  # smallest step that gets two stations, as a fraction of the tolerance in plan
_MARGIN = 0.94  # fraction of the tolerance to use, because samples underestimate the error
_LEAST_WIDTH_M = 1e-4  # narrower cells have no reliable slope across the road
_MAX_STEEPENING = 10.0  # limits slopes where a road turns about a point on its surface
_FOLDED_SHARE = 0.3  # cells that are folded by a larger fraction have no unique height
# Weights that extrapolate a parabola from three values by one sample and by half a sample.
_FROM_MIDDLE = np.array([3.0, -3.0, 1.0])
_FROM_PARTS = np.array([1.875, -1.25, 0.375])
_TWIST_SHARES = (0.1, 0.3, 0.5, 0.7, 0.9)  # positions across a cell for measuring its twist


@dataclass(frozen=True, eq=False)
class RoadStations:
    """Positions along a road.

    Attributes
    ----------
    s
        (k,) distances along the road in meters.
    pieces
        (k,) distances that select the pieces from which values are taken, in meters: `s`, or
        slightly less to select the piece before a step.
    """

    s: Floats
    pieces: Floats

    @classmethod
    def at(cls, distances: Floats) -> RoadStations:
        """Create stations at the given distances. At a step, they have the values after it."""
        return cls(distances, distances)

    def __len__(self) -> int:
        return len(self.s)

    def select(self, station_selection: AnyArray | slice) -> RoadStations:
        """Return the selected stations."""
        return RoadStations(self.s[station_selection], self.pieces[station_selection])


class SurfaceSamples(NamedTuple):
    """The stations at which a surface is measured, and the intervals that contain them."""

    intervals: Intervals
    stations: RoadStations


class PlacedStations(NamedTuple):
    """The stations at which a surface has its vertices."""

    stations: RoadStations
    steps: Ints  # (j,) stations before a step, where the next station has the same distance


@dataclass(frozen=True, eq=False)
class Intervals:
    """Intervals of a road within which each polynomial has a single piece.

    Attributes
    ----------
    ends
        (n, 2) starts and stops in meters.
    pieces
        (n, 2) distances that select the pieces for starts and stops, in meters.
    has_lead
        Whether the first interval has zero length. It then represents the end of the road before
        the surface, so that a surface can start with a step.
    """

    ends: Floats
    pieces: Floats
    has_lead: bool = False

    @classmethod
    def between(cls, start: float, stop: float, breaks: Floats) -> Intervals:
        """Divide the road between two distances into intervals.

        `breaks` (b,) are the distances at which pieces start.
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
            # The first and the last of the breaks that count as one.
            first = np.concatenate([inside[:1], inside[1:][is_far]])
            ends[1:, 0] = first
            ends[:-1, 1] = first
            pieces[:-1, 1] = first - GAP_M / 2
            pieces[1:, 0] = np.concatenate([inside[:-1][is_far], inside[-1:]])
        return cls(ends, pieces)

    def with_lead(self, breaks: Floats) -> Intervals:
        """If a piece of the road starts at the first distance, add an empty interval before it."""
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

    def surface_samples(self, *, are_planes: bool) -> SurfaceSamples:
        """Return the stations at which to measure the surface. Long intervals are divided first.

        In planes, two samples per interval are enough to detect steps.
        """
        if are_planes:
            return SurfaceSamples(self, self.samples(2))
        intervals = self._cut()
        return SurfaceSamples(intervals, intervals.samples(SAMPLES))

    def _cut(self) -> Intervals:
        """Divide long intervals so that samples capture curvatures that vary along the road."""
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
        """Return `count` evenly spaced stations in each interval.

        The result has shape (n * count,) and includes the start and the stop of each interval.
        """
        starts = self.ends[:, :1]
        s = starts + (self.ends[:, 1:] - starts) * np.linspace(0, 1, count)
        s[:, -1] = self.ends[:, 1]
        pieces = s.copy()
        pieces[:, 0] = self.pieces[:, 0]
        pieces[:, -1] = self.pieces[:, 1]
        return RoadStations(s.ravel(), pieces.ravel())

    def place(self, counts: Ints, steps: Bools) -> PlacedStations:
        """Divide each interval into the given number of parts, and return the stations.

        `steps` (n,) marks intervals at whose stop the surface has a step.
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
    """A surface along a road that is measured at samples."""

    intervals: Intervals
    points: Floats  # (c, n * m, 3) columns of points from right to left, at m samples each, meters
    is_cell: Bools  # (c - 1,) whether there is a surface between a column and the next one
    height_m: float  # height tolerance in meters

    def is_step(self, sag_m: float) -> Bools:
        """Return a mask of the intervals after which the surface has a step."""
        count = len(self.intervals)
        if count < 2:
            return np.zeros(count, np.bool_)
        points = self.points.reshape(len(self.points), count, -1, 3)
        moves = points[:, 1:, 0] - points[:, :-1, -1]
        squares = (moves * moves).sum(axis=-1).max(axis=0, initial=0.0)
        return np.append(squares > (_STEP_SHARE * sag_m) ** 2, False)

    @property
    def is_measured(self) -> bool:
        """Whether there are enough samples to measure curvatures.

        Planes have two samples per interval.
        """
        return len(self.points) > 0 and self.points.shape[1] == SAMPLES * len(self.intervals)

    def parts(self) -> Iterator[SampledSurface]:
        """Yield the surface in parts of a few intervals each, which need less memory."""
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
    """Place the stations of surfaces so that all triangles are within a tolerance.

    Parameters
    ----------
    surfaces
        The surfaces.
    sag_m
        Tolerance in plan in meters.
    allowance
        Memory that the points of the surfaces may occupy.
    bytes_per_point
        Memory per point in bytes.
    """
    surface_counts = _part_counts_in_groups(surfaces, sag_m)
    placed = []
    for surface in surfaces:
        counts = np.ones(len(surface.intervals))
        if surface.is_measured:
            counts = np.maximum(next(surface_counts), 1)
            columns = len(surface.points) + 2
            allowance.reserve((int(counts.sum()) + 2 * len(counts)) * columns * bytes_per_point)
        placed.append(
            surface.intervals.place(np.ceil(counts).astype(np.int64), surface.is_step(sag_m))
        )
    return placed


def _part_counts_in_groups(surfaces: Sequence[SampledSurface], sag_m: float) -> Iterator[Floats]:
    """Yield the `part_counts` of each measured surface, processing a few surfaces at a time."""
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
    """Determine into how many parts to divide each interval of each surface.

    The numbers are not rounded. Triangles between two cross sections deviate from the surface for
    two reasons. These are the bend along the road, which decreases with the square of the distance,
    and the twist between two columns, which decreases with the distance. Both are measured as
    height differences at the same position in plan, because a chord beside a curve is also too high
    or too low on a road that slopes sideways.
    """
    if not surfaces:
        return []
    points = np.concatenate([surface.points.reshape(-1, SAMPLES, 3) for surface in surfaces])
    x, y, z = np.moveaxis(points, -1, 0)
    columns = _Columns.from_surfaces(surfaces)
    beside, heights = _bend_errors(x, y, z, columns)
    twist = _twist_errors(x, y, z, columns)
    in_plan = np.sqrt(beside / (_MARGIN * sag_m))
    # Solve heights / p² + twist / p = tolerance for the number of parts p.
    sizes = [len(surface.intervals) for surface in surfaces]
    tolerance = _MARGIN * np.repeat([surface.height_m for surface in surfaces], sizes)
    in_height = (twist + np.sqrt(twist * twist + 4 * heights * tolerance)) / (2 * tolerance)
    counts = np.nan_to_num(np.maximum(in_plan, in_height), nan=MAX_STEPS, posinf=MAX_STEPS)
    return np.split(np.minimum(counts, MAX_STEPS), np.cumsum(sizes)[:-1])


class _Columns(NamedTuple):
    """Columns of points on several surfaces, with their intervals, and the cells between them."""

    size: int  # number of intervals
    intervals: Ints  # (r,) interval of each column
    right: Ints  # (q,) columns on the right of cells
    left: Ints  # (q,) columns on the left of cells

    @classmethod
    def from_surfaces(cls, surfaces: Sequence[SampledSurface]) -> _Columns:
        """Assign consecutive numbers to the columns and cells of all surfaces."""
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
        """Return the largest column value in each interval. See `_largest`."""
        return self._largest(self.intervals, values, ends)

    def largest_of_cells(self, values: Floats, ends: Floats) -> Floats:
        """Return the largest cell value in each interval. See `_largest`."""
        return self._largest(self.intervals[self.right], values, ends)

    def _largest(self, intervals: Ints, values: Floats, ends: Floats) -> Floats:
        """Return the largest magnitude of the values in each interval.

        Row j of the values (m, k) contains k samples along the interval `intervals[j]`. The weights
        `ends` (3,) extrapolate the first three values to the start of the interval and, in reverse
        order, the last three values to its stop.
        """
        a, b, c = ends
        first = np.abs(a * values[:, 0] + b * values[:, 1] + c * values[:, 2])
        last = np.abs(a * values[:, -1] + b * values[:, -2] + c * values[:, -3])
        largest = np.maximum(np.abs(values).max(axis=1), np.maximum(first, last))
        result = np.zeros(self.size)
        np.maximum.at(result, intervals, largest)
        return result


def has_extent(points: Floats, faces: Ints) -> Bools:
    """Return a mask of the triangles that are not degenerate."""
    a, b, c = (points[faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    edges = np.stack([b - a, c - a, c - b])
    longest = (edges * edges).sum(axis=-1).max(axis=0)
    return np.asarray((normals * normals).sum(axis=-1) > (10 * GAP_M) ** 2 * longest)


def _bend_errors(x: Floats, y: Floats, z: Floats, columns: _Columns) -> tuple[Floats, Floats]:
    """Return the errors in plan and in height that bends cause in undivided intervals."""
    # Half of the second differences (r, 3), a quarter of the error of an undivided interval.
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
    """Return the height errors that twisted cells cause."""
    along = [v[:, 1:] - v[:, :-1] for v in (x, y, z)]
    across = [(v[:, 1:] + v[:, :-1]) / 2 for v in (x, y, z)]
    across = [v[columns.left] - v[columns.right] for v in across]
    right, left = (
        [v[column_indices] for v in along] for column_indices in (columns.right, columns.left)
    )
    volumes = _determinant(right, across, left)
    areas = [_cross(right, across), _cross(left, across)]
    largest = np.maximum(np.abs(areas[0]), np.abs(areas[1]))
    # Where a road turns inside a cell, the cell is folded and has several heights at a position.
    folded = np.minimum(areas[0] * areas[1], 0) < -_FOLDED_SHARE * largest * largest
    floor = np.where(folded, largest, largest / _MAX_STEEPENING)
    errors = np.zeros_like(volumes)
    for fraction in _TWIST_SHARES:
        area = np.abs((1 - fraction) * areas[0] + fraction * areas[1])
        area = np.maximum(np.maximum(area, floor), 1e-30)
        errors = np.maximum(errors, 4 * fraction * (1 - fraction) * np.abs(volumes / area))
    return columns.largest_of_cells(np.where(_is_wide(across), errors, 0.0), _FROM_PARTS)


def _beside(bends: list[Floats], along: list[Floats]) -> Floats:
    """Return the components of vectors that are perpendicular to lines in plan."""
    length = np.sqrt(along[0] * along[0] + along[1] * along[1])
    turned = np.abs(_cross(bends, along)) / np.maximum(length, 1e-30)
    # A line that does not move in plan, because the road turns about it, has no direction.
    whole = np.sqrt(bends[0] * bends[0] + bends[1] * bends[1])
    return np.asarray(np.where(length > GAP_M, turned, whole))


def _cross(a: list[Floats], b: list[Floats]) -> Floats:
    """Return the vertical component of each cross product."""
    return np.asarray(a[0] * b[1] - a[1] * b[0])


def _determinant(a: list[Floats], b: list[Floats], c: list[Floats]) -> Floats:
    """Return the scalar triple product of each three vectors."""
    return np.asarray(
        a[0] * (b[1] * c[2] - b[2] * c[1])
        + a[1] * (b[2] * c[0] - b[0] * c[2])
        + a[2] * (b[0] * c[1] - b[1] * c[0])
    )


def _is_wide(across: list[Floats]) -> Bools:
    """Return a mask of the cells that are wide enough in plan for a slope to be defined."""
    return np.asarray(across[0] * across[0] + across[1] * across[1] > _LEAST_WIDTH_M**2)
