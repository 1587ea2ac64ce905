"""Folders «oxts» of the KITTI data set: positions and angles of an OXTS inertial navigation system.

Each file has a row of 30 numbers: latitude and longitude in degrees, altitude in meters, and roll,
pitch and yaw in radians (dataformat.txt of KITTI's development kit). Yaw is counter-clockwise from
east, pitch positive nose down and roll positive right side down, as of `Pose`; the unit's axes are
x ahead, y left and z up.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..io.input_files import read_input_text
from ..io.numbered_files import rows_of_frames, sort_by_number
from ..numerics.arrays import Floats
from ..numerics.elementary import log, sin_cos
from ..numerics.elementary_scalars import sin_cos_of
from .rotations import quaternions_of, rotations_of

WIDTH = 30  # numbers of a row
_RADIUS_M = 6378137.0  # radius of KITTI's Mercator projection
OXTS_TIMES = "timestamps.txt"
_DATE = re.compile(r"\d{4}-\d\d-\d\d[ T]\d\d:\d\d:\d\d(\.\d*)?")


def find_oxts(path: Path) -> Path | None:
    """Return the folder «oxts» at or in a path, or None."""
    for folder in (path, path / "oxts", path.parent if path.name == "data" else path):
        if (folder / "data").is_dir() and (folder / OXTS_TIMES).is_file():
            return folder
    return None


def oxts_files(folder: Path) -> list[Path]:
    """Return the files of a folder «oxts», each with a row, in the order of their numbers."""
    return sort_by_number((folder / "data").glob("*.txt"))


def read_oxts(folder: Path, origin: Sequence[float] | None) -> tuple[Floats, Floats, Floats]:
    """Read a folder with «data» and «timestamps.txt».

    Returns
    -------
    seconds since 1970 (k,), positions east, north and up of the origin (k, 3), meters, and
    quaternions (k, 4), x, y, z, w.

    Raises
    ------
    ValueError
        If the folder has no rows, a row has another number of values, or times do not fit.
    """
    files = oxts_files(folder)
    if not files:
        raise ValueError("its folder data contains no .txt files")
    rows = []
    for file in files:
        numbers = read_input_text(file).split()
        if len(numbers) != WIDTH:
            raise ValueError(f"data/{file.name} has {len(numbers)} numbers instead of {WIDTH}")
        rows.append([float(number) for number in numbers])
    seconds = dates_of(read_input_text(folder / OXTS_TIMES))
    if seconds is None:
        raise ValueError(
            f"{OXTS_TIMES} contains rows that are not dates such as 2011-09-26 13:02:25.964"
        )
    seconds = seconds[rows_of_frames(files, len(seconds), OXTS_TIMES, "files in data")]
    return seconds, *oxts_poses(np.array(rows), origin)


def dates_of(text: str) -> Floats | None:
    """Return the seconds since 1970 (k,) of the dates in a text, one a line, or None for others."""
    lines = [line.strip() for line in text.split("\n") if line.strip()]
    if not all(_DATE.fullmatch(line) for line in lines):
        return None
    return np.array(lines, "datetime64[ns]").astype(np.int64) / 1e9


def oxts_poses(rows: Floats, origin: Sequence[float] | None) -> tuple[Floats, Floats]:
    """Return positions east, north and up of an origin (k, 3), meters, and quaternions (k, 4).

    Positions are in KITTI's Mercator projection, whose scale is true at the latitude of the origin.

    Parameters
    ----------
    rows
        (k, 30): rows of the files.
    origin
        Latitude and longitude, degrees, and altitude, meters; by default of the first row.
    """
    latitude, longitude, altitude = rows[:, :3].T
    if not ((np.abs(latitude) < 90) & (np.abs(longitude) <= 360)).all():
        raise ValueError("its first two columns are not latitude and longitude in degrees")
    origin_row = rows[0, :3] if origin is None else np.asarray(origin, np.float64)
    scale = sin_cos_of(np.radians(float(origin_row[0])))[1]

    def projected(latitude: Floats, longitude: Floats) -> Floats:
        """Return meters east and north (k, 2) of a latitude and longitude in degrees (k,)."""
        sine, cosine = sin_cos((90.0 + latitude) * (np.pi / 360.0))
        north = log(sine / cosine)
        return scale * _RADIUS_M * np.stack([np.radians(longitude), north], axis=-1)

    level = projected(latitude, longitude) - projected(origin_row[0], origin_row[1])
    positions = np.column_stack([level, altitude - origin_row[2]])
    angles_deg = np.degrees(rows[:, [5, 4, 3]])
    return positions, quaternions_of(rotations_of(angles_deg))
