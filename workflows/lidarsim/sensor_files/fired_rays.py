"""Rays of a sensor in firing order, as stored in sensor files."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from ..numerics.arrays import Floats, Ints
from ..numerics.elementary import arctan2, sin_cos

# Conventions for rays, which are stated in file headers.
AXES = "x forward, y left, z up"
AZIMUTH = "from x, counter-clockwise seen from above, within half a turn"
ELEVATION = "above the xy plane"
TIME = "nanoseconds since the start of the list"
FRAME_HZ = 10.0  # assumed for lists that state neither times nor a rate


class Light(NamedTuple):
    """Optical properties of a sensor's light."""

    wavelength_nm: float | None  # None if unknown
    pulse_ns: float
    # Full horizontal and vertical angles at 1/e² of the maximum; None if unknown.
    divergence_mrad: tuple[float, float] | None


@dataclass(frozen=True, eq=False)
class RayList:
    """Rays in the sensor frame, with x forward, y left and z up.

    Attributes
    ----------
    directions
        float64 array (n, 3) of unit directions in firing order.
    times_ns
        int64 array (n,) of firing times in nanoseconds since the start of the list, or None if
        unknown.
    channels
        int64 array (n,) with the channel of each ray, where 0 is the lowest channel.
    origins
        float64 array (n, 3) of ray origins in meters, or None if all rays start at the sensor's
        center.
    cycle_ns
        Duration of the list in nanoseconds, after which it can be repeated, or None if unknown.
    rate_hz
        Number of revolutions, lines or frames per second.
    range_m
        Minimum and maximum range in meters. The maximum may be infinite.
    name
        Name of the sensor.
    repeats
        Whether the sensor itself repeats these rays exactly, apart from incomplete firings.
    light
        Optical properties of the light, or None if unknown.
    notes
        Notes on how the rays were determined.
    """

    directions: Floats
    times_ns: Ints | None = None
    channels: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    origins: Floats | None = None
    cycle_ns: float | None = None
    rate_hz: float = FRAME_HZ
    range_m: tuple[float, float] = (0.0, float("inf"))
    name: str = ""
    repeats: bool = True
    light: Light | None = None
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not len(self.channels):
            object.__setattr__(self, "channels", np.zeros(len(self.directions), np.int64))

    def __len__(self) -> int:
        return len(self.directions)

    @property
    def azimuths_deg(self) -> Floats:
        """Azimuths counterclockwise from x, in degrees within ±180."""
        x, y, _ = self.directions.T
        return np.degrees(arctan2(y, x))

    @property
    def elevations_deg(self) -> Floats:
        """Elevations above the xy plane, in degrees."""
        x, y, z = self.directions.T
        return np.degrees(arctan2(z, np.sqrt(x * x + y * y)))

    @property
    def origins_or_center(self) -> Floats:
        """Origins of the rays in meters, or zeros if all rays start at the center."""
        return np.zeros((len(self), 3)) if self.origins is None else self.origins

    def with_times(self) -> RayList:
        """Return the rays with times. Unknown times are spread evenly over a frame."""
        if self.times_ns is not None:
            return self
        cycle_ns = self.cycle_ns or 1e9 / self.rate_hz
        times_ns = np.rint(cycle_ns * np.arange(len(self)) / len(self)).astype(np.int64)
        return replace(self, times_ns=times_ns, cycle_ns=cycle_ns)


def directions_of(azimuths_deg: Floats, elevations_deg: Floats) -> Floats:
    """Convert azimuths and elevations in degrees to unit directions."""
    up, level = sin_cos(np.radians(elevations_deg))
    sin, cos = sin_cos(np.radians(azimuths_deg))
    return np.column_stack([level * cos, level * sin, up])
