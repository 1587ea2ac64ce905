"""Rays as arrays of NumPy (.npz): a one-dimensional array for each column, and a header in JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from zipfile import BadZipFile, ZipFile

import numpy as np

from ..base.allowance import Allowance
from ..base.input_files import check_input
from .complete_files import write_bytes_of
from .fired_rays import FiredRays
from .ray_header import COLUMNS, check_names, columns_of, header_of, rays_of

HEADER = "header"


def write(path: Path, rays: FiredRays, left_out: Sequence[str]) -> Sequence[str]:
    """Write rays with a header."""
    arrays = {HEADER: np.array(json.dumps(header_of(rays, left_out))), **columns_of(rays)}
    with write_bytes_of(path) as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)
    return left_out


def read(path: Path) -> FiredRays | None:
    """Return the rays of a file of this format, or None for arrays of another format.

    Raises
    ------
    ValueError
        If an array or the header cannot be used.
    LidarError
        If the content is larger than the memory.
    """
    arrays = read_arrays(path)
    if HEADER not in arrays and "direction_x" not in arrays and "azimuth_deg" not in arrays:
        return None
    header = header_in(arrays)
    check_names("arrays", arrays, COLUMNS)
    return rays_of(arrays, header)


def header_in(arrays: dict[str, Any]) -> dict[str, Any]:
    """Remove the header from arrays and return it.

    Raises ValueError if the arrays are not of a file of rays.
    """
    header = json.loads(str(arrays.pop(HEADER, np.array("{}"))))
    if not isinstance(header, dict):
        raise ValueError("its header is not of a file of rays")
    return header


def read_arrays(path: Path) -> dict[str, Any]:
    """Return the arrays of an .npz by name.

    Raises
    ------
    ValueError
        If the file is not an .npz, or an array is of objects.
    LidarError
        If the arrays are larger than the memory.
    OSError
        If the file cannot be read.
    """
    allowance = Allowance(check_input(path), "write it again with fewer rays")
    try:
        with ZipFile(path) as archive:
            allowance.take(sum(entry.file_size for entry in archive.infolist()))
        with np.load(path, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except BadZipFile as error:
        raise ValueError("it is no .npz, or its end is missing") from error
