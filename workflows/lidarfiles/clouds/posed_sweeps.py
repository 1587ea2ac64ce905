"""Sweeps of a recording with the sensor poses that transform them to world coordinates.

The pose of a sweep is valid at its timestamp. Points as fired are in the sensor frames at their
firings, whose poses are interpolated between the sweeps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from lidarsim.columns.sweep import Sweep
from lidarsim.motion.rotations import quaternions_of
from lidarsim.motion.trajectory import Track, full_poses
from lidarsim.numerics.arrays import Floats, Ints
from lidarsim.sweeps.sweep_motion import FiringPoses

from .recording import PointCloud, Recording


@dataclass(frozen=True, eq=False)
class PosedSweeps:
    """Sweeps of a recording, which are read with their poses. The parts of a cloud have none.

    Attributes
    ----------
    recording
        The recording or cloud.
    notes
        Notes for the user on the sweeps that have been read so far.
    """

    recording: Recording | PointCloud
    notes: list[str] = field(default_factory=list)
    _poses: dict[int, Floats | None] = field(default_factory=dict)

    def read(self, number: int, *, as_fired: bool = False) -> Sweep:
        """Read the returns of a sweep or of a part of a cloud.

        The sweep has a `pose` unless it is unknown. If its points are as fired, it also has their
        `firing_poses`, as far as these are known. If `as_fired` is true, compensated points of
        results are read as fired.

        Raises
        ------
        LidarError
            If the recording cannot be read.
        """
        recording = self.recording
        if isinstance(recording, PointCloud):
            return recording[number].returns()
        info = recording.info
        if info.has_firing_poses and (as_fired or info.compensated is False):
            return recording.fired(number)
        sweep = recording[number].returns()
        if sweep.pose is None and self.recorded_poses is not None:
            sweep = sweep.replace(pose=self.recorded_poses[number])
        self._poses[number] = sweep.pose
        if sweep.compensated is not False or sweep.firing_poses is not None or sweep.pose is None:
            return sweep
        return sweep.replace(firing_poses=self.firing_poses(number, sweep.pose, sweep.times_s))

    def firing_poses(self, number: int, pose: Floats, times_s: Floats | None) -> FiringPoses | None:
        """Interpolate the poses at the firings of a sweep between the poses of the sweeps.

        Parameters
        ----------
        number
            Number of the sweep.
        pose
            Pose of the sweep, of shape (4, 4).
        times_s
            Firing times in seconds relative to the timestamp of the sweep, of shape (n,), or None
            if they are unknown.

        Returns
        -------
        The poses, or None if they are unknown. In the latter case, a note is added if the sensor
        moves.
        """
        recording = self.recording
        if isinstance(recording, PointCloud):
            return None
        stamps_ns = recording.stamps_ns
        path = None
        if times_s is not None and stamps_ns is not None:
            path = path_of_sweep(self._pose, stamps_ns[: len(recording)], number)
        if path is None or times_s is None:
            if np.any(self._pose(0) != self._pose(len(recording) - 1)):
                missing = "its points" if times_s is None else "its sweeps"
                note = (
                    f"{recording.info.name} contains points as fired, but not the times of "
                    f"{missing}. All points of a sweep are placed at the pose of the sweep"
                )
                self.notes.extend([note] if note not in self.notes else [])
            return None
        positions, rotations = poses_at(path, times_s)
        position, rotation = pose[:3, 3], pose[:3, :3]
        quaternions = quaternions_of(rotation.T @ rotations)
        return FiringPoses(position, rotation, (positions - position).T, quaternions.T)

    @cached_property
    def recorded_poses(self) -> Floats | None:
        """Poses of all sweeps, if they are stored apart from the sweeps, otherwise None.

        The shape is (s, 4, 4).
        """
        if isinstance(self.recording, PointCloud) or not self.recording.has_stored_poses:
            return None
        return self.recording.poses(range(len(self.recording)))

    def _pose(self, number: int) -> Floats | None:
        if self.recorded_poses is not None:
            return self.recorded_poses[number]
        if number not in self._poses:
            self._poses[number] = self.recording[number].pose
        return self._poses[number]


def path_of_sweep(
    pose_of: Callable[[int], Floats | None], stamps_ns: Ints, number: int
) -> Track | None:
    """Return the trajectory of the sensor from the previous to the next sweep.

    Parameters
    ----------
    pose_of
        Function that returns the pose of a sweep, of shape (4, 4), or None if it is unknown.
    stamps_ns
        Timestamps of all sweeps in nanoseconds, of shape (s,).
    number
        Number of the sweep.

    Returns
    -------
    Trajectory whose time 0 is the timestamp of the previous sweep. The motion of the first and of
    the last sweep is extrapolated. None if it is unknown.
    """
    pose = pose_of(number)
    count = len(stamps_ns)
    if pose is None or count < 2:
        return None
    step_s = 1e-9 * float(np.median(np.diff(stamps_ns)))
    after, after_s = None, step_s
    before, before_s = None, step_s
    if number + 1 < count:
        after = pose_of(number + 1)
        after_s = 1e-9 * float(stamps_ns[number + 1] - stamps_ns[number])
    if number:
        before = pose_of(number - 1)
        before_s = 1e-9 * float(stamps_ns[number] - stamps_ns[number - 1])
    if after is None and before is not None:
        after, after_s = pose @ np.linalg.inv(before) @ pose, before_s
    if before is None and after is not None:
        before, before_s = pose @ np.linalg.inv(after) @ pose, after_s
    if before is None or after is None or before_s <= 0 or after_s <= 0:
        return None
    samples = np.stack([before, pose, after])
    return Track(
        np.array([-before_s, 0.0, after_s]),
        samples[:, :3, 3],
        quaternions_of(samples[:, :3, :3]),
        beyond="hold",
    )


def poses_at(path: Track, times_s: Floats) -> tuple[Floats, Floats]:
    """Return positions (n, 3) and rotations (n, 3, 3) at times relative to the sweep.

    `path` is the result of `path_of_sweep`.
    """
    return full_poses(path, 0, 1e9 * (np.asarray(times_s) - path.times_s[0]))
