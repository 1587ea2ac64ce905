"""Poses of a recording's sweeps that are stored in the recording or given by the user."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from numbers import Real
from typing import Any

import numpy as np

from lidarfiles.clouds.recording import Recording
from lidarsim.columns.sweep import Sweep
from lidarsim.errors import LidarError
from lidarsim.motion.rotations import check_rotations
from lidarsim.motion.trajectory import Pose, as_pose
from lidarsim.numerics.arrays import Floats, Ints
from lidarsim.numerics.even_samples import even_indices
from lidarsim.scene.scene import Scene
from lidarsim.scene.transform import affine
from lidarsim.sweeps.sweep_motion import FiringPoses
from lidarsim.words import plural

from ..compared_sweep import compared_sweep, with_compared_columns
from .standstill import Speed, sweep_period_ns

_MAX_SWEEPS = 64  # maximum number of sweeps whose poses are read
# Maximum differences between the poses of a stationary sensor, for exact poses and for
# localization.
_MIN_SHIFT_M = 0.001
_MIN_TURN_DEG = 0.01
_LOCALIZED_SHIFT_M = 0.05
_LOCALIZED_TURN_DEG = 0.5
_MIN_SPEED_DEG = 0.005  # smaller rotations between sweeps are not reported


@dataclass(frozen=True, eq=False)
class KnownPoses:
    """Poses of sweeps in scene coordinates, or in world coordinates if there is no scene."""

    numbers: Ints  # (n,): numbers of the sweeps
    matrices: Floats  # (n, 4, 4): from the sensor frame at the start of each sweep
    are_given: bool  # whether the user gave the poses
    origin: Floats  # (3,): origin of the scene in world coordinates, meters

    @classmethod
    def from_recording(
        cls, recording: Recording, pose: Any, scene: Scene | None
    ) -> KnownPoses | None:
        """Return the poses given by the user or stored in the recording, or None if there are none.

        Raises LidarError unless `pose` is a single pose or contains one pose for each sweep.
        """
        origin = np.zeros(3) if scene is None else scene.origin
        if pose is not None:
            matrices = _given_matrices(pose, recording)
            if scene is None and len(matrices) == 1:
                raise LidarError(
                    "`pose` requires `scene`, because it is the pose of the sensor in that "
                    "scene. Set `scene`, or omit `pose`."
                )
            return cls(np.arange(len(matrices)), matrices, True, origin)
        numbers = even_indices(len(recording), _MAX_SWEEPS)
        recorded = recording.poses(numbers.tolist())
        if recorded is None:
            return None
        recorded[:, :3, 3] -= origin
        return cls(numbers, recorded, False, origin)

    def are_of_firings(self, recording: Recording) -> bool:
        """Return True if each firing has its own pose, as in a result of lidarpool."""
        return not self.are_given and recording.info.has_firing_poses

    def speed(self, recording: Recording) -> Speed | None:
        """Return the mean motion between consecutive sweeps, or None if the sensor stands still."""
        positions = self.matrices[:, :3, 3]
        rotations = self.matrices[:, :3, :3]
        is_exact = self.are_given or self.are_of_firings(recording)
        min_shift_m = _MIN_SHIFT_M if is_exact else _LOCALIZED_SHIFT_M
        min_turn_deg = _MIN_TURN_DEG if is_exact else _LOCALIZED_TURN_DEG
        shift_m = np.linalg.norm(positions - positions[0], axis=1).max()
        turn_deg = _angles_deg(rotations[:1], rotations).max()
        if shift_m < min_shift_m and turn_deg < min_turn_deg:
            return None
        sweeps = int(self.numbers[-1] - self.numbers[0])
        steps_m = np.linalg.norm(np.diff(positions, axis=0), axis=1)
        turns_deg = _angles_deg(rotations[:-1], rotations[1:])
        period_ns = sweep_period_ns(recording, np.arange(len(recording)))
        shift_m = float(steps_m.sum() / sweeps)
        turn_deg = float(turns_deg.sum() / sweeps)
        return Speed(shift_m, turn_deg if turn_deg > _MIN_SPEED_DEG else 0.0, period_ns)

    def sweep_reader(self, recording: Recording) -> Callable[[int], Sweep]:
        """Return a function that reads a sweep's original firings and their poses in the scene.

        A result records the pose of each pulse. In other recordings, the pose of a sweep is used
        for all its pulses. Raises LidarError if only some sweeps of the recording have poses.
        """
        if not self.are_of_firings(recording):
            return self._of_whole_sweeps(recording)

        def read_in_scene(number: int) -> Sweep:
            sweep = recording.fired(number)
            poses = sweep.firing_poses
            assert isinstance(poses, FiringPoses)
            poses = replace(poses, position=poses.position - self.origin)
            return with_compared_columns(sweep).replace(firing_poses=poses)

        return read_in_scene

    def _of_whole_sweeps(self, recording: Recording) -> Callable[[int], Sweep]:
        """Return a function that reads a sweep and assigns the sweep's pose to all its pulses."""
        matrices = self.matrices
        if not self.are_given:
            recorded = recording.poses(range(len(recording)))
            if recorded is None:
                raise LidarError(
                    f"{recording.info.name} does not contain a pose for every sweep. Pass `--pose`."
                )
            matrices = recorded
            matrices[:, :3, 3] -= self.origin

        def read_from_pose(number: int) -> Sweep:
            poses = FiringPoses(matrices[number, :3, 3], matrices[number, :3, :3])
            return compared_sweep(recording, number).replace(firing_poses=poses)

        return read_from_pose


def _given_matrices(pose: Any, recording: Recording) -> Floats:
    """Convert a single pose, or one pose per sweep, to an array of matrices."""
    if isinstance(pose, np.ndarray) and pose.shape[-2:] == (4, 4):
        matrices = pose.astype(np.float64).reshape(-1, 4, 4)
        check_rotations(matrices[:, :3, :3])
        if not np.isfinite(matrices).all():
            raise LidarError("`pose` contains positions that are not finite.")
    else:
        is_single = isinstance(pose, Pose) or isinstance(next(iter(pose), 0), Real)
        poses = [as_pose("pose", single) for single in ([pose] if is_single else pose)]
        matrices = np.array(
            [affine(pose.rotation_matrix, np.array(pose.position)) for pose in poses]
        )
    if len(matrices) not in (1, len(recording)):
        raise LidarError(
            f"`pose` contains {plural(len(matrices), 'pose')}, but {recording.info.name} has "
            f"{plural(len(recording), 'sweep')}. Pass one pose, or one pose for each sweep."
        )
    return matrices


def _angles_deg(first: Floats, second: Floats) -> Floats:
    traces = np.einsum("nij,nij->n", *np.broadcast_arrays(first, second))
    return np.degrees(np.arccos(np.clip((traces - 1) / 2, -1, 1)))
