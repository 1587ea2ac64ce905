"""Packs columns of points for a page in one file, so that they compress well.

A column becomes whole numbers, the differences of neighbors in zigzag (0, -1, 1, -2, …), and
planes of their bytes, the lowest first. The module `ask.js` of the page unpacks them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidarsim.base.arrays import AnyArray, Bytes, Floats, Ints

_LEVELS = 4095  # levels of a column of fractions, besides NaN
_LOGARITHMIC_RATIO = 100.0  # ratio of the largest to the smallest value; above, levels are of logs
_MAX_CODE = 1 << 31  # limit for whole numbers that are packed exactly
_STEPS = 50_000  # steps of a coordinate, over the length of the points


class PackedColumn(NamedTuple):
    """A column as planes of bytes, and how its values are computed.

    The value of a code is ``base + step * code``. With `fractions`, code 0 is NaN, and the value of
    another is ``base + step * (code - 1)``; with `logarithmic`, its exponential.
    """

    planes: Bytes  # (planes * n,)
    base: float
    step: float
    fractions: bool = False
    logarithmic: bool = False


def pack_column(values: AnyArray) -> PackedColumn:
    """Pack the values (n,) of a column: whole numbers exactly, fractions in 4,095 levels."""
    if not len(values):
        return PackedColumn(np.zeros(0, np.uint8), 0.0, 1.0)
    if values.dtype.kind in "iub":
        lowest = int(values.min())
        reach = int(values.max()) - lowest
        step = max(1, -(-reach // _MAX_CODE))
        codes = (values.astype(np.int64) - lowest) // step
        return PackedColumn(planes_of(codes), float(lowest), float(step))
    finite = np.isfinite(values)
    numbers = values[finite].astype(np.float64)
    if not len(numbers):
        numbers = np.zeros(1)
    lowest_value, highest_value = float(numbers.min()), float(numbers.max())
    logarithmic = lowest_value > 0 and highest_value > _LOGARITHMIC_RATIO * lowest_value
    base, top = (
        (np.log(lowest_value), np.log(highest_value))
        if logarithmic
        else (lowest_value, highest_value)
    )
    scaled = np.log(numbers) if logarithmic else numbers
    step_size = float(top - base) / (_LEVELS - 1) or 1.0
    all_codes = np.zeros(len(values), np.int64)
    if finite.any():
        all_codes[finite] = 1 + np.round((scaled - base) / step_size).astype(np.int64)
    return PackedColumn(
        planes_of(all_codes), float(base), step_size, fractions=True, logarithmic=logarithmic
    )


def pack_positions(positions: Floats) -> tuple[PackedColumn, PackedColumn, PackedColumn]:
    """Pack positions (n, 3) in steps of a part in 50,000 of their length without outliers."""
    if not len(positions):
        nothing = PackedColumn(np.zeros(0, np.uint8), 0.0, 1.0)
        return nothing, nothing, nothing
    length_m = float(np.ptp(np.percentile(positions, [0.5, 99.5], axis=0), axis=0).max())
    step = max(length_m / _STEPS, float(np.ptp(positions, axis=0).max()) / _MAX_CODE, 1e-9)
    x, y, z = (_pack_axis(values, step) for values in positions.T)
    return x, y, z


def _pack_axis(values: Floats, step: float) -> PackedColumn:
    base = float(values.min())
    return PackedColumn(planes_of(np.round((values - base) / step).astype(np.int64)), base, step)


def planes_of(codes: Ints) -> Bytes:
    """Return the planes of bytes of the zigzag differences of codes (n,).

    Examples
    --------
    >>> planes_of(np.array([0, 3, 2, 300]))
    array([ 0,  6,  1, 84,  0,  0,  0,  2], dtype=uint8)
    """
    steps = np.diff(codes, prepend=0)
    zigzag = (steps << 1) ^ (steps >> 63)
    count = max(1, (int(zigzag.max(initial=0)).bit_length() + 7) // 8)
    planes = [(zigzag >> (8 * number) & 255).astype(np.uint8) for number in range(count)]
    return np.concatenate(planes)
