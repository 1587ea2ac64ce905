"""Determine whether the sensor is stationary during a recording.

The module detects motion, creep and range drift.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidarfiles.clouds.recording import Recording
from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import Ints
from lidarsim.numerics.even_samples import even_indices
from lidarsim.words import format_rounded

from .planes import fit_creep, range_scatter
from .search import MIN_SHIFT_M, MIN_YAW_RAD, motion_between
from .stack import SweepStack, finite_median
from .visibility import RigidMotion

_NEXT_PAIRS = 5  # number of pairs of consecutive sweeps to compare
_MAX_CHANGE_M = 0.1  # maximum median range change between consecutive sweeps of a static scene
# Ranges drift if their changes over many sweeps are larger by this factor.
_DRIFT_FACTOR = 1.5
_DRIFT_M = 0.002
_MIN_CREEP_M = 0.0015  # minimum standard deviation of ranges due to creep
_MIN_CREEP_EFFECT = 0.15  # minimum ratio to the noise, at which the noise is overestimated by 1 %


class Speed(NamedTuple):
    """Sensor motion between consecutive sweeps."""

    shift_m: float
    turn_deg: float
    period_ns: float | None  # time between consecutive sweeps, if known


def read_static(recording: Recording, *, is_stationary: bool = False) -> SweepStack:
    """Read the sweeps of a stationary sensor and group their points by cell.

    If `is_stationary` is true, the sensor is known to be stationary. Raises the same errors as
    `SweepStack.read`, and LidarError if the sensor or the recorded scene moves.
    """
    stack = SweepStack.read(recording)
    if stack.sweep_count < 2:
        return stack
    name = recording.info.name
    speed = None if is_stationary else find_motion(stack, sweep_period_ns(recording, stack.numbers))
    if speed is not None:
        raise LidarError(
            moving_message(
                name,
                speed,
                "Pass a mesh of its scene with `--scene` and one `--pose` for each sweep",
            )
        )
    _check_drift(stack, name)
    changes = np.abs(np.diff(stack.ranges, axis=0))
    if (change := finite_median(changes, (0, 1, 2))) > _MAX_CHANGE_M:
        raise LidarError(
            f"The ranges in {name} change by a median of {format_rounded(change, 2)} m between "
            "sweeps, which sensor motion cannot explain. Use points in meters that were recorded "
            "in a stationary environment."
        )
    return stack


def sweep_period_ns(recording: Recording, numbers: Ints) -> float | None:
    """Return the median sweep period in nanoseconds, or None if it is unknown."""
    if len(numbers) < 2 or recording.stamps_ns is None:
        return None
    return float(np.median(np.diff(recording.stamps_ns[numbers])))


def moving_message(name: str, speed: Speed, advice: str) -> str:
    """Return the error message for a sensor that moves.

    `advice` is the first suggested remedy.
    """
    amounts = []
    if speed.shift_m > 0:
        by_time = ""
        if speed.period_ns:
            by_time = f" ({format_rounded(1e9 * speed.shift_m / speed.period_ns, 2)} m/s)"
        amounts.append(f"{format_rounded(speed.shift_m, 2)} m{by_time}")
    if speed.turn_deg > 0:
        amounts.append(f"{format_rounded(speed.turn_deg, 2)}°")
    return (
        f"{name} was recorded by a sensor that moves by {' and '.join(amounts)} between sweeps. "
        f"{advice}, or use sweeps from a stationary sensor. `lidarpool twin` reconstructs such a "
        "scene from the recording, and also fits the sensor to it."
    )


def find_motion(stack: SweepStack, period_ns: float | None) -> Speed | None:
    """Find the motion of the sensor between sweeps, or return None if it is stationary.

    Sweeps are compared with the next sweep, and with the sweep half a recording later. The first
    sweep is also compared with the last, because a slow motion is detectable only in sweeps that
    are far apart.
    """
    last = stack.sweep_count - 1
    pairs_of_lag = {1: _NEXT_PAIRS, max(stack.sweep_count // 2, 1): 2, last: 1}
    for lag, pairs in sorted(pairs_of_lag.items()):
        starts = even_indices(stack.sweep_count - lag, pairs).tolist()
        moving = []
        standing = 0
        for first in starts:
            motion = motion_between(stack, first, first + lag, period_ns)
            if motion is not None:
                moving.append(motion)
            else:
                standing += 1
            if 2 * standing >= len(starts):
                break
        else:
            return _speed(moving, lag, period_ns)
    creep = fit_creep(stack)
    if creep.effect > _MIN_CREEP_EFFECT and creep.spread_m > _MIN_CREEP_M:
        shift_m = float(np.linalg.norm(creep.shift))
        return Speed(shift_m, float(np.degrees(np.linalg.norm(creep.rotation))), period_ns)
    return None


def _speed(motions: list[RigidMotion], lag: int, period_ns: float | None) -> Speed:
    """Return the median speed, given the motions between sweeps that are `lag` sweeps apart."""
    shift_m = float(np.median([np.linalg.norm(motion.shift) for motion in motions]))
    yaw_rad = float(np.median([abs(motion.yaw_rad) for motion in motions]))
    return Speed(
        shift_m / lag if shift_m > MIN_SHIFT_M else 0.0,
        float(np.degrees(yaw_rad)) / lag if yaw_rad > MIN_YAW_RAD else 0.0,
        period_ns,
    )


def _check_drift(stack: SweepStack, name: str) -> None:
    """Raise LidarError if ranges drift over many sweeps by more than they vary between sweeps."""
    lag = stack.sweep_count // 2
    step_m = range_scatter(stack, 1)
    drift_m = range_scatter(stack, lag)
    if drift_m > _DRIFT_FACTOR * step_m + _DRIFT_M:
        raise LidarError(
            f"The ranges in {name} drift: on smooth surfaces, they change by "
            f"{format_rounded(step_m, 2)} m between consecutive sweeps, but by "
            f"{format_rounded(drift_m, 2)} m over {lag} sweeps. Either the sensor or its "
            "environment is moving, or the sensor is warming up. Use sweeps from a stationary "
            "sensor that has warmed up."
        )
