"""Align sweeps to the planes of a map, and calibrate the rings of the sensor.

Odometry is accurate to a few centimeters, and the calibration errors of rings are about as large.
Both blur the map. The alignment therefore minimizes the distances between points and the planes of
the map. It adjusts the pose of each sweep, and the range, elevation and azimuth offsets of each
ring.

Points that are stored as fired are motion-compensated with the motion from their sweep to the next.
If they were fired before the timestamp of their sweep, the motion from the previous sweep is used
instead.

In array shapes, s is the number of sweeps, r the number of rings, and n the number of points.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal, NamedTuple

import numpy as np

from lidarfiles.clouds.rings import MIN_RINGS
from lidarfiles.processes.processors import processor_count
from lidarsim.columns.sweep import Sweep
from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import Bools, Floats, Floats32, Ints
from lidarsim.numerics.even_samples import even_indices
from lidarsim.sweeps.sweep_motion import FiringPoses

from ..scan_patterns.lasers import RingLasers, unit_vectors
from .blocked_directions import separated_sweeps
from .lost_pulses import SensorCoverage, lost_pulses
from .motion import Motion, MotionStep
from .odometry import RecordedPoses
from .recorded_sweeps import RecordedSweeps
from .voxel_planes import VoxelPlanes, cell_keys

_MAP_POINTS = 40_000  # points per sweep that are added to the map
_SWEEP_POINTS = 10_000  # points per sweep that are registered to the map
_VOXEL_SHARE = 0.012  # edge length of the map voxels, relative to the median range
_MIN_VOXEL_M = 0.05
_MAX_VOXEL_M = 0.3
_ROUNDS = 4  # iterations of building a map and aligning the sweeps to it
_TRIAL_ROUNDS = 2  # iterations for each candidate of the motion
_TRIAL_SWEEPS = 24  # consecutive sweeps that determine the motion
_RANGE_SWEEPS = 48  # sweeps that determine the median range
_TURN_M = 10.0  # translation in meters that blurs a map as much as a rotation by one radian
_NEAR_VOXELS = 160  # maximum range of counted points in voxels, twice the median range
# Another candidate is only preferred if it fills less than this share of the voxels.
_MAX_SHARE_OF_VOXELS = 0.99
_SHIFTS = (0.0, 0.5)  # offsets of the grids in which voxels are counted, in voxels
_STEPS = 3  # Gauss-Newton steps per iteration
_MAX_VOXELS = 1.5  # maximum distance between a point and the center of its plane, in voxels
# minimum standard deviation of distances, since simulated ranges may have no noise
_MIN_SIGMA_M = 0.005
_TUKEY_SIGMAS = 4.0  # distance at which the weight of a point becomes zero (Tukey's biweight)
# Prior standard deviations of the ring offsets.
_RANGE_PRIOR_M = 0.05
_ANGLE_PRIOR_RAD = 0.003
_POINT_SIGMA_M = 0.015  # standard deviation of distances to planes, which scales the prior
_MIN_PLANE_POINTS = 500  # minimum number of points on planes to determine the pose of a sweep
_MIN_ALIGNED_POINTS = 100  # The pose of a sweep with fewer points is not changed.


@dataclass(frozen=True, eq=False)
class Alignment:
    """Poses of all sweeps, the sensor motion during each sweep, and the offsets of the rings.

    Attributes
    ----------
    poses
        Transformations from the sensor frame at the timestamp of each sweep to the world frame.
        float64 array of shape (s, 4, 4).
    times_s
        Timestamps of the sweeps in seconds. float64 array of shape (s,).
    sweep_s
        Duration of a sweep in seconds, which is the median time between consecutive sweeps.
    voxel_m
        Edge length of the map voxels in meters.
    motion
        How the points of a sweep are motion-compensated.
    ring_offsets
        Offsets that are added to the range (meters), elevation and azimuth (radians) of the points
        of each ring. float64 array of shape (r, 3).
    thickness_m
        Median thickness of the planes of the map after each iteration.
    plane_distance_m
        Median distance between the points of each sweep and their planes. float64 array of shape
        (s,).
    lasers
        Positions and directions of the lasers of the rings, or None if they are at the origin.
    """

    poses: Floats
    times_s: Floats
    sweep_s: float
    voxel_m: float
    motion: Motion
    ring_offsets: Floats
    thickness_m: tuple[float, ...] = ()
    plane_distance_m: Floats = field(default_factory=lambda: np.empty(0))
    lasers: RingLasers | None = None

    @classmethod
    def from_poses(
        cls,
        poses: RecordedPoses,
        voxel_m: float,
        motion: Motion,
        ring_count: int,
        lasers: RingLasers | None = None,
    ) -> Alignment:
        """Create an alignment from poses, converting each pose to the timestamp of its sweep.

        The rings have no offsets.
        """
        offsets = np.zeros((ring_count, 3))
        sweep_s = float(np.median(np.diff(poses.times_s)))
        matrices = poses.matrices.copy()
        alignment = cls(matrices, poses.times_s, sweep_s, voxel_m, motion, offsets, lasers=lasers)
        if motion is Motion.COMPENSATED or not poses.share:
            return alignment
        first_s = -0.5 * sweep_s if motion.is_centered else poses.first_s
        steps = [alignment.step(number) for number in range(len(poses.matrices))]
        return replace(
            alignment,
            poses=np.stack(
                [
                    pose @ step.fraction(-(first_s + poses.share * sweep_s) / step_s)
                    for pose, (step, step_s) in zip(poses.matrices, steps, strict=True)
                ]
            ),
        )

    def select(self, numbers: Ints) -> Alignment:
        """Select the poses and times of the sweeps with the given numbers, in ascending order."""
        return replace(self, poses=self.poses[numbers], times_s=self.times_s[numbers])

    def step(self, number: int, *, backward: bool = False) -> tuple[MotionStep, float]:
        """Return the motion to the next or previous sweep, and the duration of this motion.

        The duration is in seconds, and negative for a backward step. The last sweep has no next
        sweep, so the preceding step is used. The first sweep has no previous sweep, so its backward
        step is the forward step.
        """
        if backward and number > 0:
            first, second = number, number - 1
        else:
            first = min(number, len(self.poses) - 2)
            second = first + 1
        step_s = float(self.times_s[second] - self.times_s[first])
        return MotionStep.between(self.poses[first], self.poses[second]), step_s

    def compensate(self, sweep: Sweep, number: int) -> tuple[Floats, Floats]:
        """Calibrate the points of a sweep, and compensate them for the motion of the sensor.

        Returns
        -------
        tuple of arrays
            Points in the sensor frame at the timestamp of the sweep, and the positions of the
            lasers in the same frame when they fired. Both have shape (n, 3).
        """
        points, origins = self._calibrated(sweep)
        times_s = self.motion.times_s(sweep, self.sweep_s)
        if times_s is None:
            return points, origins
        compensated = np.empty_like(points)
        for rows, step, fractions in self._split_by_step(number, times_s):
            compensated[rows], origins[rows] = step.compensate(
                fractions, points[rows], origins[rows]
            )
        return compensated, origins

    def points_as_fired(self, sweep: Sweep, number: int) -> tuple[Floats, FiringPoses] | None:
        """Return a sweep's calibrated points relative to their lasers at their firing times.

        Also returns the poses of the lasers at these times, whose axes are those of the sensor. The
        points have shape (n, 3). Return None if the points are motion-compensated and the lasers
        are at the origin.
        """
        from scipy.spatial.transform import Rotation

        times_s = self.motion.times_s(sweep, self.sweep_s)
        if times_s is None:
            if self.lasers is None or self.lasers.is_at_origin:
                return None
            times_s = np.zeros(len(sweep))
        points, origins = self._calibrated(sweep)
        pose = self.poses[number]
        offsets = np.zeros((len(sweep), 3))
        turns = np.zeros((len(sweep), 3))
        for rows, step, fractions in self._split_by_step(number, times_s):
            (moved,) = step.compensate(fractions, origins[rows])
            offsets[rows] = moved @ pose[:3, :3].T
            turns[rows] = fractions[:, None] * step.rotation
        quaternions = Rotation.from_rotvec(turns).as_quat().T
        poses = FiringPoses(pose[:3, 3], pose[:3, :3], offsets.T, quaternions)
        return points - origins, poses

    def _split_by_step(
        self, number: int, times_s: Floats
    ) -> Iterator[tuple[Bools, MotionStep, Floats]]:
        """Divide points into groups that move with the step to the next or previous sweep.

        Yields the mask of each group, its step, and the fraction of the step for each point.
        """
        for backward, rows in ((False, times_s >= 0), (True, times_s < 0)):
            if rows.any():
                step, step_s = self.step(number, backward=backward)
                yield rows, step, times_s[rows] / step_s

    def _calibrated(self, sweep: Sweep) -> tuple[Floats, Floats]:
        """Apply the ring offsets to the points of a sweep.

        Returns the points and the positions of their lasers, both with shape (n, 3).
        """
        ring = sweep.columns["row"]
        lasers = self.lasers or RingLasers.at_origin(np.zeros(len(self.ring_offsets)))
        is_calibrated = not self.ring_offsets.any()
        if is_calibrated and lasers.is_at_origin:
            return sweep.points, np.zeros_like(sweep.points)
        azimuth, elevation = lasers.angles(sweep.points, ring)
        origins = lasers.positions(azimuth, elevation, ring)
        if is_calibrated:
            return sweep.points, origins
        range_offset_m, elevation_offset, azimuth_offset = self.ring_offsets[ring].T
        range_m = np.linalg.norm(sweep.points - origins, axis=1) + range_offset_m
        directions = unit_vectors(azimuth + azimuth_offset, elevation + elevation_offset)
        return origins + range_m[:, None] * directions, origins


class AlignedSweep(NamedTuple):
    """Returns of a sweep in world coordinates, as arrays of n points."""

    points: Floats  # (n, 3), meters, calibrated, in the sensor frame at the timestamp
    world: Floats  # (n, 3), meters, in the world frame
    origins: Floats  # (n, 3), ray origins in the world frame, meters
    ring: Ints  # (n,)
    intensities: Floats | None  # (n,)
    labels: Ints | None  # (n,), class and object
    gap_range_m: Floats | None = None  # (n,), ranges at the gaps of lost pulses, or NaN
    is_blocked: Bools | None = None  # (n,), whether the vehicle blocks the pulse

    @property
    def range_m(self) -> Floats:
        """Range of each return along its ray, in meters.

        The array has shape (n,).
        """
        return np.asarray(np.linalg.norm(self.world - self.origins, axis=1))


@dataclass(frozen=True)
class _Cache:
    """Results of reading the sweeps of a submap, each of which is read several times.

    Attributes
    ----------
    compensated
        Compensated points and the positions of their lasers, both of shape (n, 3), by sweep number
        and part of the sweep.
    lost
        Lost pulses that the vehicle does not block, and the ranges at their gaps, by sweep number.
    """

    compensated: dict[tuple[int, str], tuple[Floats32, Floats32]] = field(default_factory=dict)
    lost: dict[int, tuple[Sweep, Floats]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class AlignedSweeps:
    """Sweeps of a recording with aligned poses. Only one sweep is read at a time."""

    recorded: RecordedSweeps
    alignment: Alignment
    coverage: SensorCoverage
    _cache: _Cache | None = None

    def with_cache(self) -> AlignedSweeps:
        """Return a copy that keeps the compensated points and lost pulses of the sweeps it reads.

        The points are rounded to single precision in the sensor frame, to save memory.
        """
        return replace(self, _cache=_Cache())

    @property
    def name(self) -> str:
        """Name of the recording, for use in messages."""
        return self.recorded.recording.info.name

    def find_coverage(self, numbers: Ints) -> SensorCoverage:
        """Return the coverage with the blocked directions that some sweeps show.

        The directions are unknown if the points are motion-compensated, or if the sweeps were
        recorded at too few positions.

        Raises
        ------
        LidarError
            If the recording cannot be read.
        """
        if self.alignment.motion is Motion.COMPENSATED:
            return self.coverage
        separated = separated_sweeps(numbers, self.alignment.poses[:, :3, 3])
        return self.coverage.with_blocked(self.recorded, separated)

    def read(self, number: int) -> AlignedSweep:
        """Read a sweep and transform it to world coordinates.

        Raises
        ------
        LidarError
            If the recording cannot be read.
        """
        return self._align_once(self.recorded.read(number), number, "returns")

    def read_with_lost(self, number: int) -> tuple[AlignedSweep, AlignedSweep]:
        """Read a sweep, and determine which of its pulses were lost in the surroundings.

        The lost pulses are represented by points one meter from their lasers. Pulses that the
        vehicle blocks did not reach the surroundings, so they are omitted.
        """
        passed, gap_range_m = self._read_passed(number)
        aligned = self._align_once(passed, number, "lost")
        return self.read(number), aligned._replace(gap_range_m=gap_range_m)

    def _read_passed(self, number: int) -> tuple[Sweep, Floats]:
        """Return the lost pulses that the vehicle does not block, and the ranges at their gaps."""
        kept = None if self._cache is None else self._cache.lost.get(number)
        if kept is None:
            lost, gap_range_m = self.read_lost(number)
            passed = ~self._are_blocked(lost)
            kept = lost.select(passed), gap_range_m[passed]
            if self._cache is not None:
                self._cache.lost[number] = kept
        return kept

    def read_lost(self, number: int) -> tuple[Sweep, Floats]:
        """Determine the lost pulses of a sweep and the ranges at their gaps, as `lost_pulses` does.

        Raises
        ------
        LidarError
            If the recording cannot be read.
        """
        step, step_s = self.alignment.step(number)
        # Without motion compensation, motion does not cause gaps between points.
        is_compensated = self.alignment.motion is Motion.COMPENSATED
        fraction = self.alignment.sweep_s / step_s if is_compensated else 0.0
        moved_m = fraction * float(np.linalg.norm(step.translation))
        sweep = self.recorded.read_all(number)
        return lost_pulses(sweep, self.recorded.lasers, self.coverage, moved_m)

    def _are_blocked(self, sweep: Sweep) -> Bools:
        """Return whether the vehicle blocks the pulses of a sweep, of shape (n,)."""
        ring = sweep.columns["row"]
        azimuth, _ = self.recorded.lasers.angles(sweep.points, ring)
        return self.coverage.blocked.contains(azimuth, ring)

    def read_pulses(self, number: int) -> tuple[AlignedSweep, AlignedSweep]:
        """Read the pulses of a sweep as the sensor model fires them, and those that were lost.

        A pulse starts at the laser of its ring, at the elevation of the ring. Of the recorded
        sweep, only the azimuths of the head remain in the directions. In sweeps whose rings have no
        constant elevations, such as motion-compensated ones, the recorded directions are used.
        Pulses that the vehicle blocks are included and marked.
        """
        sweep = self.recorded.read(number)
        lost, gap_range_m = self.read_lost(number)
        lasers = self.recorded.lasers
        modeled = lasers.on_rings(sweep) if lasers.have_constant_elevations else sweep
        returned = self.align(modeled, number)._replace(is_blocked=self._are_blocked(sweep))
        aligned = self.align(lost, number)._replace(is_blocked=self._are_blocked(lost))
        return returned, aligned._replace(gap_range_m=gap_range_m)

    def align(self, sweep: Sweep, number: int) -> AlignedSweep:
        """Transform the points of a sweep to world coordinates."""
        return self._place(sweep, number, *self.alignment.compensate(sweep, number))

    def _align_once(
        self, sweep: Sweep, number: int, part: Literal["returns", "lost"]
    ) -> AlignedSweep:
        """Align a part of a sweep, and keep its compensated points if there is a cache."""
        if self._cache is None:
            return self.align(sweep, number)
        kept = self._cache.compensated.get((number, part))
        if kept is None:
            points, origins = self.alignment.compensate(sweep, number)
            kept = points.astype(np.float32), origins.astype(np.float32)
            self._cache.compensated[number, part] = kept
        return self._place(sweep, number, *(array.astype(np.float64) for array in kept))

    def _place(self, sweep: Sweep, number: int, points: Floats, origins: Floats) -> AlignedSweep:
        """Transform compensated points and the positions of their lasers to world coordinates."""
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
    """Create the initial alignment of a recording from given poses.

    Also determines whether the points are motion-compensated.

    Raises
    ------
    LidarError
        If the recording contains hardly any planes or is mirrored.
    """
    numbers = even_indices(sweeps.count, _RANGE_SWEEPS).tolist()
    voxel_m = _voxel_m([_sample(sweeps.read_surfaces(number), number) for number in numbers])
    motion = _motion(sweeps, poses, voxel_m)
    return Alignment.from_poses(poses, voxel_m, motion, sweeps.ring_count, sweeps.lasers)


def align(
    sweeps: RecordedSweeps, first: Alignment, numbers: Ints, mapped: Collection[int]
) -> Alignment:
    """Align sweeps to a map that is built from the sweeps in `mapped`.

    Parameters
    ----------
    sweeps
        All sweeps of the recording.
    first
        Initial estimates of the poses of all sweeps.
    numbers
        Numbers of the sweeps to align, in ascending order. Array of shape (k,).
    mapped
        Numbers of the sweeps whose points form the map and calibrate the rings.

    Returns
    -------
    Alignment
        Alignment of the k sweeps.

    Raises
    ------
    LidarError
        If the sweeps contain hardly any planes.
    """
    samples = [_sample(sweeps.read_surfaces(number), number) for number in numbers.tolist()]
    rows = [row for row, number in enumerate(numbers.tolist()) if number in mapped]
    return _align_iteratively(
        sweeps.recording.info.name, samples, first.select(numbers), rows, _ROUNDS
    )


def _motion(sweeps: RecordedSweeps, poses: RecordedPoses, voxel_m: float) -> Motion:
    """Determine whether the points are motion-compensated, unless the recording states it.

    If they are not, also determine how their firing times are known. Surfaces that several sweeps
    observe share voxels if the points are compensated correctly. The candidate is chosen for which
    some consecutive sweeps fill the fewest voxels. The thickness of the planes is not a useful
    criterion, because a blurred wall is not detected as a plane, and a level road stays thin.

    Raise LidarError if the points fit the poses better with an inverted y axis.
    """
    window = _fastest_window(poses)
    numbers = range(sweeps.count)[window]
    samples = [_sample(sweeps.read_surfaces(number), number) for number in numbers]
    candidates = _motion_candidates(sweeps, samples)
    name = sweeps.recording.info.name
    local = poses.select(window)
    trial = partial(_filled_voxels, sweeps, samples, local, voxel_m)
    # Sorting and nearest-neighbor queries release the GIL.
    with ThreadPoolExecutor(min(len(candidates), processor_count())) as threads:
        filled = dict(zip(candidates, threads.map(trial, candidates), strict=True))
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


def _motion_candidates(sweeps: RecordedSweeps, samples: Sequence[Sweep]) -> list[Motion]:
    """Return the possible motions, starting with the one that is used if several fit."""
    if sweeps.is_compensated:
        return [Motion.COMPENSATED]
    compensated = [] if sweeps.is_compensated is False else [Motion.COMPENSATED]
    if all("time_s" in sample.columns for sample in samples):
        return [Motion.TIMED, *compensated]
    if len(sweeps.elevation_rad):
        return [
            *compensated,
            Motion.COUNTERCLOCKWISE,
            Motion.CLOCKWISE,
            Motion.CENTERED_COUNTERCLOCKWISE,
            Motion.CENTERED_CLOCKWISE,
        ]
    return [Motion.COMPENSATED]  # The firing times are unknown.


def _filled_voxels(
    sweeps: RecordedSweeps,
    samples: Sequence[Sweep],
    poses: RecordedPoses,
    voxel_m: float,
    motion: Motion,
    scale: tuple[int, int, int] = (1, 1, 1),
) -> int:
    """Count the voxels that contain points when the sweeps are placed at their poses.

    The points are multiplied by `scale` first. Poses from registration are aligned before the
    voxels are counted. Given poses are not, because alignment would make even mirrored sweeps
    consistent. Points at long range do not count, because each of them fills its own voxel.
    """
    scaled = [sample.replace(points=sample.points * scale) for sample in samples]
    # Mirrored points are not where the lasers expect them.
    lasers = sweeps.lasers if scale == (1, 1, 1) else None
    alignment = Alignment.from_poses(poses, voxel_m, motion, sweeps.ring_count, lasers)
    numbers = range(len(scaled))
    rounds = 0 if poses.are_given else _TRIAL_ROUNDS
    alignment = _align_iteratively(sweeps.recording.info.name, scaled, alignment, numbers, rounds)
    parts = []
    for number, sample in enumerate(scaled):
        points, _ = alignment.compensate(sample, number)
        near = np.linalg.norm(sample.points, axis=1) < _NEAR_VOXELS * voxel_m
        parts.append(transform_points(points[near], alignment.poses[number]))
    # A level floor on a voxel boundary fills two layers of voxels, but only one layer of a shifted
    # grid.
    placed = np.concatenate(parts)
    return sum(len(np.unique(cell_keys(placed + shift * voxel_m, voxel_m))) for shift in _SHIFTS)


def _fastest_window(poses: RecordedPoses) -> slice:
    """Return the consecutive sweeps during which the sensor moves the most."""
    steps = np.diff(poses.matrices, axis=0)
    size = np.linalg.norm(steps[:, :3, 3], axis=1)
    size += _TURN_M * np.linalg.norm(steps[:, :3, :3], axis=(1, 2))
    count = min(_TRIAL_SWEEPS, len(poses.matrices))
    total = np.convolve(size, np.ones(count - 1), "valid")
    start = int(total.argmax())
    return slice(start, start + count)


def _align_iteratively(
    name: str,
    samples: Sequence[Sweep],
    alignment: Alignment,
    mapped: Sequence[int],
    rounds: int,
) -> Alignment:
    """Alternate between building a map and aligning all sweeps to it.

    Raise LidarError if the map has no planes.
    """
    for _ in range(rounds):
        planes = _map_planes(name, samples, alignment, mapped)
        alignment = _align_to_planes(alignment, samples, planes, mapped)
    return alignment


def _sample(sweep: Sweep, number: int) -> Sweep:
    order = np.random.default_rng(number).permutation(len(sweep))[:_MAP_POINTS]
    return sweep.select(order)


def _voxel_m(samples: Sequence[Sweep]) -> float:
    ranges = np.concatenate([np.linalg.norm(sample.points, axis=1) for sample in samples])
    return float(np.clip(_VOXEL_SHARE * np.median(ranges), _MIN_VOXEL_M, _MAX_VOXEL_M))


def _map_planes(
    name: str,
    samples: Sequence[Sweep],
    alignment: Alignment,
    mapped: Sequence[int],
) -> VoxelPlanes:
    """Return the planes of a map of the `mapped` sweeps, or raise LidarError if there are none."""
    parts = [
        transform_points(alignment.compensate(samples[number], number)[0], alignment.poses[number])
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
    """Points of a sweep that lie on planes of the map."""

    rows: Bools  # (n,), mask of the points of the sample
    points: Floats  # (k, 3), in the sensor frame
    beams: Floats  # (k, 3), vectors from the lasers to the points, in the sensor frame
    distances: Floats  # (k,), signed distances to the planes, meters
    normals: Floats  # (k, 3), plane normals in the world frame
    weights: Floats  # (k,), 0 to 1

    @classmethod
    def from_sweep(
        cls, points: Floats, origins: Floats, pose: Floats, planes: VoxelPlanes, voxel_m: float
    ) -> _PlanePoints:
        """Find the points of a sweep that are close to planes of the map.

        `origins` are the positions of their lasers.
        """
        distances, plane, rows = planes.distances(
            transform_points(points, pose), _MAX_VOXELS * voxel_m
        )
        spread_m = 1.4826 * float(np.median(np.abs(distances))) if len(distances) else 0.0
        sigma = max(spread_m, _MIN_SIGMA_M)
        weights = np.maximum(1 - (distances / (_TUKEY_SIGMAS * sigma)) ** 2, 0) ** 2
        near = points[rows]
        return cls(rows, near, near - origins[rows], distances, planes.normals[plane], weights)


def _register_to_planes(
    alignment: Alignment, sample: Sweep, planes: VoxelPlanes, number: int
) -> tuple[Floats, _PlanePoints]:
    """Register a sweep to the planes of the map.

    Return its pose and its points on planes.
    """
    from scipy.spatial.transform import Rotation

    some = sample.select(slice(_SWEEP_POINTS))
    points, origins = alignment.compensate(some, number)
    pose = alignment.poses[number].copy()
    voxel_m = alignment.voxel_m
    for _ in range(_STEPS):
        on_planes = _PlanePoints.from_sweep(points, origins, pose, planes, voxel_m)
        enough = min(_MIN_PLANE_POINTS, len(points) / 10)
        if len(points) < _MIN_ALIGNED_POINTS or on_planes.weights.sum() < enough:
            return pose, on_planes  # With too few surfaces, odometry is more accurate.
        arms = on_planes.points @ pose[:3, :3].T
        design = np.hstack([np.cross(arms, on_planes.normals), on_planes.normals])
        weighted = design * on_planes.weights[:, None]
        # A weak prior keeps the estimate in directions that no plane constrains.
        normal = weighted.T @ design + np.eye(6)
        change = np.linalg.solve(normal, -weighted.T @ on_planes.distances)
        pose[:3, :3] = Rotation.from_rotvec(change[:3]).as_matrix() @ pose[:3, :3]
        pose[:3, 3] += change[3:]
    return pose, _PlanePoints.from_sweep(points, origins, pose, planes, voxel_m)


def _align_to_planes(
    alignment: Alignment,
    samples: Sequence[Sweep],
    planes: VoxelPlanes,
    mapped: Sequence[int],
) -> Alignment:
    """Align all sweeps to the planes, and use the `mapped` sweeps to calibrate the rings."""
    poses = alignment.poses.copy()
    ring_count = len(alignment.ring_offsets)
    normal = np.zeros((ring_count, 3, 3))
    side = np.zeros((ring_count, 3))
    distance_m = np.full(len(samples), np.nan)
    calibrating = set(mapped)
    for number, sample in enumerate(samples):
        poses[number], on_planes = _register_to_planes(alignment, sample, planes, number)
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
        side -= prior**2 * offsets  # Otherwise, offsets that no plane determines would drift.
        offsets = offsets + np.linalg.solve(normal, side[..., None])[..., 0]
    return replace(
        alignment,
        poses=poses,
        ring_offsets=offsets,
        thickness_m=(*alignment.thickness_m, planes.thickness_m),
        plane_distance_m=distance_m,
    )


def _ring_design(on_planes: _PlanePoints, pose: Floats) -> Floats:
    """Return the derivatives of the distances to planes with respect to the ring offsets.

    The array has shape (k, 3), for range, elevation and azimuth.
    """
    outward, upward, leftward = _spherical_derivatives(on_planes.beams)
    normals = on_planes.normals @ pose[:3, :3]
    return np.stack(
        [np.einsum("ij,ij->i", axis, normals) for axis in (outward, upward, leftward)], axis=1
    )


def _spherical_derivatives(points: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the derivatives of points with respect to range, elevation and azimuth.

    The points are relative to their lasers.

    Each array has shape (n, 3).
    """
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
    """Transform points with a pose matrix.

    The points have shape (n, 3), and the pose has shape (4, 4).
    """
    return np.asarray(points @ pose[:3, :3].T + pose[:3, 3])
