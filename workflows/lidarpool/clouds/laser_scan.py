"""Sweeps of 2D scanners as LaserScan messages of ROS (sensor_msgs)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarsim.base.arrays import Floats, Floats32
from lidarsim.columns.cloud import Cloud
from lidarsim.sensor import Sensor
from lidarsim.survey.survey import Survey
from lidarsim.sweeps.ray_image import Image
from lidarsim.sweeps.sweeps import Sweeps

COLUMNS = "ray", "range"  # columns that a LaserScan needs, with every return
_MAX_STEP_DIFFERENCE = 1e-6  # largest difference between steps of rays, radians


def is_planar(sensor: Sensor) -> bool:
    """Return True if a sensor is a 2D scanner: a beam that turns in the plane of x and y.

    Its rays start at its center, and follow each other in even steps.
    """
    if sensor.channels != 1 or sensor.spins(np.zeros(1, np.int64)) is None:
        return False
    first, stop = sensor.firings(0)
    firings = np.arange(first, max(stop, first + 3))
    rays = sensor.directions(firings)[:, 0]
    return bool(np.allclose(rays[:, 2], 0.0) and sensor.origins(firings) is None)


def has_planar_sensors(survey: Survey) -> bool:
    """Return True if a survey has 2D scanners."""
    return any(is_planar(carried.sensor) for carried in survey.carried)


def has_laser_scans(sweeps: Sweeps) -> bool:
    """Return True if bags of a survey have LaserScan messages, provided its cloud has ranges."""
    return sweeps.fired is not None and any(map(is_planar, sweeps.fired.sensors))


@dataclass(frozen=True, eq=False)
class ScanRays:
    """The rays of a sweep of a 2D scanner, with the fields of a LaserScan."""

    angles: Floats  # (n,): radians, continuous, in even steps
    time_increment_s: float  # between rays
    scan_time_s: float  # between sweeps
    range_limits_m: tuple[float, float]
    ranges: Floats32  # (n,): of the first return, meters; infinite where there is none (REP 117)
    intensities: Floats32  # (n,): of the first return; 0 where there is none

    @classmethod
    def from_points(cls, sweeps: Sweeps, sweep: int, points: Cloud) -> ScanRays | None:
        """Return the rays of a sweep, or None without a 2D scanner or with unknown rays."""
        fired = sweeps.fired
        if fired is None or "range" not in points.columns:
            return None
        sensor = fired.sensors[sweeps.sensor[sweep]]
        if not is_planar(sensor):
            return None
        image = Image.from_points(sweeps, sweep, points)
        x, y, _ = sensor.directions(image.firings)[:, 0].T
        angles = np.unwrap(np.arctan2(y, x))
        steps = np.diff(angles)
        if len(steps) == 0 or np.ptp(steps) > _MAX_STEP_DIFFERENCE:
            return None
        begins_ns = sensor.begins_ns(image.firings)
        time_increment_s = float(begins_ns[-1] - begins_ns[0]) / len(steps) / 1e9
        rate_hz = getattr(sensor.head, "rate_hz", None)
        ranges = image.filled(points["range"].astype(np.float32))[0, 0]
        intensity = points.columns.get("intensity", points.columns.get("signal"))
        intensities = np.zeros(len(ranges), np.float32)
        if intensity is not None:
            intensities = np.nan_to_num(image.filled(intensity.astype(np.float32))[0, 0])
        return cls(
            angles,
            time_increment_s,
            1 / rate_hz if rate_hz else time_increment_s * len(angles),
            (sensor.min_range_m, min(sensor.max_range_m, float(np.finfo(np.float32).max))),
            np.where(np.isnan(ranges), np.float32(np.inf), ranges),
            intensities,
        )
