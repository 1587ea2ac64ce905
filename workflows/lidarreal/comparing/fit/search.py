"""Search for the sensor motion between two sweeps that explains the most changed objects."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from lidarsim.numerics.arrays import Floats

from .planes import ARM_M, RangeChanges
from .stack import SweepStack
from .visibility import RigidMotion, VisibilityImage, VisibilityPair

MIN_SHIFT_M = 0.02  # smaller shifts count as stationary
MIN_YAW_RAD = 0.003  # smaller rotations count as stationary
_MIN_OBJECTS = 3  # minimum number of supporting objects, or two without a contradiction
_SIMILAR_SHARE = 0.95  # minimum ratio of the scores of similar motions

# Candidate motions: those of cars, and rotations in place.
_MAX_SPEED_M_S = 70.0
_MAX_SHIFT_M = 12.0
_FIRST_SHIFT_M = 0.05
_SHIFT_STEP = 0.05  # relative step
_DIRECTIONS = 36  # number of candidate directions in a plane of two free axes
_FREE_SHARE = 0.02  # maximum fraction of a free axis (see `RangeChanges.axes`)
_MAX_YAW_DEG = 45.0
_YAW_STEP_DEG = 0.25
_COARSE_POINTS = 120
_CANDIDATES = 20
_BATCH = 2000  # number of motions that are scored at once
_REFINEMENTS_M = (0.1, 0.05, 0.02)  # step sizes in meters at a distance of `ARM_M`
_FINE_POINTS = 600
_CENTER_STEPS = 15  # number of steps of the smallest size to either side
_SIMILAR_POINTS = 10  # maximum difference between the scores of similar motions
_THINGS = 3  # maximum number of moving objects to try, the largest first


def motion_between(
    stack: SweepStack, first: int, second: int, period_ns: float | None
) -> RigidMotion | None:
    """Find the sensor motion between two sweeps, or return None if it may be stationary.

    `period_ns` is the time between consecutive sweeps, or None if it is unknown.
    """
    changes = RangeChanges.between(stack, first, second)
    pair = VisibilityPair.from_images(
        VisibilityImage.from_sweep(stack, first), VisibilityImage.from_sweep(stack, second)
    )
    max_shift_m = _MAX_SHIFT_M
    if period_ns:
        max_shift_m = min(max_shift_m, _MAX_SPEED_M_S * period_ns / 1e9 * (second - first))
    by_planes = changes.motion()
    if by_planes is not None and not _is_shown(by_planes, pair, changes):
        by_planes = None
    by_sight = _search_by_visibility(pair, changes, max_shift_m)
    if by_sight is None:
        return by_planes
    by_sight = _center_motion(pair, by_sight)
    if by_planes is None:
        return by_sight
    # Planes are more accurate, unless the rays no longer hit the same planes.
    sample = pair.sample(_FINE_POINTS)
    planes_score, sight_score = (pair.score(motion, *sample) for motion in (by_planes, by_sight))
    return by_planes if planes_score > _SIMILAR_SHARE * sight_score else by_sight


def _is_shown(motion: RigidMotion, pair: VisibilityPair, changes: RangeChanges) -> bool:
    if np.linalg.norm(motion.shift) < MIN_SHIFT_M and abs(motion.yaw_rad) < MIN_YAW_RAD:
        return False
    evidence = pair.evidence(motion), changes.evidence(motion)
    moved, stayed, unexplained = np.max(evidence, axis=0).tolist()
    against = stayed + unexplained
    is_clear = moved >= _MIN_OBJECTS or (moved == _MIN_OBJECTS - 1 and not against)
    return bool(is_clear and moved > against)


def _search_by_visibility(
    pair: VisibilityPair, changes: RangeChanges, max_shift_m: float
) -> RigidMotion | None:
    """Find a sensor motion that enough objects support, or return None if there is none.

    The motion that explains most points may belong to a car beside the sensor, in which case the
    points that it explains are removed. The search is repeated until few changed objects remain.
    """
    remaining = pair
    for _ in range(_THINGS):
        if sum(remaining.evidence(None)) < _MIN_OBJECTS - 1:
            return None
        motion = _best_motion(remaining, changes, max_shift_m)
        if _is_shown(motion, pair, changes):
            return motion
        remaining = remaining.without_explained(motion)
    return None


def _best_motion(pair: VisibilityPair, changes: RangeChanges, max_shift_m: float) -> RigidMotion:
    """Find the motion that aligns the most points of two sweeps."""
    motions = _coarse_motions(_free_axes(changes), max_shift_m)
    sample = pair.sample(_COARSE_POINTS)
    scores = np.concatenate([pair.score(batch, *sample) for batch in _batches(motions)])
    candidates = _select_motions(motions, np.argsort(-scores, kind="stable")[:_CANDIDATES])
    sample = pair.sample(_FINE_POINTS)
    best, best_score = _select_best(pair, candidates, sample)
    for step_m in _REFINEMENTS_M:
        while True:
            steps = step_m * np.concatenate([np.eye(4), -np.eye(4)])
            refined, score = _select_best(pair, _add_offsets(best, steps), sample)
            if score <= best_score:
                break
            best, best_score = refined, score
    return best


def _free_axes(changes: RangeChanges) -> Floats:
    """Return the axes along which a sensor shift would change only a few ranges.

    If there are no such axes, the two axes with the smallest changes are returned.
    """
    axes, shares = changes.axes()
    free = int((shares < _FREE_SHARE).sum())
    return axes[: free or 2]


def _coarse_motions(axes: Floats, max_shift_m: float) -> RigidMotion:
    """Return candidate motions, which are pure rotations and shifts along one or two axes."""
    yaw_rad = np.radians(np.arange(_YAW_STEP_DEG, _MAX_YAW_DEG, _YAW_STEP_DEG))
    directions = axes[:1]
    if len(axes) > 1:
        angles = np.pi * np.arange(_DIRECTIONS)[:, None] / _DIRECTIONS
        directions = np.cos(angles) * axes[0] + np.sin(angles) * axes[1]
    steps = np.log(max_shift_m / _FIRST_SHIFT_M) / np.log(1 + _SHIFT_STEP)
    lengths = np.geomspace(_FIRST_SHIFT_M, max_shift_m, max(int(steps), 2))
    shifts = (np.append(lengths, -lengths)[:, None, None] * directions).reshape(-1, 3)
    yaws = np.concatenate([yaw_rad, -yaw_rad, np.zeros(len(shifts))])
    return RigidMotion(np.concatenate([np.zeros((2 * len(yaw_rad), 3)), shifts]), yaws)


def _batches(motions: RigidMotion) -> Iterator[RigidMotion]:
    for start in range(0, len(motions.shift), _BATCH):
        yield _select_motions(motions, slice(start, start + _BATCH))


def _select_motions(motions: RigidMotion, index: Any) -> RigidMotion:
    return RigidMotion(motions.shift[index], motions.yaw_rad[index])


def _select_best(
    pair: VisibilityPair, motions: RigidMotion, sample: tuple[Floats, Floats]
) -> tuple[RigidMotion, int]:
    scores = pair.score(motions, *sample)
    return _select_motions(motions, scores.argmax()), int(scores.max())


def _add_offsets(motion: RigidMotion, offsets: Floats) -> RigidMotion:
    """Add offsets to the shifts and the yaw of a motion.

    The offsets have shape (…, 4) and contain the shifts and the yaw at `ARM_M`, in meters.
    """
    return RigidMotion(motion.shift + offsets[..., :3], motion.yaw_rad + offsets[..., 3] / ARM_M)


def _center_motion(pair: VisibilityPair, motion: RigidMotion) -> RigidMotion:
    """Return the center of all motions that align two sweeps nearly as well as `motion`."""
    sample = pair.sample(_FINE_POINTS)
    steps_m = np.arange(-_CENTER_STEPS, _CENTER_STEPS + 1) * _REFINEMENTS_M[-1]
    for axis in np.eye(4):
        offsets = steps_m[:, None] * axis
        scores = pair.score(_add_offsets(motion, offsets), *sample)
        similar = scores > scores.max() - _SIMILAR_POINTS
        motion = _add_offsets(motion, offsets[similar].mean(axis=0))
    return motion
