"""LZF decompression, compatible with Marc Lehmann's LibLZF."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from raybeam.compiled import compiled


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
