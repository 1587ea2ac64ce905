"""Reader of point clouds in NumPy arrays (.npy).

An array contains either rows of numbers or records with the fields x, y and z.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ...columns.column_names import with_standard_names
from ...columns.sweep import Sweep
from ...errors import CutShortError
from ...io.input_files import check_input, open_input
from ...numerics.arrays import AnyArray
from ...words import printable

_EXPECTED = (
    "Expected an array (n, k) with at least three columns, or records with the fields x, y and z"
)


def read_npy_cloud(path: Path) -> list[Sweep]:
    """Read the points of a NumPy array.

    The coordinates x, y and z are the first three columns, or the fields with these names. The
    other columns are named `column_4`, `column_5` and so on. Range images of shape (rows, columns,
    3 or more) are flattened.

    Raises
    ------
    ValueError
        If the array is not a point cloud, or if the size of the file does not match the array.
    LidarError
        If the file is larger than the memory.
    OSError
        If the file cannot be read.
    """
    size = check_input(path)
    with open_input(path) as file:
        array = _read_array(file, size)
    columns: dict[str, AnyArray]
    if array.dtype.names is not None:
        columns = _fields(array.reshape(-1))
    elif array.ndim in (2, 3) and array.shape[-1] >= 3:
        rows = array.reshape(-1, array.shape[-1])
        names = ["x", "y", "z", *(f"column_{index + 1}" for index in range(3, rows.shape[1]))]
        columns = dict(zip(names, rows.T, strict=True))
    else:
        raise ValueError(f"its array has the shape {array.shape}. {_EXPECTED}")
    # Signaling NaN are invalid operations, and long doubles can overflow.
    with np.errstate(invalid="ignore", over="ignore"):
        positions = np.stack([columns.pop(axis) for axis in "xyz"], axis=1).astype(np.float64)
    return [Sweep(positions, columns)]


def _fields(records: AnyArray) -> dict[str, AnyArray]:
    """Return the fields of records as columns.

    Fields that are arrays are split into one column per element.
    """
    columns: dict[str, AnyArray] = {}
    for name in records.dtype.names or ():
        values = records[name]
        if values.ndim == 1:
            columns[name] = values
            continue
        numbers = values.reshape(len(values), -1)
        columns |= {f"{name}_{index}": column for index, column in enumerate(numbers.T)}
    columns = with_standard_names(columns, "xyz")
    if not {*"xyz"} <= columns.keys():
        raise ValueError(f"its fields are {printable(', '.join(columns))}. {_EXPECTED}")
    return columns


def _read_array(file: BinaryIO, size: int) -> AnyArray:
    """Read the array in a file of `size` bytes."""
    shape, is_fortran, kind = _read_header(file)
    if not _holds_numbers(kind):
        raise ValueError(f"its array has the type {printable(str(kind))[:80]!r}. {_EXPECTED}")
    announced = math.prod(shape) * kind.itemsize
    there = size - file.tell()
    if announced != there:
        failure = CutShortError if there < announced else ValueError
        raise failure(
            f"its array of shape {shape} requires {announced:,} bytes, but {there:,} are present"
        )
    array: AnyArray = np.frombuffer(file.read(), kind)
    array = array.astype(kind.newbyteorder("="))
    return array.reshape(shape, order="F" if is_fortran else "C")


def _read_header(file: BinaryIO) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Return the shape, Fortran-order flag and dtype of the array in a file."""
    layout: Any = np.lib.format
    readers = {(1, 0): layout.read_array_header_1_0, (2, 0): layout.read_array_header_2_0}
    start = file.read(len(layout.MAGIC_PREFIX))
    if start != layout.MAGIC_PREFIX:
        raise ValueError("its first bytes are not \\x93NUMPY, the signature of .npy files")
    version = (*file.read(2),)
    if version not in readers:
        raise ValueError(
            f"it has version {version} of the .npy format, but only 1.0 and 2.0 are supported"
        )
    try:
        shape, is_fortran, kind = readers[version](file)
    except Exception as error:  # NumPy evaluates the header as Python, which can raise any error
        if "EOF: reading" in str(error):
            raise CutShortError("its header is truncated") from error
        raise ValueError("its header does not describe an array") from error
    return shape, is_fortran, kind


def _holds_numbers(kind: np.dtype[Any]) -> bool:
    """Return whether a dtype contains only real numbers."""
    if kind.names is not None:
        return all(_holds_numbers(kind[name]) for name in kind.names)
    return kind.base.kind in "biuf"
