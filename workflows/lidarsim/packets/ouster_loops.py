"""Compiled loops that compute the pixels and checksums of Ouster packets (ouster.py)."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from functools import cache

import numpy as np

from raybeam.compiled import compiled

from ..numerics.arrays import UInts64

# Layouts of a pixel in 32-bit words, with the lowest bits first and sizes in bits in brackets.
SINGLE, DUAL, LOW_RATE = range(3)
# SINGLE    range [up to 20] | reflectivity [8], 8 unused, signal [16] | near infrared [16]
# DUAL      range [19], reflectivity [8 from 24] | the same for the second return
#           | signal [16], signal of the second return [16] | near infrared [16]
# LOW_RATE  range [15], reflectivity [8 from 16], near infrared [8]

_POLYNOMIAL = np.uint64(0xC96C5795D7870F42)  # ECMA-182 polynomial, lowest bit first
_ALL_BITS = np.uint64(0xFFFF_FFFF_FFFF_FFFF)
_BYTE = np.uint64(255)


@compiled()
def write_pixels(returns, valid, layout, units, pixels):
    """Write the returns of columns to `pixels`.

    `pixels` (packets, 16, c, words) is a uint32 array that the caller has filled with zeros.
    `returns` is a `ReturnImages`, and `units` a `RangeUnits`. Only `valid` columns (packets, 16)
    are written. If there are two returns, the one with the stronger signal is first, or the nearer
    one if the signals are equal.
    """
    range_m = returns.range_m
    planes, count, channels = range_m.shape
    size = valid.shape[1]
    for n in range(count):
        packet = n // size
        column = n % size
        if not valid[packet, column]:
            continue
        for c in range(channels):
            first = np.int64(0)
            if layout == DUAL and planes > 1 and range_m[1, n, c] > 0:
                first = np.int64(returns.signal[1, n, c] > returns.signal[0, n, c])
            written = 0
            for k in range(planes if layout == DUAL else 1):
                plane = first ^ k
                meters = range_m[plane, n, c]
                number = np.rint((meters * 1000.0 + units.offset_mm) / units.unit_mm)
                if not (meters > 0 and number <= units.max_number):  # also False for NaN
                    continue
                distance = np.uint32(number)
                reflectivity = np.uint32(returns.reflectivity[plane, n, c])
                signal = np.uint32(returns.signal[plane, n, c])
                if layout == SINGLE:
                    pixels[packet, column, c, 0] = distance
                    pixels[packet, column, c, 1] = reflectivity | signal << np.uint32(16)
                elif layout == DUAL:
                    pixels[packet, column, c, written] = distance | reflectivity << np.uint32(24)
                    pixels[packet, column, c, 2] |= signal << np.uint32(16 * written)
                else:
                    pixels[packet, column, c, 0] = distance | reflectivity << np.uint32(16)
                written = written + 1


@cache
def remainders() -> UInts64:
    """Return the CRC remainders of each byte value followed by 0 to 7 zero bytes.

    The result has shape (8, 256).
    """
    tables = np.zeros((8, 256), np.uint64)
    remainder = np.arange(256, dtype=np.uint64)
    for _ in range(8):
        odd = remainder & np.uint64(1)
        remainder = (remainder >> np.uint64(1)) ^ (odd * _POLYNOMIAL)
    tables[0] = remainder
    for zeros in range(1, 8):
        previous = tables[zeros - 1]
        tables[zeros] = (previous >> np.uint64(8)) ^ tables[0][previous & _BYTE]
    return tables


@compiled()
def checksums(words, tables, sums):
    """Write the CRC-64 (ECMA-182) of each packet in `words` to `sums`.

    `words` (n, k) are little-endian uint64. Eight bytes are processed at a time ("slicing by
    eight", Kounavis and Berry 2005) with the `tables` from `remainders`.
    """
    for row in range(words.shape[0]):
        crc = _ALL_BITS
        for k in range(words.shape[1]):
            crc ^= words[row, k]
            crc = (
                tables[7, crc & _BYTE]
                ^ tables[6, (crc >> np.uint64(8)) & _BYTE]
                ^ tables[5, (crc >> np.uint64(16)) & _BYTE]
                ^ tables[4, (crc >> np.uint64(24)) & _BYTE]
                ^ tables[3, (crc >> np.uint64(32)) & _BYTE]
                ^ tables[2, (crc >> np.uint64(40)) & _BYTE]
                ^ tables[1, (crc >> np.uint64(48)) & _BYTE]
                ^ tables[0, crc >> np.uint64(56)]
            )
        sums[row] = crc ^ _ALL_BITS
