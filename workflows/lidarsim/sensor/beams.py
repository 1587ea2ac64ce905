"""Beams of a sensor, and the heads that move them."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from fractions import Fraction
from functools import cached_property
from typing import Annotated, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from ..errors import LidarError
from ..numerics.arrays import AnyFloats, Bools, Floats, Integers, Ints
from ..numerics.elementary import cos, sin_cos
from ..schema.checks import as_array, check_fields, check_number
from ..schema.declared import about
from ..schema.value_texts import one_line

MAX_CHANNELS = 65_535  # limit of the uint16 column `channel`
_TURN_BITS = 40  # resolution of the azimuths in keys of directions, as a power of 2 per turn


@dataclass(frozen=True, eq=False)
class Beams:
    """Beams of a sensor, each of which is fired once per firing.

    Channel 0 is the first beam, which is usually the lowest.

    Parameters
    ----------
    elevation
        Angle of each beam above the xy plane of the sensor, in radians. Shape (c,), float64.
    azimuth
        Offset of each beam from the azimuth of the head, in radians; 0 by default. Shape (c,),
        float64.
    time_ns
        Time of each beam since the start of its firing, in nanoseconds; 0 by default. Shape (c,),
        float64.
    origin
        Start of each beam in the sensor frame with the head at azimuth 0, in meters. By default,
        all beams start at the sensor origin. Shape (c, 3), float64.
    blocked
        Directions in which the platform blocks a beam, so that its pulses have no return. Each row
        contains the index of a beam and the azimuths in the sensor frame, in radians, between which
        the beam is blocked, counterclockwise from the first to the second. The first azimuth is
        included, and the second is excluded. By default, no direction is blocked. Shape (k, 3),
        float64.
    intensity_factor
        Ratio of the reported to the received intensity of each beam, greater than 0; 1 by default.
        It does not affect the detection of returns. Shape (c,), or (c, k) with `intensity_range_m`,
        float64.
    intensity_range_m
        Ascending ranges in meters at which `intensity_factor` is specified. Between these ranges,
        the factors are interpolated linearly, and beyond them, they are constant. By default, the
        factors do not depend on the range. Shape (k,), float64.

    Raises
    ------
    LidarError
        If the lengths differ, a value is not finite, an intensity factor is not positive, the
        ranges of the factors are not ascending, there are no beams or too many beams, or `blocked`
        refers to a beam that does not exist.
    """

    elevation: Floats
    azimuth: Floats = field(default_factory=lambda: np.zeros(0))
    time_ns: Floats = field(default_factory=lambda: np.zeros(0))
    origin: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    blocked: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    intensity_factor: Floats = field(default_factory=lambda: np.zeros(0))
    intensity_range_m: Floats = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        count = as_array("Beams.elevation", self.elevation).size
        knots = as_array("Beams.intensity_range_m", self.intensity_range_m).size
        factor_shape = (count, knots) if knots else (count,)
        if not as_array("Beams.intensity_factor", self.intensity_factor).size:
            object.__setattr__(self, "intensity_factor", np.ones(factor_shape))
        if not 1 <= count <= MAX_CHANNELS:
            raise LidarError(f"A sensor must have 1 to {MAX_CHANNELS} beams, but has {count}.")
        for name, shape in (
            ("elevation", (count,)),
            ("azimuth", (count,)),
            ("time_ns", (count,)),
            ("origin", (count, 3)),
            ("intensity_range_m", (knots,)),
            ("intensity_factor", factor_shape),
        ):
            object.__setattr__(self, name, _as_table(name, getattr(self, name), shape))
        blocked = as_array("Beams.blocked", self.blocked)
        rows = blocked.reshape(-1, 3) if blocked.size % 3 == 0 else blocked
        object.__setattr__(self, "blocked", _as_table("blocked", rows, (blocked.size // 3, 3)))
        index = self.blocked[:, 0]
        unknown = index[(index != np.rint(index)) | (index < 0) | (index >= count)]
        if len(unknown):
            raise LidarError(
                f"Blocked directions refer to beam {unknown[0]:g}, but the beams are numbered "
                f"from 0 to {count - 1}."
            )
        if not (self.intensity_factor > 0).all():
            raise LidarError(
                "Beams.intensity_factor must be greater than 0 for each beam, but is "
                f"{self.intensity_factor.min():g} for one of them."
            )
        if not (np.diff(self.intensity_range_m, prepend=0.0) > 0).all():
            raise LidarError(
                "Beams.intensity_range_m must contain ascending ranges greater than 0, but is "
                f"{self.intensity_range_m.tolist()}."
            )

    def __len__(self) -> int:
        return len(self.elevation)

    def __repr__(self) -> str:
        min_deg, max_deg = np.degrees([self.elevation.min(), self.elevation.max()])
        return f"<Beams: {len(self)}, {min_deg:.4g} to {max_deg:.4g} deg>"

    @classmethod
    def even(cls, layers: int, vertical_fov_deg: float) -> Beams:
        """Create beams that are evenly spaced over a vertical field of view, including both ends.

        The field of view is centered on the horizon. A single beam points straight forward.
        """
        check_number("layers", layers, whole=True, ge=1, le=MAX_CHANNELS)
        half = np.radians(vertical_fov_deg) / 2
        return cls(np.linspace(-half, half, layers) if layers > 1 else np.zeros(1))

    def with_rotation(self, radians_per_ns: float) -> Beams:
        """Return beams for a head that rotates counterclockwise during a firing.

        Each beam is rotated by the angle that the head covers until the beam is fired. The ray
        caster therefore only needs the angle of the head at the start of each firing.
        """
        angle = radians_per_ns * self.time_ns
        x, y, z = self.origin.T
        sin, cos = sin_cos(angle)
        origin = np.column_stack([cos * x - sin * y, sin * x + cos * y, z])
        return replace(self, azimuth=self.azimuth + angle, origin=origin)

    def sort_by_elevation(self) -> Beams:
        """Return the beams sorted by elevation, so that channel 0 is the lowest beam."""
        order = np.argsort(self.elevation, kind="stable")
        blocked = self.blocked.copy()
        blocked[:, 0] = np.argsort(order)[blocked[:, 0].astype(np.intp)]
        ordered = {
            column.name: getattr(self, column.name)[order]
            for column in fields(self)
            if column.name not in {"blocked", "intensity_range_m"}
        }
        return replace(self, **ordered, blocked=blocked)

    @property
    def has_intensity_factors(self) -> bool:
        """Whether the reported intensity of a beam differs from the received intensity."""
        return bool((self.intensity_factor != 1).any())

    def intensity_factors(self, beam: Integers, range_m: AnyFloats) -> Floats:
        """Return the ratio of the reported to the received intensity of returns.

        Parameters
        ----------
        beam
            Index of the beam of each return. Shape (n,).
        range_m
            Range of each return in meters. Shape (n,).
        """
        table = self.intensity_factor.reshape(len(self), -1)
        if table.shape[1] == 1:
            return table[beam, 0]
        knots = self.intensity_range_m
        row = np.clip(np.searchsorted(knots, range_m, "right") - 1, 0, len(knots) - 2)
        weight = (np.clip(range_m, knots[0], knots[-1]) - knots[row]) / np.diff(knots)[row]
        low = table[beam, row]
        return np.asarray(low + weight * (table[beam, row + 1] - low))

    def is_blocked(self, beam: Ints, azimuth: Floats) -> Bools:
        """Return whether the platform blocks pulses.

        Parameters
        ----------
        beam
            Index of the beam of each pulse. Shape (n,).
        azimuth
            Azimuth of each pulse in the sensor frame, in radians. Shape (n,).
        """
        starts, stops = self._blocked_keys
        keys = _direction_keys(beam, azimuth)
        # Intervals may overlap.
        opened = np.searchsorted(starts, keys, "right")
        return np.asarray(opened > np.searchsorted(stops, keys, "right"))

    @cached_property
    def _blocked_keys(self) -> tuple[Ints, Ints]:
        """Sorted starts and stops of the blocked directions, as keys of directions."""
        beam = self.blocked[:, 0].astype(np.int64)
        starts = _direction_keys(beam, self.blocked[:, 1])
        stops = _direction_keys(beam, self.blocked[:, 2])
        # An interval that contains azimuth 0 is divided there.
        is_divided = stops <= starts
        ends = (beam[is_divided] + 1) << _TURN_BITS
        begins = beam[is_divided] << _TURN_BITS
        return np.sort(np.append(starts, begins)), np.sort(np.append(stops, ends))


class Head(Protocol):
    """Protocol for the mechanism that moves the beams.

    Firings and time steps are numbered from 0.
    """

    @property
    def period(self) -> int | None:
        """Number of firings after which azimuths repeat exactly, or None if they never repeat."""

    def firings(self, step: int) -> tuple[int, int]:
        """Return the half-open range of firing numbers in a time step.

        The ranges of consecutive steps must be contiguous.
        """

    def times_ns(self, firings: Ints) -> Floats:
        """Return the start times of firings in nanoseconds since the head started.

        `firings` and the result have shape (k,).
        """

    def azimuths(self, firings: Ints) -> Floats:
        """Return the azimuths of the head at the given firings, in radians.

        `firings` and the result have shape (k,).
        """


Step = Annotated[
    float, about("angle in degrees by which the head turns in one time step", gt=0, le=360)
]
Rate = Annotated[float, Field(gt=0, le=1e6)]
MirrorMotion = Literal["sine", "triangle", "sawtooth"]
Width = Annotated[float, Field(gt=0, le=360)]
Duty = Annotated[float, Field(gt=0, le=1)]


@dataclass(frozen=True)
class Spin:
    """A head that rotates at a constant rate.

    Parameters
    ----------
    firings_per_turn
        Number of firings per revolution, which is the firing rate divided by the revolution rate.
        It does not have to be an integer.
    step_deg
        Rotation per time step in degrees, in (0, 360].
    rate_hz
        Revolutions per second.
    clockwise
        Whether the head rotates clockwise as seen from above.
    zero_deg
        Azimuth at firing 0 in degrees, counterclockwise from the +x axis of the sensor.

    Raises
    ------
    LidarError
        If a value is out of range, or if a time step contains no firings.

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

    __repr__ = one_line

    def __post_init__(self) -> None:
        check_fields(self)
        if self._firings_per_step < 1:
            raise LidarError(
                f"step_deg is {self.step_deg}, which is less than the angle between two firings "
                f"({360 / self.firings_per_turn:g} degrees), so some scans would be empty. "
                "Increase step_deg or the number of firings per turn."
            )

    @cached_property
    def _firings_per_step(self) -> Fraction:
        """Exact number of firings in a time step.

        Neither 0.1 degrees nor 360/7 degrees can be represented exactly in binary. The intended
        value of such a decimal or part of a revolution is the nearest fraction with a denominator
        of at most a million. With this fraction, the steps of a revolution contain each firing
        exactly once.
        """
        step = Fraction(self.step_deg).limit_denominator(1_000_000)
        per_turn = Fraction(self.firings_per_turn).limit_denominator(1_000_000)
        return step * per_turn / 360

    @property
    def period(self) -> int | None:
        """Number of firings per revolution, or None if it is not an integer."""
        count = int(self.firings_per_turn)
        return count if count == self.firings_per_turn else None

    def firings(self, step: int) -> tuple[int, int]:
        """Return the half-open range of firing numbers in a time step."""
        # Integer arithmetic rounds up here. Fractions would take as long as a small scan.
        count, steps = self._firings_per_step.as_integer_ratio()
        return -(-step * count // steps), -(-(step + 1) * count // steps)

    def times_ns(self, firings: Ints) -> Floats:
        """Return the start times of firings in nanoseconds since the head started.

        `firings` and the result have shape (k,).
        """
        return np.asarray(firings, np.float64) * (1e9 / (self.rate_hz * self.firings_per_turn))

    def azimuths(self, firings: Ints) -> Floats:
        """Return the azimuths of the head at the given firings, in radians.

        `firings` and the result have shape (k,).
        """
        turned = 2 * np.pi * self._within(firings) / self.firings_per_turn
        return np.radians(self.zero_deg) + (-turned if self.clockwise else turned)

    def restrict_to(self, start: float, share: float) -> Mirror:
        """Return a head that only fires during part of each revolution.

        Time 0 and firing 0 are at the start of this part. A time step contains the same fraction of
        the firings as before, but at least one firing.

        Parameters
        ----------
        start
            Start of the part as a fraction of a revolution, measured from firing 0.
        share
            Length of the part as a fraction of a revolution.
        """
        firings = max(round(self.firings_per_turn * share), 1)
        width_deg = 360 * firings / self.firings_per_turn
        middle_deg = 360 * start + width_deg / 2
        return Mirror(
            firings,
            max(self.step_deg, 360 / firings),
            self.rate_hz,
            self.clockwise,
            self.zero_deg + (-middle_deg if self.clockwise else middle_deg),
            motion="sawtooth",
            width_deg=width_deg,
            duty=width_deg / 360,
        )

    def _within(self, firings: Ints) -> Floats:
        """Return the number of firings since the start of each firing's revolution.

        The numbers are fractional if a revolution starts between two firings. `firings` and the
        result have shape (k,).
        """
        return np.asarray(firings % self.firings_per_turn, np.float64)

    @property
    def radians_per_ns(self) -> float:
        """Angular velocity of the head in radians per nanosecond.

        The value is positive for a counterclockwise rotation.
        """
        return 2 * np.pi * self.rate_hz / 1e9 * (-1 if self.clockwise else 1)


@dataclass(frozen=True)
class Mirror(Spin):
    """A mirror that sweeps the beams along a line, either back and forth or in one direction.

    A cycle of the mirror counts as a revolution. It consists of two lines for an oscillating
    mirror, or of the line of one facet for a polygon mirror. Azimuth 0 is the center of a line.
    """

    # "sine" and "triangle" are oscillating mirrors, and "sawtooth" is a polygon mirror.
    motion: MirrorMotion = "triangle"
    width_deg: Width = 60.0  # length of a line
    # Fraction of each cycle in which the sensor fires. The facets of a polygon mirror sweep over
    # more than the line.
    duty: Duty = 1.0

    __repr__ = one_line

    def __post_init__(self) -> None:
        check_fields(self)

    def times_ns(self, firings: Ints) -> Floats:
        """Return the start times of firings in nanoseconds since the mirror started.

        `firings` and the result have shape (k,).
        """
        pause = self._within(firings) * (1 - self.duty)
        return (firings - pause) * (1e9 / (self.rate_hz * self.firings_per_turn))

    def azimuths(self, firings: Ints) -> Floats:
        """Return the azimuths along the line at the given firings, in radians.

        `firings` and the result have shape (k,).
        """
        phase = self._within(firings) / self.firings_per_turn
        if self.motion == "sine":
            line_fraction = -cos(2 * np.pi * phase) / 2
        elif self.motion == "triangle":
            line_fraction = 0.5 - np.abs(2 * phase - 1)
        else:
            line_fraction = phase - 0.5
        turned = np.radians(self.width_deg) * line_fraction
        return np.radians(self.zero_deg) + (-turned if self.clockwise else turned)


def _direction_keys(beam: Ints, azimuth: Floats) -> Ints:
    """Return integers that order directions by beam, and then by azimuth from 0 to a full turn."""
    steps = np.floor(azimuth / (2 * np.pi) * (1 << _TURN_BITS)).astype(np.int64)
    return np.asarray((beam.astype(np.int64) << _TURN_BITS) | (steps & ((1 << _TURN_BITS) - 1)))


def _as_table(name: str, values: ArrayLike, shape: tuple[int, ...]) -> Floats:
    """Convert values to a read-only float64 array of the given shape. Empty values become zeros."""
    array = as_array(f"Beams.{name}", values).copy()
    if not array.size:
        array = np.zeros(shape)
    if array.shape != shape or not np.isfinite(array).all():
        raise LidarError(
            f"Beams.{name} must be {shape} finite numbers, one for each beam, but has the shape "
            f"{array.shape}."
        )
    array.flags.writeable = False
    return array
