"""A lidar: beams, and a head that moves them."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from ..base.arrays import Floats, Ints
from ..base.declared import about
from ..base.elementary import sin_cos
from ..base.errors import LidarError
from ..base.validation import checked, checked_fields
from ..base.vectors import turned
from .beams import CHANNELS_MOST, Beams, Head, Mirror, Rate, Spin, Step
from .noise import Noise
from .optics import LIGHT_M_NS, Optics, Returns

RaysPerRevolution = Annotated[int, about("for a grid: azimuths in one turn", ge=1, le=10_000_000)]
Layers = Annotated[int, about("for a grid: elevations (rings)", ge=1, le=CHANNELS_MOST)]
Fov = Annotated[float, about("for a grid: degrees, half of it below the horizon", ge=0, le=180)]
Sector = Annotated[
    float, about("for a grid: degrees that a turn sweeps, half of it left of +x", gt=0, le=360)
]
MinRange = Annotated[float, Field(ge=0, le=1e8)]
MaxRange = Annotated[float, Field(gt=0, allow_inf_nan=True)]


@dataclass(frozen=True, eq=False)
@checked_fields
class Sensor:
    """Beams that a head moves. Each firing fires all beams once.

    Another kind of sensor has its own beams or head, or is a subclass with other `directions`,
    `origins` or `begins_ns`; no other code changes. Its fields identify it (see
    `lidarpool.base.fingerprint`), so keep everything that it depends on in fields.

    Parameters
    ----------
    beams, head
        Its beams, and what moves them.
    min_range_m, max_range_m
        Returns nearer or farther than this, in metres, are ignored. A ray passes through nearer
        surfaces.
    name
        Of the model, for reports; by default that of the class.
    optics
        Its light and resolution.
    start_ns
        Start of its head, nanoseconds after the start of the survey or station.
    noise, returns
        Those of surveys with this sensor that give none; no part of its fingerprint.

    Raises
    ------
    LidarError
        If a range or the start is out of bounds.

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
    cycle: ClassVar[str] = "turn"  # name of a cycle

    def __post_init__(self) -> None:
        if not self.max_range_m > self.min_range_m:
            raise LidarError(f"max_range_m is {self.max_range_m}; it must be above min_range_m.")

    @property
    def model(self) -> str:
        """Its model, for reports."""
        return self.name or f"{type(self).__name__} with {self.channels} channels"

    @classmethod
    @checked
    def grid(
        cls,
        rays_per_revolution: RaysPerRevolution = 1000,
        layers: Layers = 40,
        vertical_fov_deg: Fov = 60.0,
        step_deg: Step = 10.0,
        min_range_m: MinRange = 0.0,
        max_range_m: MaxRange = float("inf"),
        rate_hz: Rate = 10.0,
        horizontal_fov_deg: Sector = 360.0,
    ) -> Sensor:
        """Make a spinning sensor with evenly spaced azimuths and elevations.

        Azimuth 0 is the sensor's +x axis and grows counter-clockwise seen from above; channel 0
        is the lowest.

        Parameters
        ----------
        rays_per_revolution
            Firings in one turn.
        layers
            Channels, evenly spaced over the vertical field of view, both ends included; one
            channel looks straight ahead.
        vertical_fov_deg
            Vertical field of view in degrees, half of it below the horizon, in [0, 180]. 0 is for
            one layer, the plane of a 2D scanner.
        step_deg
            Degrees turned in one time step, in (0, 360].
        min_range_m, max_range_m
            As for every sensor.
        rate_hz
            Turns a second.
        horizontal_fov_deg
            Horizontal field of view in degrees, in (0, 360]. Below 360 the azimuths of a turn, and
            its time steps, sweep this sector only, from right to left, with +x in its middle.

        Raises
        ------
        LidarError
            If a value is outside its range, several layers have no field of view, or a time step
            holds no firing at all.
        """
        if layers > 1 and vertical_fov_deg == 0:
            raise LidarError(
                f"vertical_fov_deg is 0 with {layers:,} layers, which would be the same: give one "
                "layer, or a field of view above 0."
            )
        turn = rays_per_revolution, step_deg, rate_hz
        whole = horizontal_fov_deg == 360
        head = Spin(*turn) if whole else Mirror(*turn, False, 0, "sawtooth", horizontal_fov_deg)
        return cls(Beams.even(layers, vertical_fov_deg), head, min_range_m, max_range_m)

    @property
    def gate_s(self) -> float:
        """Time for which its receiver waits for returns of a pulse, seconds."""
        return 2e-9 * (self.max_range_m - self.min_range_m) / LIGHT_M_NS

    @property
    def channels(self) -> int:
        """Number of beams, and of rays in a firing."""
        return len(self.beams)

    @property
    def period(self) -> int | None:
        """Firings after which directions and origins repeat; None if they never do."""
        return self.head.period

    def firings(self, step: int) -> tuple[int, int]:
        """First firing of time step `step`, and one past the last.

        Successive steps have no gap or overlap; numbers continue from turn to turn.
        """
        return self.head.firings(step)

    def turns(self, steps: ArrayLike) -> Ints:
        """Return the number of the turn, or frame, in which each time step (k,) begins: (k,).

        A head without `rate_hz`, which may be a user's, has a turn in each step.
        """
        numbers = np.asarray(steps, np.int64)
        rate_hz = getattr(self.head, "rate_hz", None)
        if rate_hz is None:
            return numbers
        begins = self.begins_ns(np.array([self.firings(step)[0] for step in numbers.tolist()]))
        turn = np.floor((begins - self.start_ns) * (rate_hz / 1e9) + 1e-6)
        return turn.astype(np.int64)

    def turn_ns(self, number: int) -> float:
        """Return when a turn, or frame, begins, nanoseconds since the head started."""
        rate_hz = getattr(self.head, "rate_hz", None)
        if rate_hz is not None:
            return float(number * 1e9 / rate_hz)
        return float(self.head.times_ns(np.array([self.firings(number)[0]]))[0])

    def steps_of_turn(self, number: int) -> range:
        """Time steps of a turn, or frame.

        Examples
        --------
        >>> Sensor.grid(step_deg=10).steps_of_turn(2)
        range(72, 108)
        """
        first, stop = (self._first_step(n, self._steps_in_turn) for n in (number, number + 1))
        return range(first, stop)

    @cached_property
    def _steps_in_turn(self) -> int:
        return self._first_step(1, 1)

    def _first_step(self, number: int, each: int) -> int:
        """Find the first time step of a turn, if `each` turn has about so many."""

        def turn(step: int) -> int:
            return int(self.turns([step])[0])

        low = high = number * each
        back = ahead = 1
        while low and turn(low) >= number:
            low = max(0, low - back)
            back = 2 * back
        while turn(high) < number:
            high = high + ahead
            ahead = 2 * ahead
        return bisect_left(range(high + 1), number, lo=low, key=turn)

    def directions(self, firings: Ints) -> Floats:
        """Make the unit directions of firings (k,), in the sensor's axes: (k, channels, 3)."""
        return self._turned(firings, self.ahead)

    def origins(self, firings: Ints) -> Floats | None:
        """Return starts of the rays of firings (k,), sensor axes: (k, channels, 3), metres.

        None if all start at the sensor's centre.
        """
        if not self.beams.origin.any():
            return None
        return self._turned(firings, self.beams.origin)

    @cached_property
    def ahead(self) -> Floats:
        """Unit directions of the beams in the head's axes, at azimuth 0: (channels, 3)."""
        beams = self.beams
        (up, level), (sin, cos) = sin_cos(beams.elevation), sin_cos(beams.azimuth)
        return np.column_stack([level * cos, level * sin, up])

    @cached_property
    def centre(self) -> Floats | None:
        """Common start of all beams, (3,) in the head's axes; None if they differ."""
        origin = self.beams.origin
        return origin[0] if (origin == origin[0]).all() else None

    def spins(self, firings: Ints) -> Floats | None:
        """Return cosines and sines of the head's angles at firings: (2, k).

        About the head's z axis; `axes` relates it to the sensor's axes. None if the rays are not
        beams turned by such a head.
        """
        kind = type(self)
        if kind.directions is not Sensor.directions or kind.origins is not Sensor.origins:
            return None
        return np.stack(sin_cos(self.head.azimuths(firings))[::-1])

    @property
    def axes(self) -> Floats | None:
        """Rotation from the head's axes to the sensor's; None if they are the same."""
        return None

    def _turned(self, firings: Ints, vectors: Floats) -> Floats:
        """Rotate vectors (c, 3), such as one for each beam, with the head: (k, c, 3).

        Uses products of firing and beam terms, without trigonometry for each ray.
        """
        sin, cos = sin_cos(self.head.azimuths(firings)[:, None])
        x, y, z = vectors.T
        out = np.empty((len(firings), len(vectors), 3))
        out[..., 0] = cos * x - sin * y
        out[..., 1] = sin * x + cos * y
        out[..., 2] = z
        if self.axes is None:
            return out
        return turned(out.reshape(-1, 3), self.axes).reshape(out.shape)

    def begins_ns(self, firings: Ints) -> Floats:
        """Return the starts of firings (k,), since the start of the station: (k,)."""
        return self.start_ns + self.head.times_ns(firings)

    def times_ns(self, firings: Ints) -> Ints:
        """Return the times of the rays of firings (k,), from the station's start: (k, channels)."""
        times = self.begins_ns(firings)[:, None] + self.beams.time_ns
        return np.rint(times).astype(np.int64)

    @property
    def lead_ns(self) -> float:
        """Time of the first beam within a firing."""
        return float(self.beams.time_ns.min())


@dataclass(frozen=True, eq=False)
class LineSensor(Sensor):
    """A sensor whose head turns about its x axis: azimuth 0 looks down, 90 degrees to the left.

    For airborne scanners, which fly along x and sweep across.
    """

    cycle: ClassVar[str] = "cycle"

    @property
    def axes(self) -> Floats:
        """See `Sensor.axes`."""
        return np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
