"""Livox ray lists (.csv) with the columns Time/s, Azimuth/deg and Zenith/deg.

The Gazebo plug-in livox_laser_simulation and its descendants read this format. The zenith angle is
measured from the z axis, and the azimuth counterclockwise from x. In some files, the times are only
row numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..io.textfile import read_text
from .comma_rows import parse_rows
from .complete_files import write_complete_text
from .fired_rays import RayList, directions_of

HEADER = "Time/s,Azimuth/deg,Zenith/deg"
_DECIMALS = 9
_SECOND_NS = 1_000_000_000


def write(path: Path, rays: RayList, left_out: Sequence[str]) -> Sequence[str]:
    """Write rays in firing order.

    The format has no comments, so missing properties are only returned.
    """
    times_ns = rays.with_times().times_ns
    assert times_ns is not None  # `with_times` sets the times
    azimuths = np.round(rays.azimuths_deg, _DECIMALS) + 0.0  # + 0.0 avoids -0.0
    zeniths = np.round(90 - rays.elevations_deg, _DECIMALS)
    rows = zip(times_ns.tolist(), azimuths.tolist(), zeniths.tolist(), strict=True)
    lines = [
        f"{time_ns // _SECOND_NS}.{time_ns % _SECOND_NS:09d},{azimuth!r},{zenith!r}"
        for time_ns, azimuth, zenith in rows
    ]
    write_complete_text(path, "\n".join([HEADER, *lines]) + "\n")
    return left_out


def is_livox(text: str) -> bool:
    """Return whether a text has the header of a Livox ray list."""
    words = [word.strip().lower() for word in text.partition("\n")[0].split(",")]
    return words == HEADER.lower().split(",")


def read(path: Path) -> RayList | None:
    """Read rays from a Livox ray list. Return None if the file has another format."""
    text = read_text(path)
    return rays_of_text(text) if is_livox(text) else None


def rays_of_text(text: str) -> RayList:
    """Parse the rays in a list. Times that are merely row numbers are dropped.

    Raises
    ------
    ValueError
        If numbers are missing or not finite, or if times decrease.
    """
    times_s, azimuths_deg, zeniths_deg = parse_rows(text, 1, 3).T
    backward_rows = np.flatnonzero(np.diff(times_s) < 0)
    if len(backward_rows):
        raise ValueError(f"times decrease in line {backward_rows[0] + 3}")
    directions = directions_of(azimuths_deg, 90 - zeniths_deg)
    if times_s[-1] == times_s[0] or (np.diff(times_s) == 1).all():
        return RayList(directions)
    times_ns = np.rint(times_s * _SECOND_NS).astype(np.int64)
    # The first beam of a firing may be fired after its start, but before the start of the next
    # firing. If a list starts later than that, its times come from a clock.
    is_clock = times_ns[0] < 0 or times_ns[0] > np.diff(times_ns).max()
    return RayList(directions, times_ns - times_ns[0] if is_clock else times_ns)
