"""Measure a sensor's noise, losses and range bias, using the rays of a recording."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from lidarfiles.clouds.recording import Recording
from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import Floats, Ints
from lidarsim.scene.scene import Scene
from lidarsim.sensor import Spin
from lidarsim.sensor.ray_sensors import ListedSensor
from lidarsim.simulator import Scanner

from .estimates import MIN_RAYS, Estimate
from .known_poses import KnownPoses
from .moving_pulses import ScenePulses, measure_pulses
from .performance import alarm_share, fit_performance
from .ring_bias import ring_bias
from .smooth_surfaces import (
    ASSUMED_DIRECTION_NOISE_RAD,
    FLAT_TANGENT,
    SCENE_TOLERANCE_M,
    SmoothRays,
    find_surfaces,
    select_smooth_rays,
)
from .stack import SweepStack, finite_median
from .standstill import read_static

_CURVE_POINTS = 14  # maximum number of points in a curve
_MIN_SCENE_SHARE = 0.5  # fraction of rays that must be within `SCENE_TOLERANCE_M` of the scene
_MIN_REFLECTANCE = 1 / 400  # reflectance assumed for surfaces with a reported intensity of 0
_MIN_RANGE_ERROR_M = 0.001  # minimum error of a mean range, for any number of measurements

Curve = list[dict[str, float]]  # points, each with x, value, low and high


@dataclass(frozen=True, eq=False)
class SensorMeasurement:
    """Rays on smooth surfaces, and the sensor performance estimated from them."""

    stack: SweepStack
    rays: SmoothRays
    energy: Floats | None  # (k,): see `_pulse_energies`; None if unknown
    # {field: estimate}. Fields of `Noise` (see `fit_performance`), and for a stationary sensor also
    # `false_alarms`, a field of `Performance`. Empty for one sweep of a stationary sensor.
    estimates: dict[str, Estimate]
    bias: dict[int, Estimate]  # {row: range bias in meters}; relative without a scene
    lost_by_range: Curve | None = None  # fraction of lost pulses; None without a scene
    moves: bool = False  # whether the sensor moves

    def curves(self) -> dict[str, Curve]:
        """Compute all curves for `charts`, keyed by chart name."""
        rays = self.rays
        light = rays.intensity if self.energy is None else self.energy
        variance = np.where(rays.freedom > 0, rays.variance, np.nan)
        range_variance = self._range_variances()
        incidence_deg = np.degrees(np.arctan(rays.slope / rays.distance))
        curves = {
            "noise_by_range": _curve(rays.distance, range_variance, 0.5),
            "noise_by_light": _curve(light, range_variance, 0.5),
            "noise_by_tilt": _curve(incidence_deg, variance, 0.5),
            "light_by_range": _curve(rays.distance, rays.intensity),
        }
        if self.stack.sweep_count > 1:
            curves["returned_by_light"] = _curve(light, rays.return_counts / rays.trials)
        if self.lost_by_range is not None:
            curves["lost_by_range"] = self.lost_by_range
        return curves

    def _range_variances(self) -> Floats:
        """Return each ray's range variance in m², excluding the contribution of angle noise.

        The variance of a single return is NaN.
        """
        rays = self.rays
        estimate = self.estimates.get("angle_deg")
        direction_noise_rad = 0.0 if estimate is None else np.radians(estimate.value)
        variance = np.where(rays.freedom > 0, rays.variance, np.nan)
        return np.asarray(variance - (direction_noise_rad * rays.slope) ** 2)

    def channels(self) -> list[dict[str, Any]]:
        """Return a dictionary for each ring, which contains its noise, bias and azimuth spread."""
        stack = self.stack
        row_of_ray = self.rays.row
        range_variance = self._range_variances()
        azimuth_variance = np.degrees(np.diff(stack.azimuth_offsets, axis=2)) ** 2 / 2
        has_spread = len(azimuth_variance) > 1 and not self.moves
        return [
            {
                "ring": int(ring),
                "elevation_deg": float(stack.elevation_deg[row]),
                "rays": int(np.isfinite(range_variance[row_of_ray == row]).sum()),
                "noise_m": _root_mean(range_variance[row_of_ray == row]),
                "bias_m": self.bias[row]._asdict() if row in self.bias else None,
                "uneven_deg": _root_mean(azimuth_variance[:, row]) if has_spread else None,
            }
            for row, ring in enumerate(stack.rings)
        ]


def measure_standing(
    recording: Recording, white: float | None, scene: Scene | None, poses: KnownPoses | None
) -> SensorMeasurement:
    """Measure a stationary sensor, using its returns from smooth surfaces.

    `white` is the intensity of a white surface. Raises LidarError if the sensor moves, if it is not
    at its pose in the scene, or if too few rays hit smooth surfaces.
    """
    stack = read_static(
        recording, is_stationary=poses is not None and poses.are_of_firings(recording)
    )
    lost_by_range = None
    expected = None
    if scene is not None:
        expected = _scene_ranges(stack, scene, poses)
        difference = np.abs(finite_median(stack.ranges, 0) - expected)
        near_count = (difference < SCENE_TOLERANCE_M).sum()
        _check_pose(near_count / max(np.isfinite(difference).sum(), 1), recording.info.name)
        lost_by_range = _lost_by_range(stack, expected)
    sigma = stack.rough_sigma.copy()
    estimates: dict[str, Estimate] = {}
    for _ in range(2):  # the second pass excludes outliers based on the noise from the first pass
        direction_noise_rad = 0.0 if estimates else ASSUMED_DIRECTION_NOISE_RAD
        rays = select_smooth_rays(stack, sigma, direction_noise_rad, expected)
        _check_rays(len(rays.row), recording.info.name)
        energy = _pulse_energies(rays, white or recording.info.white, recording.info.energies)
        if stack.sweep_count > 1:
            estimates, sigma[rays.row, rays.column] = fit_performance(rays, energy)
    if estimates and (alarms := alarm_share(stack)):
        estimates["false_alarms"] = alarms
    bias = _bias(stack, rays, sigma, expected)
    return SensorMeasurement(stack, rays, energy, estimates, bias, lost_by_range)


def measure_moving(
    recording: Recording, white: float | None, scene: Scene, poses: KnownPoses
) -> SensorMeasurement:
    """Measure a moving sensor, using its pulses that hit smooth surfaces of a scene.

    `white` is the intensity of a white surface. Raises LidarError if the sensor is not at its poses
    in the scene, or if too few pulses hit smooth surfaces.
    """
    stack, sweeps = measure_pulses(recording, scene, poses.sweep_reader(recording))
    _check_pose(sweeps.near / max(sweeps.compared, 1), recording.info.name)
    pulses = sweeps.pulses
    if np.isfinite(stack.intensities).any():
        pulses = pulses.select(np.isfinite(pulses.intensity))
    _check_rays(np.isfinite(pulses.difference).sum(), recording.info.name)
    pulses = pulses.select(pulses.near_scene(pulses.rough_sigma()))
    sigma = pulses.rough_sigma()
    for _ in range(2):  # the second pass excludes outliers based on the noise from the first pass
        rays = pulses.rays(sigma)
        energy = _pulse_energies(rays, white or recording.info.white, recording.info.energies)
        estimates, sigma = fit_performance(rays, energy, all_known=True)
    lost = 1 - rays.return_counts.astype(np.float64)
    bias = _pulse_bias(pulses)
    return SensorMeasurement(
        stack, rays, energy, estimates, bias, _curve(rays.distance, lost), moves=True
    )


def _check_rays(count: int, name: str) -> None:
    """Raise LidarError if too few rays hit smooth surfaces."""
    if count < MIN_RAYS:
        raise LidarError(
            f"{name} has only {count} rays on smooth surfaces, but at least {MIN_RAYS} are "
            "required. Use a recording of walls or a floor, with points in the sensor frame."
        )


def _scene_ranges(stack: SweepStack, scene: Scene, poses: KnownPoses | None) -> Floats:
    """Return the distance of the scene in each cell in meters, or NaN if the ray hits nothing.

    The sensor is at the first of the poses, or at the origin if no poses are known.
    """
    rays = stack.directions.reshape(-1, 3)
    # All rays are fired in a single time step.
    sensor = ListedSensor(head=Spin(len(rays), 360), rays=rays, shot_ns=np.zeros(len(rays)))
    pose = np.eye(4) if poses is None else poses.matrices[0]
    ranges = Scanner(scene, sensor).ranges(pose[None], number=0).reshape(stack.rough_sigma.shape)
    return np.where(np.isfinite(ranges), ranges, np.nan).astype(np.float64)


def _check_pose(near_share: float, name: str) -> None:
    """Raise LidarError unless at least half of the ranges match the scene."""
    if not near_share > _MIN_SCENE_SHARE:
        message = (
            f"Less than half of the points in {name} are within {SCENE_TOLERANCE_M} m of the scene."
        )
        raise LidarError(
            f"{message} Pass the pose of the sensor in the scene with `--pose`, or omit the scene."
        )


def _lost_by_range(stack: SweepStack, expected: Floats) -> Curve:
    """Compute the fraction of lost pulses as a function of the expected range."""
    surfaces = find_surfaces(stack, expected, 0 * stack.rough_sigma)
    cells = surfaces.smooth & (stack.trials > 0)
    returned = np.isfinite(stack.ranges).sum(axis=0)
    lost = 1 - returned[cells] / stack.trials[cells]
    return _curve(expected[cells], lost)


def _pulse_energies(rays: SmoothRays, white: float | None, are_energies: bool) -> Floats | None:
    """Return the mean energy of each ray's returns, or None if it is unknown.

    A white surface at 10 m has an energy of 1. If `white`, the intensity of a white surface, is
    given, intensities are proportional to the reflectance. Otherwise they are energies if
    `are_energies` is true.
    """
    if not np.isfinite(rays.intensity).all():
        return None
    if white:
        reflectance = np.maximum(rays.intensity / white, _MIN_REFLECTANCE)
        return np.asarray(reflectance * (10 / rays.distance) ** 2)
    return rays.intensity if are_energies else None


def _bias(
    stack: SweepStack, rays: SmoothRays, sigma: Floats, expected: Floats | None
) -> dict[int, Estimate]:
    """Estimate the range bias of each row in meters, using rays with a small angle of incidence.

    If the ranges of the scene, `expected`, are known, the bias is the mean difference from them.
    Otherwise it is relative to the mean of all rows (see `ring_bias`), and the result is empty if
    fewer than three rows hit planes. `expected` and `sigma`, the standard deviation of ranges, are
    in meters and have shape (r, c).
    """
    flat = rays.select(rays.slope < FLAT_TANGENT * rays.distance)
    cell = flat.row, flat.column
    if expected is not None:
        return _mean_by_row(flat.row, flat.distance - expected[cell])
    error_m = sigma[cell] / np.sqrt(flat.return_counts) + _MIN_RANGE_ERROR_M
    return ring_bias(flat, stack.directions[cell], error_m)


def _pulse_bias(pulses: ScenePulses) -> dict[int, Estimate]:
    """Estimate the range bias of each row in meters, excluding returns at grazing incidence."""
    returned = np.isfinite(pulses.residual) & (pulses.slope < FLAT_TANGENT * pulses.expected)
    return _mean_by_row(pulses.row[returned], pulses.residual[returned])


def _mean_by_row(row: Ints, errors: Floats) -> dict[int, Estimate]:
    return {number: Estimate.from_values(errors[row == number]) for number in set(row.tolist())}


def _root_mean(variances: Floats) -> dict[str, float] | None:
    """Estimate the root mean of the finite variances, or return None if there are too few."""
    finite = variances[np.isfinite(variances)]
    if len(finite) < MIN_RAYS:
        return None
    return Estimate.from_values(finite).power(0.5)._asdict()


def _curve(x: Floats, values: Floats, power: float = 1.0) -> Curve:
    """Compute a curve of values over x with one point per interval of x.

    The intervals contain equal numbers of finite values, at least `MIN_RAYS`. The x of a point is
    the median in its interval, and its value is the mean of the interval raised to `power`.
    """
    finite = np.flatnonzero(np.isfinite(values) & np.isfinite(x))
    order = finite[np.argsort(x[finite], kind="stable")]
    intervals = np.array_split(order, min(_CURVE_POINTS, len(order) // MIN_RAYS) or 1)
    return [
        {"x": float(np.median(x[interval]))}
        | Estimate.from_values(values[interval]).power(power)._asdict()
        for interval in intervals
        if len(interval) >= MIN_RAYS
    ]
