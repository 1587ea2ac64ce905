"""Density of points in the area of an airborne survey, expected and simulated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from lidarsim.motion.trajectory import full_poses
from lidarsim.numerics.arrays import Bools, Floats, Ints
from lidarsim.numerics.vectors import matmul, rotate_into_frames
from lidarsim.scene.scene import Scene
from lidarsim.scene.simplified import SimplifiedScene
from lidarsim.survey.survey import Mounted, Survey
from raybeam import RayCaster

Ring = Sequence[tuple[float, float]]

SAMPLED_RAYS = 600_000
CELL_POINTS = 80  # mean number of points, sampled or simulated, in a cell of a density map
_GOLDEN = 0.6180339887498949  # golden ratio minus 1
_CORNERS = (0.01, 0.99)  # positions in a cell that are close to its corners


class DensityMap(NamedTuple):
    """Number of points per square meter in the square cells of a horizontal grid."""

    density_m2: Floats  # (rows, columns), southernmost row first
    corner: Floats  # (2,), southwest corner in world coordinates, meters
    cell_m: float  # side of a cell

    def within(self, area: Sequence[Ring]) -> Floats:
        """Return the densities of the cells that are completely in an area, with shape (n,)."""
        inside = np.ones(self.density_m2.size, np.bool_)
        for east, north in ((0.5, 0.5), *((x, y) for x in _CORNERS for y in _CORNERS)):
            rows, columns = self.density_m2.shape
            x, y = np.meshgrid(
                self.corner[0] + (np.arange(columns) + east) * self.cell_m,
                self.corner[1] + (np.arange(rows) + north) * self.cell_m,
            )
            inside &= is_inside(np.column_stack([x.ravel(), y.ravel()]), area)
        return np.asarray(self.density_m2.ravel()[inside])


class AreaDensity(NamedTuple):
    """Density of points in the planned area, in points per square meter."""

    planned_m2: float
    mean_m2: float
    low_m2: float  # density that 95 % of the area exceeds
    reached: float  # share of the area with at least the planned density
    empty: float  # share of the area without points
    cell_m: float  # side of the cells to which the last three values refer


def summarize_density(
    found: DensityMap, area: Sequence[Ring], planned_m2: float
) -> AreaDensity | None:
    """Compare the densities in an area with the planned density.

    Returns None if no cell is completely in the area.
    """
    densities = found.within(area)
    if not len(densities):
        return None
    return AreaDensity(
        planned_m2,
        float(densities.mean()),
        float(np.quantile(densities, 0.05)),
        float((densities >= planned_m2).mean()),
        float((densities == 0).mean()),
        found.cell_m,
    )


def is_inside(points: Floats, area: Sequence[Ring]) -> Bools:
    """Return whether points of shape (n, 2) are in an area.

    The area is bounded by closed rings, of which the inner ones are holes (even-odd rule).
    """
    x, y = points.T
    inside = np.zeros(len(points), np.bool_)
    for ring in area:
        corners = np.asarray(ring, np.float64)
        for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            if y0 == y1:
                continue
            crosses = (y0 > y) != (y1 > y)
            inside ^= crosses & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
    return inside


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
    weights = []
    for mounted, steps in zip(survey.mounted_sensors, survey.steps_each, strict=True):
        hits = _sampled_hits(caster, survey, mounted, steps, every)
        points.append(hits[:, :2] + scene.origin[:2])
        weights.append(np.full(len(hits), float(every)))
    return _count_cells(np.concatenate(points), np.concatenate(weights), area)


def _sampled_hits(
    caster: RayCaster, survey: Survey, mounted: Mounted, steps: int, every: int
) -> Floats:
    """Return the points that one in `every` rays of a sensor hits, in local coordinates."""
    sensor = mounted.sensor
    rays = sensor.firings(steps - 1)[1] * sensor.channels
    # Multiples of the golden ratio spread the rays evenly over firings and channels.
    number = np.arange(rays // every, dtype=np.int64)
    ray = number * every + (number * _GOLDEN % 1 * every).astype(np.int64)
    firing, channel = np.divmod(ray, sensor.channels)
    fired, row = np.unique(firing, return_inverse=True)
    origins, rotations = _sensor_poses(survey, mounted, fired)
    directions = sensor.directions(fired)[row, channel]
    towards = rotate_into_frames(directions, rotations.transpose(0, 2, 1)[row])
    found = caster.cast(origins[row], towards)
    in_range = (found.distance >= sensor.min_range_m) & (found.distance <= sensor.max_range_m)
    hit = found.hit & in_range
    return np.asarray(origins[row[hit]] + found.distance[hit, None] * towards[hit])


def _sensor_poses(survey: Survey, mounted: Mounted, firings: Ints) -> tuple[Floats, Floats]:
    """Return the positions and rotations of a sensor at firings of shape (k,)."""
    sensor = mounted.sensor
    times_ns = np.minimum(sensor.begins_ns(firings) + sensor.lead_ns, survey.path.duration_ns)
    positions, rotations = full_poses(survey.path, 0, times_ns)
    levers = np.broadcast_to(np.array(mounted.mount.position), positions.shape)
    origins = positions + rotate_into_frames(levers, rotations.transpose(0, 2, 1))
    return origins, matmul(rotations, mounted.mount.rotation_matrix)


def _count_cells(points: Floats, weights: Floats, area: Sequence[Ring]) -> DensityMap:
    """Count weighted points of shape (n, 2) in cells that contain enough of them."""
    corners = np.concatenate([np.asarray(ring, np.float64) for ring in area])
    low, high = corners.min(axis=0), corners.max(axis=0)
    inside = ((points >= low) & (points < high)).all(axis=1)
    extent = high - low
    per_m2 = max(inside.sum(), 1) / extent.prod()
    cell_m = nice_cell_m((CELL_POINTS / per_m2) ** 0.5)
    shape = np.maximum(np.ceil(extent / cell_m - 1e-9).astype(int), 1)
    column, row = ((points[inside] - low) / cell_m).astype(np.int64).T
    counts = np.bincount(row * shape[0] + column, weights[inside], int(shape.prod()))
    return DensityMap(counts.reshape(shape[1], shape[0]) / cell_m**2, low, cell_m)


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
