"""Poses of the sweeps of a recording: recorded, of a file, or by registration."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from lidarsim.environment.extras import reading, require_package
from lidarsim.errors import LidarError
from lidarsim.motion.trajectory_files import load_trajectory, read_kitti_poses
from lidarsim.numerics.arrays import Floats
from lidarsim.words import plural

from ..clouds.kitti import CALIBRATION_FILE, lidar_poses
from .recorded_sweeps import RecordedSweeps

_VOXELS_OF_REACH = 75  # voxels of the map in the range of the sensor
_MIN_VOXEL_M = 0.25
_MAX_VOXEL_M = 1.0
_POINTS_OF_VOXEL = 4  # points that are registered in the length of a voxel
_MAX_DISTANCE_M = 1.0  # of a point from its voxel's plane
_MAP_SWEEPS = 100  # since a voxel was last met, after which the map forgets it
_MIN_POINTS = 100  # of a sweep that is registered; with fewer the motion goes on
_FIRST_SWEEPS = 4  # that tell the reach of the sensor
_MAX_LOCAL_M = 10_000.0  # coordinates of a place that single precision holds
_MAX_STEP_M = 5.0  # from sweep to sweep at 10 Hz: 180 km/h
_MAX_ROUNDING_S = 1e-3  # by which stamps may lie outside a trajectory
_MIN_CAMERA_M = 1.0  # motion that shows the axes of poses
_CAMERA_SHARE = 0.9  # of the motion along z, which is forward for a camera and upward for a lidar
DEFAULT_PERIOD_S = 0.1  # of a recording without times: most lidars turn at 10 Hz


class RecordedPoses(NamedTuple):
    """Poses of the sweeps of a recording."""

    matrices: Floats  # (s, 4, 4): from the sensor frame to the frame of the place, meters
    times_s: Floats  # (s,): ascending, from 0
    source: str  # a clause, such as "of the recording"
    origin: Floats  # (3,): of the frame of the place in the world, whole meters
    share: float = 0.0  # of the motion of a sweep as fired, at which its pose holds
    first_s: float = 0.0  # from the stamp of a sweep to its first point, of poses with a share

    @property
    def are_given(self) -> bool:
        """Whether the poses are not found by registration of the points."""
        return not self.share

    def part(self, window: slice) -> RecordedPoses:
        """Return the poses of some consecutive sweeps."""
        return self._replace(matrices=self.matrices[window], times_s=self.times_s[window])

    @classmethod
    def in_world(cls, matrices: Floats, times_s: Floats, source: str) -> RecordedPoses:
        """Make poses (s, 4, 4) in the world local, if they are far from zero."""
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
        A file with poses of the sensor, with times or as rows of KITTI, one for each sweep. By
        default the poses are the recording's, and without these VGICP (Koide et al., 2021)
        registers each sweep to a map of the earlier sweeps.

    Raises
    ------
    LidarError
        If the trajectory does not fit the sweeps, small_gicp is needed and not installed, or the
        poses jump.
    """
    times_s = sweeps.stamps_s
    if times_s is None:
        period_s = DEFAULT_PERIOD_S if sweeps.point_times is None else sweeps.point_times.sweep_s
        times_s = period_s * np.arange(sweeps.count, dtype=np.float64)
    if trajectory is not None:
        poses, times_s = _of_file(sweeps, trajectory, times_s)
        return RecordedPoses.in_world(poses, times_s, f"from {trajectory.name}")
    recorded = sweeps.recording.poses(range(sweeps.count))
    if recorded is not None and not np.isfinite(recorded).all():
        number = int(np.flatnonzero(~np.isfinite(recorded).all(axis=(1, 2)))[0])
        raise LidarError(
            f"{sweeps.recording.name} contains an invalid pose for sweep {number}. Pass the "
            "poses with `--trajectory`."
        )
    share = 0.0
    first_s = 0.0
    # Many files of a sweep each state the pose of none, as VIEWPOINT of PCD does.
    is_known = sweeps.recording.fired is not None  # of a result, which may stand
    if recorded is not None and (is_known or np.ptp(recorded, axis=0).any()):
        poses = recorded
        source = "from the recording"
    else:
        poses = _registered(sweeps)
        source = "from registration"
        share = 0.5
        first_s = 0.0 if sweeps.point_times is None else sweeps.point_times.first_s
        steps_m = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
        if len(steps_m) and steps_m.max() > _MAX_STEP_M:
            number = int(steps_m.argmax()) + 1
            raise LidarError(
                f"Registration failed, because it places sweep {number} of "
                f"{sweeps.recording.name} {steps_m.max():.1f} m away from sweep {number - 1}. "
                "Pass the poses with `--trajectory`."
            )
    located = RecordedPoses.in_world(poses, times_s, source)
    return located._replace(share=share, first_s=first_s)


def _of_file(sweeps: RecordedSweeps, trajectory: Path, times_s: Floats) -> tuple[Floats, Floats]:
    """Return the poses (s, 4, 4) of a file, and the times (s,) of the sweeps.

    A file without times has one pose for each sweep. Poses with times are looked up at the stamps
    of the sweeps; if the recording has no stamps, there is one pose for each sweep.
    """
    rows = read_kitti_poses(trajectory)
    if rows is not None:
        return _of_rows(sweeps, trajectory, rows), times_s
    track = load_trajectory(trajectory)
    name = sweeps.recording.name
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


def _of_rows(sweeps: RecordedSweeps, trajectory: Path, rows: Floats) -> Floats:
    """Return the poses (s, 4, 4) of the sensor, given KITTI's rows (k, 3, 4).

    The rows are poses of a camera if the recording, or else the folder of the file, has KITTI's
    calibration.
    """
    name = sweeps.recording.name
    if len(rows) != sweeps.count:
        raise LidarError(
            f"{trajectory} contains {plural(len(rows), 'row')} without times, but {name} has "
            f"{plural(sweeps.count, 'sweep')}. Provide one row for each sweep, or poses with "
            "times, such as a TUM file."
        )
    of_recording = sweeps.recording.calibration
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


def _registered(sweeps: RecordedSweeps) -> Floats:
    """Register each sweep to a map of the earlier sweeps, in one thread: threads change results.

    Each voxel of the map and each point has a covariance, so that points move along planes freely.
    Odometry from point to point finds hardly any motion on level ground, where the rings of all
    sweeps are the same circles. Points are not compensated for the motion within sweeps: all sweeps
    are distorted alike, and to compensate by a motion that is estimated so makes estimates swing.
    """
    require_package("small_gicp", "twin", "Registering sweeps without poses")
    import small_gicp

    # The first sweeps may be empty, or parts of one.
    sizes = [np.linalg.norm(sweeps.read(number).points, axis=1) for number in range(_FIRST_SWEEPS)]
    reach_m = float(np.quantile(np.concatenate(sizes), 0.98)) if any(map(len, sizes)) else 0.0
    voxel_m = float(np.clip(reach_m / _VOXELS_OF_REACH, _MIN_VOXEL_M, _MAX_VOXEL_M))
    voxels = small_gicp.GaussianVoxelMap(voxel_m)
    voxels.set_lru(horizon=_MAP_SWEEPS, clear_cycle=10)
    poses: list[Floats] = []
    step = np.eye(4)
    for number in range(sweeps.count):
        sweep = sweeps.read(number)
        pose = poses[-1] @ step if poses else np.eye(4)
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
        poses.append(pose)
    return np.array(poses)
