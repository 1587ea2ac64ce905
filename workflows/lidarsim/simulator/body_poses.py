"""Convert the poses that users pass to `Scanner.move` into arrays and trajectories."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..errors import LidarError, prefix_errors
from ..motion.rotations import check_rotations
from ..motion.trajectory import CENTER, Pose, StaticPose, Track, Trajectory, as_pose
from ..numerics.arrays import Bools, Floats
from ..schema.value_texts import format_value

ROW_SLACK = 1e-8  # tolerance for the last row of a pose matrix


class BodyPoses(NamedTuple):
    """Poses of k bodies, and the trajectories of those that move."""

    positions: Floats  # (k, 3), meters; ignored for bodies that move along a trajectory
    rotations: Floats  # (k, 3, 3), from the body frame to the scene frame; ignored likewise
    trajectories: Sequence[Trajectory | None]  # (k,); None for a body that stays at its pose

    @property
    def moves(self) -> Bools:
        """Mask of the bodies that move during a sweep.

        The shape is (k,).
        """
        return np.array([t is not None and t.moves for t in self.trajectories], np.bool_)

    def trajectory(self, number: int) -> Trajectory:
        """Return the trajectory of the body with the given index."""
        trajectory = self.trajectories[number]
        if trajectory is None:
            return StaticPose(self.positions[number], self.rotations[number])
        return trajectory


def poses_of_body(pose: Any, times_s: ArrayLike | None) -> BodyPoses:
    """Convert the argument `pose` of `Scanner.move` for a single body.

    Parameters
    ----------
    pose
        A `Pose`, a position, a matrix (4, 4) or a trajectory. If `times_s` is set, an array of
        matrices with shape (samples, 4, 4).
    times_s
        Times of the matrices in seconds, shape (samples,).

    Raises
    ------
    LidarError
        If `pose` has an unsupported form, or a matrix is not a rigid transform.
    """
    if times_s is not None:
        return poses_of_bodies(_table_of(pose)[None], 1, times_s)
    if hasattr(pose, "poses") or _table_of(pose).ndim != 2:
        return _listed_poses([pose])
    return poses_of_bodies(np.asarray(pose)[None], 1, None)


def poses_of_bodies(poses: Any, count: int, times_s: ArrayLike | None) -> BodyPoses:
    """Convert the argument `pose` of `Scanner.move` for several bodies.

    Parameters
    ----------
    poses
        A list of poses and trajectories, an array of positions with shape (k, 3), or an array of
        matrices with shape (k, 4, 4). If `times_s` is set, an array of matrices with shape
        (k, samples, 4, 4).
    count
        Expected number of bodies.
    times_s
        Times of the matrices in seconds since time 0 of the actors, shape (samples,).

    Raises
    ------
    LidarError
        If `poses` has an unsupported form, the number of poses is not `count`, or a matrix is not
        a rigid transform.
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
        f"{format_value(poses)} of the shape {table.shape}."
    )


def check_matrices(matrices: Floats) -> None:
    """Raise LidarError if any of the matrices is not a rigid transform."""
    _check_finite(matrices)
    if not (np.abs(matrices[:, 3] - [0, 0, 0, 1]) <= ROW_SLACK).all():
        raise LidarError("The last row of each matrix of poses must be 0, 0, 0, 1.")
    check_rotations(matrices[:, :3, :3])


def _is_single(pose: Any) -> bool:
    """Return whether a value is a pose or a trajectory."""
    return isinstance(pose, Pose) or hasattr(pose, "poses")


def _listed_poses(poses: Sequence[Any]) -> BodyPoses:
    """Convert a list of poses, positions and trajectories to `BodyPoses`."""
    trajectories: list[Trajectory | None] = []
    positions = []
    rotations = []
    for value in poses:
        trajectory = value if hasattr(value, "poses") else None
        if trajectory is not None and trajectory.moves:
            pose = CENTER  # a placeholder, because the trajectory provides the poses
        else:
            pose = as_pose("pose", value) if trajectory is None else trajectory.pose(0)
        trajectories.append(trajectory)
        positions.append(pose.position)
        rotations.append(pose.rotation_matrix)
    return BodyPoses(np.array(positions), np.array(rotations), trajectories)


def _followed_matrices(table: Floats, count: int, times_s: ArrayLike) -> BodyPoses:
    """Return the poses of bodies that follow matrices sampled at the given times."""
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
    with prefix_errors("poses (flattened over bodies and times)"):
        check_matrices(table.reshape(-1, 4, 4))
    tracks = Track.from_matrices(times, table)
    return BodyPoses(table[:, 0, :3, 3], table[:, 0, :3, :3], tracks)


def _table_of(poses: Any) -> Floats:
    """Convert poses to a float64 array, or return an empty array if they are not numeric."""
    try:
        return np.asarray(poses, np.float64)
    except (TypeError, ValueError):
        return np.zeros(0)


def _check_count(poses: int, names: int) -> None:
    if poses != names:
        raise LidarError(
            f"There are {names} names, but {poses} poses. Pass one pose for each name."
        )


def _check_finite(table: Floats) -> None:
    """Raise LidarError with the index of the first pose that is not finite, if any."""
    finite = np.isfinite(table).reshape(len(table), -1).all(axis=1)
    if not finite.all():
        first = int(finite.argmin())
        raise LidarError(f"Pose {first} (counted from 0) is not finite.")
