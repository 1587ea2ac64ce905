"""GPS time of a survey, which cloud formats store in seconds since 1980-01-06."""

from __future__ import annotations

from lidarsim.sweeps.sweeps import Sweeps

GPS_NS = 315_964_800 * 10**9  # time between 1970-01-01 and 1980-01-06, the start of GPS time
_LEAP_S = 18  # GPS time minus UTC since 2017, the earliest start


def gps_start_s(sweeps: Sweeps) -> float:
    """Return the GPS time at the start of a survey in seconds, or 0 if it is unknown."""
    if sweeps.start_ns is None:
        return 0.0
    return (sweeps.start_ns - GPS_NS) / 1e9 + _LEAP_S
