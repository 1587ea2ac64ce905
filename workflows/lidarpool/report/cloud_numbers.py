"""Statistics of a cloud, computed in one pass."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..base.arrays import Floats
from ..columns.cloud import CHUNK_POINTS, Cloud, CloudLike
from ..columns.table import Column

_CELLS = 64  # along an axis of the grid in which points are counted, a power of two
_ENOUGH = 12  # points in a cell from which a density is estimated


class CountedCloud:
    """A cloud that computes its statistics while its points are read for something else.

    `by_object` are the points of each object, `no_surface` those of none, `limits`
    are {column: minimum and maximum}, and `bounds` (2, 3) the lowest and highest coordinates in the
    world.
    """

    def __init__(self, cloud: CloudLike, objects: int) -> None:
        self._cloud = cloud
        self.by_object, self.no_surface = np.zeros(objects, np.int64), 0
        self.limits: dict[str, tuple[float, float]] = {}
        self.bounds: Floats = np.asarray(cloud.bounds, dtype=np.float64)
        # A cell that a surface crosses has about the square of its side of that surface.
        self._side = float(np.ptp(self.bounds, axis=0).max()) / _CELLS or 1.0
        self._cells = np.zeros(_CELLS**3, np.int64)
        self.table: tuple[Column, ...] = cloud.table
        self.row_of = cloud.row_of

    def __len__(self) -> int:
        return len(self._cloud)

    def chunks(self, points: int = CHUNK_POINTS, first: int = 0) -> Iterator[Cloud]:
        """Yield the points in order, and update the statistics."""
        for chunk in self._cloud.chunks(points, first):
            owners = chunk["object"]
            if owners.min(initial=0) < 0:
                owners = owners[owners >= 0]
                self.no_surface += len(chunk) - len(owners)
            self.by_object += np.bincount(owners, minlength=len(self.by_object))
            for name in (column.name for column in chunk.table):
                values = chunk[name]
                low, high = self.limits.get(name, (np.inf, -np.inf))
                self.limits[name] = (
                    min(low, np.fmin.reduce(values).item()),
                    max(high, np.fmax.reduce(values).item()),
                )
            cell = ((chunk.positions - self.bounds[0]) / self._side).astype(np.int64)
            x, y, z = cell.clip(0, _CELLS - 1).T
            cell = (x * _CELLS + y) * _CELLS + z  # a product of whole numbers by `@` is slow
            self._cells += np.bincount(cell, minlength=len(self._cells))
            yield chunk

    @property
    def density(self) -> float | None:
        """Points per square metre of what was read, the median over the surfaces; None without."""
        if not self._cells.any():
            return None
        cells, side = self._cells.reshape(3 * (_CELLS,)), self._side
        while (median := float(np.median(cells[cells > 0]))) < _ENOUGH and len(cells) > 1:
            half = len(cells) // 2  # larger cells: those without points between sparse ones count
            cells, side = cells.reshape(half, 2, half, 2, half, 2).sum((1, 3, 5)), 2 * side
        return median / side**2
