"""Traits of a sensor that files state beside its points: modes, firings, lines of its mirror."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ..numerics.arrays import Floats, Ints
from ..sensor import Sensor
from ..sensor.beams import Mirror, Spin
from ..sensor.sensor import LineSensor

_OUSTER = "ouster"  # scale of reflectivity of sensors of this manufacturer


@dataclass(frozen=True)
class MirrorLines:
    """Lines that a mirror sweeps across the direction of flight.

    `rate_hz` counts cycles; a swinging mirror sweeps two lines in a cycle, a rotating mirror one
    line. `start_ns` is the start of cycle 0, nanoseconds since the start of the station. `leftward`
    is True if the first line of a cycle runs from right to left, seen along the sensor's x axis.
    """

    rate_hz: float
    start_ns: float
    swings: bool
    leftward: bool

    def numbers(self, times_ns: Floats) -> Ints:
        """Return the line of each time (n,), nanoseconds since the start of the station: (n,)."""
        per_second = self.rate_hz * (2 if self.swings else 1)
        # Times are rounded to 1 ns: a line starts up to 1 ns before its first firing.
        return np.floor((times_ns - self.start_ns + 1) * (per_second / 1e9)).astype(np.int64)

    def leftwards(self, lines: Ints) -> Ints:
        """Return 1 for the lines (n,) that run from right to left, else 0: (n,)."""
        returning = lines % 2 if self.swings else np.zeros(len(lines), np.int64)
        return returning ^ int(self.leftward)


@dataclass(frozen=True)
class LidarTraits:
    """Properties of a sensor that fields of files depend on."""

    channels: int
    mode: str  # mode of its returns (`Returns`)
    zero_deg: float = 0.0  # azimuth at which its head starts: counter-clockwise from x
    firing_ns: float = 0.0  # time from the first beam of a firing to the last
    # Difference between the manufacturer's ranges and distances from the beam's origin, meters.
    range_offset_m: float = 0.0
    lines: MirrorLines | None = None  # lines of sensors that sweep across the direction of flight
    # The maker's number of the laser of each channel, from 0; empty if unknown.
    lasers: tuple[int, ...] = ()

    @classmethod
    def from_sensor(cls, sensor: Sensor, mode: str) -> LidarTraits:
        """Return the traits of a sensor, whose class may be a user's."""
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
        """Return a dictionary for JSON of the traits."""
        return asdict(self)

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> LidarTraits:
        """Return the traits of a dictionary from `to_json`, whose entries are removed."""
        lines = values.pop("lines")
        lasers = tuple(values.pop("lasers"))
        return cls(**values, lines=lines and MirrorLines(**lines), lasers=lasers)


def _lines_of(sensor: Sensor) -> MirrorLines | None:
    """Return the lines of a sensor that sweeps about its x axis, else None."""
    head = sensor.head
    if not isinstance(sensor, LineSensor) or not isinstance(head, Spin):
        return None
    swings = isinstance(head, Mirror) and head.motion != "sawtooth"
    return MirrorLines(head.rate_hz, sensor.start_ns + sensor.lead_ns, swings, not head.clockwise)
