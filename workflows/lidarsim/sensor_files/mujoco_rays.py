"""Angles of rays for MuJoCo-LiDAR (.npz): arrays `theta` and `phi`, as its scan patterns are.

`theta` is the azimuth, counter-clockwise from x, and `phi` the elevation above the xy plane, both
in radians, in the frame of a site: x forward, y left, z up. MuJoCo-LiDAR casts all rays of a call
at once; the times beside the angles are for programs that cast rays in parts.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from .complete_files import write_bytes_of
from .fired_rays import FiredRays
from .ray_header import TIME_COLUMN, check_names, columns_of, header_of, rays_of
from .ray_npz import HEADER, header_in, read_arrays

_NAMES = ("theta", "phi", TIME_COLUMN, HEADER)


def write(path: Path, rays: FiredRays, left_out: Sequence[str]) -> Sequence[str]:
    """Write angles and times of rays, with a header."""
    header = np.array(json.dumps(header_of(rays, left_out, azimuth="theta", elevation="phi")))
    with write_bytes_of(path) as file:
        np.savez_compressed(
            file,
            allow_pickle=False,
            theta=np.radians(rays.azimuths_deg),
            phi=np.radians(rays.elevations_deg),
            **{TIME_COLUMN: columns_of(rays)[TIME_COLUMN], HEADER: header},
        )
    return left_out


def read(path: Path) -> FiredRays | None:
    """Return the rays of arrays `theta` and `phi`; None for other arrays.

    Raises
    ------
    ValueError
        If an array is missing or not known, or numbers are not finite.
    LidarError
        If the content is larger than the memory.
    """
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
