"""A cloud in a PLY file, whose points stay on disk until they are selected."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..base.arrays import AnyArray, AnyFloats, Ints, Records
from ..base.sampling import even_indices
from .cloud import CHUNK_POINTS, Cloud
from .ply_format import AXES, mapped_rows
from .table import TABLE, Column


class CloudFile:
    """A cloud in PLY format, whose points stay on disk until they are selected.

    The file cannot store units, so `own` describes columns that are not in the table of columns, if
    that is known. LidarError if it cannot be read, or is not a point cloud of lidarpool.
    """

    def __init__(self, path: Path, own: Sequence[Column] = ()) -> None:
        self._rows = mapped_rows(path)
        dtype = self._rows.dtype
        self.table = _table(dtype, own)
        scans = self._rows["scan"] if "scan" in (dtype.names or ()) else np.empty(0, np.int32)
        some = scans[even_indices(len(scans), 100_000)]
        ordered = scans.dtype.kind in "iu" and bool((np.diff(some) >= 0).all())
        # First and last scan; (0, 0) if the points are not in scan order.
        self.scans = (int(scans[0]), int(scans[-1])) if ordered and len(scans) else (0, 0)

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def bounds(self) -> AnyFloats:
        """Lowest and highest coordinates, (2, 3), metres; all points are read for it."""
        each = [chunk.bounds for chunk in self.chunks()] or [np.zeros((2, 3))]
        lows, highs = zip(*each, strict=True)
        return np.stack([np.min(lows, axis=0), np.max(highs, axis=0)])

    def chunks(self, points: int = CHUNK_POINTS, first: int = 0) -> Iterator[Cloud]:
        """Yield the points in order, from row `first` on, at most so many at a time."""
        for start in range(first, len(self), points):
            yield self._cloud(self._rows[start : start + points])

    def choose(self, most: int) -> Cloud:
        """Select at most so many evenly spaced points, and of these the finite ones, in order."""
        rows = self._rows[even_indices(len(self), most)]
        known = np.isfinite(_positions(rows)).all(axis=1)
        return self._cloud(rows if known.all() else rows[known], np.float64)

    def row_of(self, scan: int) -> int:
        """Row of the first point of a scan, if the points are in the order of scans."""
        return bisect_left(self._rows["scan"], scan)

    def rows_of(self, scans: tuple[float, float]) -> tuple[int, int]:
        """First row of these scans and the first after them; all rows if not in scan order."""
        if self.scans[0] >= self.scans[1] or scans == self.scans:
            return 0, len(self)
        of = self._rows["scan"]
        return bisect_left(of, scans[0]), bisect_right(of, scans[1])

    def values(self, name: str, rows: Ints | slice) -> AnyArray:
        """Values of a column, or of x, y or z, in some rows; those of a slice stay on the disk."""
        files = {column.name: column.in_files for column in self.table}
        return np.asarray(self._rows[files.get(name, name)][rows])

    def _cloud(self, rows: Records, dtype: Any = None) -> Cloud:
        columns = {column.name: rows[column.in_files] for column in self.table}
        return Cloud(_positions(rows, dtype), columns, self.table)


def _positions(rows: Records, dtype: Any = None) -> AnyArray:
    return np.stack([rows[axis] for axis in AXES], axis=1, dtype=dtype)


def _table(row: np.dtype[np.void], own: Sequence[Column]) -> tuple[Column, ...]:
    """Columns of a file with such rows: those of the table, in its order, then the others."""
    names = [name for name in row.names or () if name not in AXES]
    known = [column for column in (*TABLE.values(), *own) if column.in_files in names]
    ours = {column.in_files for column in known}
    rest = [Column(n, row[n].str, "", "") for n in names if n not in ours and n.isidentifier()]
    return (*known, *rest)
