"""Unpacking of LZF, by the format of Marc Lehmann's LibLZF."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from raybeam.compiled import compiled


@compiled()
def unpack_lzf(packed, unpacked):
    """Unpack bytes into `unpacked`, and return the number of bytes written, -1 if damaged.

    A byte below 32 announces as many literal bytes, less one. Another byte begins a copy of earlier
    bytes: its upper three bits are the length, with a further byte if all are set; the lower five
    bits and the next byte are the distance, less one.
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
            for k in range(length):  # the copy may overlap what it writes
                unpacked[written + k] = unpacked[start + k]
        written += length
    return written
