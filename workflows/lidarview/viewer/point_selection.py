"""Select the points of a cloud to display, by scans, column values, and camera."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from lidarsim.columns.cloud import Cloud
from lidarsim.columns.cloud_file import CloudFile
from lidarsim.columns.ply_format import AXES
from lidarsim.columns.table import Column
from lidarsim.numerics.arrays import AnyArray, AnyFloats, Bools, Floats, Ints
from lidarsim.numerics.even_samples import even_indices

RESULT = Column("result", "uint8", "", "result that contains the point", kind="label")
STATION = Column("station", "int64", "", "station from which the point was scanned", kind="label")
ScanRanges = tuple[tuple[int, int], ...]  # first and last scan of each range

BLOCK_ROWS = 1 << 15  # rows that are read at a time
_SAMPLE_POINTS = 200_000  # number of points for estimating the number of points in each tile
_TILE_COLUMNS = 48
_TILE_ROWS = 27
TILES = _TILE_COLUMNS * _TILE_ROWS  # number of tiles of an image
_KEEP_SHARE = 0.8  # fraction of the points that is kept whenever there are too many


class InMemoryPoints:
    """Points in memory that are not ordered by scan."""

    def __init__(self, cloud: Cloud) -> None:
        self._cloud = cloud
        self.table = cloud.table

    def __len__(self) -> int:
        return len(self._cloud)

    def values(self, name: str, row_selection: Ints | slice) -> AnyArray:
        """Return the values of a column in the selected rows.

        The columns x, y, and z are world coordinates.
        """
        if name in AXES:
            return np.asarray(self._cloud.positions[row_selection, AXES.index(name)])
        return self._cloud[name][row_selection]

    def rows_of(self, scans: tuple[float, float]) -> tuple[int, int]:
        """Return the range of all rows, because the points are not ordered by scan."""
        return 0, len(self)


class ScanOrderedPoints(InMemoryPoints):
    """Points in memory that are ordered by scan."""

    def rows_of(self, scans: tuple[float, float]) -> tuple[int, int]:
        """Return the start and stop rows of the scans from first to last.

        Without a scan column, the range contains all rows.
        """
        if "scan" not in self._cloud.columns:
            return super().rows_of(scans)
        first, last = scans
        column = self._cloud["scan"]
        start, stop = np.searchsorted(column, first), np.searchsorted(column, last, "right")
        return int(start), int(stop)


class JoinedPoints:
    """The concatenated points of several results, with the columns that all results share.

    The column `RESULT` is added.
    """

    table: tuple[Column, ...]

    def __init__(self, results: Sequence[Points]) -> None:
        # First row of each result, followed by the total number of rows.
        self._firsts = np.cumsum([0, *map(len, results)])
        # (first row, points) of each result
        self.results = [*zip(self._firsts[:-1].tolist(), results, strict=True)]
        shared = set.intersection(*({column.name for column in result.table} for result in results))
        self.table = (*(entry for entry in results[0].table if entry.name in shared), RESULT)

    def __len__(self) -> int:
        return int(self._firsts[-1])

    def values(self, name: str, row_selection: Ints | slice) -> AnyArray:
        """Return the values of a column in the selected rows, which must be in ascending order.

        The columns x, y, and z are world coordinates.
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
    """Points with an additional column for the station of each point."""

    points: CloudFile | InMemoryPoints | JoinedPoints
    scans: Ints  # (n,) first scan of each sweep, ascending
    stations: Ints  # (n,) station of each sweep

    @property
    def table(self) -> tuple[Column, ...]:
        """Columns in addition to the positions."""
        return (*self.points.table, STATION)

    def __len__(self) -> int:
        return len(self.points)

    def values(self, name: str, row_selection: Ints | slice) -> AnyArray:
        """Return the values of a column in the selected rows."""
        if name != STATION.name:
            return self.points.values(name, row_selection)
        scans = self.points.values("scan", row_selection)
        sweep = np.searchsorted(self.scans, scans, "right") - 1
        return np.asarray(self.stations[np.maximum(sweep, 0)])


Points = CloudFile | InMemoryPoints | JoinedPoints | StationPoints


def _row_ranges(points: Points, scans: ScanRanges) -> list[tuple[int, int]]:
    """Return the start and stop rows of each range of scans."""
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
class PointFilter:
    """A filter that keeps points whose column values are within limits.

    If a column has several limits, they are combined when the filter is parsed. A long filter
    therefore takes no longer to apply than a single limit per column.

    Attributes
    ----------
    limits
        (column, lowest, highest) for each limited column, inclusive.
    hidden
        (column, values) for each column with excluded values.
    """

    limits: tuple[tuple[str, float, float], ...] = ()
    hidden: tuple[tuple[str, tuple[float, ...]], ...] = ()  # (column, values)

    @classmethod
    def parse(cls, text: str, names: Sequence[str]) -> PointFilter:
        """Parse a filter from the query of a URL.

        The entries are separated by semicolons. ``column,lowest,highest`` limits a column, and
        ``!column,value,value`` excludes a value, which is written twice. Columns that are not in
        `names` are ignored.

        Raises
        ------
        ValueError
            If a limit is not a number.

        Examples
        --------
        >>> PointFilter.parse("z,0,1.5;what,1,2", ["z"])
        PointFilter(limits=(('z', 0.0, 1.5),), hidden=())
        >>> PointFilter.parse("z,0,1.5;z,1,2;!class,3,3", ["z", "class"])
        PointFilter(limits=(('z', 1.0, 1.5),), hidden=(('class', (3.0,)),))
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

    def without_column(self, column: str) -> PointFilter:
        """Return the filter without the limits and excluded values of a column."""
        return PointFilter(
            tuple(limit for limit in self.limits if limit[0] != column),
            tuple(values for values in self.hidden if values[0] != column),
        )

    def mask(self, points: Points, row_selection: Ints | slice) -> Bools:
        """Return a mask of those selected rows that pass the filter.

        Rows with nonfinite positions do not pass.
        """
        x, y, z = (points.values(axis, row_selection) for axis in AXES)
        is_kept = np.asarray(np.isfinite(x + y + z))
        for name, lower, upper in self.limits:
            values = points.values(name, row_selection)
            is_kept &= (values >= lower) & (values <= upper)  # False for NaN
        for name, hidden_values in self.hidden:
            is_kept &= ~np.isin(points.values(name, row_selection), hidden_values)
        return is_kept


def parse_scans(text: str) -> ScanRanges:
    """Parse ranges of scans such as ``4-6,0-1`` in a URL query, merging adjacent ranges.

    Raises
    ------
    ValueError
        If the text is not a list of ranges.

    Examples
    --------
    >>> parse_scans("4-6,0-1,5-9,2-2")
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
class BrowserCamera:
    """The camera of a page, as a 4 x 4 matrix from local coordinates to clip coordinates."""

    matrix: Floats

    @classmethod
    def parse(cls, text: str) -> BrowserCamera:
        """Parse 16 numbers in the column-major order of WebGL.

        Raises
        ------
        ValueError
            If the text does not consist of 16 numbers.
        """
        return cls(np.array([float(number) for number in text.split(",")]).reshape(4, 4).T.copy())

    def project(self, points: AnyFloats) -> tuple[AnyFloats, Bools]:
        """Project points to image coordinates from -1 to 1.

        Returns the coordinates (n, 2) and a mask (n,) of the points inside the image.
        """
        x, y, z, w = self._clip(points)
        inside = (np.abs(x) < w) & (np.abs(y) < w) & (z > -w)
        return np.stack([x, y], axis=1) / np.where(inside, w, 1.0)[:, None], inside

    def _clip(self, points: AnyFloats) -> AnyFloats:
        return np.asarray(self.matrix[:, :3] @ points.T + self.matrix[:, 3:])

    def tiles(self, points: AnyFloats) -> Ints:
        """Return the image tile of each point, or -1 for points outside the image."""
        projected, inside = self.project(points)
        x_fraction, y_fraction = (np.clip(projected, -1, 0.9999).T + 1) / 2
        column = (x_fraction * _TILE_COLUMNS).astype(np.int64)
        row = (y_fraction * _TILE_ROWS).astype(np.int64)
        return np.where(inside, row * _TILE_COLUMNS + column, -1)

    def may_see(self, box: Floats) -> bool:
        """Return whether a box may be inside the image.

        The result is False only if the box is certainly outside.
        """
        x, y, z, w = self._clip(box_corners(box))
        outside = (x > w, x < -w, y > w, y < -w, z < -w)
        return not any(bool(beyond.all()) for beyond in outside)


def box_corners(box: Floats) -> Floats:
    """Return the corners of a box.

    The shape is (8, 3).
    """
    return np.array(list(itertools.product(*box.T)))


def even_shares(counts: AnyArray, max_points: int) -> Floats:
    """Return the fraction of points to show in each tile so that all tiles show equally many.

    Tiles with fewer points show all of them. All tiles together show `max_points`. `counts` and the
    result have shape (t,).
    """
    ordered = np.sort(counts)
    # Show all points of the smaller tiles, and equally many points of each larger tile.
    fractions = (max_points - np.cumsum(ordered) + ordered) / np.arange(len(counts), 0, -1)
    level = fractions[(fractions <= ordered).argmax()] if ordered.sum() > max_points else np.inf
    return np.minimum(level / np.maximum(counts, 1e-9), 1.0)


def read_positions(points: Points, row_selection: Ints | slice) -> Floats:
    """Return the positions in the selected rows as float64 world coordinates."""
    # The matrix product in a camera is fastest on contiguous columns.
    return np.stack([points.values(axis, row_selection) for axis in AXES], dtype=np.float64).T


class ClientDisconnected(Exception):  # noqa: N818 - not an error
    """Error raised when the client that requested an answer has disconnected."""


class PointFinder:
    """Search for points of a cloud that pass a filter.

    The finder stores the bounding boxes of the blocks that it has read, which takes 48 bytes per
    block, or 150 kB for a hundred million points.

    Parameters
    ----------
    points
        The points.
    origin
        (3,) world position of the local origin.
    """

    def __init__(self, points: Points, origin: Floats) -> None:
        self.points = points
        self._origin = origin
        self._boxes = np.full(
            (-(-len(points) // BLOCK_ROWS), 2, 3), np.nan
        )  # NaN for unread blocks

    def find_points(
        self,
        max_points: int,
        point_filter: PointFilter = PointFilter(),
        scans: ScanRanges | None = None,
        camera: BrowserCamera | None = None,
        is_disconnected: Callable[[], bool] = lambda: False,
    ) -> tuple[Ints, int]:
        """Find at most `max_points` points that pass a filter.

        Without a camera, the points are evenly spaced in the file. With a camera, all points are
        inside its image and are evenly spaced there.

        Parameters
        ----------
        max_points
            Maximum number of points.
        point_filter
            The filter.
        scans
            Ranges of scans, or None for all.
        camera
            The camera, or None.
        is_disconnected
            Called from time to time. If it returns True, the search ends.

        Returns
        -------
        rows
            (k,) row indices, int64, ascending.
        count
            Number of points that pass the filter, including those outside the image.

        Raises
        ------
        ClientDisconnected
            If `is_disconnected` has returned True.
        """
        ranges = [(0, len(self.points))]  # ranges of rows, start and stop
        if scans is not None:
            ranges = _row_ranges(self.points, scans)
        total = sum(stop - start for start, stop in ranges)
        if point_filter == PointFilter() and (camera is None or total <= max_points):
            numbers = even_indices(total, max_points)
            offsets = np.cumsum([0, *(stop - start for start, stop in ranges)])[:-1]
            part = np.searchsorted(offsets, numbers, "right") - 1
            rows = numbers + (np.array([start for start, _ in ranges], np.int64) - offsets)[part]
            return rows[point_filter.mask(self.points, rows)], total
        if camera is None:
            return self._search(ranges, max_points, point_filter, is_disconnected)
        sample, count = self.find_points(_SAMPLE_POINTS, point_filter, scans, None, is_disconnected)
        tiles = camera.tiles(self._local(sample))
        counts = np.bincount(tiles[tiles >= 0], minlength=TILES) * (count / max(len(sample), 1))
        if counts.sum() == 0:  # the sample may have missed rare points
            counts += 1
        rows, _ = self._search(
            ranges,
            max_points,
            point_filter,
            is_disconnected,
            camera,
            even_shares(counts, max_points),
        )
        return rows, count

    def _local(self, row_selection: Ints | slice) -> Floats:
        return read_positions(self.points, row_selection) - self._origin

    def _search(
        self,
        ranges: Sequence[tuple[int, int]],
        max_points: int,
        point_filter: PointFilter,
        is_disconnected: Callable[[], bool],
        camera: BrowserCamera | None = None,
        shares: Floats | None = None,
    ) -> tuple[Ints, int]:
        """Read blocks one after another, thinning out the points whenever there are too many.

        `ranges` are ranges of rows, start and stop. `shares` (tiles,) are the fractions of points
        to keep in each tile of the camera's image. The other parameters and the results are the
        same as in `find_points`.
        """
        random = np.random.default_rng(0)
        thin = 1.0
        count = 0
        chunks = [np.empty(0, np.int64)]
        for start, stop in ranges:
            for block in range(start // BLOCK_ROWS, -(-stop // BLOCK_ROWS)):
                if is_disconnected():
                    raise ClientDisconnected
                first = max(start, block * BLOCK_ROWS)
                last = min(stop, (block + 1) * BLOCK_ROWS)
                box = self._boxes[block]
                is_read = not np.isnan(box[0, 0])
                if camera is not None and is_read and not camera.may_see(box):
                    continue
                rows = first + np.flatnonzero(point_filter.mask(self.points, slice(first, last)))
                count += len(rows)
                fraction = np.full(len(rows), thin)
                if camera is not None and shares is not None and len(rows):
                    local = self._local(rows)
                    is_whole_block = len(rows) == min(
                        BLOCK_ROWS, len(self.points) - block * BLOCK_ROWS
                    )
                    if is_whole_block and not is_read:
                        box[:] = local.min(axis=0), local.max(axis=0)
                    tiles = camera.tiles(local)
                    fraction *= np.where(tiles >= 0, shares[tiles], 0.0)
                chunks.append(rows[random.random(len(rows)) < fraction])
                while sum(map(len, chunks)) > max_points:
                    thin *= _KEEP_SHARE
                    joined = np.concatenate(chunks)
                    chunks = [joined[random.random(len(joined)) < _KEEP_SHARE]]
        return np.concatenate(chunks), count
