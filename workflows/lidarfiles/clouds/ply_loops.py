"""Compiled loop that converts the columns of a part to rows of a PLY file."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np

from raybeam.compiled import compiled, noinline

TILE_ROWS = 512  # rows per tile, which stays in the L1 cache while all columns are written


@noinline
def _scatter(values, fields):
    for k in range(len(fields)):
        fields[k] = values[k]


@noinline
def _round_positions(cells, scale, origin, positions):
    """Compute the positions of cells, rounded in the same way as by `part_columns.cell_positions`.

    This is separate from `_scatter`, so that the compiler can vectorize the loop.
    """
    for k in range(len(positions)):
        position = cells[k] * scale.precision_m + origin
        positions[k] = np.rint(position * scale.factor) / scale.factor


@compiled()
def make_rows(columns, copied, axes, scale, rows, positions, tile):
    """Write point columns and positions to the rows of a file.

    Parameters
    ----------
    columns
        Views of the memory that contains all columns, as integers of 1 to 8 bytes (`of_1` to
        `of_8`) and as `cells`.
    copied
        One row for each column that is copied, with shape (c, 3): the size of a value in bytes, the
        index of the column's first value in the view with this size, and the offset of the field in
        a row in bytes.
    axes
        One row for each axis, with shape (3, 2): the index of the first cell, and the offset of the
        field in a row in bytes.
    scale
        `Scale` of the positions.
    rows
        Views of the memory that contains the rows, as integers of 1 to 8 bytes, indexed by row and
        byte offset. `of_4[5, 12]`, for example, is the four bytes at offset 12 in row 5. The values
        are not aligned, so they are read and written one at a time.
    positions
        View of the same memory with the type of positions in the file, indexed by row and byte
        offset.
    tile
        Temporary array for positions of this type, with shape (512,).
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
