"""Sweeps of float32 in rows: .bin of KITTI, and .pcd.bin of nuScenes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...columns.sweep import Sweep
from ...io.input_files import read_input
from ...numerics.arrays import AnyArray

# Columns of the formats.
KITTI = ("x", "y", "z", "intensity")
NUSCENES = (*KITTI, "channel")
_NUSCENES_ENDING = ".pcd.bin"


def columns_by_name(path: Path) -> tuple[str, ...]:
    """Return the columns of a file by its ending."""
    return NUSCENES if path.name.lower().endswith(_NUSCENES_ENDING) else KITTI


def read_float_columns(path: Path, names: tuple[str, ...]) -> dict[str, AnyArray]:
    """Return the columns of a sweep, {name: (n,)}, which are `KITTI` or `NUSCENES`.

    ValueError for a partial row, or if the rings are not rings; OSError if the file
    cannot be read.
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
    """Read the points of a sweep, of the format that its ending tells.

    Errors as of `read_float_columns`.
    """
    columns = read_float_columns(path, columns_by_name(path))
    with np.errstate(invalid="ignore"):  # NaN of any kind may be invalid
        positions = np.stack([columns.pop(axis) for axis in "xyz"], axis=1).astype(np.float64)
    return [Sweep(positions, columns)]
