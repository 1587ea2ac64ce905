"""Statistics of a cloud for its report, counted while the cloud is written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy

import numpy as np

from lidarsim.base.arrays import AnyArray, Floats, Ints, Ints32
from lidarsim.columns.part_columns import positions_of
from lidarsim.columns.table import Column

from .count_loops import SHIFT, count_cells, count_labels

_CUBES = 64  # most cubes along an axis of the grid that measures density, a power of two
_SQUARES = 1024  # most pixels along an axis of the points from above, a power of two
_MIN_SQUARES = 50  # pixels along an axis that are not joined, however few the points are
_MIN_POINTS = 12  # points in a cube that suffice for an estimate of density


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
        Size of the cells of positions, metres.
    origin
        World position of the cell 0, 0, 0, (3,), metres.
    from_above
        Whether `above` is counted.
    """

    def __init__(
        self,
        table: Sequence[Column],
        objects: int,
        materials: int,
        precision_m: float,
        origin: Floats,
        *,
        from_above: bool,
    ) -> None:
        self.table = tuple(table)
        self.by_object = np.zeros(objects, np.int64)
        self.no_surface = 0
        self.by_class = np.zeros(1 << 16, np.int64)
        self.by_material = np.zeros(materials, np.int64)
        self.limits: dict[str, tuple[float, float]] = {}
        self._precision_m = precision_m
        self._origin = origin
        self._cubes = GridCounts(3, _CUBES)
        self._squares = GridCounts(2, _SQUARES) if from_above else None

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
        """Widen the limits of a column."""
        limits = self.limits.get(name, (np.inf, -np.inf))
        # Of 0.0 and -0.0, which are equal, the one that comes first would be the limit.
        self.limits[name] = (min(limits[0], lower) + 0, max(limits[1], upper) + 0)

    def widen(self, cell_box: Ints) -> None:
        """Make room for points between lowest and highest cells, (2, 3), before they are added."""
        self._cubes.widen(cell_box)
        if self._squares is not None:
            self._squares.widen(cell_box[:, :2])

    def add_positions(self, cells: Sequence[Ints32]) -> None:
        """Add points by their cells along x, y and z, (n,) each.

        Intermediate arrays are as long as these: some 10⁵ points at a time stay in a cache.
        """
        self._cubes.add(cells)
        if self._squares is not None:
            self._squares.add(cells[:2])

    def merge(self, other: CloudCounts) -> None:
        """Add the points of other counts of the same cloud, whose counts are no longer used."""
        self.by_object += other.by_object
        self.no_surface += other.no_surface
        self.by_class += other.by_class
        self.by_material += other.by_material
        for name, (lower, upper) in other.limits.items():
            self._add_limits(name, lower, upper)
        self._cubes.merge(other._cubes)
        if self._squares is not None and other._squares is not None:
            self._squares.merge(other._squares)

    @property
    def point_count(self) -> int:
        """Number of points, by their objects."""
        return int(self.by_object.sum()) + self.no_surface

    @property
    def bounds(self) -> Floats:
        """Lowest and highest coordinates in the world, (2, 3), metres, or zeros without points."""
        box = self._cubes.box
        if box is None:
            return np.zeros((2, 3))
        return positions_of(box, self._precision_m, self._origin)

    @property
    def above(self) -> Ints:
        """Numbers of points seen from above, (rows, columns), the first row in the south."""
        return self._pixels.counts.T

    @property
    def pixel_m(self) -> float:
        """Side of a pixel of `above`, metres."""
        return self._pixels.side * self._precision_m

    @property
    def corner(self) -> Floats:
        """World position of the corner of `above` in the south-west, (2,), metres."""
        return positions_of(self._pixels.lowest, self._precision_m, self._origin[:2])

    @property
    def _pixels(self) -> GridCounts:
        """Grid of `above`: the more points, the finer, with a point or two in a pixel."""
        assert self._squares is not None, "counted from above"
        pixels = deepcopy(self._squares)
        across = max(_MIN_SQUARES, (2 * pixels.total) ** 0.5)
        while max(pixels.shape) > across:
            pixels.coarsen()
        return pixels

    @property
    def density(self) -> float | None:
        """Points per square metre, the median over the surfaces, or None without points."""
        cubes = deepcopy(self._cubes)
        if not cubes.total:
            return None
        # Gaps between sparse points are within larger cubes.
        while (median := cubes.median) < _MIN_POINTS and max(cubes.shape) > 2:
            cubes.coarsen()
        # A cube that a surface crosses has about the square of its side of that surface.
        return median / (cubes.side * self._precision_m) ** 2


class GridCounts:
    """Numbers of points in a grid of squares or cubes, which are larger where points are far apart.

    The grid is the finest with at most `across` squares or cubes along each axis. A side is a power
    of two of cells of positions, and larger cubes consist of whole smaller cubes. So the numbers
    are the same whatever the order of the points is, and no point is needed again.

    A part of an axis has the number `(cell + SHIFT) >> level`, and the array has the part at this
    number modulo `across`: the array stays as it is while points spread in any direction.

    Parameters
    ----------
    axes
        Number of axes, 2 or 3.
    across
        Largest number of squares or cubes along an axis, a power of two.
    """

    def __init__(self, axes: int, across: int) -> None:
        self._across = across
        self._level = 0
        self.box: Ints | None = None  # lowest and highest cells, (2, axes); None without points
        self._array = np.zeros(axes * (across,), np.int64)

    def widen(self, cell_box: Ints) -> None:
        """Make room for points between lowest and highest cells, (2, axes)."""
        earlier = self.box
        if earlier is not None:
            lowest = np.minimum(cell_box[0], earlier[0])
            cell_box = np.stack([lowest, np.maximum(cell_box[1], earlier[1])])
        while (np.diff(_numbers(cell_box, self._level), axis=0) >= self._across).any():
            if earlier is None:
                self._level += 1
            else:
                self.coarsen()
        self.box = cell_box

    def add(self, cells: Sequence[Ints32]) -> None:
        """Add points by their cells along each axis, (n,), within the box of `widen`."""
        contiguous = [np.ascontiguousarray(along_axis) for along_axis in cells]
        bits = self._across.bit_length() - 1
        count_cells(*contiguous[:2], contiguous[-1], self._level, bits, self._array)

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
    def median(self) -> float:
        """Median of the numbers of points in squares or cubes with points."""
        return float(np.median(self._array[self._array > 0]))

    @property
    def side(self) -> int:
        """Side of a square or cube in cells."""
        return 1 << self._level

    @property
    def lowest(self) -> Ints:
        """Lowest cell of `counts` along each axis, (axes,)."""
        box = np.zeros((2, self._array.ndim), np.int64) if self.box is None else self.box
        return (_numbers(box[0], self._level) << self._level) - SHIFT

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of squares or cubes along each axis, between the lowest and highest points."""
        if self.box is None:
            return self._array.ndim * (1,)
        return tuple((np.diff(_numbers(self.box, self._level), axis=0)[0] + 1).tolist())

    @property
    def counts(self) -> Ints:
        """Number of points in each square or cube between the lowest and highest points."""
        lowest = (self.lowest + SHIFT) >> self._level
        numbers = [low + np.arange(n) for low, n in zip(lowest, self.shape, strict=True)]
        return self._array[self._indices(numbers)]


def _numbers(cells: Ints, level: int) -> Ints:
    """Return the numbers of parts of axes that contain cells."""
    return (cells + SHIFT) >> level
