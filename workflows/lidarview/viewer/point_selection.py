"""Selects points of a cloud for a page: by scans, by columns, and for a camera."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lidarsim.base.arrays import AnyArray, AnyFloats, Bools, Floats, Ints
from lidarsim.base.sampling import even_indices
from lidarsim.columns.cloud import Cloud
from lidarsim.columns.cloud_file import CloudFile
from lidarsim.columns.ply_format import AXES
from lidarsim.columns.table import Column

RESULT = Column("result", "uint8", "", "result that the point is of", kind="label")
ScanRanges = tuple[tuple[int, int], ...]  # first and last scan of each range

BLOCK = 1 << 15  # rows that are read at a time
_FIRST_LOOK = 200_000  # points that tell how many are where in the picture
_ACROSS = 48
_DOWN = 27
TILES = _ACROSS * _DOWN  # parts of a picture
_KEPT = 0.8  # of the points, as often as they are too many


class HeldPoints:
    """Points in memory, in any order of their scans."""

    def __init__(self, cloud: Cloud) -> None:
        self._cloud = cloud
        self.table = cloud.table

    def __len__(self) -> int:
        return len(self._cloud)

    def values(self, name: str, rows: Ints | slice) -> AnyArray:
        """Values of a column, or of x, y or z in world coordinates, in some rows."""
        if name in AXES:
            return np.asarray(self._cloud.positions[rows, AXES.index(name)])
        return self._cloud[name][rows]

    def rows_of(self, scans: tuple[float, float]) -> tuple[int, int]:
        """Return all rows."""
        return 0, len(self)


class JoinedPoints:
    """Points of several results, one after the other, with the columns that all of them have."""

    table: tuple[Column, ...]

    def __init__(self, parts: Sequence[Points]) -> None:
        self._firsts = np.cumsum([0, *map(len, parts)])  # rows; the last is one past all
        self.parts = [*zip(self._firsts[:-1].tolist(), parts, strict=True)]
        shared = set.intersection(*({column.name for column in part.table} for part in parts))
        self.table = (*(one for one in parts[0].table if one.name in shared), RESULT)

    def __len__(self) -> int:
        return int(self._firsts[-1])

    def values(self, name: str, rows: Ints | slice) -> AnyArray:
        """Values of a column, or of x, y or z in world coordinates, in some rows, ascending."""
        if isinstance(rows, slice):
            rows = np.arange(*rows.indices(len(self)))
        ends = np.searchsorted(rows, self._firsts)
        if name == RESULT.name:
            return np.repeat(np.arange(len(self.parts), dtype=np.uint8), np.diff(ends))
        pieces = zip(self.parts, itertools.pairwise(ends), strict=True)
        return np.concatenate([of.values(name, rows[a:b] - at) for (at, of), (a, b) in pieces])


Points = CloudFile | HeldPoints | JoinedPoints


@dataclass(frozen=True)
class Filter:
    """Filter: points whose columns are within limits, (column, lowest, highest) each.

    Limits of one column are joined when a filter is read, so that a long filter takes no longer
    than one limit of each column.
    """

    limits: tuple[tuple[str, float, float], ...] = ()

    @classmethod
    def read(cls, text: str, names: Sequence[str]) -> Filter:
        """Read limits from an address, ``column,lowest,highest;…``; others are left out.

        ValueError if a limit is not a number.

        Examples
        --------
        >>> Filter.read("z,0,1.5;what,1,2", ["z"])
        Filter(limits=(('z', 0.0, 1.5),))
        >>> Filter.read("z,0,1.5;z,1,2", ["z"])
        Filter(limits=(('z', 1.0, 1.5),))
        """
        limits = dict[str, tuple[float, float]]()
        for entry in filter(None, text.split(";")):
            name, *ends = entry.rsplit(",", 2)
            low, high = map(float, ends)
            if math.isnan(low) or math.isnan(high):
                raise ValueError(f"{entry!r} has a limit that is not a number")
            if name in names:
                lowest, highest = limits.get(name, (low, high))
                limits[name] = max(low, lowest), min(high, highest)
        return cls(tuple((name, *ends) for name, ends in limits.items()))

    def keeps(self, points: Points, rows: Ints | slice) -> Bools:
        """Whether some points, (n,), are within all limits."""
        x, y, z = (points.values(axis, rows) for axis in AXES)
        kept = np.asarray(np.isfinite(x + y + z))
        for name, low, high in self.limits:
            values = points.values(name, rows)
            kept &= (values >= low) & (values <= high)  # NaN is not
        return kept


def read_scans(text: str) -> ScanRanges:
    """Read ranges of scans from an address, ``first-last,…``; ranges that touch are joined.

    ValueError if the text is no such list.

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
        """Read 16 numbers, column by column, as WebGL has them; ValueError if they are not."""
        return cls(np.array([float(number) for number in text.split(",")]).reshape(4, 4).T.copy())

    def seen(self, places: AnyFloats) -> tuple[AnyFloats, Bools]:
        """Project points (n, 3) to the picture, (n, 2) in -1 to 1, and whether they are in it."""
        x, y, z, w = self._clip(places)
        inside = (np.abs(x) < w) & (np.abs(y) < w) & (z > -w)
        return np.stack([x, y], axis=1) / np.where(inside, w, 1.0)[:, None], inside

    def _clip(self, places: AnyFloats) -> AnyFloats:
        """Points (n, 3) in clip coordinates, (4, n)."""
        return np.asarray(self.matrix[:, :3] @ places.T + self.matrix[:, 3:])

    def tiles(self, places: AnyFloats) -> Ints:
        """Part of the picture of each point (n, 3): (n,); -1 outside."""
        at, inside = self.seen(places)
        across, down = (np.clip(at, -1, 0.9999).T + 1) / 2
        column = (across * _ACROSS).astype(np.int64)
        row = (down * _DOWN).astype(np.int64)
        return np.where(inside, row * _ACROSS + column, -1)

    def may_see(self, box: Floats) -> bool:
        """Whether a box (2, 3) may be partly in the picture."""
        x, y, z, w = self._clip(corners_of(box))
        outside = (x > w, x < -w, y > w, y < -w, z < -w)
        return not any(bool(beyond.all()) for beyond in outside)


def corners_of(box: Floats) -> Floats:
    """Corners (8, 3) of a box (2, 3)."""
    return np.array(list(itertools.product(*box.T)))


def even_shares(counts: AnyArray, most: int) -> Floats:
    """Shares (t,) of the points (t,) of each part of a picture, so that each part shows as many.

    A part with fewer points shows all of them; they are `most` in all.
    """
    ordered = np.sort(counts)
    # All points of the parts before, and as many of each of the others.
    each = (most - np.cumsum(ordered) + ordered) / np.arange(len(counts), 0, -1)
    level = each[(each <= ordered).argmax()] if ordered.sum() > most else np.inf
    return np.minimum(level / np.maximum(counts, 1e-9), 1.0)


def positions(points: Points, rows: Ints | slice) -> Floats:
    """Positions of some rows, float64 (n, 3), world coordinates, metres."""
    # Columns one after the other are what the matrix product of a camera reads fastest.
    return np.stack([points.values(axis, rows) for axis in AXES], dtype=np.float64).T


class Abandoned(Exception):  # noqa: N818 - no error: nobody waits for the answer any more
    """Nobody waits for the points any more."""


class PointFinder:
    """Selects points of a cloud.

    It remembers the bounding boxes of the blocks that it has read, 48 bytes each: 150 kB for a
    hundred million points. `origin` is the world position of the local origin, (3,).
    """

    def __init__(self, points: Points, origin: Floats) -> None:
        self.points = points
        self._origin = origin
        self._boxes = np.full((-(-len(points) // BLOCK), 2, 3), np.nan)  # NaN for unread blocks

    def find(
        self,
        most: int,
        wanted: Filter = Filter(),
        scans: ScanRanges | None = None,
        eye: Eye | None = None,
        abandoned: Callable[[], bool] = lambda: False,
    ) -> tuple[Ints, int]:
        """Find at most `most` points that pass a filter, in order.

        They are evenly spaced in the file, or with an eye over its picture, where all are then.
        `abandoned` is asked now and then; once it returns True, nobody waits for the answer.

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
        ranges = [(0, len(self.points))]  # of rows, first and after the last
        if scans is not None:
            points = self.points
            parts: Sequence[tuple[int, Any]] = [(0, points)]
            if isinstance(points, JoinedPoints):
                parts = points.parts
            each = ((first, part.rows_of(one)) for first, part in parts for one in scans)
            ranges = sorted((first + low, first + high) for first, (low, high) in each)
        whole = sum(high - low for low, high in ranges)
        if not wanted.limits and (eye is None or whole <= most):
            numbers = even_indices(whole, most)
            before = np.cumsum([0, *(high - low for low, high in ranges)])[:-1]
            part = np.searchsorted(before, numbers, "right") - 1
            rows = numbers + (np.array([low for low, _ in ranges], np.int64) - before)[part]
            return rows[wanted.keeps(self.points, rows)], whole
        if eye is None:
            return self._search(ranges, most, wanted, abandoned)
        some, count = self.find(_FIRST_LOOK, wanted, scans, None, abandoned)
        tiles = eye.tiles(self._local(some))
        counts = np.bincount(tiles[tiles >= 0], minlength=TILES) * (count / max(len(some), 1))
        if counts.sum() == 0:  # the sample may have missed a few
            counts += 1
        rows, _ = self._search(ranges, most, wanted, abandoned, eye, even_shares(counts, most))
        return rows, count

    def _local(self, rows: Ints | slice) -> Floats:
        return positions(self.points, rows) - self._origin

    def _search(
        self,
        ranges: Sequence[tuple[int, int]],
        most: int,
        wanted: Filter,
        abandoned: Callable[[], bool],
        eye: Eye | None = None,
        shares: Floats | None = None,
    ) -> tuple[Ints, int]:
        """Read blocks one after the other; the points that are kept become fewer on the way."""
        random = np.random.default_rng(0)
        thin = 1.0
        found = 0
        kept = [np.empty(0, np.int64)]
        for low, high in ranges:
            for number in range(low // BLOCK, -(-high // BLOCK)):
                if abandoned():
                    raise Abandoned
                first = max(low, number * BLOCK)
                last = min(high, (number + 1) * BLOCK)
                box = self._boxes[number]
                is_read = not np.isnan(box[0, 0])
                if eye is not None and is_read and not eye.may_see(box):
                    continue
                rows = first + np.flatnonzero(wanted.keeps(self.points, slice(first, last)))
                found += len(rows)
                share = np.full(len(rows), thin)
                if eye is not None and shares is not None and len(rows):
                    places = self._local(rows)
                    whole = len(rows) == min(BLOCK, len(self.points) - number * BLOCK)
                    if whole and not is_read:
                        box[:] = places.min(axis=0), places.max(axis=0)
                    tiles = eye.tiles(places)
                    share *= np.where(tiles >= 0, shares[tiles], 0.0)
                kept.append(rows[random.random(len(rows)) < share])
                while sum(map(len, kept)) > most:
                    thin *= _KEPT
                    joined = np.concatenate(kept)
                    kept = [joined[random.random(len(joined)) < _KEPT]]
        return np.concatenate(kept), found
