"""Point Cloud Data (.pcd) of PCL, all encodings, by its documentation and `pcd_io.cpp` of PCL 1.14.

Open3D writes beyond its memory where two fields have the same name, as PCL's padding has, and
leaves out VIEWPOINT. pypcd4 does not know the old keyword COLUMNS, and unpacks fields of several
numbers in another order than PCL.
"""

from __future__ import annotations

import io
import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...columns.column_names import COLORS, standard_names
from ...columns.sweep import Sweep
from ...errors import CutShortError
from ...io.allowance import Allowance
from ...io.input_files import read_input
from ...motion.rotations import matrices
from ...numerics.arrays import AnyArray, Bytes, Floats
from ...words import printable
from ..transform import affine
from .text_rows import RowReader

_KEYWORDS = (
    "VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS",
)  # fmt: skip
_DATA = re.compile(rb"^DATA[ \t]+([^\r\n]*?)[ \t]*(?:\r?\n|\Z)", re.MULTILINE)
_STARTS = (b"# .PCD", b"VERSION", b"FIELDS", b"COLUMNS")  # starts of lines of a header
_PADDING = "_"  # name of the fields that fill the rows of PCL
_KINDS = {
    ("F", 4): "<f4", ("F", 8): "<f8",
    ("I", 1): "<i1", ("I", 2): "<i2", ("I", 4): "<i4", ("I", 8): "<i8",
    ("U", 1): "<u1", ("U", 2): "<u2", ("U", 4): "<u4", ("U", 8): "<u8",
}  # fmt: skip
_LETTERS = {"f": "F", "i": "I", "u": "U"}  # {kind of NumPy: TYPE}
_HEADER_MAX_BYTES = 1 << 20
_MAX_NUMBERS = 10_000  # numbers of a point; descriptors of PCL have up to 1,980
_MAX_QUATERNION_ERROR = 0.01  # error of the length of VIEWPOINT's quaternion
_SMALLER = "write it uncompressed"
_RESOLVED = (*"xyz", "rgb", "rgba", *COLORS)  # names that are resolved here
_NO_VIEWPOINT = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class _Field:
    """A field of the header."""

    name: str
    kind: str  # type of NumPy: «<f4»
    count: int  # numbers of a point

    @property
    def size(self) -> int:
        """Bytes of a point."""
        return np.dtype(self.kind).itemsize * self.count


class _Header(NamedTuple):
    """Header of a file."""

    fields: list[_Field]
    points: int
    encoding: str
    viewpoint: tuple[float, ...]  # x, y, z, and the quaternion w, x, y, z
    lines: int  # up to DATA


def read_pcd(path: Path) -> list[Sweep]:
    """Read the points of a .pcd file, with its VIEWPOINT as their pose.

    Fields of several numbers become the columns `name_0`, `name_1`, …; the bits of `rgb` and `rgba`
    become red, green and blue, and alpha unless it is the same throughout. Padding (`_`) is left
    out. The scanner is where VIEWPOINT says, unless that is the default.

    Raises
    ------
    ValueError
        If the header is broken, or announces other numbers than the file holds; the message names
        the line.
    LidarError
        If the points would take far more memory than the file has bytes.
    OSError
        If the file cannot be read.
    """
    data = read_input(path)
    end = _DATA.search(data, 0, _HEADER_MAX_BYTES)
    if end is None:
        is_header = any(line.startswith(_STARTS) for line in data[:_HEADER_MAX_BYTES].splitlines())
        failure = CutShortError if is_header else ValueError
        raise failure("its header has no DATA line")
    header = _parse_header(data[: end.start()], end[1].decode("latin-1"))
    body = memoryview(data)[end.end() :]
    if header.encoding == "ascii":
        arrays = _read_text(header, body)
    elif header.encoding == "binary":
        arrays = _read_binary(header, body)
    else:
        arrays = _read_compressed(header, body, len(data))
    columns = _named_columns(header.fields, arrays)
    if missing := [axis for axis in "xyz" if axis not in columns]:
        names = ", ".join(field.name for field in header.fields)
        raise ValueError(
            f"its FIELDS are {printable(names)}, but it has no {', '.join(missing)}. The fields "
            "x, y and z are required, with one number each"
        )
    with np.errstate(invalid="ignore"):  # NaN of any kind may be invalid
        positions = np.stack([columns.pop(axis) for axis in "xyz"], axis=1).astype(np.float64)
    pose = _pose(header.viewpoint)
    scanner = None if header.viewpoint == _NO_VIEWPOINT else pose[:3, 3]
    return [Sweep(positions, unpacked_colors(columns), pose=pose, scanner=scanner)]


def pcd_bytes(
    fields: Sequence[tuple[str, AnyArray]],
    position: Sequence[float],
    quaternion: Sequence[float],
    comment: str,
) -> bytes:
    """Return a binary .pcd file.

    Parameters
    ----------
    fields
        Names and arrays (n,) of numbers.
    position, quaternion
        VIEWPOINT: meters, and w, x, y, z.
    comment
        First line of the file.
    """
    count = len(fields[0][1])
    row = np.dtype([(name, array.dtype.newbyteorder("<")) for name, array in fields])
    rows = np.empty(count, row)
    for name, array in fields:
        rows[name] = array
    kinds = [row[name] for name, _ in fields]
    header = (
        f"# {comment}",
        "VERSION 0.7",
        f"FIELDS {' '.join(name for name, _ in fields)}",
        f"SIZE {' '.join(str(kind.itemsize) for kind in kinds)}",
        f"TYPE {' '.join(_LETTERS[kind.kind] for kind in kinds)}",
        f"COUNT {' '.join('1' for _ in kinds)}",
        f"WIDTH {count}",
        "HEIGHT 1",
        f"VIEWPOINT {' '.join(str(float(number)) for number in (*position, *quaternion))}",
        f"POINTS {count}",
        "DATA binary\n",
    )
    return "\n".join(header).encode() + rows.tobytes()


# -- the header ----------------------------------------------------------------------------------


def _parse_header(data: bytes, encoding: str) -> _Header:
    """Return the header in `data`, up to DATA.

    Raises ValueError, with the line that is broken.
    """
    entries: dict[str, tuple[int, list[str]]] = {}  # {keyword: (number of the line, words)}
    lines = data.decode("latin-1").splitlines()
    for number, line in enumerate(lines, 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        # COLUMNS is the keyword of files before version 0.5.
        keyword = {"COLUMNS": "FIELDS"}.get(words[0].upper(), words[0].upper())
        if keyword not in _KEYWORDS:
            raise ValueError(
                f"line {number} of its header begins with {printable(words[0])[:40]!r}, but "
                f"{', '.join(_KEYWORDS)} or DATA was expected"
            )
        if keyword in entries:
            raise ValueError(
                f"its header repeats {keyword} in lines {entries[keyword][0]} and {number}"
            )
        entries[keyword] = number, words[1:]
    if encoding not in ("ascii", "binary", "binary_compressed"):
        raise ValueError(
            f"its DATA is {printable(encoding)[:20]!r}, but must be ascii, binary or "
            "binary_compressed"
        )
    return _Header(
        _fields(entries), _count_of_points(entries), encoding, _viewpoint(entries), len(lines) + 1
    )


_Entries = Mapping[str, tuple[int, list[str]]]


def _fields(entries: _Entries) -> list[_Field]:
    """Return the fields of a header.

    Raises ValueError if they are broken.
    """
    if not entries.get("FIELDS", (0, []))[1]:
        raise ValueError("its header has no FIELDS")
    names = entries["FIELDS"][1]
    # Files before version 0.5 have float32 and no further lines.
    sizes = _whole_numbers(entries, "SIZE", [4] * len(names))
    letters = [word.upper() for word in entries.get("TYPE", (0, ["F"] * len(names)))[1]]
    counts = _whole_numbers(entries, "COUNT", [1] * len(names))
    for keyword, words in (("SIZE", sizes), ("TYPE", letters), ("COUNT", counts)):
        if len(words) != len(names):
            raise ValueError(
                f"its header has {len(names)} entries in FIELDS, but {len(words)} in {keyword}"
            )
    for name, letter, size, count in zip(names, letters, sizes, counts, strict=True):
        if (letter, size) not in _KINDS or count < 1:
            raise ValueError(
                f"its field {printable(name)[:40]!r} has TYPE {letter[:20]}, SIZE {size} and "
                f"COUNT {count}. Expected F with 4 or 8 bytes, or I or U with 1, 2, 4 or 8 bytes, "
                "and a COUNT of at least 1"
            )
    if (numbers := sum(counts)) > _MAX_NUMBERS:
        raise ValueError(
            f"its header declares {numbers:,} numbers per point, but the limit is {_MAX_NUMBERS:,}"
        )
    return [
        _Field(name, _KINDS[letter, size], count)
        for name, letter, size, count in zip(names, letters, sizes, counts, strict=True)
    ]


def _count_of_points(entries: _Entries) -> int:
    """Return POINTS, or WIDTH x HEIGHT without it.

    Raises ValueError if they contradict each other.
    """
    (points,) = _whole_numbers(entries, "POINTS", [-1], 1)
    (width,) = _whole_numbers(entries, "WIDTH", [-1], 1)
    (height,) = _whole_numbers(entries, "HEIGHT", [1], 1)
    if points < 0 and width < 0:
        raise ValueError("its header has no POINTS")
    if points >= 0 and width >= 0 and points != width * height:
        raise ValueError(
            f"its header has {points:,} POINTS, but a WIDTH of {width:,} by a HEIGHT of {height:,}"
        )
    return points if points >= 0 else width * height


def _whole_numbers(
    entries: _Entries, keyword: str, default: list[int], count: int | None = None
) -> list[int]:
    """Return the whole numbers of a line of a header.

    Raises ValueError if there are others.
    """
    if keyword not in entries:
        return default
    number, words = entries[keyword]
    if not all(word.isdecimal() for word in words) or count not in (None, len(words)):
        raise ValueError(
            f"line {number} of its header is {printable(' '.join([keyword, *words]))[:60]!r}. "
            f"Expected {'a whole number' if count == 1 else 'whole numbers'} of at least 0"
        )
    return list(map(int, words))


def _viewpoint(entries: _Entries) -> tuple[float, ...]:
    """Return x, y, z, w, x, y, z of a header with a quaternion of length 1.

    Zeros throughout are the default: programs that do not know VIEWPOINT write them.
    """
    if "VIEWPOINT" not in entries:
        return _NO_VIEWPOINT
    number, words = entries["VIEWPOINT"]
    try:
        values = np.array(list(map(float, words)))
    except ValueError:
        values = np.zeros(0)
    if values.shape == (7,) and not values.any():
        return _NO_VIEWPOINT
    length = float(np.sqrt((values[3:] ** 2).sum())) if values.shape == (7,) else np.nan
    if not (np.isfinite(values).all() and abs(length - 1) <= _MAX_QUATERNION_ERROR):
        raise ValueError(
            f"line {number} of its header is {printable(' '.join(['VIEWPOINT', *words]))[:80]!r}. "
            "Expected a position x y z and a quaternion w x y z of length 1"
        )
    return (*values[:3].tolist(), *(values[3:] / length).tolist())


def _pose(viewpoint: Sequence[float]) -> Floats:
    """Return the matrix (4, 4) of a viewpoint."""
    *position, w, x, y, z = viewpoint
    return affine(matrices(np.array([[x, y, z, w]]))[0], np.array(position))


# -- the body ------------------------------------------------------------------------------------


def _read_binary(header: _Header, body: memoryview) -> list[AnyArray]:
    """Return an array (n, count) for each field of rows."""
    row_size = sum(field.size for field in header.fields)
    _check_length(header, row_size, len(body))
    size = row_size * header.points
    if remaining := len(bytes(body[size:]).strip(b"\0\r\n\t ")):
        raise ValueError(
            f"{header.points:,} points are declared, but {remaining:,} bytes follow them"
        )
    rows = np.frombuffer(body[:size], _row_type(header.fields, row_size))
    return [rows[str(index)] for index in range(len(header.fields))]


def _row_type(fields: Sequence[_Field], row_size: int) -> np.dtype[Any]:
    """Return the type of a row, whose fields are named by their numbers."""
    offsets = list(accumulate((field.size for field in fields), initial=0))[:-1]
    return np.dtype(
        {
            "names": [str(index) for index in range(len(fields))],
            "formats": [(field.kind, (field.count,)) for field in fields],
            "offsets": offsets,
            "itemsize": row_size,
        }
    )


def _check_length(header: _Header, row_size: int, size: int) -> None:
    """Check that all announced points are in a file.

    Raises ValueError if not.
    """
    if header.points * row_size > size:
        raise CutShortError(
            f"{header.points:,} points of {row_size} bytes are declared, but only "
            f"{size // max(row_size, 1):,} are present"
        )


def _read_compressed(header: _Header, body: memoryview, file_size: int) -> list[AnyArray]:
    """Return an array (n, count) for each field of a body whose fields follow each other.

    PCL leaves padding out of what it packs, other programs do not.
    """
    if len(body) < 8:
        raise CutShortError("the sizes of its compressed points are missing")
    packed_size, size = struct.unpack("<II", body[:8])
    stored = [field for field in header.fields if field.name != _PADDING]
    full_size = header.points * sum(field.size for field in header.fields)
    if size == full_size:
        stored = header.fields
    elif size != header.points * sum(field.size for field in stored):
        raise ValueError(
            f"{header.points:,} points with {full_size:,} bytes are declared, but its compressed "
            f"points declare {size:,} bytes"
        )
    if 8 + packed_size > len(body):
        raise CutShortError(
            f"{packed_size:,} bytes of compressed points are declared, but only {len(body) - 8:,} "
            "are present"
        )
    Allowance(file_size, _SMALLER).take(size)
    content = _unpacked(body[8 : 8 + packed_size], size)
    arrays = []
    start = 0
    for field in stored:
        stop = start + field.size * header.points
        values = content[start:stop].view(field.kind)
        arrays.append(values.reshape(header.points, field.count))
        start = stop
    if stored is header.fields:
        return arrays
    remaining = iter(arrays)
    return [
        np.empty((header.points, 0)) if field.name == _PADDING else next(remaining)
        for field in header.fields
    ]


def _unpacked(packed: memoryview, size: int) -> Bytes:
    """Return bytes that LZF packed.

    Raises ValueError if they are damaged.
    """
    from .lzf_loops import unpack_lzf  # numba takes a while to load

    content = np.zeros(size, np.uint8)
    if size and unpack_lzf(np.frombuffer(bytearray(packed), np.uint8), content) != size:
        raise ValueError(
            "its compressed points are damaged, because their size is wrong after decompression"
        )
    return content


def _read_text(header: _Header, body: memoryview) -> list[AnyArray]:
    """Return an array (n, count) for each field of lines.

    Real numbers are read in double precision, whatever their SIZE: programs write more digits.
    """
    names = [name for field in header.fields for name in _column_names(field)]
    lines = bytes(body).rstrip().count(b"\n") + 1
    if lines < header.points:
        raise CutShortError(
            f"{header.points:,} points are declared, but only {lines:,} lines follow"
        )
    reader = RowReader(names, range(len(names)))
    values = reader.read(io.TextIOWrapper(io.BytesIO(body), "utf-8", "replace"), header.lines + 1)
    if len(values) != header.points:
        raise ValueError(f"{header.points:,} points are declared, but {len(values):,} lines follow")
    arrays = []
    start = 0
    for field in header.fields:
        numbers: AnyArray = values[:, start : start + field.count]
        if field.name != _PADDING and field.kind[1] != "f":
            exact = _exact_integers(field, body, range(start, start + field.count))
            numbers = _as_type(numbers, field) if exact is None else exact
        arrays.append(numbers)
        start += field.count
    return arrays


def _exact_integers(field: _Field, body: memoryview, cells: Sequence[int]) -> AnyArray | None:
    """Return cells of text as the integers of a field of 64 bits, which double precision rounds.

    None for another field, or if a cell is not written as an integer.
    """
    if field.kind[2] != "8":
        return None
    try:
        return np.loadtxt(io.BytesIO(body), np.dtype(field.kind), usecols=cells, ndmin=2)
    except ValueError:
        return None


def _as_type(values: Floats, field: _Field) -> AnyArray:
    """Return real numbers as the whole numbers of a field.

    Raises ValueError if they are others.

    NaN becomes 0, as in PCL.
    """
    numbers = np.nan_to_num(values)
    limits = np.iinfo(field.kind)
    lowest = float(limits.min)
    stop = float(limits.max) + (field.kind[2] != "8")  # limits of 64 bits are rounded up as floats
    if not ((numbers % 1 == 0) & (numbers >= lowest) & (numbers < stop)).all():
        raise ValueError(
            f"its field {printable(field.name)[:40]!r} must contain whole numbers from "
            f"{limits.min} to {limits.max}, according to its TYPE and SIZE"
        )
    return numbers.astype(field.kind)


# -- columns -------------------------------------------------------------------------------------


def _column_names(field: _Field) -> list[str]:
    """Return the names of the columns of a field."""
    if field.count == 1:
        return [field.name]
    return [f"{field.name}_{index}" for index in range(field.count)]


def _named_columns(fields: Sequence[_Field], arrays: Sequence[AnyArray]) -> dict[str, AnyArray]:
    """Return the columns of all fields but padding."""
    columns = [
        (name, array[:, index])
        for field, array in zip(fields, arrays, strict=True)
        if field.name != _PADDING
        for index, name in enumerate(_column_names(field))
    ]
    names = standard_names([name for name, _ in columns], _RESOLVED)
    return {
        name: array.astype(array.dtype.newbyteorder("="))
        for name, (_, array) in zip(names, columns, strict=True)
    }


def unpacked_colors(columns: dict[str, AnyArray]) -> dict[str, AnyArray]:
    """Return columns with red, green and blue in place of the packed column `rgb` or `rgba`."""
    for name in ("rgb", "rgba"):
        if name not in columns or not columns.keys().isdisjoint(COLORS):
            continue
        bits = _bits(columns.pop(name))
        for shift, color in zip((16, 8, 0), COLORS, strict=True):
            columns[color] = (bits >> shift & 255).astype(np.uint8)
        alpha = (bits >> 24).astype(np.uint8)
        if (alpha != alpha[:1]).any():
            columns["alpha"] = alpha
    return columns


def _bits(values: AnyArray) -> AnyArray:
    """Return packed colors 0xAARRGGBB (n,): whole numbers, or the bits of real numbers.

    The first versions of PCL wrote the whole number of a color as a real number, 4.2108e+06 for a
    gray. Bits of a color without alpha are far smaller than 1.
    """
    if values.dtype.kind in "iu":
        return values.astype(np.uint32)
    with np.errstate(invalid="ignore"):
        numbers = values.astype(np.float64)
    finite = numbers[np.isfinite(numbers)]
    if finite.any() and not (finite % 1).any() and finite.min() >= 0 and finite.max() < 1 << 24:
        return np.nan_to_num(numbers).astype(np.uint32)
    return values.astype("<f4").view("<u4")
