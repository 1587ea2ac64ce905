"""Motion of the sensor during the sweeps of a recording.

Points of motion-compensated sweeps are in the sensor frame at the timestamp of the sweep, but each
pulse was fired from another pose. The scan pattern is only regular in the sensor frames at the
firing times.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from lidarfiles.clouds.posed_sweeps import path_of_sweep, poses_at
from lidarfiles.clouds.recording import Recording
from lidarsim.columns.sweep import Sweep
from lidarsim.motion.trajectory import Track
from lidarsim.numerics.arrays import Floats

_MAX_LOCAL_M = 1e4  # distance from the origin beyond which the world frame is shifted


class SweepMotion(NamedTuple):
    """Motion of the sensor during a sweep.

    Attributes
    ----------
    poses
        Positions (3,) or (f, 3) and rotations (3, 3) or (f, 3, 3) of the frame of the rays in the
        world frame, or None if they are not needed.
    origins
        (f, 3): sensor positions at the firings in the frame of the sweep in meters, or None if the
        points are not compensated for motion.
    rotations
        (f, 3, 3): rotations from the sensor frame at the firings to the frame of the sweep, or
        None.
    stamp_pose
        (4, 4): transformation from the frame of the sweep to the world frame.
    """

    poses: tuple[Floats, Floats] | None = None
    origins: Floats | None = None
    rotations: Floats | None = None
    stamp_pose: Floats = np.eye(4)


@dataclass(frozen=True, eq=False)
class SensorMotion:
    """Motion of the sensor of a recording.

    Attributes
    ----------
    recording
        The recording.
    poses
        (s, 4, 4): poses of the sweeps in the world frame, minus `shift`, or None if they are
        unknown or not needed.
    shift
        (3,): translation of the world frame in meters, so that coordinates are small.
    """

    recording: Recording
    poses: Floats | None = None
    shift: Floats = field(default_factory=lambda: np.zeros(3))

    @classmethod
    def from_recording(cls, recording: Recording, *, has_objects: bool) -> SensorMotion:
        """Read the poses of a recording if they are needed.

        They are needed for inserted objects, and for compensated sweeps. In the latter case, they
        are not read from the sweeps, which would take long.
        """
        poses = None
        if has_objects or (recording.info.compensated and recording.has_stored_poses):
            poses = recording.poses(range(len(recording)))
        if poses is None or np.abs(poses[0, :3, 3]).max() <= _MAX_LOCAL_M:
            return cls(recording, poses)
        shift = np.floor(poses[0, :3, 3])
        poses[:, :3, 3] -= shift
        return cls(recording, poses, shift)

    def as_fired(self, sweep: Sweep, number: int) -> Sweep:
        """Return the returns of a sweep in the sensor frames at their firing times, if possible.

        The points are unchanged if the sweep is not compensated, or if its motion or the times of
        its points are unknown.
        """
        path = self._compensated_path(sweep, number)
        if path is None or sweep.times_s is None or self.poses is None:
            return sweep
        origins, rotations = _relative_poses(path, self.poses[number], sweep.times_s)
        points = np.asarray(sweep.points, np.float64)
        return sweep.replace(points=np.einsum("nji,nj->ni", rotations, points - origins))

    def of_sweep(self, sweep: Sweep, number: int, times_s: Floats) -> SweepMotion:
        """Return the motion of the sensor during a sweep.

        `times_s` (f,) are the firing times relative to the timestamp of the sweep.
        """
        if self.poses is None:
            return SweepMotion()
        pose = self.poses[number]
        single = (pose[:3, 3], np.ascontiguousarray(pose[:3, :3]))
        if sweep.compensated:
            path = self._compensated_path(sweep, number)
            if path is None:
                return SweepMotion(single, stamp_pose=pose)
            return SweepMotion(single, *_relative_poses(path, pose, times_s), pose)
        path = self._path(number)
        if path is None or sweep.compensated is None:
            return SweepMotion(single, stamp_pose=pose)
        return SweepMotion(poses_at(path, times_s), stamp_pose=pose)

    def _compensated_path(self, sweep: Sweep, number: int) -> Track | None:
        """Return the trajectory during a compensated sweep, or None if it is unknown."""
        if not sweep.compensated or sweep.times_s is None:
            return None
        return self._path(number)

    def _path(self, number: int) -> Track | None:
        """Return the trajectory of the sensor around a sweep, or None if it is unknown."""
        stamps_ns = self.recording.stamps_ns
        if stamps_ns is None or self.poses is None:
            return None
        return path_of_sweep(self.poses.__getitem__, stamps_ns[: len(self.poses)], number)


def _relative_poses(path: Track, pose: Floats, times_s: Floats) -> tuple[Floats, Floats]:
    """Return positions (n, 3) and rotations (n, 3, 3) in the frame of a sweep with a given pose."""
    positions, rotations = poses_at(path, times_s)
    back = np.linalg.inv(pose)
    return positions @ back[:3, :3].T + back[:3, 3], back[:3, :3] @ rotations
