"""Height differences between overlapping strips, in the cells of a horizontal grid.

A plane is fitted to the points of each strip in each cell, so that slopes and different point
positions do not cause differences. Only sums over the points are stored, so the memory depends on
the number of cells.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from lidarfiles.clouds.recording import PointCloud, Recording
from lidarsim.columns.sweep import Sweep
from lidarsim.errors import LidarError
from lidarsim.motion.straight_lines import StraightLines
from lidarsim.numerics.arrays import Bools, Floats, Indices, Ints
from lidarsim.words import distinct_names, plural

from .deviations import Deviations, statistics
from .survey_clouds import SENSOR, SurveyCloud

SOURCE = "point_source_id"
_MIN_POINTS = 5  # minimum number of points per strip in a cell; three always lie on a plane
_MAX_ROWS = 12_000_000  # maximum number of cells of all strips, about 1.5 GB
_PENDING_ROWS = 4_000_000  # rows that are merged together
# Collinear points do not determine a plane, and planes are not extrapolated far. Both values are
# relative to the width of a cell.
_MIN_SPREAD = 0.1  # minimum standard deviation of the positions in every direction
_MAX_OFFSET = 0.3  # maximum distance between the mean positions of the points of two strips
_MAX_STRIPS = 1 << 16
_CELLS = 1 << 20  # maximum number of cells from the origin along each axis
# Sums over the points of a strip in a cell: number, dx, dy, h, dx², dx dy, dy², dx h, dy h, h²,
# where dx and dy are relative to the center of the cell.
_SUMS = 10


class _CellSums(NamedTuple):
    keys: Ints  # (n,): cell number and strip number
    sums: Floats  # (n, 10)


@dataclass(frozen=True)
class StripSettings:
    """Cells in which strips are compared."""

    cell_m: float
    max_roughness_m: float


class _Strips:
    """Names of strips, which are numbered in the order of their first points."""

    def __init__(self) -> None:
        self.numbers: dict[tuple[int, int, int], int] = {}  # by file, sensor and source

    def number_points(self, file: int, sensors: Ints, sources: Ints) -> Ints:
        """Return the number of the strip of each point."""
        joint, inverse = np.unique(
            np.stack([sensors, sources], axis=1), axis=0, return_inverse=True
        )
        numbers = [
            self.numbers.setdefault((file, sensor, source), len(self.numbers))
            for sensor, source in joint.tolist()
        ]
        if len(self.numbers) > _MAX_STRIPS:
            raise LidarError(
                f"The input contains more than {_MAX_STRIPS:,} strips. Compare fewer files at once."
            )
        return np.array(numbers, np.int64)[inverse.reshape(-1)]

    def names(self, clouds: Sequence[SurveyCloud]) -> list[str]:
        """Return the name of each strip, without parts that all strips have in common."""
        sensors = defaultdict(set)
        sources = defaultdict(set)
        for file, sensor, source in self.numbers:
            sensors[file].add(sensor)
            sources[file].add(source)
        file_names = distinct_names([cloud.name for cloud in clouds])
        names = []
        for file, sensor, source in self.numbers:
            parts = []
            if len(clouds) > 1:
                parts.append(file_names[file])
            if len(sensors[file]) > 1:
                parts.append(_sensor_name(clouds[file], sensor))
            if not parts or len(sources[file]) > 1:
                parts.append(str(source))
            names.append(" ".join(parts))
        return names


def _sensor_name(cloud: SurveyCloud, number: int) -> str:
    sweep = cloud.recordings[number][0]
    return sweep.sensor or f"sensor {number + 1}"


def strip_deviations(clouds: Sequence[SurveyCloud], settings: StripSettings) -> Deviations:
    """Return the height differences of all pairs of overlapping strips.

    Each difference is the height of the first strip minus that of the second, in one cell.

    Raises LidarError if there are fewer than two strips, or if no strips overlap.
    """
    grid = _Grid(settings.cell_m)
    for file, part, sources in _sourced_parts(clouds):
        grid.add(file, part, sources)
    if len(grid.strips.numbers) < 2:
        raise LidarError(
            f"The input contains {plural(len(grid.strips.numbers), 'strip')}, and at least two are "
            "required. Strips are different files, flight lines of a result, or points of .las "
            "files with different point source IDs."
        )
    names = grid.strips.names(clouds)
    cells = _merge_sums(grid.pending)
    overlap = _overlaps(cells, len(names), settings)
    if not len(overlap.difference_m):
        raise LidarError(
            f"The heights of the {len(names):,} strips cannot be compared. "
            + _why_incomparable(cells, overlap, settings)
        )
    figures = {
        "cell_m": settings.cell_m,
        "max_roughness_m": settings.max_roughness_m,
        "points": grid.point_count,
        "single_returns": grid.single_count,
        "strips": names,
        "rough_cells": overlap.rough,
        "overlaps": list(_pair_figures(overlap, names, settings.cell_m)),
    }
    centers = (overlap.cells + 0.5) * settings.cell_m + grid.origin[:2]
    places = np.column_stack([centers, np.zeros(len(centers))])
    return Deviations(places, {"delta_h": overlap.difference_m}, figures)


class _Grid:
    """Sums over the points of each strip in each cell."""

    def __init__(self, cell_m: float) -> None:
        self.cell_m = cell_m
        self.origin: Floats = np.zeros(3)  # lower corner of the cell of the first point
        self.strips = _Strips()
        self.pending: list[_CellSums] = []
        self._pending_rows = 0  # rows that were added since the last merge
        self.point_count = 0
        self.single_count = 0

    def add(self, file: int, part: Sweep, sources: Ints) -> None:
        """Add the single returns of a part. `sources` contains the source of each point."""
        self.point_count += len(part)
        single = _single_returns(part)
        if not len(single):
            return
        if not self.single_count:
            self.origin = np.floor(part.points[single[0]] / self.cell_m) * self.cell_m
        self.single_count += len(single)
        numbers = self.strips.number_points(file, part.columns[SENSOR][single], sources[single])
        sums = _cell_sums(part.points[single] - self.origin, numbers, self.cell_m)
        self.pending.append(sums)
        self._pending_rows += len(sums.keys)
        if self._pending_rows > _PENDING_ROWS:
            self.pending = [_merge_sums(self.pending)]
            self._pending_rows = 0


def _single_returns(part: Sweep) -> Indices:
    """Return the rows of points that are the only return of their pulse.

    If the number of returns is unknown, all rows are returned.
    """
    if "returns" not in part.columns:
        return np.arange(len(part))
    return np.flatnonzero(np.asarray(part.columns["returns"]) <= 1)


def _sourced_parts(clouds: Sequence[SurveyCloud]) -> Iterator[tuple[int, Sweep, Ints]]:
    """Yield each part with the index of its file and the source of each point."""
    for file, cloud in enumerate(clouds):
        lines = [_line_starts_ns(recording) for recording in cloud.recordings]
        for part in cloud.parts():
            sources = np.zeros(len(part), np.int64)
            if SOURCE in part.columns:
                sources += np.asarray(part.columns[SOURCE])
            elif part.time_ns is not None:  # a sweep, whose points belong to the same line
                starts_ns = lines[int(part.columns[SENSOR][0])]
                sources += max(int(np.searchsorted(starts_ns, part.time_ns, "right")), 1)
            yield file, part, sources


def _line_starts_ns(recording: Recording | PointCloud) -> Floats:
    """Return the times at which the flight lines of a recording start, in nanoseconds."""
    if isinstance(recording, PointCloud) or recording.stamps_ns is None or len(recording) < 2:
        return np.zeros(0)
    poses = recording.poses(range(len(recording)))
    if poses is None:
        return np.zeros(0)
    first = recording[0].time_ns
    times_ns = recording.stamps_ns - recording.stamps_ns[0] + (0.0 if first is None else first)
    lines = StraightLines.from_trajectory(times_ns / 1e9, poses[:, :3, 3])
    return lines.starts_s * 1e9


def _cell_sums(points: Floats, strips: Ints, cell_m: float) -> _CellSums:
    """Return sums over the points of each strip in each cell."""
    cells = np.floor(points[:, :2] / cell_m)
    if np.abs(cells).max() >= _CELLS:
        raise LidarError(
            f"The strips extend over more than {_CELLS:,} cells of {cell_m:g} m. Increase `--cell`."
        )
    offsets = points[:, :2] - (cells + 0.5) * cell_m
    column, row = cells.astype(np.int64).T + _CELLS
    keys = (((column << 21) | row) << 16) | strips
    x, y = offsets.T
    h = points[:, 2]
    terms = np.stack([np.ones(len(h)), x, y, h, x * x, x * y, y * y, x * h, y * h, h * h], axis=1)
    return _merge_sums([_CellSums(keys, terms)])


def _merge_sums(parts: Sequence[_CellSums]) -> _CellSums:
    """Add the sums with the same key, and sort them by key."""
    keys = np.concatenate([part.keys for part in parts])
    sums = np.concatenate([part.sums for part in parts])
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    starts = np.flatnonzero(np.diff(ordered, prepend=-1))
    if len(starts) > _MAX_ROWS:
        raise LidarError(
            f"The strips have more than {_MAX_ROWS:,} cells. Increase `--cell`, or compare fewer "
            "strips at once."
        )
    return _CellSums(ordered[starts], np.add.reduceat(sums[order], starts, axis=0))


class _CellPlanes(NamedTuple):
    """Planes of the strips in cells that have enough points."""

    cells: Ints  # (n,): key without the strip
    strips: Ints  # (n,)
    planes: Floats  # (n, 3): height at the center of the cell, and slopes along x and y
    means: Floats  # (n, 2): mean position of the points, relative to the center
    is_smooth: Bools  # (n,)


class _Overlap(NamedTuple):
    difference_m: Floats  # (n,): first strip minus second strip
    cells: Ints  # (n, 2): column and row
    first: Ints  # (n,): number of the first strip
    second: Ints  # (n,)
    rough: int  # number of comparisons, by cell and pair, that are omitted because of roughness


def _why_incomparable(cells: _CellSums, overlap: _Overlap, settings: StripSettings) -> str:
    """Return sentences that explain why strips have no cells in common that can be compared."""
    has_enough = cells.sums[:, 0] >= _MIN_POINTS
    size = f"cells of {settings.cell_m:g} m"
    if not _are_shared(cells.keys):
        return (
            f"No two strips have {size} in common. Check their coordinates, or increase `--cell`."
        )
    if not _are_shared(cells.keys[has_enough]):
        return (
            f"In {size}, there are fewer than {_MIN_POINTS} points of each strip. Increase "
            "`--cell`."
        )
    if overlap.rough:
        return (
            f"The points in {size} are rougher than {settings.max_roughness_m:g} m. Increase "
            "`--max-roughness`, or reduce `--cell`."
        )
    return f"The points are in a small part of {size}, or on a line. Reduce `--cell`."


def _are_shared(keys: Ints) -> bool:
    """Return whether there are keys of several strips in the same cell."""
    return len(np.unique(keys >> 16)) < len(keys)


def _cell_planes(cells: _CellSums, settings: StripSettings) -> _CellPlanes:
    """Fit planes by least squares in cells with enough points that are not collinear."""
    sums = cells.sums
    rows = np.flatnonzero(sums[:, 0] >= _MIN_POINTS)
    rows = rows[_smallest_spread(sums[rows]) >= _MIN_SPREAD * settings.cell_m]
    keys, sums = cells.keys[rows], sums[rows]
    # Columns of `_SUMS`: the normal equations of h = a + b dx + c dy.
    matrix = sums[:, [[0, 1, 2], [1, 4, 5], [2, 5, 6]]]
    right = sums[:, [3, 7, 8]]
    planes = np.asarray(np.linalg.solve(matrix, right[..., None])[..., 0], np.float64)
    squares = np.maximum(sums[:, 9] - np.einsum("ni,ni->n", planes, right), 0)
    roughness = np.sqrt(squares / (sums[:, 0] - 3))
    means: Floats = sums[:, 1:3] / sums[:, :1]
    is_smooth = roughness <= settings.max_roughness_m
    return _CellPlanes(keys >> 16, keys & 0xFFFF, planes, means, is_smooth)


def _smallest_spread(sums: Floats) -> Floats:
    """Return the smallest standard deviation of the positions in each cell over all directions."""
    n, x, y, _, xx, xy, yy = sums[:, :7].T
    a, b, c = (xx - x * x / n) / n, (xy - x * y / n) / n, (yy - y * y / n) / n
    smallest = (a + c) / 2 - np.hypot((a - c) / 2, b)  # eigenvalue of ((a, b), (b, c))
    return np.sqrt(np.maximum(smallest, 0))


def _overlaps(cells: _CellSums, count: int, settings: StripSettings) -> _Overlap:
    """Return the height differences of all pairs of strips in all cells."""
    planes = _cell_planes(cells, settings)
    a, b = _rows_of_pairs(planes.cells, count)
    apart = np.linalg.norm(planes.means[a] - planes.means[b], axis=1)
    near = apart <= _MAX_OFFSET * settings.cell_m
    smooth = planes.is_smooth[a] & planes.is_smooth[b]
    rough = int(np.count_nonzero(near & ~smooth))
    a, b = a[near & smooth], b[near & smooth]
    place = (planes.means[a] + planes.means[b]) / 2  # where neither plane is extrapolated far
    difference = planes.planes[a] - planes.planes[b]
    heights = difference[:, 0] + np.einsum("ni,ni->n", difference[:, 1:], place)
    key = planes.cells[a]
    columns_rows = np.stack([key >> 21, key & (2 * _CELLS - 1)], axis=1) - _CELLS
    return _Overlap(heights, columns_rows, planes.strips[a], planes.strips[b], rough)


def _rows_of_pairs(cells: Ints, count: int) -> tuple[Indices, Indices]:
    """Return the rows of all pairs of strips in the same cell. There are at most `count` strips.

    The cells are sorted.
    """
    rows = np.arange(len(cells))
    first: list[Indices] = [np.zeros(0, np.intp)]
    second: list[Indices] = [np.zeros(0, np.intp)]
    for step in range(1, count):
        same = rows[:-step][cells[step:] == cells[:-step]]
        if not len(same):
            break
        first.append(same)
        second.append(same + step)
    return np.concatenate(first), np.concatenate(second)


def _pair_figures(
    overlap: _Overlap, names: Sequence[str], cell_m: float
) -> Iterator[dict[str, Any]]:
    pair = overlap.first * len(names) + overlap.second
    order = np.argsort(pair, kind="stable")
    bounds = [*np.flatnonzero(np.diff(pair[order], prepend=-1)).tolist(), len(pair)]
    for start, stop in pairwise(bounds):
        rows = order[start:stop]
        yield {
            "a": names[int(overlap.first[rows[0]])],
            "b": names[int(overlap.second[rows[0]])],
            "area_m2": len(rows) * cell_m**2,
            **statistics(overlap.difference_m[rows]),
        }
