"""Aligns sweeps to the planes of a place, and calibrates the rings of the sensor by them.

Odometry is exact to centimetres, and the rings of a sensor differ by as much. Both blur a place.
Here the distances of points to the planes of the map are made small: by the pose of each sweep, and
by an offset of range, elevation and azimuth of each ring. Points have to be compensated for the
motion within their sweeps.

Arrays have s sweeps, r rings and n points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from lidarsim.base.arrays import Bools, Floats, Ints
from lidarsim.base.errors import LidarError

from .recorded_sweeps import MIN_RINGS, RecordedSweep, RecordedSweeps, elevations
from .voxel_planes import VoxelPlanes

_MAP_POINTS = 40_000  # points of a sweep in the map that is aligned to
_SWEEP_POINTS = 10_000  # points of a sweep that are aligned
_VOXEL_SHARE = 0.012  # edge of the map's voxels over the median range
_MIN_VOXEL_M = 0.05
_MAX_VOXEL_M = 0.3
_ROUNDS = 4  # of a map and an alignment to this map
_STEPS = 3  # of Gauss and Newton in a round
_MAX_VOXELS = 1.5  # distance to a plane's centre beyond which a point is not compared
_MIN_SIGMA_M = 0.005  # of distances: simulated ranges may have no noise
_TUKEY_SIGMAS = 4.0  # distances beyond which a point does not count (Tukey's biweight)
# Standard deviations of the offsets of rings, before the points say more.
_RANGE_PRIOR_M = 0.05
_ANGLE_PRIOR_RAD = 0.003
_POINT_SIGMA_M = 0.015  # of a point's distance to its plane, for the weight of these
_MIN_PLANE_POINTS = 500  # of a sweep on planes: fewer do not fix its pose


@dataclass(frozen=True, eq=False)
class Alignment:
    """Poses of the sweeps, and offsets of their rings.

    Attributes
    ----------
    poses
        float64 (s, 4, 4): from the sensor frame of each sweep to the world.
    ring_offsets
        float64 (r, 3): added to the range (metres), elevation and azimuth (radians) of the points
        of a ring.
    thickness_m
        Median thickness of the planes of the map after each round.
    plane_distance_m
        float64 (s,): median distance of the points of each sweep to their planes.
    """

    poses: Floats
    ring_offsets: Floats
    thickness_m: tuple[float, ...] = ()
    plane_distance_m: Floats = field(default_factory=lambda: np.empty(0))

    def corrected(self, sweep: RecordedSweep) -> Floats:
        """Return the calibrated points (n, 3) of a sweep in the sensor frame."""
        points = sweep.points
        if not self.ring_offsets.any():
            return points
        range_offset_m, elevation_offset, azimuth_offset = self.ring_offsets[sweep.ring].T
        range_m = np.linalg.norm(points, axis=1) + range_offset_m
        elevation = elevations(points) + elevation_offset
        azimuth = np.arctan2(points[:, 1], points[:, 0]) + azimuth_offset
        level = range_m * np.cos(elevation)
        return np.stack(
            [level * np.cos(azimuth), level * np.sin(azimuth), range_m * np.sin(elevation)], axis=1
        )


class AlignedSweep(NamedTuple):
    """Returns of a sweep, as arrays of n points."""

    points: Floats  # (n, 3): in the sensor frame, calibrated, metres
    world: Floats  # (n, 3): metres
    origin: Floats  # (3,): of the rays, in the world
    ring: Ints  # (n,)
    intensities: Floats | None  # (n,)
    classes: Ints | None  # (n,)

    @property
    def range_m(self) -> Floats:
        """Ranges (n,), metres."""
        return np.asarray(np.linalg.norm(self.points, axis=1))


@dataclass(frozen=True, eq=False)
class AlignedSweeps:
    """The sweeps of a recording at their places, which are read one by one."""

    recorded: RecordedSweeps
    alignment: Alignment

    @property
    def name(self) -> str:
        """Name of the recording, for messages."""
        return self.recorded.recording.name

    def read(self, number: int) -> AlignedSweep:
        """Read a sweep, or raise LidarError if the recording cannot be read."""
        sweep = self.recorded.read(number)
        points = self.alignment.corrected(sweep)
        pose = self.alignment.poses[number]
        return AlignedSweep(
            points=points,
            world=_placed(points, pose),
            origin=pose[:3, 3],
            ring=sweep.ring,
            intensities=sweep.intensities,
            classes=sweep.classes,
        )


def align(sweeps: RecordedSweeps, poses: Floats, mapped: Sequence[int]) -> Alignment:
    """Align all sweeps to a map of some.

    Parameters
    ----------
    sweeps
        The sweeps.
    poses
        (s, 4, 4): first estimates of the poses.
    mapped
        Numbers of the sweeps whose points make the map, and calibrate the rings.

    Raises
    ------
    LidarError
        If the recording shows hardly any planes.
    """
    samples = [_sample(sweeps.read(number), number) for number in range(sweeps.count)]
    alignment = Alignment(poses.copy(), np.zeros((sweeps.ring_count, 3)))
    voxel_m = _voxel_m(samples)
    for _ in range(_ROUNDS):
        planes = _planes(sweeps.recording.name, samples, alignment, mapped, voxel_m)
        alignment = _aligned(alignment, samples, planes, mapped, voxel_m)
    return alignment


def _sample(sweep: RecordedSweep, number: int) -> RecordedSweep:
    """Return some points of a sweep, in an order without a pattern."""
    order = np.random.default_rng(number).permutation(len(sweep))[:_MAP_POINTS]
    return sweep.part(order)


def _voxel_m(samples: Sequence[RecordedSweep]) -> float:
    """Return the edge of the voxels of the map, metres."""
    ranges = np.concatenate([np.linalg.norm(sample.points, axis=1) for sample in samples])
    return float(np.clip(_VOXEL_SHARE * np.median(ranges), _MIN_VOXEL_M, _MAX_VOXEL_M))


def _planes(
    name: str,
    samples: Sequence[RecordedSweep],
    alignment: Alignment,
    mapped: Sequence[int],
    voxel_m: float,
) -> VoxelPlanes:
    """Return the planes of the map of some sweeps, or raise LidarError without planes."""
    parts = [
        _placed(alignment.corrected(samples[number]), alignment.poses[number]) for number in mapped
    ]
    planes = VoxelPlanes.of_points(name, np.concatenate(parts), voxel_m)
    if planes is None:
        raise LidarError(
            f"{name} shows no planes, such as a floor or walls: a place is rebuilt of surfaces."
        )
    return planes


@dataclass(frozen=True, eq=False)
class _PlanePoints:
    """Points of a sweep on planes of the map."""

    rows: Bools  # (n,): of the sample
    points: Floats  # (k, 3): in the sensor frame
    distances: Floats  # (k,): to the planes, signed, metres
    normals: Floats  # (k, 3): of the planes, in the world
    weights: Floats  # (k,): 0 to 1

    @classmethod
    def of_sweep(
        cls, points: Floats, pose: Floats, planes: VoxelPlanes, voxel_m: float
    ) -> _PlanePoints:
        """Find the points (n, 3) of a sweep, at a pose, that are near planes."""
        distances, plane, rows = planes.distances(_placed(points, pose), _MAX_VOXELS * voxel_m)
        spread_m = 1.4826 * float(np.median(np.abs(distances))) if len(distances) else 0.0
        sigma = max(spread_m, _MIN_SIGMA_M)
        weights = np.maximum(1 - (distances / (_TUKEY_SIGMAS * sigma)) ** 2, 0) ** 2
        return cls(rows, points[rows], distances, planes.normals[plane], weights)


def _registered(
    alignment: Alignment, sample: RecordedSweep, planes: VoxelPlanes, number: int, voxel_m: float
) -> tuple[Floats, _PlanePoints]:
    """Return the pose of a sweep that brings its points to planes, and these points."""
    from scipy.spatial.transform import Rotation

    points = alignment.corrected(sample.part(np.arange(min(len(sample), _SWEEP_POINTS))))
    pose = alignment.poses[number].copy()
    for _ in range(_STEPS):
        on_planes = _PlanePoints.of_sweep(points, pose, planes, voxel_m)
        if on_planes.weights.sum() < min(_MIN_PLANE_POINTS, len(points) / 10):
            return pose, on_planes  # too few surfaces: odometry knows better
        arms = on_planes.points @ pose[:3, :3].T
        design = np.hstack([np.cross(arms, on_planes.normals), on_planes.normals])
        weighted = design * on_planes.weights[:, None]
        # A slight pull to the estimate, in directions that no plane shows.
        normal = weighted.T @ design + np.eye(6)
        change = np.linalg.solve(normal, -weighted.T @ on_planes.distances)
        pose[:3, :3] = Rotation.from_rotvec(change[:3]).as_matrix() @ pose[:3, :3]
        pose[:3, 3] += change[3:]
    return pose, _PlanePoints.of_sweep(points, pose, planes, voxel_m)


def _aligned(
    alignment: Alignment,
    samples: Sequence[RecordedSweep],
    planes: VoxelPlanes,
    mapped: Sequence[int],
    voxel_m: float,
) -> Alignment:
    """Return poses and offsets of rings that bring points to planes."""
    poses = alignment.poses.copy()
    ring_count = len(alignment.ring_offsets)
    normal = np.zeros((ring_count, 3, 3))
    side = np.zeros((ring_count, 3))
    distance_m = np.full(len(samples), np.nan)
    calibrating = set(mapped)
    for number, sample in enumerate(samples):
        poses[number], on_planes = _registered(alignment, sample, planes, number, voxel_m)
        if len(on_planes.distances):
            distance_m[number] = np.median(np.abs(on_planes.distances))
        if number in calibrating and ring_count >= MIN_RINGS:
            ring = sample.ring[: len(on_planes.rows)][on_planes.rows]
            design = _ring_design(on_planes, poses[number])
            weighted = design * on_planes.weights[:, None]
            for first in range(3):
                terms = weighted[:, first] * on_planes.distances
                side[:, first] -= np.bincount(ring, terms, ring_count)
                for second in range(3):
                    terms = weighted[:, first] * design[:, second]
                    normal[:, first, second] += np.bincount(ring, terms, ring_count)
    offsets = alignment.ring_offsets
    if ring_count >= MIN_RINGS:
        prior = _POINT_SIGMA_M / np.array([_RANGE_PRIOR_M, _ANGLE_PRIOR_RAD, _ANGLE_PRIOR_RAD])
        normal += np.diag(prior**2)
        offsets = offsets + np.linalg.solve(normal, side[..., None])[..., 0]
    return Alignment(
        poses,
        offsets,
        (*alignment.thickness_m, planes.thickness_m),
        distance_m,
    )


def _ring_design(on_planes: _PlanePoints, pose: Floats) -> Floats:
    """Return changes (k, 3) of distances to planes with range, elevation and azimuth."""
    outward, upward, leftward = _axes(on_planes.points)
    normals = on_planes.normals @ pose[:3, :3]
    return np.stack(
        [np.einsum("ij,ij->i", axis, normals) for axis in (outward, upward, leftward)], axis=1
    )


def _axes(points: Floats) -> tuple[Floats, Floats, Floats]:
    """Return how points (n, 3) move with range, elevation and azimuth: (n, 3) each."""
    ranges = np.linalg.norm(points, axis=1)
    outward = points / ranges[:, None]
    level = np.hypot(points[:, 0], points[:, 1])
    leftward = np.stack([-points[:, 1], points[:, 0], np.zeros_like(level)], axis=1)
    safe = np.maximum(level, 1e-9)
    upward = np.stack(
        [-points[:, 2] * points[:, 0] / safe, -points[:, 2] * points[:, 1] / safe, level], axis=1
    )
    return outward, upward, leftward


def _placed(points: Floats, pose: Floats) -> Floats:
    """Return points (n, 3) moved by a pose (4, 4)."""
    return np.asarray(points @ pose[:3, :3].T + pose[:3, 3])
