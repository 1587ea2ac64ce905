"""Compare pulses of a moving sensor with a scene, given the pose of the sensor at each firing.

No two pulses share a ray, so a ray has no mean range, and the scene provides the expected range.
Arrays for a sweep have r rows and c columns, as described in `stack`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np

from lidarfiles.clouds.recording import Recording
from lidarsim.columns.sweep import Sweep
from lidarsim.columns.table import NORMAL
from lidarsim.motion.rotations import matrices
from lidarsim.motion.trajectory import Pose
from lidarsim.numerics.arrays import Bools, Floats, Indices, Ints
from lidarsim.numerics.even_samples import even_indices
from lidarsim.scene.scene import Scene
from lidarsim.sensor import Spin
from lidarsim.sensor.ray_sensors import ListedSensor
from lidarsim.simulator import Scanner

from .smooth_surfaces import (
    ASSUMED_DIRECTION_NOISE_RAD,
    MAX_KINK_PER_M,
    MAX_SIGMAS,
    MAX_TANGENT,
    MIN_RANGE_M,
    SCENE_TOLERANCE_M,
    CellNeighbors,
    SmoothRays,
    among_smooth,
)
from .stack import MAX_KINK_M, SweepStack

_MAX_PULSES = 1 << 17  # maximum number of pulses to fit, sampled evenly
_SAME_RANGE_M = 1e-3  # maximum difference between ranges of the same return due to rounding
# Maximum angle from a cell to the closest return of its ring, whose pose is used.
_MAX_GAP_DEG = 2.0
# Minimum number of azimuth steps between two returns if a pulse between them was lost.
_MIN_LOST_STEPS = 1.5
_LIGHT_COLUMNS = 3  # number of cells on either side whose intensities are averaged


@dataclass(frozen=True, eq=False)
class ScenePulses:
    """Pulses that hit smooth surfaces of a scene.

    All arrays have shape (n,).
    """

    row: Ints
    column: Ints
    expected: Floats  # range of the scene, meters
    slope: Floats  # gradient of the range with respect to the direction, meters per radian
    residual: Floats  # range minus `expected` in meters; NaN for a lost pulse
    intensity: Floats  # mean of the neighboring returns; NaN if unknown
    difference: Floats  # residual minus the next residual in the ring; NaN if unknown

    def rough_sigma(self) -> Floats:
        """Estimate each pulse's range noise in meters. It is used only to detect outliers."""
        scatter_m = float(np.nanmedian(np.abs(self.difference))) / (0.6745 * np.sqrt(2))
        return np.hypot(scatter_m, ASSUMED_DIRECTION_NOISE_RAD * self.slope)

    def select(self, chosen: Bools | Indices) -> ScenePulses:
        """Select pulses with a mask or with indices."""
        return ScenePulses(*(values[chosen] for values in vars(self).values()))

    def near_scene(self, sigma: Floats) -> Bools:
        """Mark pulses that are lost or whose range matches the scene.

        `sigma` is the standard deviation of each range.
        """
        limit_m = np.maximum(MAX_SIGMAS * sigma, SCENE_TOLERANCE_M)
        return ~(np.abs(self.residual) > limit_m)  # NaN is marked, too

    def rays(self, sigma: Floats) -> SmoothRays:
        """Convert pulses to rays, each of which consists of a single pulse.

        `sigma` is the standard deviation of each range. The variances of the rays are derived from
        differences between neighboring pulses, in which errors of the poses and of the scene cancel
        out.
        """
        returned = np.isfinite(self.residual)
        with np.errstate(invalid="ignore"):
            paired = np.abs(self.difference) < MAX_SIGMAS * np.sqrt(2) * sigma
        return SmoothRays(
            row=self.row,
            column=self.column,
            distance=self.expected,
            slope=self.slope,
            intensity=self.intensity,
            return_counts=returned.astype(np.int64),
            trials=np.ones(len(self.row), np.int64),
            variance=np.where(paired, self.difference**2 / 2, 0.0),
            freedom=paired.astype(np.int64),
        )


class SweepPulses(NamedTuple):
    """Pulses of one or more sweeps that hit smooth surfaces of the scene."""

    pulses: ScenePulses
    compared: int  # number of returns where the scene has a surface
    near: int  # number of these returns within `SCENE_TOLERANCE_M` of the surface

    @classmethod
    def concatenate(cls, sweeps: Sequence[SweepPulses]) -> SweepPulses:
        """Concatenate the pulses of several sweeps.

        If there are too many pulses, they are sampled evenly.
        """
        columns = zip(*(vars(sweep.pulses).values() for sweep in sweeps), strict=True)
        pulses = ScenePulses(*map(np.concatenate, columns))
        return cls(
            pulses.select(even_indices(len(pulses.row), _MAX_PULSES)),
            sum(sweep.compared for sweep in sweeps),
            sum(sweep.near for sweep in sweeps),
        )


def measure_pulses(
    recording: Recording, scene: Scene, fired: Callable[[int], Sweep]
) -> tuple[SweepStack, SweepPulses]:
    """Read the sweeps of a moving sensor, and compare their pulses with a scene.

    `fired` reads a sweep as fired, with `firing_poses` in the scene frame. Raises the same errors
    as `SweepStack.read`.
    """
    stack = SweepStack.read(recording, fired)
    caster = _CellCaster.from_stack(stack, scene)
    sweeps = enumerate(stack.numbers.tolist())
    return stack, SweepPulses.concatenate(
        [_pulses_of_sweep(stack, index, caster, fired(number)) for index, number in sweeps]
    )


class _CellReturns(NamedTuple):
    """Returns that are assigned to the cells of a sweep.

    A cell without its own return is assigned the closest return of the same ring.
    """

    points: Floats  # (r, c, 3): meters, in the sensor frame at the firing of each point
    beside: Floats  # (2, r, c, 3): returns of the ring before and after the cell, like `points`
    own: Bools  # (r, c): whether the return belongs to the cell
    known: Bools  # (r, c): whether the pose of the cell's pulse is known
    positions: Floats  # (r c, 3): sensor positions at the firings in the scene frame, meters
    rotations: Floats  # (r c, 3, 3): from the sensor frame to the scene frame

    @classmethod
    def from_sweep(cls, stack: SweepStack, sweep: int, fired: Sweep) -> _CellReturns:
        """Find the returns of all cells in a sweep."""
        points = fired.points
        rings = fired.rings
        assert rings is not None
        nearest = _NearestReturns.from_sweep(stack, sweep, points, rings)
        index = nearest.indices
        ranges = np.linalg.norm(points, axis=1)[index]
        cell_ranges = stack.ranges[sweep]
        with np.errstate(invalid="ignore"):
            own = np.abs(cell_ranges - ranges) < _SAME_RANGE_M
        known = stack.covered[sweep] & (nearest.gap_deg < _MAX_GAP_DEG)
        # If the sensor's motion is compensated, azimuth steps are longer or shorter, so cells may
        # be empty although no pulse was lost.
        min_spacing_deg = _MIN_LOST_STEPS * 360 / cell_ranges.shape[1]
        known &= np.where(np.isfinite(cell_ranges), own, nearest.spacing_deg > min_spacing_deg)
        return cls(
            points[index], points[nearest.sides], own, known, *_firing_poses(fired, index.ravel())
        )


class _NearestReturns(NamedTuple):
    """For each cell of a sweep, the return on the same ring that is closest in azimuth.

    Distances are infinite in rings without a return.
    """

    indices: Ints  # (r, c): indices of the nearest points
    gap_deg: Floats  # (r, c): azimuth difference between the cell and the point
    sides: Ints  # (2, r, c): indices of the points before and after the cell
    spacing_deg: Floats  # (r, c): azimuth difference between the points before and after the cell

    @classmethod
    def from_sweep(
        cls, stack: SweepStack, sweep: int, points: Floats, rings: Ints
    ) -> _NearestReturns:
        """Find the points of a sweep that are closest in azimuth to each cell.

        `rings` contains the ring of each point.
        """
        azimuth = np.arctan2(stack.directions[..., 1], stack.directions[..., 0])
        # Lost pulses are assumed to have the mean azimuth of their cell.
        azimuth = azimuth + np.nan_to_num(stack.azimuth_offsets[sweep])
        cell_deg = (np.degrees(azimuth) + 180) % 360 - 180
        azimuth_deg = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
        # If a pulse has several returns, the closest one comes first.
        order = np.lexsort((np.linalg.norm(points, axis=1), azimuth_deg, rings))
        bounds = np.searchsorted(rings[order], np.stack([stack.rings, stack.rings + 1], axis=1))
        indices_by_ring = [order[start:stop] for start, stop in bounds.tolist()]
        nearest = [
            cls._for_ring(ring_cells, azimuth_deg[ring_points], ring_points)
            for ring_cells, ring_points in zip(cell_deg, indices_by_ring, strict=True)
        ]
        indices, gap_deg, sides, spacing_deg = zip(*nearest, strict=True)
        return cls(
            np.stack(indices), np.stack(gap_deg), np.stack(sides, axis=1), np.stack(spacing_deg)
        )

    @classmethod
    def _for_ring(cls, cell_deg: Floats, ring_deg: Floats, points: Ints) -> _NearestReturns:
        """Find the points of a ring that are closest in azimuth to each cell of the ring.

        Points are sorted by azimuth.
        """
        if not len(points):
            no_point = np.zeros((2, len(cell_deg)), np.int64)
            far_deg = np.full(len(cell_deg), np.inf)
            return cls(no_point[0], far_deg, no_point, far_deg)
        wrapped = np.concatenate([[ring_deg[-1] - 360], ring_deg, [ring_deg[0] + 360]])
        following = np.searchsorted(wrapped, cell_deg).clip(1, len(wrapped) - 1)
        before_deg = cell_deg - wrapped[following - 1]
        after_deg = wrapped[following] - cell_deg
        nearest = np.searchsorted(wrapped, wrapped[following - (before_deg < after_deg)])
        return cls(
            points[(nearest - 1) % len(points)],
            np.abs(wrapped[nearest] - cell_deg),
            points[(following - [[2], [1]]) % len(points)],
            before_deg + after_deg,
        )


@dataclass(frozen=True, eq=False)
class _RayPoses:
    """Poses of individual rays, in the form of a trajectory.

    The time of ray i is i nanoseconds.
    """

    positions: Floats  # (k, 3)
    rotations: Floats  # (k, 3, 3)
    stations: ClassVar[int] = 1
    moves: ClassVar[bool] = True
    duration_ns: ClassVar[float] = np.inf

    def pose(self, station: int, time_ns: float = 0.0) -> Pose:
        positions, rotations = self.poses(station, np.array([time_ns]))
        return Pose.from_rotation(positions[0], rotations[0])

    def poses(self, station: int, times_ns: Floats) -> tuple[Floats, Floats]:
        ray = np.rint(times_ns).astype(np.int64).clip(0, len(self.positions) - 1)
        return self.positions[ray], self.rotations[ray]


@dataclass(frozen=True, eq=False)
class _CellCaster:
    """Ray caster with one ray for each cell of a sweep."""

    scanner: Scanner
    directions: Floats  # (r, c, 3): unit directions in the sensor frame

    @classmethod
    def from_stack(cls, stack: SweepStack, scene: Scene) -> _CellCaster:
        """Create a ray caster for the cells of a sweep stack."""
        rays = stack.directions.reshape(-1, 3)
        shot_ns = np.arange(len(rays), dtype=np.float64)
        sensor = ListedSensor(head=Spin(len(rays), 360), rays=rays, shot_ns=shot_ns)
        scanner = Scanner(scene, sensor, columns=["ray", "range", *NORMAL])
        return cls(scanner, stack.directions)

    def surfaces(self, positions: Floats, rotations: Floats) -> _SceneSurfaces:
        """Cast the rays of all cells, each from the given position and with the given rotation."""
        cloud = self.scanner.sweep(_RayPoses(positions, rotations), number=0)
        shape = self.directions.shape
        cell = np.unravel_index(cloud["ray"].astype(np.int64), shape[:2])
        distance = np.full(shape[:2], np.nan)
        normal = np.full(shape, np.nan)
        distance[cell] = cloud["range"]
        normal[cell] = np.stack([cloud[name] for name in NORMAL], axis=1)
        directions = _rotate_vectors(rotations, self.directions)
        with np.errstate(invalid="ignore", divide="ignore"):
            cosine = (normal * directions).sum(axis=-1)
            slope = distance * np.sqrt(np.maximum(1 / cosine**2 - 1, 0))
            path = distance[..., None] * directions
            scaled_normal = normal / cosine[..., None]
            points = positions.reshape(shape) + path
            smooth = (slope < MAX_TANGENT * distance) & (distance > MIN_RANGE_M)
            tolerance_m = MAX_KINK_M + MAX_KINK_PER_M * distance
            smooth &= CellNeighbors.from_points(points).are_coplanar(
                points, scaled_normal, tolerance_m
            )
        return _SceneSurfaces(distance, slope, path, scaled_normal, smooth)


class _SceneSurfaces(NamedTuple):
    """Scene surfaces that the rays of a sweep's cells hit."""

    distance: Floats  # (r, c): meters; NaN without a hit
    slope: Floats  # (r, c): gradient of the range with respect to the direction, meters per radian
    path: Floats  # (r, c, 3): vector from the sensor to the surface in the scene frame, meters
    scaled_normal: Floats  # (r, c, 3): normal n, as n / (n · d) for the direction d
    smooth: Bools  # (r, c): whether the neighbors lie in one plane with the cell

    def range_errors(self, points: Floats, rotations: Floats) -> Floats:
        """Return the difference between each point's range and the plane in its cell, in meters.

        `points` has shape (r, c, 3) and is in the sensor frame. The plane's range is computed in
        the direction of the point, because pulses are not at the centers of their cells.
        `rotations` has shape (r c, 3, 3) and rotates from the sensor frame to the scene frame.
        """
        ranges = np.linalg.norm(points, axis=-1)
        with np.errstate(invalid="ignore", divide="ignore"):
            directions = _rotate_vectors(rotations, points / ranges[..., None])
            offset = (self.path * self.scaled_normal).sum(axis=-1)
            return np.asarray(ranges - offset / (directions * self.scaled_normal).sum(axis=-1))


def _pulses_of_sweep(
    stack: SweepStack, sweep: int, caster: _CellCaster, fired: Sweep
) -> SweepPulses:
    """Compare a sweep's pulses with the smooth surfaces of a scene."""
    returns = _CellReturns.from_sweep(stack, sweep, fired)
    surfaces = caster.surfaces(returns.positions, returns.rotations)
    residual = np.where(
        returns.own, surfaces.range_errors(returns.points, returns.rotations), np.nan
    )
    beside = np.stack([surfaces.range_errors(side, returns.rotations) for side in returns.beside])
    with np.errstate(invalid="ignore"):
        limit_m = MAX_SIGMAS * ASSUMED_DIRECTION_NOISE_RAD * surfaces.slope
        limit_m = np.maximum(limit_m, SCENE_TOLERANCE_M)
        is_near = (np.abs(residual) < limit_m) & surfaces.smooth
        usable = returns.known & (surfaces.distance < np.nanmax(stack.ranges))
        # A pulse counts as lost only between two returns from the surface. Elsewhere, the surface
        # may be occluded, or may not exist in the recorded place.
        usable &= returns.own | (np.abs(beside) < limit_m).all(axis=0)
    # The surface may not exist in the recorded place if no pulse nearby returns from it.
    usable &= np.isfinite(_means_beside(np.where(is_near, stack.ranges[sweep], np.nan)))
    difference = residual - np.roll(np.where(is_near, residual, np.nan), -1, axis=1)
    difference[:, 1::2] = np.nan  # so that each return contributes to only one difference
    intensity = _means_beside(np.where(is_near, stack.intensities[sweep], np.nan))
    cell = np.nonzero(usable & among_smooth(surfaces.smooth))
    pulses = ScenePulses(
        row=cell[0],
        column=cell[1],
        expected=surfaces.distance[cell],
        slope=surfaces.slope[cell],
        residual=residual[cell],
        intensity=intensity[cell],
        difference=difference[cell],
    )
    errors = np.abs(residual[np.isfinite(residual)])
    return SweepPulses(pulses, len(errors), int((errors < SCENE_TOLERANCE_M).sum()))


def _firing_poses(fired: Sweep, index: Ints) -> tuple[Floats, Floats]:
    """Return the sensor position and rotation at the firing of each point."""
    poses = fired.firing_poses
    assert poses is not None
    if poses.quaternions is None or poses.offsets is None:
        count = len(index)
        rotations = np.broadcast_to(poses.rotation, (count, 3, 3))
        return np.broadcast_to(poses.position, (count, 3)), rotations
    rotations = poses.rotation @ matrices(poses.quaternions[:, index].T)
    return poses.position + poses.offsets[:, index].T, rotations


def _rotate_vectors(rotations: Floats, vectors: Floats) -> Floats:
    turned = np.einsum("kij,kj->ki", rotations, vectors.reshape(-1, 3))
    return np.asarray(turned.reshape(vectors.shape))


def _means_beside(values: Floats) -> Floats:
    """For each cell, return the mean of its neighbors in the same row.

    Neighbors that are NaN are ignored. The mean is NaN if all neighbors are NaN.
    """
    shifts = [shift for shift in range(-_LIGHT_COLUMNS, _LIGHT_COLUMNS + 1) if shift]
    beside = np.stack([np.roll(values, shift, axis=1) for shift in shifts])
    known = np.isfinite(beside)
    sums = np.where(known, beside, 0).sum(axis=0)
    with np.errstate(invalid="ignore"):
        return np.asarray(sums / np.where(known.any(axis=0), known.sum(axis=0), np.nan))
