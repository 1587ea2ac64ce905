"""Layout of the binary PLY files in which lidarpool stores point clouds.

A file consists of a header and one row per point.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..errors import LidarError, explain_os_errors
from ..io.input_files import open_input
from ..numerics.arrays import AnyArray, Records
from .table import Column

AXES = ("x", "y", "z")

_MAGIC = "ply\nformat binary_little_endian 1.0\n"
_HEADER_LIMIT = 65_536
_COMMENTS_LIMIT = 1 << 25
_PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "<i2", "int16": "<i2", "ushort": "<u2", "uint16": "<u2",
    "int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4",
    "float": "<f4", "float32": "<f4", "double": "<f8", "float64": "<f8",
}  # fmt: skip


# {type of a column: type in files}. A file uses only types that Open3D writes, which may be wider
# than the type of the column.
_FILE_TYPES = {
    "u1": "u1", "u2": "<u2", "i1": "<i4", "i2": "<i4", "i4": "<i4", "f4": "<f4", "f8": "<f8",
    "u4": "<f8", "i8": "<f8", "u8": "<f8",
}  # fmt: skip
_NAMES = {"<f4": "float", "<f8": "double", "<i4": "int", "<u2": "uint16", "|u1": "uchar"}
_EXACT = 2**53  # integers up to this limit are exact in double precision


class PlyLayout(NamedTuple):
    """Layout of the points in a PLY file."""

    start: int  # offset of the first point, bytes
    points: int  # number of points
    row: np.dtype[np.void]  # dtype of a row


def file_type(column: Column) -> np.dtype[Any]:
    """Return the dtype in which a column is stored in a file."""
    return np.dtype(_FILE_TYPES.get(np.dtype(column.dtype).str[1:], "<f8"))


def as_file_type(column: Column, values: AnyArray) -> AnyArray:
    """Convert column values to the dtype in which the column is stored in a file.

    Raises
    ------
    LidarError
        If a value cannot be represented exactly.
    """
    dtype = file_type(column)
    if dtype == np.float64 and values.dtype.kind in "iu" and len(values):
        largest = max(abs(int(values.min())), abs(int(values.max())))
        if largest > _EXACT:
            raise LidarError(
                f"Column {column.name!r} contains {largest}, but PLY files store whole numbers "
                f"exactly only up to {_EXACT}. Omit the column."
            )
    return values.astype(dtype, copy=False)


def row_type(position_type: np.dtype[np.floating], table: Sequence[Column]) -> np.dtype[np.void]:
    """Return the dtype of a file row for the columns of a table, in table order.

    Rows written by Open3D have the same size, but the columns are in the order of a hash table.
    """
    kind = "<f8" if position_type == np.float64 else "<f4"
    return np.dtype([(axis, kind) for axis in AXES] + [(c.in_files, file_type(c)) for c in table])


def header(row: np.dtype[np.void], count: int, comments: str = "") -> bytes:
    """Return the header of a file with `count` points, in the format that Open3D writes.

    `comments` contains additional comment lines, each of which ends with a newline.
    """
    lines = [f"property {_NAMES[row[name].str]} {name}" for name in row.names or ()]
    lines = ["comment Created by Open3D", f"{comments}element vertex {count}", *lines]
    return (_MAGIC + "\n".join([*lines, "end_header\n"])).encode()


def layout(path: Path) -> PlyLayout:
    """Return the layout of the points in a PLY file.

    Raises
    ------
    OSError
        If the file cannot be read.
    ValueError
        If the file is not a complete binary PLY file written by lidarpool. The message is a clause.
    """
    with open_input(path) as file:
        size = os.fstat(file.fileno()).st_size
        data = file.read(_HEADER_LIMIT)
        if b"end_header\n" not in data:  # the header may list many class names
            data += file.read(_COMMENTS_LIMIT)
    head, end_marker, _ = data.partition(b"end_header\n")
    text = head.decode("ascii", errors="replace")
    if not end_marker or not text.startswith(_MAGIC):
        raise ValueError("it has no binary little-endian PLY header")
    count, dtype = _parse_header(text)
    start = len(head) + len(end_marker)
    announced = start + count * dtype.itemsize
    if size != announced:
        raise ValueError(
            f"{count:,} points in {announced:,} bytes were expected, but there are {size:,} bytes"
        )
    return PlyLayout(start, count, dtype)


def map_rows(path: Path) -> Records:
    """Memory-map the points of a PLY file as rows.

    Raises
    ------
    LidarError
        If the file cannot be read or is not a complete binary PLY file written by lidarpool.
    """
    try:
        with explain_os_errors(f"{path} cannot be read"):
            start, count, dtype = layout(path)
            # An empty file cannot be mapped.
            return np.memmap(path, dtype, "r", start, (count,)) if count else np.empty(0, dtype)
    except ValueError as error:
        raise LidarError(f"{path} is not a point cloud written by lidarpool: {error}.") from error


def _parse_header(text: str) -> tuple[int, np.dtype[np.void]]:
    """Return the number and dtype of the rows that a header describes.

    Raise ValueError if the header was not written by lidarpool.
    """
    elements = [line.split() for line in text.splitlines() if line.startswith("element")]
    properties = [line.split() for line in text.splitlines() if line.startswith("property")]
    if len(elements) != 1 or elements[0][1] != "vertex" or not elements[0][-1].isdigit():
        raise ValueError("it contains elements other than points, or no points")
    if any(len(entry) != 3 or entry[1] not in _PLY_TYPES for entry in properties):
        raise ValueError("it has list properties or unknown data types")
    dtype = np.dtype([(name, _PLY_TYPES[kind]) for _, kind, name in properties])
    missing = {*AXES} - set(dtype.names or ())
    if missing:
        raise ValueError(f"it lacks {', '.join(sorted(missing))}")
    return int(elements[0][-1]), dtype
