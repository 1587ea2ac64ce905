"""A cloud in a PLY file, whose points stay on disk until they are selected."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.choice import one_of_each_part
from ..base.errors import LidarpoolError
from ..columns.cloud import CHUNK_POINTS, Cloud
from ..columns.table import TABLE, Column
from .ply_format import AXES, layout


class CloudFile:
    """A cloud in PLY format, whose points stay on disk until they are selected.

    Parameters
    ----------
    path
        The file.
    own
        Descriptions of its columns that are not in the table of columns, if known: the file cannot
        store units.

    Raises
    ------
    LidarpoolError
        If it cannot be read, or is not a point cloud of lidarpool.
    """

    def __init__(self, path: Path, own: Sequence[Column] = ()) -> None:
        try:
            start, count, dtype = layout(path)
            # An empty file cannot be mapped.
            self._rows: NDArray[np.void] = (
                np.memmap(path, dtype, "r", start, (count,)) if count else np.empty(0, dtype)
            )
        except OSError as error:
            raise LidarpoolError(f"{path} cannot be read: {error.strerror or error}.") from error
        except ValueError as error:
            raise LidarpoolError(f"{path} is not a point cloud of lidarpool: {error}.") from error
        self.table = _table(dtype, own)
        scans = self._rows["scan"] if "scan" in (dtype.names or ()) else np.empty(0, np.int32)
        some = scans[one_of_each_part(len(scans), 100_000)]
        ordered = scans.dtype.kind in "iu" and bool((np.diff(some) >= 0).all())
        # First and last scan; None if the points are not in scan order.
        self.scans = (int(scans[0]), int(scans[-1])) if ordered and len(scans) else (0, 0)

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def bounds(self) -> NDArray[np.floating]:
        """Lowest and highest coordinates, (2, 3), metres; all points are read for it."""
        each = [chunk.bounds for chunk in self.chunks()] or [np.zeros((2, 3))]
        lows, highs = zip(*each, strict=True)
        return np.stack([np.min(lows, axis=0), np.max(highs, axis=0)])

    def chunks(self, points: int = CHUNK_POINTS, first: int = 0) -> Iterator[Cloud]:
        """Yield the points in order, from row `first` on, at most so many at a time."""
        for start in range(first, len(self), points):
            rows = self._rows[start : start + points]
            positions = np.stack([rows[axis] for axis in AXES], axis=1)
            columns = {column.name: rows[column.in_files] for column in self.table}
            yield Cloud(positions, columns, self.table)

    def choose(self, most: int, scans: tuple[int, int] | None = None) -> tuple[Cloud, int]:
        """Select at most so many evenly spaced points, from the first to the last scan.

        Returns
        -------
        cloud
            The points in order. Those without finite coordinates are left out.
        count
            Number of points in these scans.
        """
        low, high = (0, len(self)) if scans is None else self.rows_of(scans)
        return self._cloud(self._rows[low + one_of_each_part(high - low, most)]), high - low

    def row_of(self, scan: int) -> int:
        """Row of the first point of a scan, if the points are in the order of scans."""
        return bisect_left(self._rows["scan"], scan)

    def rows_of(self, scans: tuple[float, float]) -> tuple[int, int]:
        """First row of these scans and the first after them; all rows if not in scan order."""
        if self.scans[0] >= self.scans[1] or scans == self.scans:
            return 0, len(self)
        of = self._rows["scan"]
        return bisect_left(of, scans[0]), bisect_right(of, scans[1])

    def values(self, name: str, rows: NDArray[np.int64] | slice) -> NDArray[Any]:
        """Values of a column, or of x, y or z, in some rows; those of a slice stay on the disk."""
        files = {column.name: column.in_files for column in self.table}
        return np.asarray(self._rows[files.get(name, name)][rows])

    def _cloud(self, rows: NDArray[np.void]) -> Cloud:
        positions = np.stack([rows[axis] for axis in AXES], axis=1, dtype=np.float64)
        known = np.isfinite(positions).all(axis=1)
        if not known.all():
            rows, positions = rows[known], positions[known]
        columns = {column.name: rows[column.in_files] for column in self.table}
        return Cloud(positions, columns, self.table)


def _table(row: np.dtype[np.void], own: Sequence[Column]) -> tuple[Column, ...]:
    """Columns of a file with such rows: those of the table, in its order, then the others."""
    names = [name for name in row.names or () if name not in AXES]
    known = [column for column in (*TABLE.values(), *own) if column.in_files in names]
    ours = {column.in_files for column in known}
    rest = [Column(n, row[n].str, "", "") for n in names if n not in ours and n.isidentifier()]
    return (*known, *rest)
