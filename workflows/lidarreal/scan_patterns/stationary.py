"""Check that the sensor of a recording is stationary, as required to estimate its scan pattern."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from lidarfiles.clouds.recording import Recording
from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import Floats
from lidarsim.numerics.even_samples import even_indices
from lidarsim.words import format_rounded

from ..comparing.fit.known_poses import KnownPoses
from ..comparing.fit.stack import SweepStack
from ..comparing.fit.standstill import Speed, find_motion, sweep_period_ns
from .pattern_returns import PatternReturns

_MAX_POINTS = 40_000  # maximum number of points of each part of a recording to register
_PLANE_POINTS = 10  # number of neighboring points that determine a plane
_MAX_FLATNESS = 0.05  # maximum ratio of the thickness of a plane to its width
_ROUNDS = 15
_MAX_DISTANCE_M = 1.0  # maximum distance between points that are registered
_MIN_SIGMA_M = 0.005
_DAMPING = 1e-3  # share of the points; motions that no surface determines are 0
_MIN_SHIFT_M = 0.05  # smaller motions cannot be distinguished from noise
_MIN_TURN_DEG = 0.3
_MIN_IMPROVEMENT = 0.9  # maximum ratio of the residuals with and without motion


def check_stationary(recording: Recording, returns: PatternReturns) -> tuple[str, ...]:
    """Raise LidarError if the sensor moves, and return notes for the user.

    If the rings are known, sweeps are compared as in `fit`. Otherwise, the first third of the
    recording is registered to the last third.
    """
    speed = _speed(recording, returns)
    if speed is None:
        if returns.sweep_count > 1:
            return ()
        return (
            "motion cannot be detected in a single sweep. The sensor must have been stationary",
        )
    amounts = []
    if speed.shift_m > 0:
        amounts.append(f"{format_rounded(speed.shift_m, 2)} m")
    if speed.turn_deg > 0:
        amounts.append(f"{format_rounded(speed.turn_deg, 2)}°")
    raise LidarError(
        f"{recording.info.name} was recorded by a sensor that moves by "
        f"{' and '.join(amounts)} between sweeps. A scan pattern can only be estimated with a "
        "stationary sensor. Record a few seconds without moving the sensor, or use a part of the "
        "recording in which it stands still."
    )


def _speed(recording: Recording, returns: PatternReturns) -> Speed | None:
    if returns.sweep_count < 2:
        return None
    poses = KnownPoses.from_recording(recording, None, None)
    if poses is not None and poses.are_of_firings(recording):
        return poses.speed(recording)
    if len(recording.rings):
        with suppress(LidarError):  # the rings of a sensor with a wide field of view are no cones
            stack = SweepStack.read(recording)
            return find_motion(stack, sweep_period_ns(recording, stack.numbers))
    return _registered_speed(returns)


def _registered_speed(returns: PatternReturns) -> Speed | None:
    """Determine the motion between the first and the last third of the sweeps."""
    count = returns.sweep_count
    third = max(count // 3, 1)
    first = returns.points[returns.sweep < third]
    last = returns.points[returns.sweep >= count - third]
    if not len(first) or not len(last):
        return None
    motion = _register(
        first[even_indices(len(first), _MAX_POINTS)], last[even_indices(len(last), _MAX_POINTS)]
    )
    if motion is None:
        return None
    shift_m = float(np.linalg.norm(motion[3:]))
    turn_deg = float(np.degrees(np.linalg.norm(motion[:3])))
    if shift_m < _MIN_SHIFT_M and turn_deg < _MIN_TURN_DEG:
        return None
    steps = count - third
    return Speed(
        shift_m / steps if shift_m >= _MIN_SHIFT_M else 0.0,
        turn_deg / steps if turn_deg >= _MIN_TURN_DEG else 0.0,
        1e9 * returns.sweep_times.period_s,
    )


def _register(fixed: Floats, moved: Floats) -> Floats | None:
    """Return the rotation vector and the translation that register points to planes.

    The result has shape (6,), in radians and meters. It is None if it does not fit better than no
    motion.
    """
    from scipy.spatial import cKDTree

    tree = cKDTree(fixed)
    motion = np.zeros(6)
    still_m = sigma_m = np.inf
    for number in range(_ROUNDS):
        points = _transform(moved, motion)
        distance, near = tree.query(points, _PLANE_POINTS, distance_upper_bound=_MAX_DISTANCE_M)
        used = np.isfinite(distance).all(axis=1)
        residual, design = _plane_distances(points[used], fixed[near[used]])
        if len(residual) < _PLANE_POINTS:
            return None
        sigma_m = max(1.4826 * float(np.median(np.abs(residual))), _MIN_SIGMA_M)
        still_m = sigma_m if number == 0 else still_m
        weighted = design / (1 + np.square(residual / (2 * sigma_m)))[:, None]
        matrix = weighted.T @ design + _DAMPING * len(residual) * np.eye(6)
        motion -= np.linalg.solve(matrix, weighted.T @ residual)
    return motion if sigma_m < _MIN_IMPROVEMENT * still_m or still_m == _MIN_SIGMA_M else None


def _plane_distances(points: Floats, neighbors: Floats) -> tuple[Floats, Floats]:
    """Return the distances of points to planes, and their derivatives with respect to a motion.

    `neighbors` (n, k, 3) are the points of the plane of each point. Points are omitted if their
    neighbors do not lie on a plane. The results have shapes (m,) and (m, 6).
    """
    center = neighbors.mean(axis=1)
    _, lengths, axes = np.linalg.svd(neighbors - center[:, None], full_matrices=False)
    is_flat = lengths[:, 2] < _MAX_FLATNESS * lengths[:, 1]
    normal, points = axes[is_flat, 2], points[is_flat]
    distance = np.einsum("ni,ni->n", normal, points - center[is_flat])
    return distance, np.concatenate([np.cross(points, normal), normal], axis=1)


def _transform(points: Floats, motion: Floats) -> Floats:
    """Rotate points by a rotation vector, by the formula of Rodrigues, and translate them."""
    angle = float(np.linalg.norm(motion[:3]))
    axis = motion[:3] / (angle or 1.0)
    along = (points @ axis)[:, None] * axis
    rotated = along + np.cos(angle) * (points - along) + np.sin(angle) * np.cross(axis, points)
    return np.asarray(rotated + motion[3:])
