"""Sweeps of float32 in rows: .bin of KITTI, and .pcd.bin of nuScenes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...base.arrays import AnyArray
from ...base.input_files import read_input
from .cloud_scan import CloudScan

_NUSCENES_ENDING = ".pcd.bin"
# {format: names of the columns}
_KITTI = ("x", "y", "z", "intensity")
_NUSCENES = (*_KITTI, "channel")


def read_float_columns(path: Path) -> dict[str, AnyArray]:
    """Return the columns of a sweep, {name: (n,)}; the name of the file tells the format.

    ValueError if the size is not that of whole rows; OSError if the file cannot be read.
    """
    is_nuscenes = path.name.lower().endswith(_NUSCENES_ENDING)
    names = _NUSCENES if is_nuscenes else _KITTI
    data = read_input(path)
    row_size = 4 * len(names)
    if len(data) % row_size:
        other_ending = "" if is_nuscenes else f" (five, with {_NUSCENES[-1]}, as {_NUSCENES_ENDING})"
        raise ValueError(
            f"{path.name} has {len(data):,} bytes, and whole rows of {row_size} were expected: "
            f"{', '.join(names)} as float32{other_ending}"
        )
    rows = np.frombuffer(data, "<f4").reshape(-1, len(names))
    columns: dict[str, AnyArray] = dict(zip(names, rows.T.astype(np.float32), strict=True))
    if is_nuscenes:
        rings = columns["channel"]
        if not ((rings >= 0) & (rings < 1 << 16) & (rings % 1 == 0)).all():
            raise ValueError(
                f"{path.name} has numbers other than rings, 0 to 65,535, as the last of each five: "
                "it is no sweep of nuScenes"
            )
        columns["channel"] = rings.astype(np.uint16)
    return columns


def read_float_rows(path: Path) -> list[CloudScan]:
    """Read the points of a sweep; errors as of `read_float_columns`."""
    columns = read_float_columns(path)
    positions = np.stack([columns.pop(axis) for axis in "xyz"], axis=1).astype(np.float64)
    return [CloudScan(positions, columns)]
