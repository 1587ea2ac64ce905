"""Scanners that look down from an aircraft, and the limits of their rates."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lidarsim.errors import LidarError
from lidarsim.motion.trajectory import CENTER, Pose
from lidarsim.numerics.arrays import Floats
from lidarsim.numerics.vectors import rotate
from lidarsim.sensor import Sensor
from lidarsim.sensor.beams import Mirror
from lidarsim.sensor.models import load_sensor, read_model
from lidarsim.sensor.sensor import LineSensor

WIDE_FOV_DEG = 90.0  # field of view that is planned for scanners with a wider one
DOWN = Pose((0.0, 0.0, 0.0), pitch_deg=90)  # mount of sensors whose z axis is the axis of rotation
_SAMPLED_PULSES = 50_000


@dataclass(frozen=True)
class AirborneScanner:
    """A scanner that looks down from an aircraft, with the limits of its rates.

    Parameters
    ----------
    model
        Name of the sensor model, or path of a sensor file.
    sensor
        The sensor at its nominal rates.
    mount
        Pose of the sensor in the frame of the aircraft.
    half_fov_deg
        Half of the planned field of view across the track, in degrees.
    pulses_hz
        Maximum number of pulses per second within the planned field of view, averaged over a cycle.
    fired_hz
        Maximum number of pulses per second, averaged over a cycle.
    ahead
        Tangent of the largest angle between the nadir and a ray along the track.
    lines_per_cycle
        Number of scan lines in a cycle of the scanner.
    rates_hz
        Minimum and maximum number of cycles per second. Both are equal if the rate is fixed.
    has_pulse_count
        Whether the number of pulses per cycle can be set.
    """

    model: str
    sensor: Sensor
    mount: Pose
    half_fov_deg: float
    pulses_hz: float
    fired_hz: float
    ahead: float
    lines_per_cycle: int
    rates_hz: tuple[float, float]
    has_pulse_count: bool

    @classmethod
    def load(cls, model: str, fov_deg: float | None = None) -> AirborneScanner:
        """Load a sensor model and determine its field of view and rates.

        Sensors whose head rotates about the z axis, and sensors that look forward, are mounted with
        their x axis down.

        Raises
        ------
        LidarError
            If the sensor emits no pulses downward, or if its field of view is narrower than
            `fov_deg`.
        """
        content = read_model(model)
        sensor = load_sensor(model)
        mount = CENTER if isinstance(sensor, LineSensor) else DOWN
        x, y, z = _cycle_directions(sensor, mount)
        across_deg = np.degrees(np.arctan2(np.abs(y), -z))
        widest_deg = 2 * float(across_deg[across_deg < 90].max(initial=0.0))
        _check_field(sensor, widest_deg, fov_deg)
        planned_deg = min(widest_deg, WIDE_FOV_DEG) if fov_deg is None else fov_deg
        within = across_deg <= planned_deg / 2 + 1e-6
        fired_hz = sensor.pulse_rate_hz
        mirror = sensor.head if isinstance(sensor.head, Mirror) else None
        oscillates = mirror is not None and mirror.motion != "sawtooth"
        limits = (content.rate_hz, content.rate_hz)
        if content.rates_hz is not None and (mirror or content.firing_us is not None):
            limits = content.rates_hz
        return cls(
            model=model,
            sensor=sensor,
            mount=mount,
            half_fov_deg=planned_deg / 2,
            pulses_hz=fired_hz * float(within.mean()),
            fired_hz=fired_hz,
            ahead=float(np.abs(x[within] / z[within]).max()),
            lines_per_cycle=2 if oscillates else sensor.channels,
            rates_hz=limits,
            has_pulse_count=mirror is not None and content.firings_per_turn is not None,
        )

    @property
    def tangent(self) -> float:
        """Half of the swath divided by the height above ground."""
        return math.tan(math.radians(self.half_fov_deg))

    def swath_m(self, height_m: float) -> float:
        """Return the width of the swath at a height above level ground, in meters."""
        return 2 * height_m * self.tangent


def _cycle_directions(sensor: Sensor, mount: Pose) -> Floats:
    """Return the directions of pulses in a cycle in the aircraft frame, with shape (3, n)."""
    cycle = sensor.firings_of_revolution(0)
    count = min(len(cycle), max(1, _SAMPLED_PULSES // sensor.channels))
    firings = np.linspace(cycle.start, cycle.stop, count, endpoint=False).astype(np.int64)
    return rotate(sensor.directions(firings).reshape(-1, 3), mount.rotation).T


def _check_field(sensor: Sensor, widest_deg: float, fov_deg: float | None) -> None:
    """Raise LidarError if a sensor does not scan across the track, or not widely enough."""
    if not widest_deg > 0:
        raise LidarError(
            f"{sensor.model} emits no pulses across the flight direction. Use an airborne scanner, "
            "such as airborne/riegl-vq780i."
        )
    if fov_deg is not None and fov_deg > widest_deg + 0.1:
        raise LidarError(
            f"`--fov` is {fov_deg:g}°, but the field of view of {sensor.model} across the flight "
            f"direction is {widest_deg:.4g}°. Reduce `--fov`."
        )
