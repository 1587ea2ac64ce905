"""Conversion of 2D scanner sweeps to the fields of ROS LaserScan messages."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarsim.columns.cloud import Cloud
from lidarsim.numerics.arrays import Floats, Floats32
from lidarsim.sensor import Sensor
from lidarsim.survey.survey import Survey
from lidarsim.sweeps.ray_image import RayImage
from lidarsim.sweeps.sweeps import Sweeps

COLUMNS = "ray", "range"  # columns that a LaserScan requires, in addition to all returns
_MAX_STEP_DIFFERENCE = 1e-6  # tolerated difference between angle steps in radians


def is_planar(sensor: Sensor) -> bool:
    """Return whether a sensor is a 2D scanner, whose only beam rotates in its x-y plane.

    The rays of a 2D scanner start at its origin.
    """
    if sensor.channels != 1 or sensor.spins(np.zeros(1, np.int64)) is None:
        return False
    first, stop = sensor.firings(0)
    firings = np.arange(first, max(stop, first + 3))
    rays = sensor.directions(firings)[:, 0]
    return bool(np.allclose(rays[:, 2], 0.0) and sensor.origins(firings) is None)


def has_planar_sensors(survey: Survey) -> bool:
    """Return whether a survey has at least one 2D scanner."""
    return any(is_planar(carried.sensor) for carried in survey.mounted_sensors)


def has_laser_scans(sweeps: Sweeps) -> bool:
    """Return whether there are sweeps of 2D scanners that can become LaserScan messages.

    The messages also require a cloud with ranges.
    """
    return sweeps.fired is not None and any(map(is_planar, sweeps.fired.sensors))


@dataclass(frozen=True, eq=False)
class ScanRays:
    """Rays in a sweep of a 2D scanner, with the values that a LaserScan message requires."""

    angles: Floats  # (n,): radians, evenly spaced and without jumps at ±pi
    time_increment_s: float  # time between consecutive rays
    scan_time_s: float  # time between consecutive sweeps
    range_limits_m: tuple[float, float]  # minimum and maximum range
    # (n,): range of the first return in meters, or infinity if there is no return (REP 117).
    ranges: Floats32
    intensities: Floats32  # (n,): intensity of the first return, or 0 if there is no return

    @classmethod
    def from_points(cls, sweeps: Sweeps, sweep: int, points: Cloud) -> ScanRays | None:
        """Return the rays of a sweep.

        Returns None if the sensor is not a 2D scanner, if its rays are unknown or not evenly
        spaced, or if the points have no ranges.
        """
        fired = sweeps.fired
        if fired is None or "range" not in points.columns:
            return None
        sensor = fired.sensors[sweeps.sensor[sweep]]
        if not is_planar(sensor):
            return None
        image = RayImage.from_points(sweeps, sweep, points)
        x, y, _ = sensor.directions(image.firings)[:, 0].T
        angles = np.unwrap(np.arctan2(y, x))
        steps = np.diff(angles)
        if len(steps) == 0 or np.ptp(steps) > _MAX_STEP_DIFFERENCE:
            return None
        begins_ns = sensor.begins_ns(image.firings)
        time_increment_s = float(begins_ns[-1] - begins_ns[0]) / len(steps) / 1e9
        rate_hz = getattr(sensor.head, "rate_hz", None)
        ranges = image.to_images(points["range"].astype(np.float32))[0, 0]
        intensity = points.columns.get("intensity", points.columns.get("signal"))
        intensities = np.zeros(len(ranges), np.float32)
        if intensity is not None:
            intensities = np.nan_to_num(image.to_images(intensity.astype(np.float32))[0, 0])
        return cls(
            angles,
            time_increment_s,
            1 / rate_hz if rate_hz else time_increment_s * len(angles),
            (sensor.min_range_m, min(sensor.max_range_m, float(np.finfo(np.float32).max))),
            np.where(np.isnan(ranges), np.float32(np.inf), ranges),
            intensities,
        )
