"""Decompression of Draco meshes in glTF files with DracoPy."""

from __future__ import annotations

import re
import struct
from typing import Any

from ...io.allowance import Allowance
from .scene_graph import MeshFileError

DRACO = "KHR_draco_mesh_compression"


def decompress_draco(data: bytes, allowance: Allowance) -> Any:
    """Decompress a Draco mesh."""
    try:
        import DracoPy
    except ImportError as error:
        raise MeshFileError(
            f"is compressed with {DRACO}. Install DracoPy, or export it without compression"
        ) from error
    allowance.reserve(24 * sum(_draco_counts(data)))
    return DracoPy.decode(data)


def _draco_counts(data: bytes) -> tuple[int, int]:
    """Return the face and vertex counts that the header of a Draco 2.2 mesh declares.

    The decoder allocates memory according to these counts, and even a small file can declare
    arbitrarily large ones.
    """
    magic, version, kind, method, flags = struct.unpack_from("<5sHBBH", data)
    if magic != b"DRACO" or kind != 1 or method > 1:
        raise ValueError("its Draco data is not a mesh")
    if version != 0x0202 or flags & 0x8000:
        raise MeshFileError(
            "has Draco data with metadata or with a version other than 2.2, which is not "
            "supported. Export it again"
        )
    # The numbers are stored with seven bits per byte, least significant byte first. The second
    # encoding method has an additional byte before them.
    first, second = re.findall(rb"(?s)[\x80-\xff]*[\0-\x7f]", data[11 + method : 31])[:2]
    return _varint(first), _varint(second)


def _varint(data: bytes) -> int:
    """Decode an integer that is stored with seven bits per byte, least significant byte first."""
    return sum((byte & 0x7F) << 7 * position for position, byte in enumerate(data))
