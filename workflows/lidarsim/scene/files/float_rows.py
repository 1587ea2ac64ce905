"""Reader of float32 sweep files, such as .bin (KITTI) and .pcd.bin (nuScenes)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...columns.sweep import Sweep
from ...io.input_files import read_input
from ...numerics.arrays import AnyArray

# Columns in each format
KITTI = ("x", "y", "z", "intensity")
NUSCENES = (*KITTI, "channel")
_NUSCENES_ENDING = ".pcd.bin"


def columns_by_name(path: Path) -> tuple[str, ...]:
    """Return the column names of a file, as determined by its extension."""
    return NUSCENES if path.name.lower().endswith(_NUSCENES_ENDING) else KITTI


def read_float_columns(path: Path, names: tuple[str, ...]) -> dict[str, AnyArray]:
    """Read the columns of a sweep, keyed by name.

    `names` is `KITTI` or `NUSCENES`. Each column has shape (n,).

    Raises
    ------
    ValueError
        If the last row is incomplete, or if a ring number is invalid.
    OSError
        If the file cannot be read.
    """
    data = read_input(path)
    row_size = 4 * len(names)
    if len(data) % row_size:
        other_format = f" (and {NUSCENES[-1]} in {_NUSCENES_ENDING})" if names is KITTI else ""
        raise ValueError(
            f"{path.name} has {len(data):,} bytes, but a multiple of {row_size} was expected. A "
            f"point consists of {', '.join(names)} as float32{other_format}"
        )
    rows = np.frombuffer(data, "<f4").reshape(-1, len(names))
    columns: dict[str, AnyArray] = dict(zip(names, rows.T.copy(), strict=True))
    if names is NUSCENES:
        rings = columns["channel"]
        if not ((rings >= 0) & (rings < 1 << 16) & (rings == np.floor(rings))).all():
            raise ValueError(
                f"{path.name} is not a nuScenes sweep, because the fifth value of a point must be "
                "a ring number from 0 to 65,535"
            )
        columns["channel"] = rings.astype(np.uint16)
    return columns


def read_float_rows(path: Path) -> list[Sweep]:
    """Read the points of a sweep in the format implied by the file extension.

    Raises
    ------
    ValueError
        If the last row is incomplete, or if a ring number is invalid.
    OSError
        If the file cannot be read.
    """
    columns = read_float_columns(path, columns_by_name(path))
    with np.errstate(invalid="ignore"):  # converting signaling NaN is an invalid operation
        positions = np.stack([columns.pop(axis) for axis in "xyz"], axis=1).astype(np.float64)
    return [Sweep(positions, columns)]
