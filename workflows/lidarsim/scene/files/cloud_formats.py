"""Mapping from file extensions to readers of point cloud files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from ...columns.sweep import Sweep
from .float_rows import read_float_rows
from .npy_cloud import read_npy_cloud
from .pcd import read_pcd
from .pts import read_pts
from .ptx import read_ptx
from .text_cloud import read_text_cloud

# {extension: reader, which raises ValueError if a file is invalid}
SCAN_READERS: dict[str, Callable[[Path], list[Sweep]]] = {
    ".pcd": read_pcd,
    ".xyz": read_text_cloud,
    ".txt": read_text_cloud,
    ".asc": read_text_cloud,
    ".csv": read_text_cloud,
    ".pts": read_pts,
    ".ptx": read_ptx,
    ".npy": read_npy_cloud,
    ".bin": read_float_rows,
}
