"""Calibration files of Hesai sensors, which contain the lasers' angles and firing times.

Sources: the folder "correction" of HesaiLidar_SDK_2.0, and the parsers that load the files.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ..numerics.arrays import Floats
from ..sensor import Sensor
from .hesai_layouts import HesaiPacketLayout

_NEAR_M = "2.85"  # range below which a Pandar128 fires differently, as in the original file


class LaserTable(NamedTuple):
    """Angles and firing times of the lasers, in the manufacturer's order."""

    layout: HesaiPacketLayout
    elevation_deg: Floats  # (c,)
    azimuth_deg: Floats  # (c,): clockwise relative to the head
    time_us: Floats  # (c,): time after the reference of the block

    @classmethod
    def from_sensor(cls, sensor: Sensor, layout: HesaiPacketLayout) -> LaserTable:
        """Return the laser table of a sensor."""
        channels = sensor.packets.channels  # type: ignore[union-attr]
        beams = sensor.beams
        # The beam azimuths of a sensor include the rotation of the head within a firing.
        turned = sensor.head.radians_per_ns * beams.time_ns  # type: ignore[attr-defined]
        return cls(
            layout,
            np.degrees(beams.elevation)[channels],
            -np.degrees(beams.azimuth - turned)[channels],
            layout.first_laser_us + beams.time_ns[channels] / 1000,
        )

    def angles_file(self) -> str:
        """Return the content of the angle file, in degrees."""
        rows = zip(self.elevation_deg, self.azimuth_deg, strict=True)
        lines = [
            f"{laser},{_decimal(elevation)},{_decimal(azimuth)}"
            for laser, (elevation, azimuth) in enumerate(rows, 1)
        ]
        return "\n".join(["Channel,Elevation,Azimuth", *lines, ""])

    def firetimes_file(self) -> str:
        """Return the content of the firing time file.

        All states and ranges have equal times.
        """
        states = self.layout.listed_states
        times_us = [_decimal(time) for time in self.time_us]
        if not states:
            return _table([["Channel", "fire time(us)"]], times_us, 1)
        azimuth_states = [states[:n].count(state) for n, state in enumerate(states)]
        if not self.layout.lists_distances:
            heads = [["Operational State", *states], ["Azimuth State", *azimuth_states]]
            return _table(heads, times_us, len(states))
        heads = [
            [_NEAR_M, *["distance>=A1", "distance<A1"] * len(states)],
            ["operation mode", *np.repeat(states, 2)],
            ["angle state", *np.repeat(azimuth_states, 2)],
        ]
        times_ns = [f"{round(time * 1000)}" for time in self.time_us]
        return _table(heads, times_ns, 2 * len(states))


def _table(heads: list[list[Any]], times: list[str], columns: int) -> str:
    """Return a text table with each laser's time repeated in several columns."""
    rows = [[laser, *[time] * columns] for laser, time in enumerate(times, 1)]
    return "\n".join([*(",".join(map(str, row)) for row in [*heads, *rows]), ""])


def _decimal(number: float) -> str:
    return f"{round(number, 6) + 0.0:.6f}".rstrip("0").rstrip(".")  # + 0.0 avoids -0
