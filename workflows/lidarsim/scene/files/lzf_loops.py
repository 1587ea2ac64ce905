"""LZF compression and decompression, compatible with Marc Lehmann's LibLZF."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np

from raybeam.compiled import compiled

_TABLE_BITS = 14
_MAX_DISTANCE = 1 << 13
_MAX_LENGTH = 264
_MAX_LITERALS = 32


@compiled()
def unpack_lzf(packed, unpacked):
    """Decompress data and return the number of bytes written, or -1 if the data is corrupt.

    A control byte below 32 is the number of literal bytes that follow, minus one. Any other control
    byte starts a copy of earlier output. Its upper three bits are the length minus two, to which an
    additional byte is added if all three bits are set. Its lower five bits and the next byte are
    the distance minus one.
    """
    read = 0
    written = 0
    while read < packed.size:
        control = int(packed[read])
        read += 1
        if control < 32:
            length = control + 1
            if read + length > packed.size or written + length > unpacked.size:
                return -1
            for k in range(length):
                unpacked[written + k] = packed[read + k]
            read += length
        else:
            length = control >> 5
            if length == 7 and read < packed.size:
                length += int(packed[read])
                read += 1
            if read >= packed.size:
                return -1
            start = written - ((control & 31) << 8) - int(packed[read]) - 1
            read += 1
            length += 2
            if start < 0 or written + length > unpacked.size:
                return -1
            for k in range(length):  # source and destination of the copy can overlap
                unpacked[written + k] = unpacked[start + k]
        written += length
    return written


def packed_limit(size: int) -> int:
    """Return the maximum size of compressed data in bytes."""
    return size + size // _MAX_LITERALS + 2


@compiled()
def pack_lzf(unpacked, packed):  # noqa: C901, PLR0915 - a compiled loop
    """Compress data and return the number of bytes written.

    `packed` must have room for `packed_limit` bytes. Copies refer to the last position at which the
    same three bytes occurred.
    """
    positions = np.full(1 << _TABLE_BITS, -1, np.int64)
    size = unpacked.size
    read = 0
    written = 0
    literals = 0  # position of the first byte that is not written yet
    while read < size:
        length = 0
        candidate = -1
        if read + 2 < size:
            key = int(unpacked[read]) << 16 | int(unpacked[read + 1]) << 8 | int(unpacked[read + 2])
            slot = (key * 2654435761 >> 16) & ((1 << _TABLE_BITS) - 1)
            candidate = positions[slot]
            positions[slot] = read
            if candidate >= 0 and read - candidate <= _MAX_DISTANCE:
                limit = min(size - read, _MAX_LENGTH)
                while length < limit and unpacked[candidate + length] == unpacked[read + length]:
                    length += 1
        if length < 3:
            read += 1
            if read < size:
                continue
        stop = read
        while literals < stop:
            count = min(stop - literals, _MAX_LITERALS)
            packed[written] = count - 1
            written += 1
            for k in range(count):
                packed[written + k] = unpacked[literals + k]
            written += count
            literals += count
        if length >= 3:
            distance = read - candidate - 1
            if length < 9:
                packed[written] = (length - 2) << 5 | distance >> 8
            else:
                packed[written] = 7 << 5 | distance >> 8
                written += 1
                packed[written] = length - 9
            packed[written + 1] = distance & 255
            written += 2
            read += length
            literals = read
    return written
