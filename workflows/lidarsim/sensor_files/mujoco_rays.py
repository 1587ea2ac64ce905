"""Angle arrays `theta` and `phi` for MuJoCo-LiDAR, in the same form as its scan patterns.

An .npz file contains the arrays. A Python file (.py) has a function that returns the arrays of a
frame, and requires only NumPy.

`theta` is the azimuth, counterclockwise from x, and `phi` the elevation above the xy plane. Both
are in radians in the frame of a site, with x forward, y left and z up. MuJoCo-LiDAR casts all rays
of a call at once. The times in the file are intended for programs that cast rays in parts.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from .complete_files import open_complete, write_complete_text
from .fired_rays import AXES, RayList
from .python_file import array_code, python_text, times_code
from .ray_header import TIME_COLUMN, check_names, columns_of, header_of, rays_of
from .ray_npz import HEADER, header_in, read_arrays

_PYTHON = ".py"
_WORDS = f"""Angles are float64 radians in the frame of a site, {AXES}: theta is the
azimuth, counter-clockwise from x, and phi the elevation above the xy plane.

    ranges = lidar.trace_rays(data, *angles(frame=0))"""
_FUNCTIONS = '''def angles(frame=0):
    """Return theta (n,) and phi (n,) of the rays of a frame, radians."""
    start, stop = _BOUNDS[frame % FRAMES], _BOUNDS[frame % FRAMES + 1]
    return _THETA[start:stop], _PHI[start:stop]


def times_ns(frame=0):
    """Return the times (n,) of the rays of a frame, nanoseconds since the start of the pattern."""
    start, stop = _BOUNDS[frame % FRAMES], _BOUNDS[frame % FRAMES + 1]
    return _TIMES_NS[start:stop]
'''
_NAMES = ("theta", "phi", TIME_COLUMN, HEADER)


def write(path: Path, rays: RayList, left_out: Sequence[str]) -> Sequence[str]:
    """Write the angles and times of rays to an .npz file with a header, or to a Python file."""
    if path.suffix.lower() == _PYTHON:
        write_complete_text(path, _python_text(rays.with_times(), left_out))
        return left_out
    header = np.array(json.dumps(header_of(rays, left_out, azimuth="theta", elevation="phi")))
    with open_complete(path) as file:
        np.savez_compressed(
            file,
            allow_pickle=False,
            theta=np.radians(rays.azimuths_deg),
            phi=np.radians(rays.elevations_deg),
            **{TIME_COLUMN: columns_of(rays)[TIME_COLUMN], HEADER: header},
        )
    return left_out


def _python_text(rays: RayList, left_out: Sequence[str]) -> str:
    """Return the content of a Python file with the given rays, which must have times."""
    arrays = {
        "_THETA": array_code(np.radians(rays.azimuths_deg), "<f8"),
        "_PHI": array_code(np.radians(rays.elevations_deg), "<f8"),
        "_TIMES_NS": times_code(rays),
    }
    title = "Ray angles of {name} for MuJoCo-LiDAR, written by lidarpool."
    return python_text(rays, title, _WORDS, left_out, _FUNCTIONS, arrays)


def read(path: Path) -> RayList | None:
    """Read rays from the arrays `theta` and `phi`.

    The result is None for a Python file, and for a file that contains neither of these arrays.

    Raises
    ------
    ValueError
        If an array is missing or unknown, or if a value is not finite.
    LidarError
        If the content exceeds the memory limit.
    """
    if path.suffix.lower() == _PYTHON:
        return None  # code is not run
    arrays = read_arrays(path)
    if not {"theta", "phi"} & arrays.keys():
        return None
    check_names("arrays", arrays, _NAMES)
    if missing := [name for name in ("theta", "phi") if name not in arrays]:
        raise ValueError(f"it has no array {missing[0]}")
    header = header_in(arrays)
    columns = {
        "azimuth_deg": np.degrees(arrays.pop("theta")),
        "elevation_deg": np.degrees(arrays.pop("phi")),
        **arrays,
    }
    return rays_of(columns, header)
