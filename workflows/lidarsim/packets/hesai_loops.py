"""Compiled loop that computes the checksums of Hesai packets (hesai.py)."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from raybeam.compiled import compiled

_POLYNOMIAL = np.uint32(0x04C11DB7)  # highest bit first
_ALL_BITS = np.uint32(0xFFFF_FFFF)
_HIGHEST_BIT = np.uint32(0x8000_0000)


def remainders() -> NDArray[np.uint32]:
    """Return the CRC remainders of all 256 byte values."""
    remainder = np.arange(256, dtype=np.uint32) << np.uint32(24)
    for _ in range(8):
        carry = (remainder & _HIGHEST_BIT) >> np.uint32(31)
        remainder = (remainder << np.uint32(1)) ^ (carry * _POLYNOMIAL)
    return remainder


@compiled()
def checksums(contents, table, sums):
    """Write the CRC-32/MPEG-2 of each row of `contents` to `sums`.

    `contents` has shape (n, k), `sums` has shape (n,), and `table` is the result of `remainders`.
    """
    for row in range(contents.shape[0]):
        crc = _ALL_BITS
        for k in range(contents.shape[1]):
            highest = (crc >> np.uint32(24)) ^ np.uint32(contents[row, k])
            # numba widens shifted numbers to 64 bits.
            crc = np.uint32((crc << np.uint32(8)) & _ALL_BITS) ^ table[highest]
        sums[row] = crc
