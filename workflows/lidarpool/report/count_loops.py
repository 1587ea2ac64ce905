"""Loops that count points of a cloud by their positions and labels."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np

from raybeam.compiled import compiled, noinline

# Added to coordinates, in binary 101…0101. Multiples of no power of two are near it, so that no
# grid has a boundary at zero, where walls often are: their points would be in two rows.
SHIFT = 0x15555555
_SHIFT = np.int32(SHIFT)
_TILE = 1024  # points at a time: their indices stay in the first cache


@noinline
def _find_parts(cells, level, bits, indices):
    """Append the number of the part of an axis that contains each cell to the bits of an index."""
    mask = np.int32((1 << bits) - 1)
    shift = np.int32(level)
    wide = np.uint32(bits)
    for k in range(len(indices)):
        # A sum beyond 32 bits differs in bits that are not used.
        number = (np.int32(cells[k] + _SHIFT) >> shift) & mask
        indices[k] = np.uint32(indices[k] << wide) | np.uint32(number)


@compiled()
def count_cells(x, y, level, bits, counts):
    """Count points by their cells along the axes, (n,) int32 each, in a grid (`GridCounts`).

    `counts` have two axes, x and y, with 2^`bits` parts along each.
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
    """Count points by labels (n,), whole numbers, and return the number of labels below 0.

    Labels beyond the counts are not counted.
    """
    last = np.int64(-1)
    repeats = 0  # of the last label: neighbors are often of the same object
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
