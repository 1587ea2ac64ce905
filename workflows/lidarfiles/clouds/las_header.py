"""Open LAS and LAZ files safely with laspy and read their coordinate systems.

Headers are checked first, because damaged headers can make laspy allocate all memory or loop for
hours.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from lidarsim.errors import CutShortError
from lidarsim.io.allowance import Allowance
from lidarsim.io.input_files import open_input
from lidarsim.scene.files.noise_points import LEGACY_NOISE_CLASSES, NOISE_CLASSES
from lidarsim.scene.files.stated_system import StatedSystem

# Fields of the header and their offsets, according to ASPRS LAS 1.4 R15, table 3.
_HEADER_BYTES = 375  # header size in LAS 1.4 (LAS 1.2: 227)
_ENCODING = struct.Struct("<H"), 6
_LAYOUT = struct.Struct("<HII"), 94  # header size, offset of the points, number of VLRs
_EXTENDED = struct.Struct("<QI"), 235  # offset and number of extended VLRs (LAS 1.4 only)
_VLR = struct.Struct("<2x16sHH32x")  # user ID, record ID, number of bytes
_EXTENDED_VLR = struct.Struct("<2x16sHQ32x")
_PROJECTION = b"LASF_Projection"
_MAX_EXTENDED = 1_000  # maximum number of extended VLRs that are searched
_MAX_RECORD = 1 << 20  # maximum size of a coordinate system record in bytes
_WKT_BIT = 16  # bit of the global encoding that marks WKT coordinate systems
_SIGNATURE = b"LASF"  # first bytes of a file
_EARLY_END = "failed to fill whole buffer"  # part of the lazrs error message for truncated files
_SMALLER = "convert it to .las, or downsample it first"


@contextmanager
def open_las(path: Path) -> Iterator[Any]:
    """Open a .las or .laz file as a `laspy.LasReader`, after checking its header.

    Raises
    ------
    LidarError
        If the points require far more memory than the size of the file suggests.
    ValueError
        If the header declares more points or records than the file contains. laspy raises further
        types of errors.
    OSError
        If the file cannot be read.
    """
    import laspy

    with open_input(path) as file:
        size = os.fstat(file.fileno()).st_size
        _, points_start, _ = _layout(file)
        file.seek(0)
        with laspy.open(file, closefd=False, read_evlrs=False) as reader:
            header = reader.header
            announced = header.point_count * header.point_format.size
            if not header.are_points_compressed and points_start + announced > size:
                raise CutShortError(
                    f"its header declares {header.point_count:,} points, but it contains fewer"
                )
            Allowance(size, _SMALLER).reserve(announced if header.are_points_compressed else 0)
            try:
                yield reader
            except Exception as error:  # only the message of a lazrs error identifies its cause
                if _EARLY_END not in str(error):
                    raise
                raise CutShortError("its compressed points are truncated") from error


def noise_classes(header: Any) -> tuple[int, ...]:
    """Return the classification codes for noise in the file with the given laspy header."""
    return NOISE_CLASSES if header.point_format.id >= 6 else LEGACY_NOISE_CLASSES


def las_system(path: Path) -> StatedSystem | None:
    """Return the coordinate system that a file declares, or None if it declares none.

    Raises
    ------
    ValueError
        If the coordinate system records are damaged.
    OSError
        If the file cannot be read.
    """
    with open_input(path) as file:
        (encoding,) = _unpacked(file, *_ENCODING)
        records = dict(_projection_records(file))
    return StatedSystem.from_records(records, prefer_wkt=bool(encoding & _WKT_BIT))


def _projection_records(file: BinaryIO) -> Iterator[tuple[int, bytes]]:
    """Yield the IDs and contents of the coordinate system records in a file."""
    header_size, _, count = _layout(file)
    yield from _records(file, header_size, count, _VLR)
    if header_size >= _HEADER_BYTES:
        start, count = _unpacked(file, *_EXTENDED)
        yield from _records(file, start, min(count, _MAX_EXTENDED), _EXTENDED_VLR)


def _records(
    file: BinaryIO, start: int, count: int, head: struct.Struct
) -> Iterator[tuple[int, bytes]]:
    """Find the coordinate system records among `count` records, beginning at byte `start`.

    Yields the record ID and content of each record found. `head` is the layout of a record header.
    """
    for _ in range(count):
        file.seek(start)
        data = file.read(head.size)
        if len(data) < head.size:
            raise CutShortError("its variable-length records are truncated")
        user, number, size = head.unpack(data)
        if user.rstrip(b"\0") == _PROJECTION and size <= _MAX_RECORD:
            yield number, file.read(size)
        start += head.size + size


def _layout(file: BinaryIO) -> tuple[int, int, int]:
    """Return the header size, the point offset and the number of VLRs.

    Raises ValueError if these numbers are inconsistent with each other or with the file size.
    Without this check, laspy would try to read up to four billion records.
    """
    header_size, points_start, records = _unpacked(file, *_LAYOUT)
    file.seek(0)
    if file.read(len(_SIGNATURE)) != _SIGNATURE:
        raise ValueError("it does not start with LASF, the signature of .las and .laz files")
    size = os.fstat(file.fileno()).st_size
    if points_start > size:
        raise CutShortError(
            f"its points start at byte {points_start:,}, but it has only {size:,} bytes"
        )
    if header_size + _VLR.size * records > points_start:
        raise ValueError(
            f"its header declares {records:,} variable-length records, which do not fit "
            f"between the header and the points (bytes {header_size:,} to {points_start:,})"
        )
    return header_size, points_start, records


def _unpacked(file: BinaryIO, layout: struct.Struct, offset: int) -> tuple[int, ...]:
    """Unpack numbers at an offset in a file, or raise CutShortError if the file is too short."""
    file.seek(offset)
    data = file.read(layout.size)
    if len(data) < layout.size:
        raise CutShortError("its header is truncated")
    return layout.unpack(data)
