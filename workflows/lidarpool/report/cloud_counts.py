"""Statistics of a cloud for its report, counted while the cloud is written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import NamedTuple

import numpy as np

from lidarsim.columns.part_columns import cell_positions
from lidarsim.columns.table import Column
from lidarsim.numerics.arrays import AnyArray, Floats, Ints, Ints32

from .count_loops import SHIFT, count_cells, count_labels

_SQUARES = 1024  # most pixels along an axis of the points from above, a power of two
_MIN_SQUARES = 50  # pixels along an axis that are not joined, however few the points are
_MIN_POINTS = 30  # points in a square, in the median, that suffice for an estimate of density
_MIN_DENSITY_SQUARES = 16  # squares along an axis that are not joined for it


class Density(NamedTuple):
    """Points per square meter seen from above, over the squares of a grid that contain points."""

    mean: float  # all points over the area of these squares
    median: float  # of the squares
    cell_m: float  # side of a square in meters


class CloudCounts:
    """Statistics of a cloud, whose points are added piece by piece.

    `by_object`, `by_class` and `by_material` are the numbers of points of each object, class and
    material, `no_surface` the points of no object, and `limits` are {column: minimum and maximum}.

    Parameters
    ----------
    table
        Columns beside the positions.
    objects, materials
        Numbers of objects and materials of the scene.
    precision_m
        Size of the cells of positions, meters.
    origin
        World position of the cell 0, 0, 0, (3,), meters.
    """

    def __init__(
        self,
        table: Sequence[Column],
        objects: int,
        materials: int,
        precision_m: float,
        origin: Floats,
    ) -> None:
        self.table = tuple(table)
        self.by_object = np.zeros(objects, np.int64)
        self.no_surface = 0
        self.by_class = np.zeros(1 << 16, np.int64)
        self.by_material = np.zeros(materials, np.int64)
        self.limits: dict[str, tuple[float, float]] = {}
        self._precision_m = precision_m
        self._origin = origin
        self._squares = GridCounts(_SQUARES)

    def add(self, columns: Mapping[str, AnyArray]) -> None:
        """Add points: {name of a column: (n,)}, n > 0."""
        self.no_surface += count_labels(columns["object"], self.by_object)
        if "class" in columns:
            count_labels(columns["class"], self.by_class)
        if "material" in columns:
            count_labels(columns["material"], self.by_material)
        for column in self.table:
            values = columns[column.name]
            self._add_limits(
                column.name, np.fmin.reduce(values).item(), np.fmax.reduce(values).item()
            )

    def _add_limits(self, name: str, lower: float, upper: float) -> None:
        limits = self.limits.get(name, (np.inf, -np.inf))
        # Of 0.0 and -0.0, which are equal, the one that comes first would be the limit.
        self.limits[name] = (min(limits[0], lower) + 0, max(limits[1], upper) + 0)

    def widen(self, cell_box: Ints) -> None:
        """Make room for points between lowest and highest cells, (2, 3), before they are added."""
        self._squares.widen(cell_box)

    def add_positions(self, cells: Sequence[Ints32]) -> None:
        """Add points by their cells along x and y, (n,) each; further axes are ignored.

        Intermediate arrays are as long as these: some 10⁵ points at a time stay in a cache.
        """
        self._squares.add(cells[0], cells[1])

    def merge(self, other: CloudCounts) -> None:
        """Add the points of other counts of the same cloud, whose counts are no longer used."""
        self.by_object += other.by_object
        self.no_surface += other.no_surface
        self.by_class += other.by_class
        self.by_material += other.by_material
        for name, (lower, upper) in other.limits.items():
            self._add_limits(name, lower, upper)
        self._squares.merge(other._squares)

    @property
    def point_count(self) -> int:
        """Number of points, by their objects."""
        return int(self.by_object.sum()) + self.no_surface

    @property
    def bounds(self) -> Floats:
        """Lowest and highest coordinates in the world, (2, 3), meters, or zeros without points."""
        if self._squares.box is None:
            return np.zeros((2, 3))
        return cell_positions(self._squares.box, self._precision_m, self._origin)

    @property
    def above(self) -> Ints:
        """Numbers of points seen from above, (rows, columns), the first row in the south."""
        return self._pixels.counts.T

    @property
    def pixel_m(self) -> float:
        """Side of a pixel of `above`, meters."""
        return self._pixels.side * self._precision_m

    @property
    def corner(self) -> Floats:
        """World position of the corner of `above` in the south-west, (2,), meters."""
        return cell_positions(self._pixels.lowest, self._precision_m, self._origin[:2])

    @property
    def _pixels(self) -> GridCounts:
        """Grid of `above`: the more points, the finer, with a point or two in a pixel."""
        pixels = deepcopy(self._squares)
        across = max(_MIN_SQUARES, (2 * pixels.total) ** 0.5)
        while max(pixels.shape) > across:
            pixels.coarsen()
        return pixels

    @property
    def density(self) -> Density | None:
        """Points per square meter seen from above, or None without points.

        Squares are joined until half of those with points have 30 points or more, so that gaps
        between sparse points lie within squares.
        """
        squares = deepcopy(self._squares)
        if not squares.total:
            return None
        while squares.median < _MIN_POINTS and max(squares.shape) > _MIN_DENSITY_SQUARES:
            squares.coarsen()
        cell_m = squares.side * self._precision_m
        return Density(squares.mean / cell_m**2, squares.median / cell_m**2, cell_m)


class GridCounts:
    """Numbers of points in a grid of squares, which are larger where points are far apart.

    The grid is the finest with at most `across` squares along each axis. A side is a power of two
    of cells of positions, and larger squares consist of whole smaller squares. So the numbers are
    the same whatever the order of the points is, and no point is needed again.

    A part of an axis has the number `(cell + SHIFT) >> level`, and the array has the part at this
    number modulo `across`: the array stays as it is while points spread in any direction.

    Parameters
    ----------
    across
        Largest number of squares along an axis, a power of two.
    """

    def __init__(self, across: int) -> None:
        self._across = across
        self._level = 0
        # Lowest and highest cells along x, y and perhaps further axes, (2, n); None without points.
        self.box: Ints | None = None
        self._array = np.zeros((across, across), np.int64)

    def widen(self, cell_box: Ints) -> None:
        """Make room for points between lowest and highest cells, (2, n)."""
        earlier = self.box
        if earlier is not None:
            lowest = np.minimum(earlier[0], cell_box[0])
            cell_box = np.stack([lowest, np.maximum(earlier[1], cell_box[1])])
        while (np.diff(_numbers(cell_box, self._level), axis=0) >= self._across).any():
            if earlier is None:
                self._level += 1
            else:
                self.coarsen()
        self.box = cell_box

    def add(self, x: Ints32, y: Ints32) -> None:
        """Add points by their cells along each axis, (n,), within the box of `widen`."""
        bits = self._across.bit_length() - 1
        x, y = np.ascontiguousarray(x), np.ascontiguousarray(y)
        count_cells(x, y, self._level, bits, self._array)

    def merge(self, other: GridCounts) -> None:
        """Add the points of another grid, which may become coarser by it."""
        if other.box is None:
            return
        self.widen(other.box)
        while other._level < self._level:
            other.coarsen()
        self._array += other._array

    def coarsen(self) -> None:
        """Double the side."""
        if self.box is not None:
            lowest = _numbers(self.box[0], self._level)
            finer = [low + np.arange(self._across) for low in lowest]
            counts = self._array[self._indices(finer)]
            self._array = np.zeros_like(self._array)
            np.add.at(self._array, self._indices([numbers >> 1 for numbers in finer]), counts)
        self._level += 1

    def _indices(self, numbers: Sequence[Ints]) -> tuple[Ints, ...]:
        """Return indices of the array of all combinations of numbers along each axis."""
        return np.ix_(*(along_axis % self._across for along_axis in numbers))

    @property
    def total(self) -> int:
        """Number of points."""
        return int(self._array.sum())

    @property
    def mean(self) -> float:
        """Mean of the numbers of points in squares with points."""
        return float(np.mean(self._array[self._array > 0]))

    @property
    def median(self) -> float:
        """Median of the numbers of points in squares with points."""
        return float(np.median(self._array[self._array > 0]))

    @property
    def side(self) -> int:
        """Side of a square in cells."""
        return 1 << self._level

    @property
    def lowest(self) -> Ints:
        """Lowest cell of `counts` along each axis, (2,)."""
        box = np.zeros((2, 2), np.int64) if self.box is None else self.box
        return (_numbers(box[0], self._level) << self._level) - SHIFT

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of squares along each axis, between the lowest and highest points."""
        if self.box is None:
            return 1, 1
        return tuple((np.diff(_numbers(self.box, self._level), axis=0)[0] + 1).tolist())

    @property
    def counts(self) -> Ints:
        """Number of points in each square between the lowest and highest points."""
        lowest = (self.lowest + SHIFT) >> self._level
        numbers = [low + np.arange(n) for low, n in zip(lowest, self.shape, strict=True)]
        return self._array[self._indices(numbers)]


def _numbers(cells: Ints, level: int) -> Ints:
    """Return the numbers of the parts of x and y that contain cells, (…, n), as (…, 2)."""
    return (cells[..., :2] + SHIFT) >> level
