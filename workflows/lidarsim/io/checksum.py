"""CRC-32 of files, with the polynomial of ZIP: the numbers of zlib, at a multiple of its speed."""

from __future__ import annotations

from isal import isal_zlib


def crc32(data: bytes | memoryview, crc: int = 0) -> int:
    """Return the CRC-32 of bytes that follow bytes of a CRC-32, 0 at the start of a file.

    Other threads run meanwhile.
    """
    return isal_zlib.crc32(data, crc)
