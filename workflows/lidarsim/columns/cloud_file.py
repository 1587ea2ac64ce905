"""Point clouds in PLY files, whose points are read from disk only when they are selected."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..numerics.arrays import AnyArray, AnyFloats, Ints, Records
from ..numerics.even_samples import even_indices
from .cloud import CHUNK_POINTS, Cloud
from .ply_format import AXES, map_rows
from .table import TABLE, Column


class CloudFile:
    """A cloud in a PLY file, whose points are read from disk only when they are selected.

    Parameters
    ----------
    path
        PLY file written by lidarpool.
    custom_columns
        Descriptions of columns that are not in `lidarsim.columns.table`, if known. A PLY file
        cannot store them.

    Raises
    ------
    LidarError
        If the file cannot be read or is not a point cloud written by lidarpool.
    """

    def __init__(self, path: Path, custom_columns: Sequence[Column] = ()) -> None:
        self._rows = map_rows(path)
        dtype = self._rows.dtype
        self.table = _table(dtype, custom_columns)
        scans = self._rows["scan"] if "scan" in (dtype.names or ()) else np.empty(0, np.int32)
        sampled_scans = scans[even_indices(len(scans), 100_000)]
        ordered = scans.dtype.kind in "iu" and bool((np.diff(sampled_scans) >= 0).all())
        # First and last scan, or (0, 0) if the points are not ordered by scan.
        self.scans = (int(scans[0]), int(scans[-1])) if ordered and len(scans) else (0, 0)

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def bounds(self) -> AnyFloats:
        """Minimum and maximum coordinates in meters.

        The shape is (2, 3). Computing the bounds reads all points.
        """
        chunk_bounds = [chunk.bounds for chunk in self.chunks()] or [np.zeros((2, 3))]
        lows, highs = zip(*chunk_bounds, strict=True)
        return np.stack([np.min(lows, axis=0), np.max(highs, axis=0)])

    def chunks(self, points: int = CHUNK_POINTS, first: int = 0) -> Iterator[Cloud]:
        """Yield clouds of at most `points` consecutive points, starting at row `first`."""
        for start in range(first, len(self), points):
            yield self._cloud(self._rows[start : start + points])

    def choose(self, max_points: int) -> Cloud:
        """Select at most `max_points` evenly spaced points, omitting those that are not finite."""
        rows = self._rows[even_indices(len(self), max_points)]
        finite = np.isfinite(_positions(rows)).all(axis=1)
        return self._cloud(rows if finite.all() else rows[finite], np.float64)

    def row_of(self, scan: int) -> int:
        """Return the row of the first point in a scan.

        The points must be ordered by scan.
        """
        return bisect_left(self._rows["scan"].view(np.ndarray), scan)

    def rows_of(self, scans: tuple[float, float]) -> tuple[int, int]:
        """Return the start and stop rows of an inclusive range of scans.

        If the points are not ordered by scan, the range covers all rows.
        """
        if self.scans[0] >= self.scans[1] or scans == self.scans:
            return 0, len(self)
        scan_column = self._rows["scan"]
        return bisect_left(scan_column, scans[0]), bisect_right(scan_column, scans[1])

    def values(self, name: str, row_selection: Ints | slice) -> AnyArray:
        """Return selected values of a column or coordinate.

        The values are copied to memory if the rows are given as indices, but not if they are given
        as a slice.
        """
        files = {column.name: column.in_files for column in self.table}
        return np.asarray(self._rows[files.get(name, name)][row_selection])

    def _cloud(self, rows: Records, dtype: Any = None) -> Cloud:
        """Convert rows to a cloud whose positions have `dtype` (default: dtype in the file)."""
        columns = {column.name: rows[column.in_files] for column in self.table}
        return Cloud(_positions(rows, dtype), columns, self.table)


def _positions(rows: Records, dtype: Any = None) -> AnyArray:
    """Return the positions in rows, converted to `dtype` (default: dtype in the file)."""
    return np.stack([rows[axis] for axis in AXES], axis=1, dtype=dtype)


def _table(row: np.dtype[np.void], custom_columns: Sequence[Column]) -> tuple[Column, ...]:
    """Describe the columns of a row in this order: standard columns, custom columns, the rest."""
    names = [name for name in row.names or () if name not in AXES]
    described = [
        column for column in (*TABLE.values(), *custom_columns) if column.in_files in names
    ]
    described_names = {column.in_files for column in described}
    undescribed = [
        Column(n, row[n].str, "", "")
        for n in names
        if n not in described_names and n.isidentifier()
    ]
    return (*described, *undescribed)
