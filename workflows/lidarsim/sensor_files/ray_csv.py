"""Rays as a comma-separated table (.csv), with the header in comments above the columns."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from ..columns.column_names import ALIASES, TIMES
from ..io.tables import DEGREES, METERS, NUMBERS, Quantity, read_table
from ..io.textfile import read_text
from ..io.time_units import SECONDS
from .complete_files import write_complete_text
from .fired_rays import RayList
from .ray_header import COLUMNS, DIRECTION, ORIGIN, TIME_COLUMN, columns_of, header_of, rays_of

_DECIMALS = 9  # decimals of angles, whereas directions are written with all digits
_TIMES = (*TIMES, "offset", "stamp", "fire_time")
QUANTITIES = (
    Quantity("time_s", _TIMES, SECONDS, None),
    Quantity("channel", ("channel", *ALIASES["channel"]), NUMBERS, ""),
    Quantity("azimuth_deg", ("azimuth",), DEGREES, None),
    Quantity("elevation_deg", ("elevation",), DEGREES, None),
    *(Quantity(name, (name, name[-1], f"d{name[-1]}"), NUMBERS, "") for name in DIRECTION),
    *(Quantity(name, (name.removesuffix("_m"),), METERS, "m") for name in ORIGIN),
)


def write(path: Path, rays: RayList, left_out: Sequence[str]) -> Sequence[str]:
    """Write rays as a table, with the header in comments."""
    columns: dict[str, Any] = columns_of(rays)
    for name in ("azimuth_deg", "elevation_deg"):
        columns[name] = np.round(columns[name], _DECIMALS) + 0.0  # + 0.0 avoids -0.0
    remarks = [
        f"# {name}: {json.dumps(value)}" for name, value in header_of(rays, left_out).items()
    ]
    rows = zip(*(values.tolist() for values in columns.values()), strict=True)
    lines = [*remarks, ",".join(COLUMNS), *(",".join(map(repr, row)) for row in rows)]
    write_complete_text(path, "\n".join(lines) + "\n")
    return left_out


def is_ray_table(text: str) -> bool:
    """Return whether a text is a ray table, which is recognized by its time column."""
    lines = (line for line in text.splitlines() if line.strip() and not line.startswith("#"))
    return TIME_COLUMN in next(lines, "").split(",")


def read(path: Path) -> RayList | None:
    """Read rays from a text table (`rays_of_text`)."""
    return rays_of_text(read_text(path))


def rays_of_text(text: str) -> RayList:
    """Parse a table of rays, which are given by azimuths and elevations or by directions.

    Column names and units may have other spellings, such as "Azimuth [rad]". Times in tables of
    other programs are measured from the first ray.

    Raises
    ------
    ValueError
        If a column is missing or unknown, or a value is not a finite number.
    """
    columns = read_table(text, QUANTITIES)
    header = _header(text)
    if "time_s" in columns:
        times_s = columns.pop("time_s")
        columns[TIME_COLUMN] = 1e9 * (times_s if header else times_s - times_s[:1])
    return rays_of(columns, header)


def _header(text: str) -> dict[str, Any]:
    """Parse the header in the comments at the start of a text.

    Other comments are ignored.
    """
    header = {}
    for line in text.splitlines():
        if not line.startswith("#"):
            break
        name, _, value = line.lstrip("# ").partition(":")
        with suppress(ValueError, RecursionError):
            header[name.strip()] = json.loads(value)
    return header
