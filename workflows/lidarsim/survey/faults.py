"""Sensor faults, for testing programs that process sensor data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from ..errors import LidarError, prefix_errors
from ..numerics.arrays import Bools, Floats, Ints
from ..numerics.random_numbers import Purpose, uniform
from ..schema.checks import check_fields, check_order
from ..schema.declared import AngleDeg, FileSection, MinMax, Several, Text, Two, UnitShare, about
from ..schema.value_texts import one_line
from ..sensor.sensor import Sensor
from ..words import did_you_mean, join_names

PACKET = Purpose(61, "whether a packet is lost")
FaultKind = Literal["dirt", "dead_channels", "dropped_packets", "frozen", "time_jump"]
Time = Annotated[float, Field(ge=0, le=1e9)]  # seconds since the survey's start
Channels = Annotated[Several[Annotated[int, Field(ge=0)]], Field(min_length=1)]
Count = Annotated[int, Field(ge=1, le=1_000_000)]
Shift = Annotated[float, Field(ge=-1e6, le=1e6)]

# Fields that only apply to one kind of fault. The angles of the sector are optional.
_KIND_FIELDS: dict[str, tuple[str, ...]] = {
    "dirt": ("transmission", "azimuth_deg", "elevation_deg"),
    "dead_channels": ("channels",),
    "dropped_packets": ("share", "packet"),
    "frozen": (),
    "time_jump": ("by_s",),
}


@dataclass(frozen=True)
class Fault(FileSection):
    """A temporary fault of a sensor, such as a dirty window or lost packets.

    Faults do not affect labels, which describe the true scene and list the active faults.

    Raises
    ------
    LidarError
        If a number is out of range, or if the fields cannot be combined.
    """

    kind: Annotated[FaultKind, about("kind of fault")]
    from_s: Annotated[Time, about("start time in seconds after the start of the survey")] = 0.0
    to_s: Annotated[
        Time | None,
        about("end time in seconds after the start of the survey (default: end of the survey)"),
    ] = None
    sensor: Annotated[Text | None, about("name of the faulty sensor (default: all sensors)")] = None
    transmission: Annotated[
        UnitShare | None,
        about("fraction of the energy that dirt transmits on the way out and back"),
    ] = None
    azimuth_deg: Annotated[
        Two[AngleDeg] | None,
        about("start and end azimuth of the dirt in degrees, counterclockwise"),
    ] = None
    elevation_deg: Annotated[
        MinMax[AngleDeg] | None, about("lowest and highest elevation of the dirt in degrees")
    ] = None
    channels: Annotated[
        Channels | None, about("channels that are dead; 0 is the lowest channel")
    ] = None
    share: Annotated[UnitShare | None, about("fraction of packets that are lost")] = None
    packet: Annotated[Count | None, about("number of consecutive firings per packet")] = None
    by_s: Annotated[
        Shift | None, about("offset in seconds that a time jump adds to timestamps")
    ] = None

    __repr__ = one_line

    def __post_init__(self) -> None:
        check_fields(self)
        for name, value in self.to_dict().items():  # values must be JSON types for the labels
            if np.iterable(value) and not isinstance(value, str):
                value = tuple(np.asarray([*value]).tolist())
            elif isinstance(value, np.number):
                value = value.item()
            object.__setattr__(self, name, value)
        if self.elevation_deg is not None:
            check_order("elevation_deg", self.elevation_deg)
        kind_fields = _KIND_FIELDS[self.kind]
        present = self.to_dict().keys() - {"kind", "from_s", "to_s", "sensor"}
        optional = {name for name in kind_fields if name.endswith("_deg")}
        for name in sorted((present ^ {*kind_fields}) - optional):
            advice = f"Remove {name}" if name in present else f"Set {name}"
            takes = (
                f"supports {join_names([*kind_fields])}"
                if kind_fields
                else "supports only from_s and to_s"
            )
            raise LidarError(f"A fault of kind {self.kind!r} {takes}. {advice}.")
        if self.to_s is not None and self.to_s <= self.from_s:
            raise LidarError(
                f"to_s must be greater than from_s ({self.from_s:g}), but is {self.to_s:g}."
            )

    def to_dict(self) -> dict[str, Any]:
        """Return the fields that are not None as a dictionary."""
        return {name: value for name, value in vars(self).items() if value is not None}

    @property
    def span_ns(self) -> tuple[float, float]:
        """Start and end of the fault in nanoseconds since the start of the survey.

        The end is infinite if `to_s` is None.
        """
        return self.from_s * 1e9, inf if self.to_s is None else self.to_s * 1e9

    def is_active(self, starts_ns: Floats | Ints, stops_ns: Floats | Ints | None = None) -> Bools:
        """Return a mask of the times or time intervals at which the fault is active.

        Times are in nanoseconds since the start of the survey.
        """
        stops_ns = starts_ns if stops_ns is None else stops_ns
        begin, end = self.span_ns
        return np.asarray((stops_ns >= begin) & (starts_ns < end))

    def find_dropped(self, firings: Ints, seed: int, station: int, number: int) -> Bools:
        """Return a mask of the firings whose packets are dropped.

        Parameters
        ----------
        firings
            Indices of the firings. Shape (n,).
        seed
            Seed of the sensor's noise.
        station
            Index of the station.
        number
            Index of this fault in its survey.
        """
        packets = firings // (self.packet or 1)
        return np.asarray(uniform(seed, PACKET, station, packets, number) < (self.share or 0.0))

    def time_errors_ns(self, times_ns: Floats | Ints) -> Ints:
        """Return the timestamp errors at the given times, in nanoseconds.

        Times and results have shape (n,). The error is zero while the fault is inactive.
        """
        return self.is_active(times_ns) * np.int64(round((self.by_s or 0) * 1e9))


def check_faults(
    faults: Sequence[Fault], sensors: Mapping[str, Sensor], duration_ns: float
) -> None:
    """Check that faults are compatible with the sensors and the duration of a survey.

    Parameters
    ----------
    faults
        Faults of the survey.
    sensors
        Sensors by name.
    duration_ns
        Duration of the survey in nanoseconds.

    Raises
    ------
    LidarError
        If a fault refers to a sensor or channel that does not exist, or starts at an invalid time.
    """
    for number, fault in enumerate(faults):
        with prefix_errors(f"faults[{number}]"):
            _check_fault(fault, sensors, duration_ns / 1e9)


def _check_fault(fault: Fault, sensors: Mapping[str, Sensor], duration_s: float) -> None:
    faulty = [sensor for name, sensor in sensors.items() if fault.sensor in (None, name)]
    if not faulty:
        advice = " The survey has a single unnamed sensor. Remove sensor."
        if any(sensors):
            advice = f" Available sensors: {', '.join(sensors)}."
        hint = did_you_mean(str(fault.sensor), sensors) or advice
        raise LidarError(f"Unknown sensor {fault.sensor!r}.{hint}")
    first_firing = np.zeros(1, np.int64)
    starts_ns = [sensor.begins_ns(first_firing)[0] + sensor.lead_ns for sensor in faulty]
    if fault.kind == "frozen" and fault.from_s <= max(starts_ns) / 1e9:
        raise LidarError(
            "A frozen sensor repeats its previous sweep, so from_s must be after the first sweep."
        )
    if fault.from_s > duration_s:
        raise LidarError(
            f"from_s must be less than the duration of the survey ({duration_s:.6g} s), but is "
            f"{fault.from_s:g}."
        )
    channels = min(sensor.channels for sensor in faulty)
    highest = max(fault.channels or (0,))
    if highest >= channels:
        raise LidarError(f"Channel {highest} does not exist. The channels are 0 to {channels - 1}.")
