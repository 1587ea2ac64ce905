"""Aligns sweeps to the planes of a place, and calibrates the rings of the sensor by them.

Odometry is exact to centimeters, and the rings of a sensor differ by as much. Both blur a place.
Here the distances of points to the planes of the map are made small: by the pose of each sweep, and
by an offset of range, elevation and azimuth of each ring. Points as they were fired are compensated
by the motion from their sweep to the next or, if they were fired before the stamp of their sweep,
from the sweep before.

Arrays have s sweeps, r rings and n points.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from lidarsim.columns.sweep import Sweep
from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import Bools, Floats, Ints
from lidarsim.numerics.even_samples import even_indices
from lidarsim.sweeps.sweep_motion import FiringPoses

from ..clouds.rings import MIN_RINGS, elevations
from .lost_pulses import SensorCoverage, lost_pulses
from .motion import Motion, MotionStep
from .odometry import RecordedPoses
from .recorded_sweeps import RecordedSweeps
from .voxel_planes import VoxelPlanes

_MAP_POINTS = 40_000  # points of a sweep in the map that is aligned to
_SWEEP_POINTS = 10_000  # points of a sweep that are aligned
_VOXEL_SHARE = 0.012  # edge of the map's voxels over the median range
_MIN_VOXEL_M = 0.05
_MAX_VOXEL_M = 0.3
_ROUNDS = 4  # of a map and an alignment to this map
_TRIAL_ROUNDS = 2  # of each way in which points may be stored
_TRIAL_SWEEPS = 24  # consecutive
_RANGE_SWEEPS = 48  # that tell the ranges of the sensor
_TURN_M = 10.0  # motion that blurs as much as a turn by a radian
_NEAR_VOXELS = 160  # twice the median range
_MAX_SHARE_OF_VOXELS = 0.99  # of those of the usual way, filled in another way that is right
_SHIFTS = (0.0, 0.5)  # of the voxels that are counted, in voxels
_STEPS = 3  # of Gauss and Newton in a round
_MAX_VOXELS = 1.5  # distance to a plane's center beyond which a point is not compared
_MIN_SIGMA_M = 0.005  # of distances: simulated ranges may have no noise
_TUKEY_SIGMAS = 4.0  # distances beyond which a point does not count (Tukey's biweight)
# Standard deviations of the offsets of rings, before the points say more.
_RANGE_PRIOR_M = 0.05
_ANGLE_PRIOR_RAD = 0.003
_POINT_SIGMA_M = 0.015  # of a point's distance to its plane, for the weight of these
_MIN_PLANE_POINTS = 500  # of a sweep on planes: fewer do not fix its pose
_MIN_ALIGNED_POINTS = 100  # of a sweep; with fewer its pose stays


@dataclass(frozen=True, eq=False)
class Alignment:
    """Poses of the sweeps, motion within them, and offsets of their rings.

    Attributes
    ----------
    poses
        float64 (s, 4, 4): from the sensor frame at the stamp of each sweep to the world.
    times_s
        float64 (s,): stamps of the sweeps.
    sweep_s
        Seconds that a sweep takes: from most sweeps to the next, if none was dropped.
    voxel_m
        Edge of the voxels of the map, meters.
    motion
        How the points of a sweep are compensated.
    ring_offsets
        float64 (r, 3): added to the range (meters), elevation and azimuth (radians) of the points
        of a ring.
    thickness_m
        Median thickness of the planes of the map after each round.
    plane_distance_m
        float64 (s,): median distance of the points of each sweep to their planes.
    """

    poses: Floats
    times_s: Floats
    sweep_s: float
    voxel_m: float
    motion: Motion
    ring_offsets: Floats
    thickness_m: tuple[float, ...] = ()
    plane_distance_m: Floats = field(default_factory=lambda: np.empty(0))

    @classmethod
    def unaligned(
        cls, poses: RecordedPoses, voxel_m: float, motion: Motion, ring_count: int
    ) -> Alignment:
        """Return the alignment of poses, moved to the stamps of sweeps, without corrections."""
        offsets = np.zeros((ring_count, 3))
        sweep_s = float(np.median(np.diff(poses.times_s)))
        alignment = cls(poses.matrices.copy(), poses.times_s, sweep_s, voxel_m, motion, offsets)
        if motion is Motion.COMPENSATED or not poses.share:
            return alignment
        steps = [alignment.step(number) for number in range(len(poses.matrices))]
        return replace(
            alignment,
            poses=np.stack(
                [
                    pose @ step.part(-(poses.first_s + poses.share * sweep_s) / step_s)
                    for pose, (step, step_s) in zip(poses.matrices, steps, strict=True)
                ]
            ),
        )

    def part(self, numbers: Ints) -> Alignment:
        """Return the poses and times of some sweeps, ascending."""
        return replace(self, poses=self.poses[numbers], times_s=self.times_s[numbers])

    def step(self, number: int, *, backward: bool = False) -> tuple[MotionStep, float]:
        """Return the motion from a sweep to the next or to the previous sweep, and its seconds.

        The seconds are negative for a step backward. The last sweep has the motion of the step
        before, and the first sweep has no step backward, so its step is the one forward.
        """
        if backward and number > 0:
            first, second = number, number - 1
        else:
            first = min(number, len(self.poses) - 2)
            second = first + 1
        step_s = float(self.times_s[second] - self.times_s[first])
        return MotionStep.between(self.poses[first], self.poses[second]), step_s

    def compensated(self, sweep: Sweep, number: int) -> tuple[Floats, Floats]:
        """Return the points (n, 3) of a sweep in the sensor frame at its stamp, calibrated.

        The second array (n, 3) has the positions of the sensor when it fired, in the same frame.
        """
        points = self._calibrated(sweep)
        origins = np.zeros_like(points)
        times_s = self.motion.times_s(sweep, self.sweep_s)
        if times_s is None:
            return points, origins
        compensated = np.empty_like(points)
        for rows, step, shares in self._moved(number, times_s):
            compensated[rows] = step.compensated(points[rows], shares)
            origins[rows] = shares[:, None] * step.translation
        return compensated, origins

    def fired(self, sweep: Sweep, number: int) -> tuple[Floats, FiringPoses] | None:
        """Return the points (n, 3) of a sweep as fired, calibrated, and the poses of their firings.

        Returns None if the points are compensated.
        """
        from scipy.spatial.transform import Rotation

        times_s = self.motion.times_s(sweep, self.sweep_s)
        if times_s is None:
            return None
        pose = self.poses[number]
        offsets = np.zeros((len(sweep), 3))
        turns = np.zeros((len(sweep), 3))
        for rows, step, shares in self._moved(number, times_s):
            offsets[rows] = shares[:, None] * (pose[:3, :3] @ step.translation)
            turns[rows] = shares[:, None] * step.rotation
        quaternions = Rotation.from_rotvec(turns).as_quat().T
        poses = FiringPoses(pose[:3, 3], pose[:3, :3], offsets.T, quaternions)
        return self._calibrated(sweep), poses

    def _moved(self, number: int, times_s: Floats) -> Iterator[tuple[Bools, MotionStep, Floats]]:
        """Yield masks of the points fired at times (n,), their step, and their shares of it."""
        for backward, rows in ((False, times_s >= 0), (True, times_s < 0)):
            if rows.any():
                step, step_s = self.step(number, backward=backward)
                yield rows, step, times_s[rows] / step_s

    def _calibrated(self, sweep: Sweep) -> Floats:
        """Return the points (n, 3) of a sweep with the offsets of their rings."""
        points = sweep.points
        if not self.ring_offsets.any():
            return points
        range_offset_m, elevation_offset, azimuth_offset = self.ring_offsets[sweep.columns["row"]].T
        range_m = np.linalg.norm(points, axis=1) + range_offset_m
        elevation = elevations(points) + elevation_offset
        azimuth = np.arctan2(points[:, 1], points[:, 0]) + azimuth_offset
        level = range_m * np.cos(elevation)
        return np.stack(
            [level * np.cos(azimuth), level * np.sin(azimuth), range_m * np.sin(elevation)], axis=1
        )


class AlignedSweep(NamedTuple):
    """Returns of a sweep, as arrays of n points."""

    points: Floats  # (n, 3): in the sensor frame at the stamp, calibrated, meters
    world: Floats  # (n, 3): meters
    origins: Floats  # (n, 3): of the rays, in the world
    ring: Ints  # (n,)
    intensities: Floats | None  # (n,)
    labels: Ints | None  # (n,): of class and object
    gap_range_m: Floats | None = None  # (n,): of lost pulses: ranges around their gaps, or NaN

    @property
    def range_m(self) -> Floats:
        """Ranges (n,) along the rays, meters."""
        return np.asarray(np.linalg.norm(self.world - self.origins, axis=1))


@dataclass(frozen=True, eq=False)
class AlignedSweeps:
    """The sweeps of a recording at their places, which are read one by one."""

    recorded: RecordedSweeps
    alignment: Alignment
    coverage: SensorCoverage

    @property
    def name(self) -> str:
        """Name of the recording, for messages."""
        return self.recorded.recording.name

    def read(self, number: int) -> AlignedSweep:
        """Read a sweep, or raise LidarError if the recording cannot be read."""
        return self.aligned(self.recorded.read(number), number)

    def read_with_lost(self, number: int) -> tuple[AlignedSweep, AlignedSweep]:
        """Read a sweep, and return it and its lost pulses, as points a meter away."""
        step, step_s = self.alignment.step(number)
        # Points as fired have no gaps by motion.
        is_compensated = self.alignment.motion is Motion.COMPENSATED
        share = self.alignment.sweep_s / step_s if is_compensated else 0.0
        moved_m = share * float(np.linalg.norm(step.translation))
        sweep = self.recorded.read(number)
        elevation_rad = self.recorded.elevation_rad
        lost, gap_range_m = lost_pulses(sweep, elevation_rad, self.coverage, moved_m)
        aligned = self.aligned(lost, number)._replace(gap_range_m=gap_range_m)
        return self.aligned(sweep, number), aligned

    def aligned(self, sweep: Sweep, number: int) -> AlignedSweep:
        """Return points of a sweep at their places."""
        points, origins = self.alignment.compensated(sweep, number)
        pose = self.alignment.poses[number]
        return AlignedSweep(
            points=points,
            world=transform_points(points, pose),
            origins=transform_points(origins, pose),
            ring=sweep.columns["row"],
            intensities=sweep.intensity,
            labels=sweep.columns.get("label"),
        )


def first_alignment(sweeps: RecordedSweeps, poses: RecordedPoses) -> Alignment:
    """Return the poses of all sweeps before these are aligned, and how points were stored.

    LidarError if the recording shows hardly any planes, or is mirrored.
    """
    numbers = even_indices(sweeps.count, _RANGE_SWEEPS).tolist()
    voxel_m = _voxel_m([_sample(sweeps.read(number), number) for number in numbers])
    motion = _motion(sweeps, poses, voxel_m)
    return Alignment.unaligned(poses, voxel_m, motion, sweeps.ring_count)


def align(
    sweeps: RecordedSweeps, first: Alignment, numbers: Ints, mapped: Collection[int]
) -> Alignment:
    """Align some sweeps to a map of those that are `mapped`.

    Parameters
    ----------
    sweeps
        The sweeps.
    first
        First estimates of the poses of all sweeps.
    numbers
        (k,): of the sweeps that are aligned, ascending.
    mapped
        Numbers of the sweeps whose points make the map, and calibrate the rings.

    Returns
    -------
    Alignment
        Of the k sweeps.

    Raises
    ------
    LidarError
        If the sweeps show hardly any planes.
    """
    samples = [_sample(sweeps.read(number), number) for number in numbers.tolist()]
    rows = [row for row, number in enumerate(numbers.tolist()) if number in mapped]
    return _rounds(sweeps.recording.name, samples, first.part(numbers), rows, _ROUNDS)


def _motion(sweeps: RecordedSweeps, poses: RecordedPoses, voxel_m: float) -> Motion:
    """Return how points are stored: the way in which some consecutive sweeps fill few voxels.

    Surfaces that several sweeps saw at the same place share voxels. The thickness of planes does
    not tell: of a blurred wall no plane is found, and a level road stays thin.

    LidarError if points fit the poses better with their y axis turned.
    """
    window = _fastest(poses)
    numbers = range(sweeps.count)[window]
    samples = [_sample(sweeps.read(number), number) for number in numbers]
    is_timed = all("time_s" in sample.columns for sample in samples)
    if sweeps.is_compensated:
        candidates = [Motion.COMPENSATED]
    elif is_timed:
        candidates = [Motion.TIMED, Motion.COMPENSATED]
    elif len(sweeps.elevation_rad):
        candidates = [Motion.COMPENSATED, Motion.COUNTERCLOCKWISE, Motion.CLOCKWISE]
    else:
        candidates = [Motion.COMPENSATED]
    name = sweeps.recording.name
    local = poses.part(window)
    trial = partial(_filled_voxels, name, samples, local, sweeps.ring_count, voxel_m)
    filled = {motion: trial(motion) for motion in candidates}
    best = min(candidates, key=filled.__getitem__)
    if filled[best] > _MAX_SHARE_OF_VOXELS * filled[candidates[0]]:
        best = candidates[0]
    if poses.are_given and trial(best, (1, -1, 1)) < _MAX_SHARE_OF_VOXELS * filled[best]:
        raise LidarError(
            f"The points of {name} fit its poses better with y inverted. Either the points "
            "are mirrored, or the poses refer to different axes. Use points and poses in "
            "coordinate systems of the same handedness."
        )
    return best


def _filled_voxels(
    name: str,
    samples: Sequence[Sweep],
    poses: RecordedPoses,
    ring_count: int,
    voxel_m: float,
    motion: Motion,
    scale: tuple[int, int, int] = (1, 1, 1),
) -> int:
    """Return the number of voxels that hold points of sweeps, times `scale`, at their poses.

    Poses by registration are aligned first. Poses that are given are not: alignment would bring
    even mirrored sweeps together. Far points, which are alone in their voxels, do not count.
    """
    scaled = [sample.replace(points=sample.points * scale) for sample in samples]
    alignment = Alignment.unaligned(poses, voxel_m, motion, ring_count)
    numbers = range(len(scaled))
    rounds = 0 if poses.are_given else _TRIAL_ROUNDS
    alignment = _rounds(name, scaled, alignment, numbers, rounds)
    parts = []
    for number, sample in enumerate(scaled):
        points, _ = alignment.compensated(sample, number)
        near = np.linalg.norm(sample.points, axis=1) < _NEAR_VOXELS * voxel_m
        parts.append(transform_points(points[near], alignment.poses[number]))
    # A level floor on a boundary is in two layers of voxels: of other voxels it is in one.
    cells = np.concatenate(parts) / voxel_m
    return sum(
        len(np.unique(np.floor(cells + shift).astype(np.int64), axis=0)) for shift in _SHIFTS
    )


def _fastest(poses: RecordedPoses) -> slice:
    """Return consecutive sweeps in which the sensor moves and turns most."""
    steps = np.diff(poses.matrices, axis=0)
    size = np.linalg.norm(steps[:, :3, 3], axis=1)
    size += _TURN_M * np.linalg.norm(steps[:, :3, :3], axis=(1, 2))
    count = min(_TRIAL_SWEEPS, len(poses.matrices))
    total = np.convolve(size, np.ones(count - 1), "valid")
    start = int(total.argmax())
    return slice(start, start + count)


def _rounds(
    name: str,
    samples: Sequence[Sweep],
    alignment: Alignment,
    mapped: Sequence[int],
    rounds: int,
) -> Alignment:
    """Make a map and align all sweeps to it, several times; LidarError without planes."""
    for _ in range(rounds):
        planes = _planes(name, samples, alignment, mapped)
        alignment = _aligned(alignment, samples, planes, mapped)
    return alignment


def _sample(sweep: Sweep, number: int) -> Sweep:
    """Return some points of a sweep, in an order without a pattern."""
    order = np.random.default_rng(number).permutation(len(sweep))[:_MAP_POINTS]
    return sweep.select(order)


def _voxel_m(samples: Sequence[Sweep]) -> float:
    """Return the edge of the voxels of the map, meters."""
    ranges = np.concatenate([np.linalg.norm(sample.points, axis=1) for sample in samples])
    return float(np.clip(_VOXEL_SHARE * np.median(ranges), _MIN_VOXEL_M, _MAX_VOXEL_M))


def _planes(
    name: str,
    samples: Sequence[Sweep],
    alignment: Alignment,
    mapped: Sequence[int],
) -> VoxelPlanes:
    """Return the planes of the map of some sweeps, or raise LidarError without planes."""
    parts = [
        transform_points(alignment.compensated(samples[number], number)[0], alignment.poses[number])
        for number in mapped
    ]
    planes = VoxelPlanes.from_points(name, np.concatenate(parts), alignment.voxel_m)
    if planes is None:
        raise LidarError(
            f"{name} contains no planar surfaces, such as a floor or walls, which the "
            "reconstruction requires."
        )
    return planes


@dataclass(frozen=True, eq=False)
class _PlanePoints:
    """Points of a sweep on planes of the map."""

    rows: Bools  # (n,): of the sample
    points: Floats  # (k, 3): in the sensor frame
    distances: Floats  # (k,): to the planes, signed, meters
    normals: Floats  # (k, 3): of the planes, in the world
    weights: Floats  # (k,): 0 to 1

    @classmethod
    def from_sweep(
        cls, points: Floats, pose: Floats, planes: VoxelPlanes, voxel_m: float
    ) -> _PlanePoints:
        """Find the points (n, 3) of a sweep, at a pose, that are near planes."""
        distances, plane, rows = planes.distances(
            transform_points(points, pose), _MAX_VOXELS * voxel_m
        )
        spread_m = 1.4826 * float(np.median(np.abs(distances))) if len(distances) else 0.0
        sigma = max(spread_m, _MIN_SIGMA_M)
        weights = np.maximum(1 - (distances / (_TUKEY_SIGMAS * sigma)) ** 2, 0) ** 2
        return cls(rows, points[rows], distances, planes.normals[plane], weights)


def _registered(
    alignment: Alignment, sample: Sweep, planes: VoxelPlanes, number: int
) -> tuple[Floats, _PlanePoints]:
    """Return the pose of a sweep that brings its points to planes, and these points."""
    from scipy.spatial.transform import Rotation

    some = sample.select(slice(_SWEEP_POINTS))
    points, _ = alignment.compensated(some, number)
    pose = alignment.poses[number].copy()
    voxel_m = alignment.voxel_m
    for _ in range(_STEPS):
        on_planes = _PlanePoints.from_sweep(points, pose, planes, voxel_m)
        enough = min(_MIN_PLANE_POINTS, len(points) / 10)
        if len(points) < _MIN_ALIGNED_POINTS or on_planes.weights.sum() < enough:
            return pose, on_planes  # too few surfaces: odometry knows better
        arms = on_planes.points @ pose[:3, :3].T
        design = np.hstack([np.cross(arms, on_planes.normals), on_planes.normals])
        weighted = design * on_planes.weights[:, None]
        # A slight pull to the estimate, in directions that no plane shows.
        normal = weighted.T @ design + np.eye(6)
        change = np.linalg.solve(normal, -weighted.T @ on_planes.distances)
        pose[:3, :3] = Rotation.from_rotvec(change[:3]).as_matrix() @ pose[:3, :3]
        pose[:3, 3] += change[3:]
    return pose, _PlanePoints.from_sweep(points, pose, planes, voxel_m)


def _aligned(
    alignment: Alignment,
    samples: Sequence[Sweep],
    planes: VoxelPlanes,
    mapped: Sequence[int],
) -> Alignment:
    """Return poses and offsets of rings that bring points to planes."""
    poses = alignment.poses.copy()
    ring_count = len(alignment.ring_offsets)
    normal = np.zeros((ring_count, 3, 3))
    side = np.zeros((ring_count, 3))
    distance_m = np.full(len(samples), np.nan)
    calibrating = set(mapped)
    for number, sample in enumerate(samples):
        poses[number], on_planes = _registered(alignment, sample, planes, number)
        if len(on_planes.distances):
            distance_m[number] = np.median(np.abs(on_planes.distances))
        if number in calibrating and ring_count >= MIN_RINGS:
            ring = sample.columns["row"][: len(on_planes.rows)][on_planes.rows]
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
    return replace(
        alignment,
        poses=poses,
        ring_offsets=offsets,
        thickness_m=(*alignment.thickness_m, planes.thickness_m),
        plane_distance_m=distance_m,
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


def transform_points(points: Floats, pose: Floats) -> Floats:
    """Return points (n, 3) moved by a pose (4, 4)."""
    return np.asarray(points @ pose[:3, :3].T + pose[:3, 3])
