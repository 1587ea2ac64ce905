"""Faults of sensors, to test programs that read sensor data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from ..base.arrays import Bools, Floats, Ints
from ..base.declared import AngleDeg, MinMax, Several, Text, Two, UnitShare, about
from ..base.errors import LidarError, prefixed
from ..base.random_numbers import Purpose, uniform
from ..base.validation import checked_fields, without_numpy
from ..base.words import did_you_mean, joined
from ..sensor.sensor import Sensor

PACKET = Purpose(61, "whether a packet is lost")
FaultKind = Literal["dirt", "dead_channels", "dropped_packets", "frozen", "time_jump"]
Time = Annotated[float, Field(ge=0, le=1e9)]  # seconds since the survey's start
Channels = Annotated[Several[Annotated[int, Field(ge=0)]], Field(min_length=1)]
Count = Annotated[int, Field(ge=1, le=1_000_000)]
Shift = Annotated[float, Field(ge=-1e6, le=1e6)]

# {kind: fields that only this kind has}; sectors may be left out
_KIND_FIELDS: dict[str, tuple[str, ...]] = {
    "dirt": ("transmission", "azimuth_deg", "elevation_deg"),
    "dead_channels": ("channels",),
    "dropped_packets": ("share", "packet"),
    "frozen": (),
    "time_jump": ("by_s",),
}


@dataclass(frozen=True)
@checked_fields
class Fault:
    """Temporary fault of a sensor.

    The labels describe the true scene and list the active faults.

    Raises
    ------
    LidarError
        If a number is out of range, or if the fields cannot be combined.
    """

    kind: Annotated[FaultKind, about("kind of fault")]
    from_s: Annotated[Time, about("start, seconds since the survey's start")] = 0.0
    to_s: Annotated[Time | None, about("end; by default the survey's end")] = None
    sensor: Annotated[Text | None, about("name of the faulty sensor; by default all")] = None
    transmission: Annotated[UnitShare | None, about("of dirt: share of energy, out and back")] = (
        None
    )
    azimuth_deg: Annotated[
        Two[AngleDeg] | None, about("of dirt: start and end, counter-clockwise")
    ] = None
    elevation_deg: Annotated[MinMax[AngleDeg] | None, about("of dirt: lowest and highest")] = None
    channels: Annotated[Channels | None, about("dead channels; 0 is the lowest")] = None
    share: Annotated[UnitShare | None, about("share of packets that are lost")] = None
    packet: Annotated[Count | None, about("consecutive firings in a packet")] = None
    by_s: Annotated[Shift | None, about("of a time jump: added to stamps, seconds")] = None

    def __post_init__(self) -> None:
        for name, value in self.words().items():  # labels have them as JSON
            listed = np.iterable(value) and not isinstance(value, str)
            object.__setattr__(self, name, without_numpy(tuple(value) if listed else value))
        kind_fields = _KIND_FIELDS[self.kind]
        present = self.words().keys() - {"kind", "from_s", "to_s", "sensor"}
        optional = {name for name in kind_fields if name.endswith("_deg")}
        for name in sorted((present ^ {*kind_fields}) - optional):
            advice = f"Remove {name}" if name in present else f"Set {name}"
            takes = (
                f"takes {joined([*kind_fields])}" if kind_fields else "takes only from_s and to_s"
            )
            raise LidarError(f"A fault of kind {self.kind!r} {takes}. {advice}.")
        if self.to_s is not None and self.to_s <= self.from_s:
            raise LidarError(
                f"to_s must be greater than from_s ({self.from_s:g}), but is {self.to_s:g}."
            )

    def words(self) -> dict[str, Any]:
        """Return the fields that are not None as a dict."""
        return {name: value for name, value in vars(self).items() if value is not None}

    @property
    def span_ns(self) -> tuple[float, float]:
        """Start and end of the fault in nanoseconds since the start of the survey."""
        return self.from_s * 1e9, inf if self.to_s is None else self.to_s * 1e9

    def during(self, starts_ns: Floats | Ints, stops_ns: Floats | Ints | None = None) -> Bools:
        """Return a mask of the times or intervals during which the fault is active."""
        stops_ns = starts_ns if stops_ns is None else stops_ns
        begin, end = self.span_ns
        return np.asarray((stops_ns >= begin) & (starts_ns < end))

    def drops(self, firings: Ints, seed: int, station: int, number: int) -> Bools:
        """Return a mask of the firings (n,) that belong to dropped packets.

        `number` is the number of this fault in its survey, `seed` the seed of the sensor's noise.
        """
        packets = firings // (self.packet or 1)
        return np.asarray(uniform(seed, PACKET, station, packets, number) < (self.share or 0.0))

    def jumps_ns(self, times_ns: Floats | Ints) -> Ints:
        """Return the shift of the timestamps at times (n,) in nanoseconds."""
        return self.during(times_ns) * np.int64(round((self.by_s or 0) * 1e9))


def check_faults(
    faults: Sequence[Fault], sensors: Mapping[str, Sensor], duration_ns: float
) -> None:
    """Check that faults fit the sensors and the duration of a survey.

    `sensors` are {name: sensor}.

    Raises
    ------
    LidarError
        If a fault does not fit.
    """
    for number, fault in enumerate(faults):
        with prefixed(f"faults[{number}]"):
            _check_fault(fault, sensors, duration_ns / 1e9)


def _check_fault(fault: Fault, sensors: Mapping[str, Sensor], duration_s: float) -> None:
    """Check that a fault fits the sensors {name: sensor} and the duration of a survey."""
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
