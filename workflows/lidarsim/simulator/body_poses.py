"""Poses of bodies as users give them to `Scanner.move`: of one body or many, standing or moving."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..base.arrays import Bools, Floats
from ..base.errors import LidarError, prefixed
from ..base.value_texts import shown
from ..motion.rotations import check_rotations
from ..motion.trajectory import CENTER, Pose, StaticPose, Track, Trajectory, pose_of

ROW_SLACK = 1e-8  # tolerance of the last rows of matrices


class BodyPoses(NamedTuple):
    """Poses of k bodies, and the trajectories of the bodies that have one."""

    positions: Floats  # (k, 3), meters; not used of bodies with a trajectory that moves
    rotations: Floats  # (k, 3, 3), from the frame of the body to the scene frame; as above
    trajectories: Sequence[Trajectory | None]  # (k,); None for a body that stands at its pose

    @property
    def moves(self) -> Bools:
        """Whether each body moves during a sweep: (k,)."""
        return np.array([t is not None and t.moves for t in self.trajectories], np.bool_)

    def trajectory(self, number: int) -> Trajectory:
        """Return the trajectory of a body, by its index."""
        trajectory = self.trajectories[number]
        if trajectory is None:
            return StaticPose(self.positions[number], self.rotations[number])
        return trajectory


def poses_of_body(pose: Any, times_s: ArrayLike | None) -> BodyPoses:
    """Return the poses of one body: a pose, position, matrix or trajectory, or matrices at times.

    Raises
    ------
    LidarError
        If the pose is none of these, or mirrors or deforms.
    """
    if times_s is not None:
        return poses_of_bodies(_table_of(pose)[None], 1, times_s)
    if hasattr(pose, "poses") or _table_of(pose).ndim != 2:
        return _listed_poses([pose])
    return poses_of_bodies(np.asarray(pose)[None], 1, None)


def poses_of_bodies(poses: Any, count: int, times_s: ArrayLike | None) -> BodyPoses:
    """Return the poses of `count` bodies.

    Parameters
    ----------
    poses
        A list of poses and trajectories, positions (k, 3), or matrices (k, 4, 4); with times,
        matrices (k, samples, 4, 4).
    times_s
        (samples,): seconds since time 0 of actors.

    Raises
    ------
    LidarError
        If the poses are none of these or of another number, or a matrix mirrors or deforms.
    """
    if isinstance(poses, Sequence) and times_s is None and any(map(_is_single, poses)):
        _check_count(len(poses), count)
        return _listed_poses(poses)
    table = _table_of(poses)
    if times_s is not None:
        return _followed_matrices(table, count, times_s)
    if table.shape[1:] == (3,):
        _check_count(len(table), count)
        _check_finite(table)
        return BodyPoses(table, np.broadcast_to(np.eye(3), (count, 3, 3)), (None,) * count)
    if table.shape[1:] == (4, 4):
        _check_count(len(table), count)
        check_matrices(table)
        return BodyPoses(table[:, :3, 3], table[:, :3, :3], (None,) * count)
    raise LidarError(
        "poses must be a list of Pose, positions (k, 3) or matrices (k, 4, 4), but is "
        f"{shown(poses)} of the shape {table.shape}."
    )


def check_matrices(matrices: Floats) -> None:
    """Check that matrices (k, 4, 4) are rigid transforms.

    Raises LidarError if not.
    """
    _check_finite(matrices)
    if not (np.abs(matrices[:, 3] - [0, 0, 0, 1]) <= ROW_SLACK).all():
        raise LidarError("The last row of each matrix of poses must be 0, 0, 0, 1.")
    check_rotations(matrices[:, :3, :3])


def _is_single(pose: Any) -> bool:
    """Return whether a value is a pose or a trajectory."""
    return isinstance(pose, Pose) or hasattr(pose, "poses")


def _listed_poses(poses: Sequence[Any]) -> BodyPoses:
    """Return the poses of a list of poses, positions and trajectories."""
    trajectories: list[Trajectory | None] = []
    positions = []
    rotations = []
    for value in poses:
        trajectory = value if hasattr(value, "poses") else None
        if trajectory is not None and trajectory.moves:
            pose = CENTER  # not used: only actors have such trajectories
        else:
            pose = pose_of("pose", value) if trajectory is None else trajectory.pose(0)
        trajectories.append(trajectory)
        positions.append(pose.position)
        rotations.append(pose.rotation_matrix)
    return BodyPoses(np.array(positions), np.array(rotations), trajectories)


def _followed_matrices(table: Floats, count: int, times_s: ArrayLike) -> BodyPoses:
    """Return the poses of bodies that follow matrices (k, samples, 4, 4) at times (samples,)."""
    try:
        times = np.asarray(times_s, np.float64)
    except (TypeError, ValueError):
        times = np.zeros(0)
    if times.ndim != 1 or table.shape[1:] != (len(times), 4, 4):
        raise LidarError(
            f"With times_s of the shape {times.shape}, poses must be matrices (k, samples, 4, 4) "
            f"at times (samples,), but has the shape {table.shape}."
        )
    _check_count(len(table), count)
    with prefixed("poses (flattened over bodies and times)"):
        check_matrices(table.reshape(-1, 4, 4))
    tracks = Track.from_matrices(times, table)
    return BodyPoses(table[:, 0, :3, 3], table[:, 0, :3, :3], tracks)


def _table_of(poses: Any) -> Floats:
    """Return poses as an array of float64, or an empty one if they are not numbers."""
    try:
        return np.asarray(poses, np.float64)
    except (TypeError, ValueError):
        return np.zeros(0)


def _check_count(poses: int, names: int) -> None:
    """Check that there is a pose for each name.

    Raises LidarError if not.
    """
    if poses != names:
        raise LidarError(
            f"There are {names} names, but {poses} poses. Pass one pose for each name."
        )


def _check_finite(table: Floats) -> None:
    """Check that numbers are finite.

    Raises LidarError, with the first pose (k, ...), if not.
    """
    finite = np.isfinite(table).reshape(len(table), -1).all(axis=1)
    if not finite.all():
        first = int(finite.argmin())
        raise LidarError(f"Pose {first} (counted from 0) is not finite.")
