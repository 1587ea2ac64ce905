"""Rays as NumPy arrays (.npz), with one array for each column and a JSON header."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from zipfile import BadZipFile, ZipFile

import numpy as np

from ..io.allowance import Allowance
from ..io.input_files import check_input
from .complete_files import open_complete
from .fired_rays import RayList
from .ray_header import (
    COLUMNS,
    check_names,
    check_numbers,
    columns_of,
    header_of,
    parsed_header,
    rays_of,
)

HEADER = "header"
_ENCRYPTED = 1  # flag of an archive member


def write(path: Path, rays: RayList, left_out: Sequence[str]) -> Sequence[str]:
    """Write rays and a header to an .npz file."""
    arrays = {HEADER: np.array(json.dumps(header_of(rays, left_out))), **columns_of(rays)}
    with open_complete(path) as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)
    return left_out


def read(path: Path) -> RayList | None:
    """Read rays from an .npz file. Return None if its arrays have another format.

    Raises
    ------
    ValueError
        If an array or the header is invalid.
    LidarError
        If the content exceeds the memory limit.
    """
    arrays = read_arrays(path)
    if HEADER not in arrays and "direction_x" not in arrays and "azimuth_deg" not in arrays:
        return None
    header = header_in(arrays)
    check_names("arrays", arrays, COLUMNS)
    return rays_of(arrays, header)


def header_in(arrays: dict[str, Any]) -> dict[str, Any]:
    """Remove the header from `arrays`, and return it parsed.

    Raises ValueError if the header is not a JSON object.
    """
    return parsed_header(str(arrays.pop(HEADER, "{}")))


def read_arrays(path: Path) -> dict[str, Any]:
    """Read the arrays in an .npz file, keyed by name.

    Raises
    ------
    ValueError
        If the file is not an .npz file or is encrypted, or an array is not numeric.
    LidarError
        If the arrays exceed the memory limit.
    OSError
        If the file cannot be read.
    """
    allowance = Allowance(check_input(path), "write it again with fewer rays")
    try:
        with ZipFile(path) as archive:
            entries = archive.infolist()
        if any(entry.flag_bits & _ENCRYPTED for entry in entries):
            raise ValueError("it is encrypted. Write it again without a password")
        allowance.reserve(sum(entry.file_size for entry in entries))
        with np.load(path, allow_pickle=False) as content:
            arrays = {name: content[name] for name in content.files}
    except BadZipFile as error:
        raise ValueError(f"it is not a valid .npz file ({error})") from error
    for name, array in arrays.items():
        if name != HEADER:
            check_numbers(name, array.dtype)
    return arrays
