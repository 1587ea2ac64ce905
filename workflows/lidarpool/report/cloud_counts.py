"""Statistics of a point cloud for its report, which are computed while the cloud is written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import NamedTuple

import numpy as np

from lidarscenario.plan.flight_density import Squares
from lidarsim.columns.part_columns import cell_positions
from lidarsim.columns.table import Column
from lidarsim.numerics.arrays import AnyArray, Floats, Ints, Ints32

from .count_loops import SHIFT, count_cells, count_labels

_SQUARES = 1024  # maximum grid size along each axis, a power of two
_MIN_SQUARES = 50  # top views of at most this size along both axes are not coarsened
_MIN_POINTS = 30  # median number of points per square that suffices to estimate the density
_MIN_DENSITY_SQUARES = 16  # grids of at most this size are not coarsened for the density


class Density(NamedTuple):
    """Horizontal point density per square meter, computed over squares that contain points."""

    mean: float  # number of points divided by the total area of the squares
    median: float  # median over the squares
    cell_m: float  # side length of a square in meters


class CloudCounts:
    """Statistics of a point cloud, to which points are added in batches.

    Parameters
    ----------
    table
        All columns except the positions.
    objects, materials
        Numbers of objects and materials in the scene.
    precision_m
        Size in meters of the cells that positions are rounded to.
    origin
        World position of cell (0, 0, 0) in meters. Shape (3,).

    Attributes
    ----------
    by_object, by_class, by_material
        Number of points for each object, class and material.
    no_surface
        Number of points that do not belong to an object.
    limits
        {column name: (minimum, maximum)}.
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

    def add_points(self, columns: Mapping[str, AnyArray]) -> None:
        """Add the columns of at least one point, as {column name: values}.

        The values have shape (n,).
        """
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
        # Adding 0 turns -0.0 into 0.0. Otherwise, the sign would depend on the order of the points.
        self.limits[name] = (min(limits[0], lower) + 0, max(limits[1], upper) + 0)

    def widen(self, cell_box: Ints) -> None:
        """Extend the grid to a box that contains the points to be added.

        `cell_box` contains the lowest and the highest cell of the box. Shape (2, 3).
        """
        self._squares.widen(cell_box)

    def add_positions(self, cells: Sequence[Ints32]) -> None:
        """Add the positions of points.

        `cells` contains one array of shape (n,) for each axis. Axes other than x and y are ignored.
        Intermediate arrays have the same length, so batches of about 10⁵ points stay in the CPU
        cache.
        """
        self._squares.add_points(cells[0], cells[1])

    def merge(self, other: CloudCounts) -> None:
        """Add the statistics of other points in the same cloud.

        `other` must not be used afterward.
        """
        self.by_object += other.by_object
        self.no_surface += other.no_surface
        self.by_class += other.by_class
        self.by_material += other.by_material
        for name, (lower, upper) in other.limits.items():
            self._add_limits(name, lower, upper)
        self._squares.merge(other._squares)

    @property
    def point_count(self) -> int:
        """Total number of points, including those that do not belong to an object."""
        return int(self.by_object.sum()) + self.no_surface

    @property
    def bounds(self) -> Floats:
        """Minimum and maximum world coordinates in meters, or zeros for an empty cloud.

        The array has shape (2, 3).
        """
        if self._squares.box is None:
            return np.zeros((2, 3))
        return cell_positions(self._squares.box, self._precision_m, self._origin)

    def top_view(self) -> Squares:
        """Return the point counts for a top view, with about one point per pixel."""
        pixels = deepcopy(self._squares)
        across = max(_MIN_SQUARES, (2 * pixels.total) ** 0.5)
        while max(pixels.shape) > across:
            pixels.coarsen()
        return self._squares_of(pixels)

    @property
    def density(self) -> Density | None:
        """Horizontal point density, or None if there are no points.

        The grid is coarsened until the median square with points contains at least 30 points.
        Smaller squares would exclude the gaps between sparse points from the area.
        """
        squares = deepcopy(self._squares)
        if not squares.total:
            return None
        while squares.median < _MIN_POINTS and max(squares.shape) > _MIN_DENSITY_SQUARES:
            squares.coarsen()
        cell_m = squares.side * self._precision_m
        return Density(squares.mean / cell_m**2, squares.median / cell_m**2, cell_m)

    def squares(self, least_m: float) -> Squares:
        """Return the points in squares with sides of at least `least_m` meters."""
        grid = deepcopy(self._squares)
        while grid.side * self._precision_m < least_m:
            grid.coarsen()
        return self._squares_of(grid)

    def _squares_of(self, grid: GridCounts) -> Squares:
        corner = cell_positions(grid.lowest, self._precision_m, self._origin[:2])
        return Squares(grid.counts.T, corner, grid.side * self._precision_m)


class GridCounts:
    """Number of points in each square of a grid that becomes coarser as the points spread.

    The grid is always the finest grid with at most `across` squares along each axis. The side of a
    square is a power of two in cells, so coarser squares consist of whole finer squares. Therefore
    the counts do not depend on the order of the points, and points do not have to be read again
    when the grid is coarsened.

    Squares are numbered `(cell + SHIFT) >> level` along each axis, and stored at this number modulo
    `across`. The array does not have to be moved when the points spread in any direction.

    Parameters
    ----------
    across
        Maximum number of squares along each axis, a power of two.
    """

    def __init__(self, across: int) -> None:
        self._across = across
        self._level = 0
        # Lowest and highest cells along x, y and possibly more axes, shape (2, axes).
        self.box: Ints | None = None
        self._array = np.zeros((across, across), np.int64)

    def widen(self, cell_box: Ints) -> None:
        """Extend the grid to a box, given its lowest and highest cells.

        The box has shape (2, axes).
        """
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

    def add_points(self, x: Ints32, y: Ints32) -> None:
        """Add points, given their cells along each axis.

        Both arrays have shape (n,). The points must lie within the box passed to `widen`.
        """
        bits = self._across.bit_length() - 1
        x, y = np.ascontiguousarray(x), np.ascontiguousarray(y)
        count_cells(x, y, self._level, bits, self._array)

    def merge(self, other: GridCounts) -> None:
        """Add the points of another grid, coarsening its squares if necessary."""
        if other.box is None:
            return
        self.widen(other.box)
        while other._level < self._level:
            other.coarsen()
        self._array += other._array

    def coarsen(self) -> None:
        """Double the side length of the squares."""
        if self.box is not None:
            lowest = _numbers(self.box[0], self._level)
            finer = [low + np.arange(self._across) for low in lowest]
            counts = self._array[self._indices(finer)]
            coarser = []
            for axis, numbers in enumerate(finer):
                halves, first = np.unique(numbers >> 1, return_index=True)
                counts = np.add.reduceat(counts, first, axis)
                coarser.append(halves)
            self._array = np.zeros_like(self._array)
            self._array[self._indices(coarser)] = counts
        self._level += 1

    def _indices(self, numbers: Sequence[Ints]) -> tuple[Ints, ...]:
        return np.ix_(*(along_axis % self._across for along_axis in numbers))

    @property
    def total(self) -> int:
        """Total number of points."""
        return int(self._array.sum())

    @property
    def mean(self) -> float:
        """Mean number of points in the squares that contain points."""
        return float(np.mean(self._array[self._array > 0]))

    @property
    def median(self) -> float:
        """Median number of points in the squares that contain points."""
        return float(np.median(self._array[self._array > 0]))

    @property
    def side(self) -> int:
        """Side length of a square in cells."""
        return 1 << self._level

    @property
    def lowest(self) -> Ints:
        """Smallest x and y of the cells that `counts` covers.

        The array has shape (2,).
        """
        box = np.zeros((2, 2), np.int64) if self.box is None else self.box
        return (_numbers(box[0], self._level) << self._level) - SHIFT

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of squares along each axis between the outermost points."""
        if self.box is None:
            return 1, 1
        return tuple((np.diff(_numbers(self.box, self._level), axis=0)[0] + 1).tolist())

    @property
    def counts(self) -> Ints:
        """Number of points in each square between the outermost points."""
        lowest = (self.lowest + SHIFT) >> self._level
        numbers = [low + np.arange(n) for low, n in zip(lowest, self.shape, strict=True)]
        return self._array[self._indices(numbers)]


def _numbers(cells: Ints, level: int) -> Ints:
    """Return the x and y numbers of the squares that contain the given cells.

    `cells` has shape (…, axes), and the result has shape (…, 2).
    """
    return (cells[..., :2] + SHIFT) >> level
