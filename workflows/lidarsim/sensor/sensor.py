"""Lidar sensors, which consist of beams and a head that moves the beams."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from ..environment.notebook import html_picture, html_table
from ..errors import LidarError
from ..numerics.arrays import Bools, Floats, Ints
from ..numerics.elementary import arcsin, arctan2, sin_cos
from ..numerics.vectors import rotate
from ..schema.checks import check_fields, check_fits
from ..schema.declared import about
from ..schema.value_texts import one_line
from ..words import format_rounded
from .beams import MAX_CHANNELS, Beams, Head, Mirror, Spin
from .noise import Noise
from .optics import LIGHT_M_NS, Optics, Returns
from .packet_settings import Identifier, PacketSettings

RaysPerRevolution = Annotated[
    int, about("number of azimuths per revolution, for a regular grid", ge=1, le=10_000_000)
]
Layers = Annotated[
    int, about("number of elevations (rings), for a regular grid", ge=1, le=MAX_CHANNELS)
]
Fov = Annotated[
    float,
    about(
        "vertical field of view in degrees, half of it below the horizon, for a regular grid",
        ge=0,
        le=180,
    ),
]
Sector = Annotated[
    float,
    about(
        "horizontal field of view in degrees, half of it to the left of +x, for a regular grid",
        gt=0,
        le=360,
    ),
]
SAMPLED_FIRINGS = 2000  # number of firings from which the field of view is determined
# Maximum gap between adjacent azimuths of a sensor with a 360-degree field of view.
MAX_GAP_DEG = 5.0
MinRange = Annotated[float, Field(ge=0, le=1e8)]
MaxRange = Annotated[float, Field(gt=0, allow_inf_nan=True)]


@dataclass(frozen=True, eq=False)
class Sensor:
    """A lidar sensor, which consists of beams and a head that moves the beams.

    All beams are fired once per firing.

    To define another kind of sensor, use other beams or another head, or write a subclass that
    overrides `directions`, `origins` or `begins_ns`. No other code has to be changed. A sensor is
    identified by its fields (see `lidarfiles.identity.fingerprint`), so any data that affects the
    rays must be stored in fields.

    Parameters
    ----------
    beams
        The beams, all of which are fired in each firing.
    head
        The mechanism that moves the beams.
    min_range_m, max_range_m
        Minimum and maximum range in meters. Returns outside this interval are ignored, and rays
        pass through surfaces that are closer than the minimum range.
    name
        Name of the sensor model for reports. The default is the name of the class.
    optics
        Optical parameters and range resolution.
    start_ns
        Time at which the head starts, in nanoseconds since the start of the survey or station.
    noise, returns
        Defaults for surveys with this sensor. They are not part of its fingerprint.
    packets
        Packet format of the manufacturer for recordings of this sensor. It is not part of its
        fingerprint.

    Raises
    ------
    LidarError
        If a range or the start is out of range.

    Examples
    --------
    >>> sensor = Sensor.grid(rays_per_revolution=1000, layers=40, step_deg=10)
    >>> sensor.channels, sensor.firings(1)
    (40, (28, 56))
    """

    beams: Beams = field(default_factory=lambda: Beams.even(40, 60.0))
    head: Head = field(default_factory=Spin)
    min_range_m: MinRange = 0.0
    max_range_m: MaxRange = float("inf")
    name: str = ""
    optics: Optics = field(default_factory=Optics)
    start_ns: Annotated[float, Field(ge=0)] = 0.0
    noise: Noise | None = field(default=None, kw_only=True, compare=False)
    returns: Returns | None = field(default=None, kw_only=True, compare=False)
    packets: PacketSettings | None = field(default=None, kw_only=True, compare=False)
    cycle: ClassVar[str] = "turn"  # term for one cycle of the sensor

    __repr__ = one_line

    def __post_init__(self) -> None:
        check_fields(self)
        if not self.max_range_m > self.min_range_m:
            raise LidarError(
                f"max_range_m must be greater than min_range_m, but is {self.max_range_m}."
            )
        if len(self.beams.blocked) and type(self).directions is not Sensor.directions:
            raise LidarError(
                "Blocked directions require beams that rotate with a head. Remove them from the "
                "beams."
            )

    def _repr_html_(self) -> str:
        """Return an HTML table of the main properties, with an image if a package can draw it."""
        rows = {
            "sensor": self.model,
            "channels": f"{self.channels:,}",
            "field of view": self._field_of_view(),
            "rate": self._rate(),
            "range": f"from {self.min_range_m:g} m"
            + (f" to {self.max_range_m:g} m" if self.max_range_m < float("inf") else ""),
            "wavelength": f"{self.optics.simulated_nm:g} nm"
            + " (assumed)" * (self.optics.wavelength_nm is None),
        }
        return html_table(rows.items()) + html_picture(self)

    def _field_of_view(self) -> str:
        """Format the horizontal and vertical field of view, estimated from a sample of the rays."""
        all_firings = self.firings_of_revolution(0)
        samples = min(len(all_firings), SAMPLED_FIRINGS)
        firings = np.linspace(all_firings[0], all_firings[-1], samples).astype(np.int64)
        x, y, z = self.directions(firings).reshape(-1, 3).T
        azimuths = np.sort(np.degrees(arctan2(y, x)))
        # The field of view is the full circle except for the widest gap between adjacent azimuths.
        gaps = np.diff(azimuths, append=azimuths[0] + 360)
        width = 360.0 if gaps.max() < MAX_GAP_DEG else 360.0 - float(gaps.max())
        elevations = np.degrees(arcsin(np.clip(z, -1, 1)))
        return f"{width:.4g}°, {elevations.min():.3g}° to {elevations.max():.3g}°"

    def _rate(self) -> str:
        """Format the revolution or frame rate and the number of rays per second."""
        seconds = (self.revolution_start_ns(1) - self.revolution_start_ns(0)) / 1e9
        return f"{format_rounded(1 / seconds, 4)} Hz, {self.pulse_rate_hz:,.0f} rays/s"

    def with_packets(
        self, ports: Mapping[str, int], identifiers: Mapping[str, Identifier]
    ) -> Sensor:
        """Return a copy of the sensor with some packet ports and identifiers replaced.

        Raises
        ------
        LidarError
            If the sensor has no packet format.
        """
        if self.packets is None:
            raise LidarError(f"{self.model} has no packet format. Remove packets.")
        packets = replace(
            self.packets,
            ports={**self.packets.ports, **ports},
            identifiers={**self.packets.identifiers, **identifiers},
        )
        return replace(self, packets=packets)

    @property
    def model(self) -> str:
        """Name of the sensor model, for use in reports."""
        return self.name or f"{type(self).__name__} with {self.channels} channels"

    @classmethod
    def grid(
        cls,
        rays_per_revolution: int = 1000,
        layers: int = 40,
        vertical_fov_deg: float = 60.0,
        step_deg: float = 10.0,
        min_range_m: float = 0.0,
        max_range_m: float = float("inf"),
        rate_hz: float = 10.0,
        *,
        horizontal_fov_deg: float = 360.0,
    ) -> Sensor:
        """Create a spinning sensor with evenly spaced azimuths and elevations.

        Azimuth 0 is the +x axis of the sensor, and azimuths increase counterclockwise as seen from
        above. Channel 0 is the lowest channel.

        Parameters
        ----------
        rays_per_revolution
            Number of firings per revolution.
        layers
            Number of channels, which are evenly spaced over the vertical field of view, including
            both ends. A single channel points straight forward.
        vertical_fov_deg
            Vertical field of view in degrees, in [0, 180], centered on the horizon. A value of 0 is
            only possible for a single layer, as in a 2D scanner.
        step_deg
            Rotation per time step in degrees, in (0, 360].
        min_range_m, max_range_m
            Minimum and maximum range in meters. Returns outside this interval are ignored.
        rate_hz
            Revolutions per second.
        horizontal_fov_deg
            Horizontal field of view in degrees, in (0, 360]. If it is less than 360, the firings
            and time steps of a revolution cover only this sector, from right to left, centered on
            the +x axis.

        Raises
        ------
        LidarError
            If a value is out of range, several layers have a field of view of 0, or a time step
            contains no firings.
        """
        check_fits("rays_per_revolution", rays_per_revolution, RaysPerRevolution)
        check_fits("layers", layers, Layers)
        check_fits("vertical_fov_deg", vertical_fov_deg, Fov)
        check_fits("horizontal_fov_deg", horizontal_fov_deg, Sector)
        if layers > 1 and vertical_fov_deg == 0:
            raise LidarError(
                f"vertical_fov_deg is 0, so all {layers:,} layers would be identical. Set layers "
                "to 1, or increase vertical_fov_deg."
            )
        head = Spin(rays_per_revolution, step_deg, rate_hz)
        if horizontal_fov_deg != 360:
            head = Mirror(
                rays_per_revolution,
                step_deg,
                rate_hz,
                zero_deg=0,  # not 0.0, which would change the fingerprint
                motion="sawtooth",
                width_deg=horizontal_fov_deg,
            )
        return cls(Beams.even(layers, vertical_fov_deg), head, min_range_m, max_range_m)

    @property
    def gate_s(self) -> float:
        """Time for which the receiver waits for the returns of a pulse, in seconds."""
        return 2e-9 * (self.max_range_m - self.min_range_m) / LIGHT_M_NS

    @property
    def channels(self) -> int:
        """Number of beams, which is the number of rays per firing."""
        return len(self.beams)

    @property
    def ring_step(self) -> int | None:
        """Number of rays between consecutive firings of a channel, or None if unknown."""
        return self.channels

    @property
    def period(self) -> int | None:
        """Number of firings after which directions and origins repeat, or None if they never do."""
        return self.head.period

    def firings(self, step: int) -> tuple[int, int]:
        """Return the half-open range of firing numbers in a time step.

        The ranges of consecutive steps neither overlap nor leave gaps. Indices continue across
        revolutions.
        """
        return self.head.firings(step)

    def revolutions(self, steps: ArrayLike) -> Ints:
        """Return the number of the revolution or frame in which each time step starts.

        `steps` and the result have shape (k,). If the head has no `rate_hz`, as is possible for
        custom heads, each step counts as one revolution.
        """
        numbers = np.asarray(steps, np.int64)
        rate_hz = getattr(self.head, "rate_hz", None)
        if rate_hz is None:
            return numbers
        starts_ns = self.begins_ns(np.array([self.firings(step)[0] for step in numbers.tolist()]))
        revolutions = np.floor((starts_ns - self.start_ns) * (rate_hz / 1e9) + 1e-6)
        return revolutions.astype(np.int64)

    def revolution_start_ns(self, number: int) -> float:
        """Return the start of a revolution or frame in nanoseconds since the head started."""
        rate_hz = getattr(self.head, "rate_hz", None)
        if rate_hz is not None:
            return float(number * 1e9 / rate_hz)
        return float(self.head.times_ns(np.array([self.firings(number)[0]]))[0])

    def steps_of_revolution(self, number: int) -> range:
        """Return the range of time steps in a revolution or frame.

        Examples
        --------
        >>> Sensor.grid(step_deg=10).steps_of_revolution(2)
        range(72, 108)
        """
        first = self._first_step(number, self._steps_in_revolution)
        return range(first, self._first_step(number + 1, self._steps_in_revolution))

    @property
    def pulse_rate_hz(self) -> float:
        """Number of rays per second, averaged over the first revolution or frame."""
        pulses = len(self.firings_of_revolution(0)) * self.channels
        return pulses / ((self.revolution_start_ns(1) - self.revolution_start_ns(0)) / 1e9)

    def firings_of_revolution(self, number: int) -> range:
        """Return the range of firing numbers in a revolution or frame."""
        steps = self.steps_of_revolution(number)
        return range(self.firings(steps[0])[0], self.firings(steps[-1])[1])

    @cached_property
    def _steps_in_revolution(self) -> int:
        return self._first_step(1, 1)

    def _first_step(self, number: int, steps_per_revolution: int) -> int:
        """Return the first time step of a revolution.

        `steps_per_revolution` is only a first guess, which speeds up the search.
        """

        def revolution_of(step: int) -> int:
            return int(self.revolutions([step])[0])

        lower = upper = number * steps_per_revolution
        back_step = ahead_step = 1
        while lower and revolution_of(lower) >= number:
            lower = max(0, lower - back_step)
            back_step = 2 * back_step
        while revolution_of(upper) < number:
            upper = upper + ahead_step
            ahead_step = 2 * ahead_step
        return bisect_left(range(upper + 1), number, lo=lower, key=revolution_of)

    def directions(self, firings: Ints) -> Floats:
        """Return the ray directions of the given firings in the sensor frame.

        For `firings` of shape (k,), the result has shape (k, channels, 3). Directions are unit
        vectors.
        """
        return self._rotate(firings, self.beam_directions)

    def origins(self, firings: Ints) -> Floats | None:
        """Return the ray origins of the given firings in the sensor frame, in meters.

        For `firings` of shape (k,), the result has shape (k, channels, 3). It is None if all rays
        start at the sensor origin.
        """
        if not self.beams.origin.any():
            return None
        return self._rotate(firings, self.beams.origin)

    @property
    def has_blocked_directions(self) -> bool:
        """Whether the platform blocks any directions."""
        return len(self.beams.blocked) > 0

    def is_blocked(self, firings: Ints, channels: Ints) -> Bools:
        """Return whether the platform blocks pulses, which then have no return.

        `firings` and `channels` of the pulses and the result have shape (n,).
        """
        azimuth = self.head.azimuths(firings) + self.beams.azimuth[channels]
        return self.beams.is_blocked(channels, azimuth)

    @cached_property
    def beam_directions(self) -> Floats:
        """Unit vectors along the beams in the head frame at azimuth 0.

        The shape is (channels, 3).
        """
        beams = self.beams
        up, level = sin_cos(beams.elevation)
        sin, cos = sin_cos(beams.azimuth)
        return np.column_stack([level * cos, level * sin, up])

    @cached_property
    def center(self) -> Floats | None:
        """Common origin of all beams in the head frame, in meters, or None if there is none."""
        origin = self.beams.origin
        return origin[0] if (origin == origin[0]).all() else None

    def spins(self, firings: Ints) -> Floats | None:
        """Return the cosines and sines of the head angles at the given firings.

        For `firings` of shape (k,), the result has shape (2, k). The head rotates about the z axis
        of its frame, and `axes` transforms the head frame to the sensor frame. The result is None
        if a subclass computes the rays in another way.
        """
        kind = type(self)
        if kind.directions is not Sensor.directions or kind.origins is not Sensor.origins:
            return None
        return np.stack(sin_cos(self.head.azimuths(firings))[::-1])

    @property
    def axes(self) -> Floats | None:
        """Rotation matrix from the head frame to the sensor frame, or None for the identity."""
        return None

    def _rotate(self, firings: Ints, vectors: Floats) -> Floats:
        """Rotate one vector per beam by the head angles at the given firings.

        For `vectors` of shape (c, 3) and `firings` of shape (k,), the result has shape (k, c, 3).
        """
        # Sines and cosines are computed per firing instead of per ray.
        sin, cos = sin_cos(self.head.azimuths(firings)[:, None])
        x, y, z = vectors.T
        rotated = np.empty((len(firings), len(vectors), 3))
        rotated[..., 0] = cos * x - sin * y
        rotated[..., 1] = sin * x + cos * y
        rotated[..., 2] = z
        if self.axes is None:
            return rotated
        return rotate(rotated.reshape(-1, 3), self.axes).reshape(rotated.shape)

    def begins_ns(self, firings: Ints) -> Floats:
        """Return the start times of firings in nanoseconds since the start of the station.

        `firings` and the result have shape (k,).
        """
        return self.start_ns + self.head.times_ns(firings)

    def times_ns(self, firings: Ints) -> Ints:
        """Return the firing times of rays in nanoseconds since the start of the station.

        For `firings` of shape (k,), the result has shape (k, channels) and is rounded to integers.
        """
        times = self.begins_ns(firings)[:, None] + self.beams.time_ns
        return np.rint(times).astype(np.int64)

    @property
    def lead_ns(self) -> float:
        """Time of the earliest beam within a firing, in nanoseconds."""
        return float(self.beams.time_ns.min())


@dataclass(frozen=True, eq=False, repr=False)
class LineSensor(Sensor):
    """A sensor whose head rotates about its x axis, such as an airborne scanner.

    The sensor flies along x and sweeps across its track. Azimuth 0 points down, and 90 degrees
    points to the left.
    """

    cycle: ClassVar[str] = "cycle"

    @property
    def axes(self) -> Floats:
        """Rotation matrix from the head frame to the sensor frame."""
        return np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
