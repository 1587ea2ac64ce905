"""Motion of a sensor during a recording, and drift of its ranges."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidarsim.base.arrays import Bools, Floats
from lidarsim.base.errors import LidarError
from lidarsim.base.sampling import even_indices

from ...recordings.recordings import Recording
from .estimates import MIN_RAYS, sandwich
from .stack import SweepStack, finite_median
from .surfaces import FLAT_TANGENT, MAX_KINK_PER_M, Surfaces, find_surfaces

_MIN_SHIFT_M = 0.02  # shift from which on a sensor moves
_MIN_YAW_RAD = 0.003  # yaw from which on a sensor moves
_MAX_CHANGE_M = 0.1  # median change of ranges, from sweep to sweep, of a static scene
# growth of changes over many sweeps from which on ranges drift
_DRIFT_FACTOR = 1.5
_DRIFT_M = 0.002
_CALM_SHARE = 0.8  # share of the changes, the smallest, whose mean is the scatter
_MIN_EXPLAINED_SHARE = 0.5  # of the rays that a motion changes
_SWEEP_PAIRS = 8  # pairs of sweeps whose motion is fitted
_YAW_ARM_M = 10.0  # distance at which yaw is expressed in metres
# noise of ranges, and motion, for which rays are weighted, metres
_ASSUMED_NOISE_M = 0.02
_ASSUMED_SHIFT_M = 0.5


def read_static(recording: Recording) -> SweepStack:
    """Read the sweeps of a sensor that stands into the same cells.

    LidarError as of `SweepStack.read`, or if the sensor moves.
    """
    stack = SweepStack.read(recording)
    period_ns = None
    if recording.times is not None:
        times = np.array([*recording.times()])[stack.numbers]
        period_ns = float(np.median(np.diff(times)))
    check_static(stack, recording.name, period_ns)
    return stack


def check_static(stack: SweepStack, name: str, period_ns: float | None) -> None:
    """Raise LidarError if the sensor or the recorded scene moves.

    One rigid motion, a shift and a yaw, has to explain the ranges of most of the rays that the
    motion changes. `period_ns` is the time from sweep to sweep, if known.
    """
    if stack.sweep_count < 2:
        return
    _check_motion(stack, name, period_ns)
    _check_drift(stack, name)
    changes = np.abs(np.diff(stack.ranges, axis=0))
    if (change := finite_median(changes, (0, 1, 2))) > _MAX_CHANGE_M:
        raise LidarError(
            f"{name} has ranges that change by {change:.2g} m from sweep to sweep, in the median, "
            "and no motion of the sensor explains that: give points in metres, of a place that "
            "stands still."
        )


def _check_motion(stack: SweepStack, name: str, period_ns: float | None) -> None:
    """Raise LidarError if a sensor moves from sweep to sweep, or over the recording."""
    count = stack.sweep_count
    starts = even_indices(count - 1, _SWEEP_PAIRS).tolist()
    steps = [sensor_motion(stack, k, k + 1) for k in starts]
    overall = [sensor_motion(stack, 0, k) for k in sorted({count // 2, count - 1})]
    motions = [step for step in steps if step.moves]
    sweeps = 1
    if len(motions) <= len(steps) / 2:
        if not all(motion.moves for motion in overall):
            return
        motions = [overall[-1]]
        sweeps = count - 1
    shift_m = float(np.median([motion.shift_m for motion in motions])) / sweeps
    yaw_deg = float(np.degrees(np.median([motion.yaw_rad for motion in motions]))) / sweeps
    speeds = []
    if shift_m > 0:
        speed = f" ({1e9 * shift_m / period_ns:.2g} m/s)" if period_ns else ""
        speeds.append(f"{shift_m:.2g} m{speed}")
    if yaw_deg > 0:
        speeds.append(f"{yaw_deg:.2g}°")
    raise LidarError(
        f"{name} is of a sensor that moves, by {' and '.join(speeds)} from sweep to sweep: give "
        "sweeps of a sensor that stands, or one sweep for the bias of its rings."
    )


def _check_drift(stack: SweepStack, name: str) -> None:
    """Raise LidarError if ranges change more over many sweeps than from sweep to sweep."""
    lag = stack.sweep_count // 2
    step_m = range_scatter(stack, 1)
    drift_m = range_scatter(stack, lag)
    if drift_m > _DRIFT_FACTOR * step_m + _DRIFT_M:
        raise LidarError(
            f"{name} has ranges that drift: smooth surfaces change by {step_m:.2g} m from sweep to "
            f"sweep, but by {drift_m:.2g} m in {lag} sweeps, so the sensor or the place moves, "
            "or the sensor warms up: give sweeps of a warm sensor that stands."
        )


class SensorMotion(NamedTuple):
    """Motion of a sensor between two sweeps; 0 if noise may explain the changes of ranges."""

    shift_m: float  # length
    yaw_rad: float  # magnitude

    @property
    def moves(self) -> bool:
        """True if the sensor moves."""
        return self.shift_m > _MIN_SHIFT_M or self.yaw_rad > _MIN_YAW_RAD


class RangeChanges(NamedTuple):
    """Changes of the ranges of smooth surfaces between two sweeps."""

    surfaces: Surfaces  # of the first sweep
    # (r, c): rays that meet smooth surfaces, not steeply, in the first sweep and return in both
    chosen: Bools
    change: Floats  # (r, c): metres, second less first, without the change by shifted azimuths


def range_changes(stack: SweepStack, first: int, second: int) -> RangeChanges:
    """Compare the ranges of two sweeps where the first sweep meets smooth surfaces."""
    distance = stack.ranges[first].astype(np.float64)
    # Changes of ranges from sweep to sweep are no noise if the sensor moves.
    surfaces = find_surfaces(stack, distance, np.full_like(distance, _ASSUMED_NOISE_M))
    with np.errstate(invalid="ignore"):
        azimuth_change = stack.azimuth_offsets[second] - stack.azimuth_offsets[first]
        change = stack.ranges[second] - distance - surfaces.azimuth_slope * azimuth_change
        chosen = surfaces.smooth & np.isfinite(change) & (surfaces.slope < FLAT_TANGENT * distance)
    return RangeChanges(surfaces, chosen, change)


def range_scatter(stack: SweepStack, lag: int) -> float:
    """Return the typical change of the range of a smooth surface in `lag` sweeps, metres.

    The result is a mean without the largest changes: ranges may be rounded to more than their
    noise.
    """
    scatter = []
    for first in even_indices(stack.sweep_count - lag, _SWEEP_PAIRS).tolist():
        changes = range_changes(stack, first, first + lag)
        sizes = np.sort(np.abs(changes.change[changes.chosen]))
        if len(sizes) >= MIN_RAYS:
            scatter.append(sizes[: round(_CALM_SHARE * len(sizes))].mean())
    return float(np.median(scatter)) if scatter else 0.0


def sensor_motion(stack: SweepStack, first: int, second: int) -> SensorMotion:
    """Fit the shift and the yaw of the sensor between two sweeps to the changes of ranges.

    In the direction d, the plane n · x = c is nearer by n · s / (n · d) after a shift s of the
    sensor.
    """
    surfaces, chosen, changes = range_changes(stack, first, second)
    if chosen.sum() < MIN_RAYS:
        return SensorMotion(0.0, 0.0)
    change = changes[chosen]
    distance = stack.ranges[first].astype(np.float64)[chosen]
    # Normals are of points two columns away on either side: normals of close points are inexact.
    column_count = stack.ranges.shape[2]
    normal_error = _ASSUMED_NOISE_M / (np.sqrt(10) * distance * 2 * np.pi / column_count)
    noise = np.hypot(_ASSUMED_NOISE_M + MAX_KINK_PER_M * distance, _ASSUMED_SHIFT_M * normal_error)
    # Yaw as metres at a distance of 10 m, so that the unknowns are of about the same size.
    design = np.column_stack(
        [-surfaces.scaled_normal[chosen], surfaces.azimuth_slope[chosen] / _YAW_ARM_M]
    )
    changed = np.abs(change) > 5 * noise  # in a street, few rays show how far the sensor moves
    for rays in (slice(None), changed):
        motion = _rigid_motion(design[rays], change[rays], noise[rays])
        if _explains(motion, design, change, noise, normal_error):
            shift_m = float(np.linalg.norm(motion[:3]))
            yaw_rad = float(abs(motion[3])) / _YAW_ARM_M
            return SensorMotion(
                shift_m if shift_m > _MIN_SHIFT_M else 0.0,
                yaw_rad if yaw_rad > _MIN_YAW_RAD else 0.0,
            )
    return SensorMotion(0.0, 0.0)


def _explains(
    motion: Floats, design: Floats, change: Floats, noise: Floats, normal_error: Floats
) -> bool:
    """Return True if a motion (4,) explains most of the large changes that the motion predicts.

    `motion` and `design` (k, 4) are those of `_rigid_motion`. `change` (k,) has the changes of
    ranges and `noise` (k,) their noise, metres; `normal_error` (k,) the errors of normals, radians.
    """
    predicted = design @ motion
    residual = np.abs(change - predicted)
    scale = 1.4826 * np.median(residual / noise)
    limit = np.hypot(3 * scale * noise, 3 * normal_error * np.linalg.norm(motion[:3]))
    large = np.abs(predicted) > limit
    if large.sum() < MIN_RAYS:
        return False
    return bool((residual < np.abs(predicted) / 2)[large].mean() >= _MIN_EXPLAINED_SHARE)


def _rigid_motion(design: Floats, change: Floats, noise: Floats) -> Floats:
    """Fit a motion (4,) to changes of ranges (k,): shift x, y, z and yaw at `_YAW_ARM_M`, metres.

    A row of `design` (k, 4) is the change of the range with the motion; `noise` (k,) is the noise
    of `change`, metres. Components along principal axes of the covariance that are not significant
    are 0. Huber's estimate: few rays of things that move count little.
    """
    motion: Floats = np.zeros(4)
    if len(change) < MIN_RAYS:
        return motion
    for _ in range(30):
        residual = np.abs(change - design @ motion) / noise
        weight = np.sqrt(np.minimum(1, 2 / np.maximum(residual, 1e-9))) / noise
        weighted = design * weight[:, None]
        motion = np.asarray(np.linalg.lstsq(weighted, change * weight, rcond=1e-6)[0], np.float64)
    covariance = sandwich(weighted, (change - design @ motion) * weight)
    variance, axes = np.linalg.eigh(covariance)
    components = axes.T @ motion
    significant = np.abs(components) > 5 * np.sqrt(np.maximum(variance, 0)) + 1e-9
    motion = axes @ np.where(significant, components, 0.0)
    return np.asarray(motion)
