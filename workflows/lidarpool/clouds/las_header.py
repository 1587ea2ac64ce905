"""LAS and LAZ through laspy: files opened after a check of their headers, and their systems."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from lidarsim.base.allowance import Allowance
from lidarsim.base.errors import CutShortError
from lidarsim.base.input_files import open_input
from lidarsim.scene.files.noise_points import LEGACY_NOISE_CLASSES, NOISE_CLASSES
from lidarsim.scene.files.stated_system import StatedSystem

# Offsets within the header, by ASPRS LAS 1.4 R15, table 3.
_HEADER_BYTES = 375  # bytes of LAS 1.4; 1.2 has 227
_ENCODING = struct.Struct("<H"), 6
_LAYOUT = struct.Struct("<HII"), 94  # bytes of the header, offset of the points, number of VLRs
_EXTENDED = struct.Struct("<QI"), 235  # offset and number of extended VLRs, of LAS 1.4
_VLR = struct.Struct("<2x16sHH32x")  # user, record, bytes
_EXTENDED_VLR = struct.Struct("<2x16sHQ32x")
_PROJECTION = b"LASF_Projection"
_MAX_EXTENDED = 1_000  # extended records that are searched for a coordinate system
_MAX_RECORD = 1 << 20  # bytes of a record with a coordinate system
_WKT_BIT = 16  # bit of the global encoding: the coordinate system is WKT
_SIGNATURE = b"LASF"  # first bytes
_EARLY_END = "failed to fill whole buffer"  # part of the error of lazrs at the end of a file
_SMALLER = "convert it to .las, or downsample it first"


@contextmanager
def open_las(path: Path) -> Iterator[Any]:
    """Open a .las or .laz file for the body, as a `laspy.LasReader`.

    Raises
    ------
    LidarError
        If the points would take far more memory than the file has bytes.
    ValueError
        If the header announces more than the file holds; laspy raises further errors.
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
            Allowance(size, _SMALLER).take(announced if header.are_points_compressed else 0)
            try:
                yield reader
            except Exception as error:  # the text of the error of lazrs tells its kind
                if _EARLY_END not in str(error):
                    raise
                raise CutShortError("its compressed points are truncated") from error


def noise_classes(header: Any) -> tuple[int, ...]:
    """Return the classes of noise of a file, by the header of laspy."""
    return NOISE_CLASSES if header.point_format.id >= 6 else LEGACY_NOISE_CLASSES


def las_system(path: Path) -> StatedSystem | None:
    """Return the coordinate system that a file states, or None.

    Raises
    ------
    ValueError
        If the records of the coordinate system are broken.
    OSError
        If the file cannot be read.
    """
    with open_input(path) as file:
        (encoding,) = _unpacked(file, *_ENCODING)
        records = dict(_projection_records(file))
    return StatedSystem.of_records(records, prefer_wkt=bool(encoding & _WKT_BIT))


def _projection_records(file: BinaryIO) -> Iterator[tuple[int, bytes]]:
    """Yield the numbers and contents of the records of a coordinate system."""
    header_size, _, count = _layout(file)
    yield from _records(file, header_size, count, _VLR)
    if header_size >= _HEADER_BYTES:
        start, count = _unpacked(file, *_EXTENDED)
        yield from _records(file, start, min(count, _MAX_EXTENDED), _EXTENDED_VLR)


def _records(
    file: BinaryIO, start: int, count: int, head: struct.Struct
) -> Iterator[tuple[int, bytes]]:
    """Yield the numbers and contents of records of `_PROJECTION` among records from `start` on."""
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
    """Return the size of the header, the offset of the points, and the number of VLRs.

    ValueError if the numbers contradict each other or the size of the file: laspy would go through
    four thousand million records.
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
    """Unpack numbers at an offset of a file.

    Raises ValueError if the file is shorter.
    """
    file.seek(offset)
    data = file.read(layout.size)
    if len(data) < layout.size:
        raise CutShortError("its header is truncated")
    return layout.unpack(data)
