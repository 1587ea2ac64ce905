"""Reader for oxts folders of KITTI, which contain data of an inertial navigation system.

Each file contains a row of 30 numbers. The row starts with latitude and longitude in degrees,
altitude in meters, and roll, pitch and yaw in radians, as described in dataformat.txt of KITTI's
development kit. As in `Pose`, yaw is counterclockwise from east, pitch is positive with the nose
down, and roll is positive with the right side down. The axes of the unit are x forward, y left and
z up.
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

WIDTH = 30  # number of values in a row
_RADIUS_M = 6378137.0  # radius of KITTI's Mercator projection
OXTS_TIMES = "timestamps.txt"
_DATE = re.compile(r"\d{4}-\d\d-\d\d[ T]\d\d:\d\d:\d\d(\.\d*)?")


def find_oxts(path: Path) -> Path | None:
    """Find the oxts folder at or inside a path. Return None if there is none."""
    for folder in (path, path / "oxts", path.parent if path.name == "data" else path):
        if (folder / "data").is_dir() and (folder / OXTS_TIMES).is_file():
            return folder
    return None


def oxts_files(folder: Path) -> list[Path]:
    """Return the data files of an oxts folder, sorted by their numbers."""
    return sort_by_number((folder / "data").glob("*.txt"))


def read_oxts(folder: Path, origin: Sequence[float] | None) -> tuple[Floats, Floats, Floats]:
    """Read an oxts folder, which contains timestamps.txt and a folder `data`.

    Returns
    -------
    tuple
        Times (k,) in seconds since 1970, positions (k, 3) in meters to the east, north and up from
        the origin, and quaternions (x, y, z, w) of shape (k, 4).

    Raises
    ------
    ValueError
        If the folder has no rows, a row does not have 30 values, or the times do not match the
        rows.
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
    seconds = parse_dates(read_input_text(folder / OXTS_TIMES))
    if seconds is None:
        raise ValueError(
            f"{OXTS_TIMES} contains rows that are not dates such as 2011-09-26 13:02:25.964"
        )
    seconds = seconds[rows_of_frames(files, len(seconds), OXTS_TIMES, "files in data")]
    return seconds, *oxts_poses(np.array(rows), origin)


def parse_dates(text: str) -> Floats | None:
    """Convert text with one date per line to seconds since 1970.

    The result is None if any line is not a date.
    """
    lines = [line.strip() for line in text.split("\n") if line.strip()]
    if not all(_DATE.fullmatch(line) for line in lines):
        return None
    return np.array(lines, "datetime64[ns]").astype(np.int64) / 1e9


def oxts_poses(rows: Floats, origin: Sequence[float] | None) -> tuple[Floats, Floats]:
    """Convert the rows of oxts files to positions and quaternions.

    Parameters
    ----------
    rows
        Rows of the files. Shape (k, 30).
    origin
        Latitude and longitude in degrees and altitude in meters of the origin. The default is the
        position in the first row.

    Returns
    -------
    tuple
        Positions (k, 3) in meters to the east, north and up from the origin, and quaternions
        (k, 4). Positions are in KITTI's Mercator projection, whose scale is true at the latitude of
        the origin.

    Raises
    ------
    ValueError
        If a row has an invalid latitude or longitude.
    """
    latitude, longitude, altitude = rows[:, :3].T
    if not ((np.abs(latitude) < 90) & (np.abs(longitude) <= 360)).all():
        raise ValueError("its first two columns are not latitude and longitude in degrees")
    origin_row = rows[0, :3] if origin is None else np.asarray(origin, np.float64)
    scale = sin_cos_of(np.radians(float(origin_row[0])))[1]

    def project(latitude: Floats, longitude: Floats) -> Floats:
        """Project latitudes and longitudes in degrees to meters to the east and north."""
        sine, cosine = sin_cos((90.0 + latitude) * (np.pi / 360.0))
        north = log(sine / cosine)
        return scale * _RADIUS_M * np.stack([np.radians(longitude), north], axis=-1)

    level = project(latitude, longitude) - project(origin_row[0], origin_row[1])
    positions = np.column_stack([level, altitude - origin_row[2]])
    angles_deg = np.degrees(rows[:, [5, 4, 3]])
    return positions, quaternions_of(rotations_of(angles_deg))
