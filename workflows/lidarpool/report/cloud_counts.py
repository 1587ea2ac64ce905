"""Statistics of a cloud for its report, counted while the cloud is written."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np

from lidarsim.base.arrays import AnyArray, AnyFloats, Floats, Ints
from lidarsim.columns.cloud import CloudLike
from lidarsim.columns.part_columns import positions_of
from lidarsim.columns.ply_format import PlyLayout, layout
from lidarsim.columns.table import AXES, Column

from ..clouds.pieces import THREADS
from ..columns.parts import StoredCloud

_CELLS = 64  # cells along an axis of the grid that counts points, a power of two
_BLOCK_ROWS = 1 << 15  # rows whose positions are counted at a time, which fit into a cache
_MIN_POINTS = 12  # points in a cell that suffice for an estimate of density


class CloudCounts:
    """Statistics of a cloud: columns are added piece by piece, and positions once bounds are known.

    `by_object`, `by_class` and `by_material` are the numbers of points of each object, class and
    material, `no_surface` the points of no object, and `limits` are {column: minimum and maximum}.
    `bounds`, `above` and `density` are as in `PositionCounts`.

    Parameters
    ----------
    table
        Columns beside the positions.
    objects, materials
        Numbers of objects and materials of the scene.
    """

    def __init__(self, table: Sequence[Column], objects: int, materials: int = 0) -> None:
        self.table = tuple(table)
        self.by_object = np.zeros(objects, np.int64)
        self.no_surface = 0
        self.by_class = np.zeros(1 << 16, np.int64)
        self.by_material = np.zeros(materials, np.int64)
        self.limits: dict[str, tuple[float, float]] = {}
        self._positions = PositionCounts(np.zeros((2, 3)), 0)

    @classmethod
    def from_cloud(cls, cloud: CloudLike, objects: int, materials: int = 0) -> CloudCounts:
        """Return the statistics of a whole cloud, which is read once."""
        counts = cls(cloud.table, objects, materials)
        positions = PositionCounts(cloud.bounds, len(cloud))
        for chunk in cloud.chunks():
            counts.add(chunk.columns)
            x, y, z = chunk.positions.T
            cells = positions.cell_index(0, x) + positions.cell_index(1, y)
            cells += positions.cell_index(2, z)
            positions.add_cells(cells)
            positions.add_pixels(positions.pixel_index(0, x) + positions.pixel_index(1, y))
        counts._positions = positions
        return counts

    def add(self, columns: Mapping[str, AnyArray]) -> None:
        """Add points: {name of a column: (n,)}, n > 0."""
        owners = columns["object"]
        if owners.min(initial=0) < 0:
            self.no_surface += int(np.count_nonzero(owners < 0))
            owners = owners[owners >= 0]
        self.by_object += np.bincount(owners, minlength=len(self.by_object))
        if "class" in columns:
            self.by_class += np.bincount(columns["class"], minlength=len(self.by_class))
        if "material" in columns:
            numbers = columns["material"]
            numbers = numbers[numbers >= 0]
            self.by_material += np.bincount(numbers, minlength=len(self.by_material))
        for column in self.table:
            values = columns[column.name]
            lower, upper = self.limits.get(column.name, (np.inf, -np.inf))
            self.limits[column.name] = (
                min(lower, np.fmin.reduce(values).item()),
                max(upper, np.fmax.reduce(values).item()),
            )

    def add_positions(self, points: StoredCloud, path: Path, *, from_above: bool) -> None:
        """Add the positions of all points, from their PLY file, as in `PositionCounts`.

        `above` is counted only if `from_above`, because it takes as long as all else.
        """
        counted = partial(_counted_positions, points, path, layout(path), from_above)
        size = -(-len(points) // THREADS) or 1
        starts = range(0, len(points), size)
        self._positions = PositionCounts(points.bounds, len(points))
        with ThreadPoolExecutor(THREADS, "count") as pool:  # NumPy lets threads run
            for positions in pool.map(counted, starts, [start + size for start in starts]):
                self._positions.merge(positions)

    @property
    def bounds(self) -> Floats:
        """Lowest and highest coordinates in the world, (2, 3), metres."""
        return self._positions.bounds

    @property
    def above(self) -> Ints:
        """Points seen from above."""
        return self._positions.above

    @property
    def pixel_m(self) -> float:
        """Side of a pixel of `above`, metres."""
        return self._positions.pixel_m

    @property
    def density(self) -> float | None:
        """Points per square metre."""
        return self._positions.density


class PositionCounts:
    """Numbers of points in a grid and seen from above.

    The bounds of all points must be known.

    `above` (rows, columns) are the numbers of points seen from above, the first row in the south.

    Parameters
    ----------
    bounds
        Lowest and highest coordinates in the world, (2, 3), metres.
    count
        Number of all points.
    """

    def __init__(self, bounds: AnyFloats, count: int) -> None:
        self.bounds: Floats = np.asarray(bounds, dtype=np.float64)
        # A cell that a surface crosses has about the square of its side of that surface.
        self._side = float(np.ptp(self.bounds, axis=0).max()) / _CELLS or 1.0
        self._cells = np.zeros(_CELLS**3, np.int64)
        # The more points, the finer.
        across = np.ptp(self.bounds[:, :2], axis=0)
        self.pixel_m = float(across.max() / np.clip(count**0.5, 50, 800)) or 1.0
        self.above = np.zeros((across[::-1] / self.pixel_m).astype(np.int64) + 1, np.int64)

    def cell_index(self, axis: int, positions: AnyFloats) -> Ints:
        """Return the part of an axis in the indices of cells of the grid, of coordinates (n,)."""
        cells = ((positions - self.bounds[0, axis]) / self._side).astype(np.int64)
        return cells.clip(0, _CELLS - 1) * _CELLS ** (2 - axis)

    def pixel_index(self, axis: int, positions: AnyFloats) -> Ints:
        """Return the part of x or y in the indices of pixels, of coordinates (n,)."""
        rows, columns = self.above.shape
        pixels = ((positions - self.bounds[0, axis]) / self.pixel_m).astype(np.int64)
        return pixels.clip(0, columns - 1) if axis == 0 else pixels.clip(0, rows - 1) * columns

    def add_cells(self, cells: Ints) -> None:
        """Add points by the indices of their cells in the grid, (n,)."""
        # Of few points, `bincount` would take longer to make its array than to count.
        np.add.at(self._cells, cells, 1)

    def add_pixels(self, pixels: Ints) -> None:
        """Add points by the indices of their pixels, (n,)."""
        np.add.at(self.above.reshape(-1), pixels, 1)

    def merge(self, other: PositionCounts) -> None:
        """Add the points of counts with the same bounds."""
        self._cells += other._cells
        self.above += other.above

    @property
    def density(self) -> float | None:
        """Points per square metre, the median over the surfaces, or None without points."""
        if not self._cells.any():
            return None
        cells = self._cells.reshape(3 * (_CELLS,))
        side = self._side
        while (median := float(np.median(cells[cells > 0]))) < _MIN_POINTS and len(cells) > 1:
            half = len(cells) // 2  # gaps between sparse points count in larger cells
            cells = cells.reshape(half, 2, half, 2, half, 2).sum((1, 3, 5))
            side = 2 * side
        return median / side**2


def _counted_positions(
    points: StoredCloud, path: Path, ply: PlyLayout, from_above: bool, start: int, stop: int
) -> PositionCounts:
    """Return the counts of the points in the rows from `start` to `stop` of a PLY file."""
    counts = PositionCounts(points.bounds, len(points))
    cell_indices = [_of_cells(points, axis, partial(counts.cell_index, axis)) for axis in range(3)]
    pixel_indices = [
        _of_cells(points, axis, partial(counts.pixel_index, axis)) for axis in range(2)
    ]
    for first in range(start, min(stop, ply.points), _BLOCK_ROWS):
        # Pages of a mapped file would count as memory of this process.
        offset = ply.start + first * ply.row.itemsize
        block = np.fromfile(path, ply.row, min(_BLOCK_ROWS, stop - first), offset=offset)
        x, y, z = (points.cells_along(axis, block[AXES[axis].name]) for axis in range(3))
        cells = cell_indices[0](x) + cell_indices[1](y)
        cells += cell_indices[2](z)
        counts.add_cells(cells)
        if from_above:
            counts.add_pixels(pixel_indices[0](x) + pixel_indices[1](y))
    return counts


def _of_cells(
    points: StoredCloud, axis: int, of_positions: Callable[[AnyFloats], Ints]
) -> Callable[[Ints], Ints]:
    """Return a function of cells along an axis for a function of coordinates.

    If there are fewer cells than points, the function is computed once for each cell.
    """
    origin_m = points.origin[axis]

    def of_cells(cells: Ints) -> Ints:
        return of_positions(positions_of(cells, points.precision_m, origin_m))

    if points.cells is None:
        return of_cells
    lower, upper = points.cells[:, axis].tolist()
    if upper - lower >= len(points):
        return of_cells
    table = of_cells(np.arange(lower, upper + 1))
    return lambda cells: table.take(cells - lower)
