"""Sweep poses that are recorded, read from a file, or estimated by registration."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from lidarfiles.clouds.kitti import CALIBRATION_FILE, lidar_poses
from lidarsim.environment.extras import reading, require_package
from lidarsim.errors import LidarError
from lidarsim.motion.trajectory_files import load_trajectory, read_kitti_poses
from lidarsim.numerics.arrays import Floats, Ints
from lidarsim.words import plural

from .motion import MotionStep
from .recorded_sweeps import RecordedSweeps

_VOXELS_OF_REACH = 75  # range of the sensor in voxels of the map
_MIN_VOXEL_M = 0.25
_MAX_VOXEL_M = 1.0
_POINTS_OF_VOXEL = 4  # registered points per voxel edge
_MAX_DISTANCE_M = 1.0  # maximum distance between a point and the plane of its voxel
_MAP_SWEEPS = 100  # sweeps after which unobserved voxels are removed from the map
_MIN_POINTS = 100  # A sweep with fewer points is not registered. Its motion is extrapolated.
_FIRST_SWEEPS = 4  # sweeps that determine the range of the sensor
_MAX_LOCAL_M = 10_000.0  # maximum coordinate that single precision can represent accurately enough
_MAX_STEP_M = 5.0  # maximum distance between sweeps, which is 180 km/h at 10 Hz
_MAX_ROUNDING_S = 1e-3  # maximum time by which timestamps may lie outside a trajectory
_MIN_CAMERA_M = 1.0  # minimum distance to detect the axes of poses
# minimum share of motion along z, which is forward for a camera and upward for a lidar
_CAMERA_SHARE = 0.9
DEFAULT_PERIOD_S = 0.1  # for recordings without times, since most lidars rotate at 10 Hz


class RecordedPoses(NamedTuple):
    """Poses of all sweeps in a recording."""

    matrices: Floats  # (s, 4, 4), from the sensor frame to the scene frame, meters
    times_s: Floats  # (s,), ascending from 0
    source: str  # a phrase such as "from the recording"
    origin: Floats  # (3,), origin of the scene frame in the world frame, whole meters
    share: float = 0.0  # fraction of the motion within a sweep as fired at which its pose is valid
    first_s: float = 0.0  # time from the timestamp to the first point, if the share is not 0

    @property
    def are_given(self) -> bool:
        """Whether the poses come from the recording or a file instead of a registration."""
        return not self.share

    def select(self, window: slice) -> RecordedPoses:
        """Select the poses of consecutive sweeps."""
        return self._replace(matrices=self.matrices[window], times_s=self.times_s[window])

    @classmethod
    def in_world(cls, matrices: Floats, times_s: Floats, source: str) -> RecordedPoses:
        """Create poses from transformation matrices in world coordinates.

        Large coordinates are reduced by a local origin. `matrices` has shape (s, 4, 4).
        """
        first = matrices[0, :3, 3]
        origin = np.rint(first) if np.abs(first).max() > _MAX_LOCAL_M else np.zeros(3)
        local = matrices.copy()
        local[:, :3, 3] -= origin
        return cls(local, times_s - times_s[0], source, origin)


def find_poses(sweeps: RecordedSweeps, trajectory: Path | None) -> RecordedPoses:
    """Return the poses of all sweeps.

    Parameters
    ----------
    sweeps
        The sweeps.
    trajectory
        File with sensor poses, either with times or as KITTI rows, one for each sweep. By default,
        the poses of the recording are used. If it has none, VGICP (Koide et al., 2021) registers
        each sweep to a map of the earlier sweeps.

    Raises
    ------
    LidarError
        If the trajectory does not match the sweeps, small_gicp is required but not installed, or
        the poses jump.
    """
    times_s = sweeps.stamps_s
    if times_s is None:
        period_s = DEFAULT_PERIOD_S if sweeps.point_times is None else sweeps.point_times.sweep_s
        times_s = period_s * np.arange(sweeps.count, dtype=np.float64)
    if trajectory is not None:
        poses, times_s = _read_poses(sweeps, trajectory, times_s)
        return RecordedPoses.in_world(poses, times_s, f"from {trajectory.name}")
    recorded = sweeps.recording.poses(range(sweeps.count))
    fraction = 0.0
    first_s = 0.0
    # In recordings with one file per sweep, many files state the same default pose, such as
    # VIEWPOINT in PCD files.
    # a lidarpool result, whose sensor may be stationary
    is_known = sweeps.recording.info.has_firing_poses
    if recorded is not None and (is_known or np.ptp(recorded, axis=0).any()):
        poses = recorded
        source = "from the recording"
    else:
        poses = _register_sweeps(sweeps, _step_counts(times_s))
        source = "from registration"
        fraction = 0.5
        first_s = 0.0 if sweeps.point_times is None else sweeps.point_times.first_s
        steps_m = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
        steps_m /= _step_counts(times_s)
        if len(steps_m) and steps_m.max() > _MAX_STEP_M:
            number = int(steps_m.argmax()) + 1
            raise LidarError(
                f"Registration failed, because it places sweep {number} of "
                f"{sweeps.recording.info.name} {steps_m.max():.1f} m away from sweep {number - 1}. "
                "Pass the poses with `--trajectory`."
            )
    located = RecordedPoses.in_world(poses, times_s, source)
    return located._replace(share=fraction, first_s=first_s)


def _read_poses(sweeps: RecordedSweeps, trajectory: Path, times_s: Floats) -> tuple[Floats, Floats]:
    """Read poses from a file, and return the pose and time of each sweep.

    A file without times must have one pose for each sweep. Poses with times are interpolated at the
    timestamps of the sweeps. If the recording has no timestamps, there must be one pose for each
    sweep.
    """
    rows = read_kitti_poses(trajectory)
    if rows is not None:
        return _sensor_poses(sweeps, trajectory, rows), times_s
    track = load_trajectory(trajectory)
    name = sweeps.recording.info.name
    first_s, last_s = (float(track.times_s[k]) for k in (0, -1))
    if sweeps.stamps_s is None:
        if len(track.times_s) != sweeps.count:
            raise LidarError(
                f"{trajectory} contains {plural(len(track.times_s), 'pose')}, but {name} has "
                f"{plural(sweeps.count, 'sweep')} without times. Provide one pose for each "
                "sweep."
            )
        times_s = np.asarray(track.times_s, np.float64)
    elif times_s[0] < first_s - _MAX_ROUNDING_S or times_s[-1] > last_s + _MAX_ROUNDING_S:
        raise LidarError(
            f"{trajectory} covers {first_s:.3f} to {last_s:.3f} s, but the sweeps of {name} "
            f"have timestamps from {times_s[0]:.3f} to {times_s[-1]:.3f} s. Use a trajectory "
            "of the same drive with the same clock, or KITTI poses with one row for each "
            "sweep."
        )
    positions, rotations = track.poses(0, 1e9 * (times_s.clip(first_s, last_s) - first_s))
    poses = np.tile(np.eye(4), (sweeps.count, 1, 1))
    poses[:, :3, :3] = rotations
    poses[:, :3, 3] = positions
    return poses, times_s


def _sensor_poses(sweeps: RecordedSweeps, trajectory: Path, rows: Floats) -> Floats:
    """Convert KITTI rows to sensor poses.

    The rows have shape (k, 3, 4), and the poses have shape (s, 4, 4).

    The rows are camera poses if the recording, or otherwise the folder of the file, contains a
    KITTI calibration.
    """
    name = sweeps.recording.info.name
    if len(rows) != sweeps.count:
        raise LidarError(
            f"{trajectory} contains {plural(len(rows), 'row')} without times, but {name} has "
            f"{plural(sweeps.count, 'sweep')}. Provide one row for each sweep, or poses with "
            "times, such as a TUM file."
        )
    of_recording = sweeps.recording.info.calibration
    is_calibrated = of_recording is not None and of_recording.exists()
    calibration = of_recording if is_calibrated else trajectory.with_name(CALIBRATION_FILE)
    assert calibration is not None
    with reading(str(trajectory)):
        poses = lidar_poses(rows, calibration)
    steps = (np.linalg.inv(poses[:-1]) @ poses[1:])[:, :3, 3]
    length_m = float(np.linalg.norm(steps, axis=1).sum())
    upward_m = float(np.abs(steps[:, 2]).sum())
    if length_m > _MIN_CAMERA_M and upward_m > _CAMERA_SHARE * length_m:
        raise LidarError(
            f"{trajectory} moves the sensor along its z axis, so its poses are probably "
            f"camera poses. Put KITTI's {CALIBRATION_FILE} next to the file, or use sensor "
            "poses with times, such as a TUM file."
        )
    return poses


def _step_counts(times_s: Floats) -> Ints:
    """Return the number of sweep intervals between consecutive sweeps.

    It is greater than 1 where sweeps are missing. The shape is (s - 1,).
    """
    steps_s = np.diff(times_s)
    counts = np.rint(steps_s / np.median(steps_s)) if len(steps_s) else steps_s
    return np.maximum(counts, 1).astype(np.int64)


def _register_sweeps(sweeps: RecordedSweeps, step_counts: Ints) -> Floats:
    """Register each sweep to a map of the earlier sweeps.

    The motion in a sweep interval is assumed to continue. `step_counts` (s - 1,) are the numbers of
    intervals between consecutive sweeps.

    Each voxel of the map and each point has a covariance, so points can slide along planes.
    Point-to-point odometry finds hardly any motion on level ground, because the rings of all sweeps
    form the same circles there. Points are not motion-compensated. All sweeps are distorted in the
    same way, and compensation with an estimated motion makes the estimates oscillate. Registration
    uses one thread, because multithreading changes the results.
    """
    require_package("small_gicp", "twin", "Registering sweeps without poses")
    import small_gicp

    # The first sweeps may be empty or incomplete.
    first = [sweeps.read_surfaces(number) for number in range(_FIRST_SWEEPS)]
    sizes = [np.linalg.norm(sweep.points, axis=1) for sweep in first]
    reach_m = float(np.quantile(np.concatenate(sizes), 0.98)) if any(map(len, sizes)) else 0.0
    voxel_m = float(np.clip(reach_m / _VOXELS_OF_REACH, _MIN_VOXEL_M, _MAX_VOXEL_M))
    voxels = small_gicp.GaussianVoxelMap(voxel_m)
    voxels.set_lru(horizon=_MAP_SWEEPS, clear_cycle=10)
    poses: list[Floats] = []
    step = np.eye(4)
    for number in range(sweeps.count):
        sweep = sweeps.read_surfaces(number)
        count = int(step_counts[number - 1]) if poses else 1
        pose = poses[-1] @ np.linalg.matrix_power(step, count) if poses else np.eye(4)
        if len(sweep) >= _MIN_POINTS:
            points, _ = small_gicp.preprocess_points(
                sweep.points, voxel_m / _POINTS_OF_VOXEL, num_threads=1
            )
            if voxels.size():
                pose = np.array(
                    small_gicp.align(
                        voxels,
                        points,
                        pose,
                        max_correspondence_distance=_MAX_DISTANCE_M,
                        num_threads=1,
                    ).T_target_source
                )
            voxels.insert(points, pose)
        if poses:
            step = np.linalg.inv(poses[-1]) @ pose
            if count > 1:
                step = MotionStep.between(poses[-1], pose).fraction(1 / count)
        poses.append(pose)
    return np.array(poses)
