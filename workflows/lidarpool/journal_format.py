"""What the records of a journal hold: JSON for a header, numbers for points."""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .identity import Identity
from .records import Buffer
from .scan.messages import POINT

FORMAT = 1

HEADER, POINTS, TRIAL = 1, 2, 3  # kinds of records

# What reading may raise of bytes that are not what they should be.
UNREADABLE = (
    ValueError, KeyError, TypeError, IndexError, AttributeError,
    OverflowError, RecursionError, struct.error,
)  # fmt: skip

_COUNT = struct.Struct("<I")


def pack_header(backend: str, identity: Identity) -> bytes:
    """Header of a journal whose scans are cast with `backend`."""
    header = {"format": FORMAT, "backend": backend, "identity": identity.to_data()}
    return json.dumps(header).encode()


def unpack_header(data: Buffer) -> tuple[int, str, Identity | None]:
    """Format, backend and identity of a header; the latter two only if the format is ours.

    Raises
    ------
    One of `UNREADABLE`
        If it is no header.
    """
    header = json.loads(bytes(data))
    if header["format"] != FORMAT:
        return header["format"], "", None
    return FORMAT, str(header["backend"]), Identity.from_data(header["identity"])


def pack_points(
    scans: Sequence[int], counts: Sequence[int], points: NDArray[Any]
) -> tuple[bytes, memoryview]:
    """Pack the points (POINT) of some scans: what comes before them in a record, and they."""
    head = _COUNT.pack(len(scans)) + np.array([scans, counts], "<u4").tobytes()
    return head, np.ascontiguousarray(points).view(np.uint8).data


def unpack_points(
    data: Buffer,
) -> tuple[NDArray[np.uint32], NDArray[np.uint32], int, NDArray[Any]]:
    """Inverse of `pack_points`: scans, their counts, where the points begin, the points.

    Raises
    ------
    One of `UNREADABLE`
        If it is not that.
    """
    (count,) = _COUNT.unpack_from(data)
    begin = _COUNT.size + 8 * count
    scans, counts = np.frombuffer(data, "<u4", 2 * count, _COUNT.size).reshape(2, count)
    points = np.frombuffer(data, POINT, offset=begin)
    if counts.sum(dtype=np.int64) != len(points):
        raise ValueError(f"a record holds {len(points):,} points and announces others")
    return scans, counts, begin, points
