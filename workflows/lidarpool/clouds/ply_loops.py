"""The loop that makes rows of a PLY file from the columns of a part."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np

from raybeam.compiled import compiled, noinline

TILE_ROWS = 512  # rows at a time: they stay in the first cache while all columns are written


@noinline
def _scatter(values, fields):
    """Write values (n,) into a field of n rows."""
    for k in range(len(fields)):
        fields[k] = values[k]


@noinline
def _round_positions(cells, scale, origin, positions):
    """Write the positions of cells (n,), rounded as by `part_columns.positions_of`.

    Apart from `_scatter`: so several positions are computed by one instruction.
    """
    for k in range(len(positions)):
        position = cells[k] * scale.precision_m + origin
        positions[k] = np.rint(position * scale.factor) / scale.factor


@compiled()
def make_rows(columns, copied, axes, scale, rows, positions, tile):
    """Write columns and positions of points into the rows of a file.

    Parameters
    ----------
    columns
        Memory of all columns as numbers of each size in bytes, `of_1` to `of_8`, and as `cells`.
    copied
        (c, 3), for each column that is copied: size of a value in bytes; index of the column's
        first value among the numbers of this size; and offset of the field in a row, bytes.
    axes
        (3, 2), for each axis: index of the first cell, and offset of the field in a row, bytes.
    scale
        `Scale` of the positions.
    rows
        Memory of the rows as numbers of each size, (rows, offsets in bytes) each: `of_4[5, 12]` are
        the four bytes at offset 12 of row 5. They are read and written one by one, since they are
        not aligned.
    positions
        The same memory as numbers of the type of positions in the file, (rows, offsets).
    tile
        (512,), memory for positions in this type.
    """
    for start in range(0, len(positions), len(tile)):
        stop = min(start + len(tile), len(positions))
        for c in range(len(copied)):
            size = copied[c, 0]
            first = copied[c, 1] + start
            last = copied[c, 1] + stop
            offset = copied[c, 2]
            if size == 4:
                _scatter(columns.of_4[first:last], rows.of_4[start:stop, offset])
            elif size == 2:
                _scatter(columns.of_2[first:last], rows.of_2[start:stop, offset])
            elif size == 1:
                _scatter(columns.of_1[first:last], rows.of_1[start:stop, offset])
            else:
                _scatter(columns.of_8[first:last], rows.of_8[start:stop, offset])
        for a in range(3):
            first = axes[a, 0] + start
            last = axes[a, 0] + stop
            rounded = tile[: stop - start]
            _round_positions(columns.cells[first:last], scale, scale.origin[a], rounded)
            _scatter(rounded, positions[start:stop, axes[a, 1]])
