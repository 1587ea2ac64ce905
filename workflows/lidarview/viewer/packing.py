"""Pack point columns for a page into a single file that compresses well.

The values of a column are mapped to integers. The differences between neighbors are zigzag-encoded
(0, -1, 1, -2, … become 0, 1, 2, 3, …) and stored as byte planes, the lowest byte first. The page
unpacks them in `ask.js`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidarsim.numerics.arrays import AnyArray, Bytes, Floats, Ints

_LEVELS = 4095  # levels of a floating-point column, in addition to NaN
_LOGARITHMIC_RATIO = 100.0  # levels are logarithmic above this ratio of the largest to the smallest
_MAX_CODE = 1 << 31  # integers up to this span are packed exactly
_STEPS = 50_000  # steps along the longest side of the points


class PackedColumn(NamedTuple):
    """A column as byte planes, with the parameters to restore its values.

    A code represents the value ``base + step * code``. If `fractions` is set, code 0 represents
    NaN, and any other code represents ``base + step * (code - 1)``. If `logarithmic` is set as
    well, the result is the natural logarithm of the value.
    """

    planes: Bytes  # (planes * n,)
    base: float
    step: float
    fractions: bool = False
    logarithmic: bool = False


def pack_column(values: AnyArray) -> PackedColumn:
    """Pack the values of a column.

    Integers are stored exactly unless their span exceeds 2**31. Floating-point values are quantized
    to 4,095 levels.
    """
    if not len(values):
        return PackedColumn(np.zeros(0, np.uint8), 0.0, 1.0)
    if values.dtype.kind in "iub":
        lowest = int(values.min())
        reach = int(values.max()) - lowest
        step = max(1, -(-reach // _MAX_CODE))
        codes = (values.astype(np.int64) - lowest) // step
        return PackedColumn(byte_planes(codes), float(lowest), float(step))
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
        byte_planes(all_codes), float(base), step_size, fractions=True, logarithmic=logarithmic
    )


def pack_positions(positions: Floats) -> tuple[PackedColumn, PackedColumn, PackedColumn]:
    """Pack the x, y, and z coordinates of positions.

    The step is 1/50,000 of the longest side of the points, ignoring outliers.
    """
    if not len(positions):
        nothing = PackedColumn(np.zeros(0, np.uint8), 0.0, 1.0)
        return nothing, nothing, nothing
    length_m = float(np.ptp(np.percentile(positions, [0.5, 99.5], axis=0), axis=0).max())
    step = max(length_m / _STEPS, float(np.ptp(positions, axis=0).max()) / _MAX_CODE, 1e-9)
    x, y, z = (_pack_axis(values, step) for values in positions.T)
    return x, y, z


def _pack_axis(values: Floats, step: float) -> PackedColumn:
    base = float(values.min())
    return PackedColumn(byte_planes(np.round((values - base) / step).astype(np.int64)), base, step)


def byte_planes(codes: Ints) -> Bytes:
    """Return the byte planes of the zigzag-encoded differences between neighboring codes.

    Examples
    --------
    >>> byte_planes(np.array([0, 3, 2, 300]))
    array([ 0,  6,  1, 84,  0,  0,  0,  2], dtype=uint8)
    """
    steps = np.diff(codes, prepend=0)
    zigzag = (steps << 1) ^ (steps >> 63)
    count = max(1, (int(zigzag.max(initial=0)).bit_length() + 7) // 8)
    planes = [(zigzag >> (8 * number) & 255).astype(np.uint8) for number in range(count)]
    return np.concatenate(planes)
