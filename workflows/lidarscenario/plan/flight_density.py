"""Expected and simulated point density in the area of an airborne survey."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from lidarsim.motion.trajectory import mounted_poses
from lidarsim.numerics.arrays import Bools, Floats, Ints
from lidarsim.numerics.vectors import rotate_into_frames
from lidarsim.scene.scene import Scene
from lidarsim.scene.simplified import SimplifiedScene
from lidarsim.survey.survey import Mounted, Survey
from raybeam import RayCaster

Ring = Sequence[tuple[float, float]]

SAMPLED_RAYS = 600_000
CELL_POINTS = 80  # mean number of points, sampled or simulated, in a cell of a density map
_GOLDEN = 0.6180339887498949  # golden ratio minus 1
_SQUARES_PER_CELL = 10  # squares along each side of a cell
_MIN_COVERED = 0.25  # smaller parts of cells contain too few points


class Squares(NamedTuple):
    """Number of points in the squares of a fine horizontal grid."""

    counts: Floats | Ints  # (rows, columns), southernmost row first
    corner: Floats  # (2,), southwest corner in world coordinates, meters
    side_m: float

    @property
    def centers(self) -> tuple[Floats, Floats]:
        """Coordinates x of the columns and y of the rows."""
        rows, columns = self.counts.shape
        x = self.corner[0] + (np.arange(columns) + 0.5) * self.side_m
        y = self.corner[1] + (np.arange(rows) + 0.5) * self.side_m
        return x, y

    def over(self, area: Sequence[Ring]) -> Squares:
        """Return the squares of the same grid that cover the bounding box of an area."""
        lower, upper = _bounds(area)
        first, stop = (
            rounded((limit - self.corner) / self.side_m).astype(int)
            for rounded, limit in ((np.floor, lower), (np.ceil, upper))
        )
        counts = np.zeros(np.maximum(stop - first, 1)[::-1], self.counts.dtype)
        low = np.maximum(first, 0)
        high = np.maximum(np.minimum(stop, self.counts.shape[::-1]), low)
        rows, columns = (slice(*limits) for limits in zip(low[::-1], high[::-1], strict=True))
        known = self.counts[rows, columns]
        to = low - first
        counts[to[1] : to[1] + known.shape[0], to[0] : to[0] + known.shape[1]] = known
        return Squares(counts, self.corner + first * self.side_m, self.side_m)


class DensityMap(NamedTuple):
    """Number of points per square meter in the square cells of a horizontal grid.

    Only the points and the parts of the cells that are in the area are counted.
    """

    density_m2: Floats  # (rows, columns), southernmost row first, NaN outside the area
    covered: Floats  # (rows, columns), share of each cell that is in the area
    corner: Floats  # (2,), southwest corner in world coordinates, meters
    cell_m: float  # side of a cell

    @classmethod
    def from_squares(cls, squares: Squares, area: Sequence[Ring], least_m: float) -> DensityMap:
        """Combine squares whose centers are in an area into cells of at least `least_m` meters.

        The southwest corner of the grid is that of the bounding box of the area.
        """
        squares = squares.over(area)
        lower, upper = _bounds(area)
        cell_m = nice_cell_m(max(least_m, squares.side_m))
        columns, rows = np.maximum(np.ceil((upper - lower) / cell_m - 1e-9).astype(int), 1)
        x, y = squares.centers
        inside = is_inside_grid(x, y, area)
        column = np.clip(((x - lower[0]) / cell_m).astype(int), 0, columns - 1)
        row = np.clip(((y - lower[1]) / cell_m).astype(int), 0, rows - 1)
        cell = (row[:, None] * columns + column)[inside]
        covered_m2 = np.bincount(cell, minlength=rows * columns) * squares.side_m**2
        density = np.asarray(np.bincount(cell, squares.counts[inside], rows * columns), np.float64)
        density[covered_m2 == 0] = np.nan
        np.divide(density, covered_m2, out=density, where=covered_m2 > 0)
        covered = np.minimum(covered_m2 / cell_m**2, 1.0)
        return cls(density.reshape(rows, columns), covered.reshape(rows, columns), lower, cell_m)


class AreaDensity(NamedTuple):
    """Point density in the planned area, in points per square meter."""

    planned_m2: float
    mean_m2: float
    low_m2: float  # density that 95 % of the area exceeds
    reached: float  # share of the area with at least the planned density
    empty: float  # share of the area without points
    cell_m: float  # side of the cells from which the previous three values are computed


def summarize_density(found: DensityMap, planned_m2: float) -> AreaDensity:
    """Compare the densities in an area with the planned density.

    Cells are weighted by their area within the planned area. Cells of which less than a quarter is
    in the area only contribute to the mean, because they contain few points.
    """
    inside = found.covered > 0
    densities = found.density_m2[inside]
    weights = found.covered[inside]
    mean_m2 = float(np.average(densities, weights=weights))
    large = weights >= min(_MIN_COVERED, weights.max())
    order = np.argsort(densities[large], kind="stable")
    densities, weights = densities[large][order], weights[large][order]
    weights /= weights.sum()
    return AreaDensity(
        planned_m2,
        mean_m2,
        float(densities[np.searchsorted(np.cumsum(weights), 0.05)]),
        float(weights[densities >= planned_m2].sum()),
        float(weights[densities == 0].sum()),
        found.cell_m,
    )


def is_inside_grid(x: Floats, y: Floats, area: Sequence[Ring]) -> Bools:
    """Return which points of a grid are in an area, by the even-odd rule.

    For `x` of shape (n,) and `y` of shape (m,), both in ascending order, the result has shape
    (m, n).

    Examples
    --------
    >>> is_inside_grid(np.arange(3.0), np.arange(2.0), [[(0.5, -1), (5, -1), (5, 1), (0.5, 1)]])
    array([[False,  True,  True],
           [False, False, False]])
    """
    # An edge that crosses a row toggles all points to its left.
    toggles = np.zeros((len(y), len(x) + 1), np.int32)
    for ring in area:
        corners = np.asarray(ring, np.float64)
        for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            first, stop = np.searchsorted(y, sorted((y0, y1)))
            if first < stop:
                crossings = x0 + (y[first:stop] - y0) * (x1 - x0) / (y1 - y0)
                toggles[np.arange(first, stop), np.searchsorted(x, crossings)] += 1
    to_the_right = toggles[:, ::-1].cumsum(axis=1)[:, ::-1]
    return np.asarray(to_the_right[:, 1:] % 2 == 1)


def _bounds(area: Sequence[Ring]) -> tuple[Floats, Floats]:
    """Return the lower and upper bounds of an area, with shape (2,)."""
    corners = np.concatenate([np.asarray(ring, np.float64) for ring in area])
    return corners.min(axis=0), corners.max(axis=0)


def expected_density(scene: Scene, survey: Survey, area: Sequence[Ring]) -> DensityMap:
    """Estimate the density of a survey by casting a sample of its rays.

    Noise, weather and secondary returns are ignored. Rays count if they hit a surface within the
    range of their sensor.

    Parameters
    ----------
    scene, survey
        Scene and survey in local coordinates.
    area
        Rings of the area in world coordinates, in meters. The map covers its bounding box.
    """
    static = replace(SimplifiedScene.from_scene(scene).scene, actors=())
    caster = RayCaster(static.vertices, static.faces)
    every = max(1, -(-survey.ray_count // SAMPLED_RAYS))
    points = []
    for mounted, steps in zip(survey.mounted_sensors, survey.steps_each, strict=True):
        hits = _sampled_hits(caster, survey, mounted, steps, every)
        points.append(hits[:, :2] + scene.origin[:2])
    return _count_in_area(np.concatenate(points), float(every), area)


def _sampled_hits(
    caster: RayCaster, survey: Survey, mounted: Mounted, steps: int, every: int
) -> Floats:
    """Return the points that one in `every` rays of a sensor hits, in local coordinates."""
    sensor = mounted.sensor
    rays = sensor.firings(steps - 1)[1] * sensor.channels
    firing, channel = np.divmod(_sampled_numbers(rays, every), sensor.channels)
    fired, row = np.unique(firing, return_inverse=True)
    times_ns = np.minimum(sensor.begins_ns(fired) + sensor.lead_ns, survey.path.duration_ns)
    origins, rotations = mounted_poses(survey.path, 0, mounted.mount, times_ns)
    directions = sensor.directions(fired)[row, channel]
    towards = rotate_into_frames(directions, rotations.transpose(0, 2, 1)[row])
    found = caster.cast(origins[row], towards)
    in_range = (found.distance >= sensor.min_range_m) & (found.distance <= sensor.max_range_m)
    hit = found.hit & in_range
    return np.asarray(origins[row[hit]] + found.distance[hit, None] * towards[hit])


def _sampled_numbers(rays: int, every: int) -> Ints:
    """Return the numbers of one in `every` rays, spread evenly over firings and channels."""
    number = np.arange(rays // every, dtype=np.int64)
    # Multiples of the golden ratio modulo 1 are evenly distributed.
    return number * every + (number * _GOLDEN % 1 * every).astype(np.int64)


def _count_in_area(points: Floats, weight: float, area: Sequence[Ring]) -> DensityMap:
    """Count points of shape (n, 2), each of which represents `weight` points, in an area."""
    lower, upper = _bounds(area)
    extent = upper - lower
    inside = ((points >= lower) & (points < upper)).all(axis=1)
    least_m = cell_side_m(inside.sum() / extent.prod(), area)
    side_m = nice_cell_m(least_m) / _SQUARES_PER_CELL
    shape = np.ceil(extent / side_m - 1e-9).astype(int)
    column, row = ((points[inside] - lower) / side_m).astype(np.int64).T
    sampled = np.bincount(row * shape[0] + column, minlength=int(shape.prod()))
    counts = np.asarray(weight * sampled, np.float64)
    squares = Squares(counts.reshape(shape[1], shape[0]), lower, side_m)
    return DensityMap.from_squares(squares, area, least_m)


def cell_side_m(density_m2: float, area: Sequence[Ring]) -> float:
    """Return the side in meters of cells with enough points, at most the side of the area."""
    longest_m = longest_side_m(area)
    if density_m2 * longest_m**2 <= CELL_POINTS:
        return longest_m
    return float((CELL_POINTS / density_m2) ** 0.5)


def longest_side_m(area: Sequence[Ring]) -> float:
    """Return the longest side of the bounding box of an area in meters."""
    lower, upper = _bounds(area)
    return float((upper - lower).max())


def nice_cell_m(least_m: float) -> float:
    """Return the smallest of 1, 2 and 5 times a power of ten that is at least `least_m`.

    Examples
    --------
    >>> nice_cell_m(3.1), nice_cell_m(0.2)
    (5.0, 0.2)
    """
    power = 10.0 ** np.floor(np.log10(least_m))
    factor = next(f for f in (1, 2, 5, 10) if f * power >= least_m * (1 - 1e-9))
    return float(factor * power)
