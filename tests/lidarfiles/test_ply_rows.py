"""Rows of a PLY file that a compiled loop makes are those that NumPy makes."""

from __future__ import annotations

import numpy as np
import pytest

from lidarfiles.clouds.ply_rows import PlyRowEncoder
from lidarfiles.parts.part_blocks import BlockMemory
from lidarsim import Column, LidarError
from lidarsim.columns.part_columns import cell_positions
from lidarsim.columns.ply_format import as_file_type, row_type
from lidarsim.columns.table import AXES, OPTIONAL, SCAN, TABLE

TYPES = ["u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f2", "f4", "f8"]
OF_ALL_TYPES = tuple(Column(f"of_{name}", name, "", "") for name in TYPES)
TABLES = {
    "none": (),
    "usual": (SCAN, TABLE["channel"], TABLE["object"], TABLE["range"], TABLE["intensity"]),
    "all": (SCAN, TABLE["channel"], TABLE["object"], *OPTIONAL),
    "all types": OF_ALL_TYPES,
}


def filled_memory(table, rows: int, max_cell: int) -> BlockMemory:
    """Memory with any columns, also with NaN and the farthest cells."""
    chance = np.random.default_rng(rows)
    memory = BlockMemory((*AXES, *table), rows)
    for name, values in memory.columns(rows).items():
        if name in "xyz":
            values[:] = chance.integers(-max_cell, max_cell, rows)
            values[: min(rows, 3)] = [0, -max_cell, max_cell - 1][: min(rows, 3)]
        elif values.dtype.kind == "f":
            values[:] = chance.normal(0, 100, rows)
            values[::5] = np.nan
        else:
            limit = min(np.iinfo(values.dtype).max, 2**53)
            values[:] = chance.integers(0, limit, rows, endpoint=True)
    return memory


def expected_rows(row, table, columns, precision_m, origin) -> np.ndarray:
    """Rows, field by field."""
    rows = np.empty(len(columns["x"]), row)
    for i, axis in enumerate("xyz"):
        rows[axis] = cell_positions(columns[axis], precision_m, origin[i])
    for column in table:
        rows[column.in_files] = as_file_type(column, columns[column.name])
    return rows


@pytest.mark.parametrize("position_type", ["f4", "f8"])
@pytest.mark.parametrize("table", TABLES)
@pytest.mark.parametrize("rows", [1, 511, 512, 2000])
def test_rows_are_numpys(position_type, table, rows):
    """Also of a block that does not fill the memory, and in the order of another program."""
    memory = filled_memory(TABLES[table], rows, 2**31)
    origin = np.array([512_345.5, 0.0, -7.25])
    given = row_type(np.dtype(position_type), TABLES[table])
    names = [*given.names[:3], *reversed(given.names[3:])]
    row = np.dtype([(name, given[name]) for name in names])
    encoder = PlyRowEncoder(row, TABLES[table], memory, 0.01, origin)
    for count in (rows, max(1, rows // 2)):
        columns = memory.columns(count)
        expected = expected_rows(row, TABLES[table], columns, 0.01, origin)
        assert bytes(encoder.encode(columns)) == expected.tobytes()


@pytest.mark.parametrize(
    "precision_m", [1e-9, 1e-6, 1e-4, 0.001, 0.002, 0.0123, 0.07, 0.5, 3.0, 1e4]
)
@pytest.mark.parametrize("origin_m", [0.0, 1 / 3, -5_403_210.123])
def test_positions_are_numpys_at_any_precision(precision_m, origin_m):
    memory = filled_memory((), 3000, 2**31)
    row = row_type(np.dtype(np.float64), ())
    origin = np.array([origin_m, -origin_m, 2 * origin_m])
    encoder = PlyRowEncoder(row, (), memory, precision_m, origin)
    columns = memory.columns(3000)
    expected = expected_rows(row, (), columns, precision_m, origin)
    assert bytes(encoder.encode(columns)) == expected.tobytes()


def test_a_number_that_a_file_cannot_hold_is_refused():
    table = (TABLE["time"],)
    memory = filled_memory(table, 5, 100)
    columns = memory.columns(5)
    columns["time"][3] = 2**53 + 1
    encoder = PlyRowEncoder(row_type(np.dtype(np.float32), table), table, memory, 0.01, np.zeros(3))
    with pytest.raises(LidarError, match="'time' contains 9007199254740993"):
        encoder.encode(columns)
