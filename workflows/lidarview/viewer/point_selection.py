"""Selects points of a cloud for a page: by scans, by columns, and for a camera."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from lidarsim.base.arrays import AnyArray, AnyFloats, Bools, Floats, Ints
from lidarsim.base.even_samples import even_indices
from lidarsim.columns.cloud import Cloud
from lidarsim.columns.cloud_file import CloudFile
from lidarsim.columns.ply_format import AXES
from lidarsim.columns.table import Column

RESULT = Column("result", "uint8", "", "result that contains the point", kind="label")
STATION = Column("station", "int64", "", "station from which the point was scanned", kind="label")
ScanRanges = tuple[tuple[int, int], ...]  # first and last scan of each range

BLOCK_ROWS = 1 << 15  # rows that are read at a time
_SAMPLE_POINTS = 200_000  # points for an estimate of the counts of tiles
_TILE_COLUMNS = 48
_TILE_ROWS = 27
TILES = _TILE_COLUMNS * _TILE_ROWS  # parts of a picture
_KEEP_SHARE = 0.8  # share of the points, each time there are too many


class HeldPoints:
    """Points in memory, in any order of their scans."""

    def __init__(self, cloud: Cloud) -> None:
        self._cloud = cloud
        self.table = cloud.table

    def __len__(self) -> int:
        return len(self._cloud)

    def values(self, name: str, row_selection: Ints | slice) -> AnyArray:
        """Return the values of a column at rows.

        Columns x, y and z are world coordinates.
        """
        if name in AXES:
            return np.asarray(self._cloud.positions[row_selection, AXES.index(name)])
        return self._cloud[name][row_selection]

    def rows_of(self, scans: tuple[float, float]) -> tuple[int, int]:
        """Return all rows."""
        return 0, len(self)


class OrderedPoints(HeldPoints):
    """All points of a recording in memory, in the order of their scans."""

    def rows_of(self, scans: tuple[float, float]) -> tuple[int, int]:
        """Return the first row of a range of scans, and one past its last row."""
        if "scan" not in self._cloud.columns:
            return super().rows_of(scans)
        first, last = scans
        column = self._cloud["scan"]
        start, stop = np.searchsorted(column, first), np.searchsorted(column, last, "right")
        return int(start), int(stop)


class JoinedPoints:
    """Points of several results in turn, with the columns that all results have."""

    table: tuple[Column, ...]

    def __init__(self, results: Sequence[Points]) -> None:
        self._firsts = np.cumsum([0, *map(len, results)])  # rows; the last is one past all
        # [(row of the first point, points of a result)]
        self.results = [*zip(self._firsts[:-1].tolist(), results, strict=True)]
        shared = set.intersection(*({column.name for column in result.table} for result in results))
        self.table = (*(entry for entry in results[0].table if entry.name in shared), RESULT)

    def __len__(self) -> int:
        return int(self._firsts[-1])

    def values(self, name: str, row_selection: Ints | slice) -> AnyArray:
        """Return the values of a column at ascending rows.

        Columns x, y and z are world coordinates.
        """
        if isinstance(row_selection, slice):
            row_selection = np.arange(*row_selection.indices(len(self)))
        bounds = np.searchsorted(row_selection, self._firsts)
        if name == RESULT.name:
            return np.repeat(np.arange(len(self.results), dtype=np.uint8), np.diff(bounds))
        pieces = zip(self.results, itertools.pairwise(bounds), strict=True)
        return np.concatenate(
            [part.values(name, row_selection[a:b] - first) for (first, part), (a, b) in pieces]
        )


@dataclass(frozen=True, eq=False)
class StationPoints:
    """Points with a further column, the station from which each point was scanned."""

    points: CloudFile | HeldPoints | JoinedPoints
    scans: Ints  # (n,): first scan of each sweep, ascending
    stations: Ints  # (n,): station of each sweep

    @property
    def table(self) -> tuple[Column, ...]:
        """Columns beside the positions."""
        return (*self.points.table, STATION)

    def __len__(self) -> int:
        return len(self.points)

    def values(self, name: str, row_selection: Ints | slice) -> AnyArray:
        """Return the values of a column at rows, as the points without the column do."""
        if name != STATION.name:
            return self.points.values(name, row_selection)
        scans = self.points.values("scan", row_selection)
        sweep = np.searchsorted(self.scans, scans, "right") - 1
        return np.asarray(self.stations[np.maximum(sweep, 0)])


Points = CloudFile | HeldPoints | JoinedPoints | StationPoints


def _row_ranges(points: Points, scans: ScanRanges) -> list[tuple[int, int]]:
    """Return the ranges of rows, start and stop, that contain ranges of scans."""
    if isinstance(points, StationPoints):
        return _row_ranges(points.points, scans)
    if isinstance(points, JoinedPoints):
        return sorted(
            (first + start, first + stop)
            for first, result in points.results
            for start, stop in _row_ranges(result, scans)
        )
    return sorted(points.rows_of(scan_range) for scan_range in scans)


@dataclass(frozen=True)
class Filter:
    """Filter: points whose columns are within limits, (column, lowest, highest) each.

    Limits of one column are joined when a filter is read, so that a long filter takes no longer
    than one limit of each column. `hidden` are values of columns that are left out.
    """

    limits: tuple[tuple[str, float, float], ...] = ()
    hidden: tuple[tuple[str, tuple[float, ...]], ...] = ()  # (column, values)

    @classmethod
    def read(cls, text: str, names: Sequence[str]) -> Filter:
        """Read limits of known columns from an address, such as ``column,lowest,highest``.

        Semicolons separate the columns.

        An entry ``!column,value,value`` leaves a value out. `names` are the known columns.
        ValueError if a limit is not a number.

        Examples
        --------
        >>> Filter.read("z,0,1.5;what,1,2", ["z"])
        Filter(limits=(('z', 0.0, 1.5),), hidden=())
        >>> Filter.read("z,0,1.5;z,1,2;!class,3,3", ["z", "class"])
        Filter(limits=(('z', 1.0, 1.5),), hidden=(('class', (3.0,)),))
        """
        hidden = dict[str, set[float]]()
        limits = dict[str, tuple[float, float]]()
        for entry in filter(None, text.split(";")):
            name, *texts = entry.rsplit(",", 2)
            lower, upper = map(float, texts)
            if math.isnan(lower) or math.isnan(upper):
                raise ValueError(f"{entry!r} has a limit that is not a number")
            if name.startswith("!"):
                hidden.setdefault(name[1:], set()).add(lower)
            elif name in names:
                lowest, highest = limits.get(name, (lower, upper))
                limits[name] = max(lower, lowest), min(upper, highest)
        return cls(
            tuple((name, *ends) for name, ends in limits.items()),
            tuple((name, tuple(sorted(hidden[name]))) for name in hidden if name in names),
        )

    def without(self, column: str) -> Filter:
        """Return the filter without what concerns a column."""
        return Filter(
            tuple(limit for limit in self.limits if limit[0] != column),
            tuple(values for values in self.hidden if values[0] != column),
        )

    def keeps(self, points: Points, row_selection: Ints | slice) -> Bools:
        """Return a mask (n,) of the points at rows that are within all limits."""
        x, y, z = (points.values(axis, row_selection) for axis in AXES)
        is_kept = np.asarray(np.isfinite(x + y + z))
        for name, lower, upper in self.limits:
            values = points.values(name, row_selection)
            is_kept &= (values >= lower) & (values <= upper)  # False for NaN
        for name, hidden_values in self.hidden:
            is_kept &= ~np.isin(points.values(name, row_selection), hidden_values)
        return is_kept


def read_scans(text: str) -> ScanRanges:
    """Read ranges of scans from an address, ``first-last,…``.

    Ranges that touch are joined.

    ValueError if the text is not such a list.

    Examples
    --------
    >>> read_scans("4-6,0-1,5-9,2-2")
    ((0, 2), (4, 9))
    """
    ranges: list[tuple[int, int]] = []
    pairs = (entry.split("-") for entry in text.split(",") if entry)
    for first, last in sorted((int(first), int(last)) for first, last in pairs):
        if ranges and first <= ranges[-1][1] + 1:
            ranges[-1] = ranges[-1][0], max(last, ranges[-1][1])
        elif first <= last:
            ranges.append((first, last))
    return tuple(ranges)


@dataclass(frozen=True, eq=False)
class Eye:
    """Camera of a browser: the matrix (4, 4) from local coordinates to clip coordinates."""

    matrix: Floats

    @classmethod
    def read(cls, text: str) -> Eye:
        """Read 16 numbers in the order of WebGL, column by column, else raise ValueError."""
        return cls(np.array([float(number) for number in text.split(",")]).reshape(4, 4).T.copy())

    def project(self, points: AnyFloats) -> tuple[AnyFloats, Bools]:
        """Project points (n, 3) to the picture, (n, 2) in -1 to 1, with a visibility mask."""
        x, y, z, w = self._clip(points)
        inside = (np.abs(x) < w) & (np.abs(y) < w) & (z > -w)
        return np.stack([x, y], axis=1) / np.where(inside, w, 1.0)[:, None], inside

    def _clip(self, points: AnyFloats) -> AnyFloats:
        """Return points (n, 3) in clip coordinates, (4, n)."""
        return np.asarray(self.matrix[:, :3] @ points.T + self.matrix[:, 3:])

    def tiles(self, points: AnyFloats) -> Ints:
        """Return the tile (n,) of the picture that each point (n, 3) is in, or -1 outside."""
        projected, inside = self.project(points)
        x_share, y_share = (np.clip(projected, -1, 0.9999).T + 1) / 2
        column = (x_share * _TILE_COLUMNS).astype(np.int64)
        row = (y_share * _TILE_ROWS).astype(np.int64)
        return np.where(inside, row * _TILE_COLUMNS + column, -1)

    def may_see(self, box: Floats) -> bool:
        """Return True if a box (2, 3) may be partly in the picture."""
        x, y, z, w = self._clip(corners_of(box))
        outside = (x > w, x < -w, y > w, y < -w, z < -w)
        return not any(bool(beyond.all()) for beyond in outside)


def corners_of(box: Floats) -> Floats:
    """Return the corners (8, 3) of a box (2, 3)."""
    return np.array(list(itertools.product(*box.T)))


def even_shares(counts: AnyArray, max_points: int) -> Floats:
    """Return the share (t,) of points that each tile shows, the same number of points in each.

    `counts` (t,) are the points of the tiles. A tile with fewer points shows all its points; all
    tiles together show `max_points`.
    """
    ordered = np.sort(counts)
    # All points of smaller tiles, and equally many points of each further tile.
    shares = (max_points - np.cumsum(ordered) + ordered) / np.arange(len(counts), 0, -1)
    level = shares[(shares <= ordered).argmax()] if ordered.sum() > max_points else np.inf
    return np.minimum(level / np.maximum(counts, 1e-9), 1.0)


def positions(points: Points, row_selection: Ints | slice) -> Floats:
    """Return the positions at rows, float64 (n, 3), world coordinates, meters."""
    # The matrix product of a camera is fastest on contiguous columns.
    return np.stack([points.values(axis, row_selection) for axis in AXES], dtype=np.float64).T


class Abandoned(Exception):  # noqa: N818 - no error: nobody waits for the answer any more
    """Raised when nobody waits for an answer any more."""


class PointFinder:
    """Selects points of a cloud.

    The finder remembers the bounding boxes of blocks that were read, 48 bytes each: 150 kB for a
    hundred million points. `origin` is the world position of the local origin, (3,).
    """

    def __init__(self, points: Points, origin: Floats) -> None:
        self.points = points
        self._origin = origin
        self._boxes = np.full(
            (-(-len(points) // BLOCK_ROWS), 2, 3), np.nan
        )  # NaN for unread blocks

    def find(
        self,
        max_points: int,
        point_filter: Filter = Filter(),
        scans: ScanRanges | None = None,
        eye: Eye | None = None,
        abandoned: Callable[[], bool] = lambda: False,
    ) -> tuple[Ints, int]:
        """Find at most `max_points` points that pass a filter, in order.

        The points are evenly spaced in the file; with an eye, all are in its picture and evenly
        spaced there. `abandoned` is called now and then; once it returns True, nobody waits for the
        answer.

        Returns
        -------
        rows
            int64 (k,), ascending.
        count
            Number of points that pass the filter, also outside the picture.

        Raises
        ------
        Abandoned
            If nobody waits for the answer.
        """
        ranges = [(0, len(self.points))]  # ranges of rows, first and after the last
        if scans is not None:
            ranges = _row_ranges(self.points, scans)
        total = sum(stop - start for start, stop in ranges)
        if point_filter == Filter() and (eye is None or total <= max_points):
            numbers = even_indices(total, max_points)
            offsets = np.cumsum([0, *(stop - start for start, stop in ranges)])[:-1]
            part = np.searchsorted(offsets, numbers, "right") - 1
            rows = numbers + (np.array([start for start, _ in ranges], np.int64) - offsets)[part]
            return rows[point_filter.keeps(self.points, rows)], total
        if eye is None:
            return self._search(ranges, max_points, point_filter, abandoned)
        sample, count = self.find(_SAMPLE_POINTS, point_filter, scans, None, abandoned)
        tiles = eye.tiles(self._local(sample))
        counts = np.bincount(tiles[tiles >= 0], minlength=TILES) * (count / max(len(sample), 1))
        if counts.sum() == 0:  # the sample may have missed rare points
            counts += 1
        rows, _ = self._search(
            ranges, max_points, point_filter, abandoned, eye, even_shares(counts, max_points)
        )
        return rows, count

    def _local(self, row_selection: Ints | slice) -> Floats:
        return positions(self.points, row_selection) - self._origin

    def _search(
        self,
        ranges: Sequence[tuple[int, int]],
        max_points: int,
        point_filter: Filter,
        abandoned: Callable[[], bool],
        eye: Eye | None = None,
        shares: Floats | None = None,
    ) -> tuple[Ints, int]:
        """Read blocks in turn, and thin the points out while there are too many.

        Arguments and results are as in `find`, with ranges of rows (start, stop), and the shares
        (tiles,) of the points that are kept in each tile of the eye's picture.
        """
        random = np.random.default_rng(0)
        thin = 1.0
        count = 0
        chunks = [np.empty(0, np.int64)]
        for start, stop in ranges:
            for block in range(start // BLOCK_ROWS, -(-stop // BLOCK_ROWS)):
                if abandoned():
                    raise Abandoned
                first = max(start, block * BLOCK_ROWS)
                last = min(stop, (block + 1) * BLOCK_ROWS)
                box = self._boxes[block]
                is_read = not np.isnan(box[0, 0])
                if eye is not None and is_read and not eye.may_see(box):
                    continue
                rows = first + np.flatnonzero(point_filter.keeps(self.points, slice(first, last)))
                count += len(rows)
                share = np.full(len(rows), thin)
                if eye is not None and shares is not None and len(rows):
                    local = self._local(rows)
                    is_whole_block = len(rows) == min(
                        BLOCK_ROWS, len(self.points) - block * BLOCK_ROWS
                    )
                    if is_whole_block and not is_read:
                        box[:] = local.min(axis=0), local.max(axis=0)
                    tiles = eye.tiles(local)
                    share *= np.where(tiles >= 0, shares[tiles], 0.0)
                chunks.append(rows[random.random(len(rows)) < share])
                while sum(map(len, chunks)) > max_points:
                    thin *= _KEEP_SHARE
                    joined = np.concatenate(chunks)
                    chunks = [joined[random.random(len(joined)) < _KEEP_SHARE]]
        return np.concatenate(chunks), count
