"""A scanning lidar: which directions it looks in, and in which order."""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from .errors import LidarpoolError


@dataclass(frozen=True)
class Sensor:
    """A rotating lidar with evenly spaced azimuths and elevations.

    In each time step the head turns by `step_deg` and fires, at every azimuth that it passes,
    one ray a layer. Azimuth 0 is the sensor's +x axis and grows counter-clockwise seen from
    above; ring 0 is the lowest elevation.

    Parameters
    ----------
    rays_per_revolution
        Azimuths in one revolution.
    layers
        Elevations (rings), evenly spaced over the vertical field of view, both ends included;
        one layer looks straight ahead.
    vertical_fov_deg
        Vertical field of view in degrees, half of it below the horizon, in (0, 180].
    step_deg
        Degrees turned in one time step, in (0, 360].
    min_range_m, max_range_m
        Returns nearer or farther than this, in metres, are not seen. A ray goes on through
        what is nearer.

    Raises
    ------
    LidarpoolError
        If a value is outside its range, or a time step holds no azimuth at all.

    Examples
    --------
    >>> sensor = Sensor(rays_per_revolution=1000, step_deg=10)
    >>> sensor.sector(0), sensor.sector(1)
    ((0, 28), (28, 56))
    """

    rays_per_revolution: int = 1000
    layers: int = 40
    vertical_fov_deg: float = 60.0
    step_deg: float = 10.0
    min_range_m: float = 0.0
    max_range_m: float = float("inf")

    def __post_init__(self) -> None:
        checks = (
            ("rays_per_revolution", self.rays_per_revolution >= 1, "at least 1"),
            ("layers", 1 <= self.layers <= 65_535, "1 to 65535"),
            ("vertical_fov_deg", 0 < self.vertical_fov_deg <= 180, "above 0, at most 180"),
            ("step_deg", 0 < self.step_deg <= 360, "above 0, at most 360"),
            ("min_range_m", 0 <= self.min_range_m < float("inf"), "finite, at least 0"),
            ("max_range_m", self.max_range_m > self.min_range_m, "above min_range_m"),
        )
        for name, good, allowed in checks:
            if not good:
                raise LidarpoolError(f"{name} is {getattr(self, name)}; it must be {allowed}.")
        if self._azimuths_per_step < 1:
            raise LidarpoolError(
                f"step_deg {self.step_deg} is less than one azimuth "
                f"({360 / self.rays_per_revolution:g} degrees), so some scans would be empty: "
                "make step_deg or rays_per_revolution larger."
            )

    @cached_property
    def _azimuths_per_step(self) -> Fraction:
        """How many azimuths the head passes in a time step, exactly.

        Neither 0.1 nor 360/7 degrees is itself in binary. The nearest fraction with a
        denominator of at most a million is what was meant, for decimals and for parts of a
        turn; with it, the sectors of a revolution hold each azimuth once.
        """
        step = Fraction(self.step_deg).limit_denominator(1_000_000)
        return step * self.rays_per_revolution / 360

    def sector(self, step: int) -> tuple[int, int]:
        """Azimuths fired in time step `step`: first, and one past the last.

        Successive sectors meet without gap or overlap, whatever the numbers. After one
        revolution the azimuths go on past `rays_per_revolution`.
        """
        per_step = self._azimuths_per_step
        return math.ceil(step * per_step), math.ceil((step + 1) * per_step)

    @cached_property
    def elevations(self) -> NDArray[np.float64]:
        """Elevation of each ring in radians, lowest first: (layers,)."""
        half = np.radians(self.vertical_fov_deg) / 2
        return np.linspace(-half, half, self.layers) if self.layers > 1 else np.zeros(1)

    @cached_property
    def directions(self) -> NDArray[np.float64]:
        """Unit directions of one revolution: (rays_per_revolution, layers, 3)."""
        azimuth = 2 * np.pi * np.arange(self.rays_per_revolution) / self.rays_per_revolution
        horizontal = np.cos(self.elevations)
        out = np.empty((self.rays_per_revolution, self.layers, 3))
        out[..., 0] = np.cos(azimuth)[:, None] * horizontal
        out[..., 1] = np.sin(azimuth)[:, None] * horizontal
        out[..., 2] = np.sin(self.elevations)
        return out
