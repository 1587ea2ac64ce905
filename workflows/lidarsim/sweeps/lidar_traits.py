"""Sensor properties that files store together with points, such as return modes and scan lines."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ..numerics.arrays import Floats, Ints
from ..sensor import Sensor
from ..sensor.beams import Mirror, Spin
from ..sensor.sensor import LineSensor

_OUSTER = "ouster"  # reflectivity scale of sensors from this manufacturer


@dataclass(frozen=True)
class MirrorLines:
    """Scan lines of a mirror that sweeps across the flight direction.

    `rate_hz` is the number of cycles per second. An oscillating mirror scans two lines per cycle,
    and a rotating mirror scans one. `start_ns` is the start of cycle 0 in nanoseconds since the
    start of the station. `leftward` is true if the first line in a cycle runs from right to left,
    as seen along the x axis of the sensor.
    """

    rate_hz: float
    start_ns: float
    swings: bool
    leftward: bool

    def numbers(self, times_ns: Floats) -> Ints:
        """Return the line number at each of the given times.

        Times are in nanoseconds since the start of the station.
        """
        per_second = self.rate_hz * (2 if self.swings else 1)
        # Times are rounded to 1 ns, so a line must start up to 1 ns before its first firing.
        return np.floor((times_ns - self.start_ns + 1) * (per_second / 1e9)).astype(np.int64)

    def runs_leftward(self, lines: Ints) -> Ints:
        """Return 1 for each line that runs from right to left, and 0 for the others."""
        returning = lines % 2 if self.swings else np.zeros(len(lines), np.int64)
        return returning ^ int(self.leftward)


@dataclass(frozen=True)
class LidarTraits:
    """Sensor properties that determine the values of fields in output files."""

    channels: int
    mode: str  # return mode; see `Returns`. Empty if unknown
    zero_deg: float = 0.0  # azimuth at which the head starts, counterclockwise from the x axis
    firing_ns: float = 0.0  # time between the first and last beam of a firing
    # Difference between the ranges that the sensor reports and the distances from the beam origin.
    range_offset_m: float = 0.0
    lines: MirrorLines | None = None  # only for sensors that sweep across the flight direction
    # The manufacturer's laser number for each channel, starting at 0; empty if unknown.
    lasers: tuple[int, ...] = ()

    @classmethod
    def from_sensor(cls, sensor: Sensor, mode: str) -> LidarTraits:
        """Determine the traits of a sensor, which may be an instance of a custom class."""
        head = sensor.head
        beams = sensor.beams
        spins = isinstance(head, Spin) and not isinstance(head, Mirror)
        delays = beams.time_ns
        offset_m = 0.0
        if sensor.optics.reflectivity == _OUSTER and len(beams.origin):
            offset_m = float(np.hypot(*beams.origin[0, :2]))
        return cls(
            channels=sensor.channels,
            mode=mode,
            zero_deg=float(head.zero_deg) if isinstance(head, Spin) and spins else 0.0,
            firing_ns=float(np.ptp(delays)) if len(delays) else 0.0,
            range_offset_m=offset_m,
            lines=_lines_of(sensor),
            lasers=() if sensor.packets is None else tuple(sensor.packets.lasers.tolist()),
        )

    def to_json(self) -> dict[str, Any]:
        """Convert the traits to a JSON-serializable dictionary."""
        return asdict(self)

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> LidarTraits:
        """Create the traits from a dictionary that `to_json` returned.

        Entries are removed from the dictionary.
        """
        lines = values.pop("lines")
        lasers = tuple(values.pop("lasers"))
        return cls(**values, lines=lines and MirrorLines(**lines), lasers=lasers)


def _lines_of(sensor: Sensor) -> MirrorLines | None:
    """Return the scan lines if a sensor sweeps about its x axis, or None otherwise."""
    head = sensor.head
    if not isinstance(sensor, LineSensor) or not isinstance(head, Spin):
        return None
    swings = isinstance(head, Mirror) and head.motion != "sawtooth"
    return MirrorLines(head.rate_hz, sensor.start_ns + sensor.lead_ns, swings, not head.clockwise)
