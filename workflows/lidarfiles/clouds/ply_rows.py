"""Conversion of part columns to rows of a PLY file, in a single compiled pass."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from lidarsim.columns.part_columns import position_decimals
from lidarsim.columns.ply_format import as_file_type
from lidarsim.columns.table import AXES, Column
from lidarsim.numerics.arrays import AnyArray, Floats, Ints32

from ..parts.part_blocks import BlockMemory
from .ply_loops import TILE_ROWS, make_rows

_SIZES = (1, 2, 4, 8)  # sizes of integers in bytes


class Scale(NamedTuple):
    """Conversion of cells to positions.

    A position is `round((cell * precision_m + origin) * factor) / factor`.
    """

    precision_m: float  # size of a cell in meters
    origin: Floats  # (3,): position of the cell (0, 0, 0) in world coordinates, in meters
    factor: float  # power of ten that determines the number of decimals


class _Columns(NamedTuple):
    """Columns in memory, viewed as integers of 1, 2, 4 and 8 bytes."""

    of_1: AnyArray
    of_2: AnyArray
    of_4: AnyArray
    of_8: AnyArray
    cells: Ints32


class _Rows(NamedTuple):
    """Rows in memory, viewed as integers of 1, 2, 4 and 8 bytes.

    Each view is indexed by the row and by the byte offset in the row.
    """

    of_1: AnyArray
    of_2: AnyArray
    of_4: AnyArray
    of_8: AnyArray


class PlyRowEncoder:
    """Encoder that creates rows of a PLY file in reused memory.

    Columns that have a different type in the file are converted by NumPy.

    Parameters
    ----------
    row
        Type of a row.
    table
        Columns in addition to the positions.
    memory
        Memory that contains the columns.
    precision_m
        Size of a cell in meters.
    origin
        Position of the cell (0, 0, 0) in world coordinates, in meters. Shape (3,).
    """

    def __init__(
        self,
        row: np.dtype[np.void],
        table: Sequence[Column],
        memory: BlockMemory,
        precision_m: float,
        origin: Floats,
    ) -> None:
        copied = [column for column in table if np.dtype(column.dtype) == row[column.in_files]]
        self._converted = [column for column in table if column not in copied]
        sizes = [np.dtype(column.dtype).itemsize for column in copied]
        copies = [
            (size, memory.starts[column.name] // size, _offset(row, column.in_files))
            for column, size in zip(copied, sizes, strict=True)
        ]
        self._copied = np.array(copies, np.int64).reshape(-1, 3)
        axes = [(memory.starts[axis.name] // 4, _offset(row, axis.name)) for axis in AXES]
        self._axes = np.array(axes, np.int64)
        self._columns = _Columns(
            memory.data,
            memory.data.view(np.uint16),
            memory.data.view(np.uint32),
            memory.data.view(np.uint64),
            memory.data.view(np.int32),
        )
        factor = float(10 ** position_decimals(precision_m))
        self._scale = Scale(float(precision_m), np.array(origin, np.float64), factor)
        self._rows = np.zeros(memory.max_rows, row)
        self._fields = [self._fields_of(np.dtype(f"u{size}")) for size in _SIZES]
        self._positions = self._fields_of(row[AXES[0].name])
        self._tile = np.zeros(TILE_ROWS, self._positions.dtype)

    def _fields_of(self, dtype: np.dtype[Any]) -> AnyArray:
        """Return a view in which values of a dtype can start at any byte of a row.

        The view is indexed by the row and by the byte offset in the row.
        """
        row_bytes = self._rows.itemsize
        shape = (len(self._rows), row_bytes - dtype.itemsize + 1)
        return np.ndarray(shape, dtype, self._rows.view(np.uint8), strides=(row_bytes, 1))

    def encode(self, columns: Mapping[str, AnyArray]) -> memoryview:
        """Encode the rows of a block as bytes.

        The bytes are valid until the next call.

        Parameters
        ----------
        columns
            Columns of the block by name, which are views of the memory.

        Raises
        ------
        LidarError
            If a value is out of range for its type in the file.
        """
        count = len(columns[AXES[0].name])
        rows = self._rows[:count]
        fields = _Rows(*(numbers[:count] for numbers in self._fields))
        positions = self._positions[:count]
        make_rows(
            self._columns, self._copied, self._axes, self._scale, fields, positions, self._tile
        )
        for column in self._converted:
            rows[column.in_files] = as_file_type(column, columns[column.name])
        return rows.data.cast("B")


def _offset(row: np.dtype[np.void], name: str) -> int:
    assert row.fields is not None, "named fields"
    return row.fields[name][1]
