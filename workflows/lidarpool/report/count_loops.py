"""Compiled loops that count points by position and by label."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np

from raybeam.compiled import compiled, noinline

# Added to cells, so that no grid has a boundary at zero. Walls are often at zero, and noise would
# spread their points over two rows of squares. The binary digits of the number are 1010…0101, so it
# is not close to a multiple of any large power of two.
SHIFT = 0x15555555
_SHIFT = np.int32(SHIFT)
_TILE = 1024  # points per iteration, so that their indices stay in the L1 cache


@noinline
def _find_parts(cells, level, bits, indices):
    """Update the indices of the squares that contain cells with the positions along one axis.

    The number of the square along the axis is appended to the bits of its index.
    """
    mask = np.int32((1 << bits) - 1)
    shift = np.int32(level)
    wide = np.uint32(bits)
    for k in range(len(indices)):
        # An integer overflow only affects bits that the mask removes.
        number = (np.int32(cells[k] + _SHIFT) >> shift) & mask
        indices[k] = np.uint32(indices[k] << wide) | np.uint32(number)


@compiled()
def count_cells(x, y, level, bits, counts):
    """Count the points in each square of a grid, as `GridCounts` describes.

    `x` and `y` are the cells of the points along each axis, int32 arrays with shape (n,). `counts`
    is updated in place and has shape (2**bits, 2**bits).
    """
    flat = counts.reshape(-1)
    indices = np.empty(_TILE, np.uint32)
    for start in range(0, len(x), _TILE):
        stop = min(start + _TILE, len(x))
        tile = indices[: stop - start]
        tile[:] = 0
        _find_parts(x[start:stop], level, bits, tile)
        _find_parts(y[start:stop], level, bits, tile)
        for k in range(len(tile)):
            flat[tile[k]] += 1


@compiled()
def count_labels(labels, counts):
    """Count the points that have each label, and return the number of negative labels.

    `labels` is an integer array with shape (n,). `counts` is updated in place. Labels that exceed
    its length are ignored.
    """
    last = np.int64(-1)
    repeats = 0  # consecutive points often have the same label
    negative = 0
    for k in range(len(labels)):
        label = np.int64(labels[k])
        if label == last:
            repeats += 1
            continue
        if 0 <= last < len(counts):
            counts[last] += repeats
        elif last < 0:
            negative += repeats
        last = label
        repeats = 1
    if 0 <= last < len(counts):
        counts[last] += repeats
    elif last < 0:
        negative += repeats
    return negative
