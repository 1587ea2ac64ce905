"""The beams of a sensor, and the head that moves them."""

from __future__ import annotations

from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property
from typing import Annotated, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from ..base.arrays import Floats, Ints
from ..base.declared import about
from ..base.elementary import cos, sin_cos
from ..base.errors import LidarError
from ..base.validation import as_array, checked, checked_fields

CHANNELS_MOST = 65_535  # the type of the column


@dataclass(frozen=True, eq=False)
class Beams:
    """The beams of a sensor; each firing fires all of them once.

    Channel 0 is the first of them, usually the lowest.

    Parameters
    ----------
    elevation
        float64 (c,): angle above the sensor's xy plane, radians.
    azimuth
        float64 (c,): offset from the head's azimuth, radians; 0 by default.
    time_ns
        float64 (c,): time of a beam within a firing, nanoseconds; 0 by default.
    origin
        float64 (c, 3): start of a beam with the head at azimuth 0, metres, in the sensor's axes;
        the sensor's centre by default.

    Raises
    ------
    LidarError
        If the lengths differ, a value is not finite, or there are no beams or too many.
    """

    elevation: Floats
    azimuth: Floats = field(default_factory=lambda: np.zeros(0))
    time_ns: Floats = field(default_factory=lambda: np.zeros(0))
    origin: Floats = field(default_factory=lambda: np.zeros((0, 3)))

    def __post_init__(self) -> None:
        count = as_array("Beams.elevation", self.elevation).size
        if not 1 <= count <= CHANNELS_MOST:
            raise LidarError(f"A sensor has 1 to {CHANNELS_MOST} beams, not {count}.")
        for name, shape in (
            ("elevation", (count,)),
            ("azimuth", (count,)),
            ("time_ns", (count,)),
            ("origin", (count, 3)),
        ):
            object.__setattr__(self, name, _table(name, getattr(self, name), shape))

    def __len__(self) -> int:
        return len(self.elevation)

    def __repr__(self) -> str:
        low, high = np.degrees([self.elevation.min(), self.elevation.max()])
        return f"<Beams: {len(self)}, {low:.4g} to {high:.4g} deg>"

    @classmethod
    @checked
    def even(cls, layers: int, vertical_fov_deg: float) -> Beams:
        """Beams evenly spaced over a vertical field of view, both ends included.

        Half of it is below the horizon; a single beam looks straight ahead.
        """
        half = np.radians(vertical_fov_deg) / 2
        return cls(np.linspace(-half, half, layers) if layers > 1 else np.zeros(1))

    def turning(self, radians_per_ns: float) -> Beams:
        """Return the beams for a head that keeps turning within a firing, counter-clockwise.

        Each is rotated by the head's angle at its time, so that the rotation within a firing takes
        no time later.
        """
        angle = radians_per_ns * self.time_ns
        (x, y, z), (sin, cos) = self.origin.T, sin_cos(angle)
        origin = np.column_stack([cos * x - sin * y, sin * x + cos * y, z])
        return Beams(self.elevation, self.azimuth + angle, self.time_ns, origin)

    def lowest_first(self) -> Beams:
        """Return the same beams in the order of channels."""
        order = np.argsort(self.elevation, kind="stable")
        return Beams(*(a[order] for a in (self.elevation, self.azimuth, self.time_ns, self.origin)))


class Head(Protocol):
    """Moves the beams; each time step has some firings, numbered from 0."""

    @property
    def period(self) -> int | None:
        """Firings after which it repeats; None if it never does exactly."""

    def firings(self, step: int) -> tuple[int, int]:
        """First firing of a time step, and one past the last; steps have no gaps."""

    def times_ns(self, firings: Ints) -> Floats:
        """When firings begin, nanoseconds since the head started: (k,)."""

    def azimuths(self, firings: Ints) -> Floats:
        """Azimuth of the head at firings, radians: (k,)."""


Step = Annotated[float, about("degrees that the head turns in one time step", gt=0, le=360)]
Rate = Annotated[float, Field(gt=0, le=1e6)]
MirrorMotion = Literal["sine", "triangle", "sawtooth"]
Width = Annotated[float, Field(gt=0, le=360)]
Duty = Annotated[float, Field(gt=0, le=1)]


@dataclass(frozen=True)
@checked_fields
class Spin:
    """A head that spins.

    Parameters
    ----------
    firings_per_turn
        Firings in one turn: firing rate over turning rate, not always a whole number.
    step_deg
        Rotation in one time step, in (0, 360].
    rate_hz
        Turns a second.
    clockwise
        Direction of rotation, seen from above.
    zero_deg
        Azimuth at firing 0: counter-clockwise from the sensor's +x axis.

    Raises
    ------
    LidarError
        If a value is out of its range, or a time step holds no firing at all.

    Examples
    --------
    >>> head = Spin(firings_per_turn=1000, step_deg=10)
    >>> head.firings(0), head.firings(1)
    ((0, 28), (28, 56))
    """

    firings_per_turn: Annotated[float, Field(ge=1, lt=2**31)] = 1000
    step_deg: Step = 10.0
    rate_hz: Rate = 10.0
    clockwise: bool = False
    zero_deg: float = 0.0

    def __post_init__(self) -> None:
        if self._firings_per_step < 1:
            raise LidarError(
                f"step_deg {self.step_deg} is less than one firing "
                f"({360 / self.firings_per_turn:g} degrees), so some scans would be empty: make "
                "step_deg or the number of firings larger."
            )

    @cached_property
    def _firings_per_step(self) -> Fraction:
        """Exact number of firings in a time step.

        Neither 0.1 nor 360/7 degrees is exact in binary. The nearest fraction with a denominator
        of at most a million is the intended one, for decimals and for parts of a turn; with it,
        the steps of a turn have each firing once.
        """
        step = Fraction(self.step_deg).limit_denominator(1_000_000)
        per_turn = Fraction(self.firings_per_turn).limit_denominator(1_000_000)
        return step * per_turn / 360

    @property
    def period(self) -> int | None:
        """See `Head.period`."""
        whole = int(self.firings_per_turn)
        return whole if whole == self.firings_per_turn else None

    def firings(self, step: int) -> tuple[int, int]:
        """See `Head.firings`; numbers continue after one turn."""
        # Rounded up, in whole numbers: fractions would take as long as a small scan.
        count, steps = self._firings_per_step.as_integer_ratio()
        return -(-step * count // steps), -(-(step + 1) * count // steps)

    def times_ns(self, firings: Ints) -> Floats:
        """See `Head.times_ns`."""
        return np.asarray(firings, np.float64) * (1e9 / (self.rate_hz * self.firings_per_turn))

    def azimuths(self, firings: Ints) -> Floats:
        """See `Head.azimuths`."""
        turned = 2 * np.pi * self._within(firings) / self.firings_per_turn
        return np.radians(self.zero_deg) + (-turned if self.clockwise else turned)

    def _within(self, firings: Ints) -> Floats:
        """Count firings since the turn began; fractional if a turn begins between two."""
        return np.asarray(firings % self.firings_per_turn, np.float64)

    @property
    def radians_per_ns(self) -> float:
        """Radians in a nanosecond, counter-clockwise."""
        return 2 * np.pi * self.rate_hz / 1e9 * (-1 if self.clockwise else 1)


@dataclass(frozen=True)
@checked_fields
class Mirror(Spin):
    """A mirror that sweeps the beams over a line, to and fro or in one direction.

    A turn is one cycle: two lines of a swinging mirror, one of a polygon's facet.
    Azimuth 0 is in the middle of a line.
    """

    motion: MirrorMotion = "triangle"  # "sine" and "triangle" swing, "sawtooth" is a polygon
    width_deg: Width = 60.0  # length of a line
    # Share of each cycle in which it fires: a polygon's facets cover more than is used.
    duty: Duty = 1.0

    def times_ns(self, firings: Ints) -> Floats:
        """See `Head.times_ns`."""
        pause = self._within(firings) * (1 - self.duty)
        return (firings - pause) * (1e9 / (self.rate_hz * self.firings_per_turn))

    def azimuths(self, firings: Ints) -> Floats:
        """See `Head.azimuths`."""
        phase = self._within(firings) / self.firings_per_turn
        if self.motion == "sine":
            place = -cos(2 * np.pi * phase) / 2
        elif self.motion == "triangle":
            place = 0.5 - np.abs(2 * phase - 1)
        else:
            place = phase - 0.5
        turned = np.radians(self.width_deg) * place
        return np.radians(self.zero_deg) + (-turned if self.clockwise else turned)


def _table(name: str, values: ArrayLike, shape: tuple[int, ...]) -> Floats:
    """Read-only float64 array of a shape; zeros where none were given."""
    array = as_array(f"Beams.{name}", values).copy()
    if not array.size:
        array = np.zeros(shape)
    if array.shape != shape or not np.isfinite(array).all():
        raise LidarError(
            f"Beams.{name} must be {shape} finite numbers, one for each beam; given: {array.shape}."
        )
    array.flags.writeable = False
    return array
