"""Reader and writer of PCL's Point Cloud Data (.pcd) files in all encodings.

The implementation follows the documentation and `pcd_io.cpp` of PCL 1.14. Open3D is not used
because it ignores VIEWPOINT and writes out of bounds if two fields have the same name, as in PCL's
padding. pypcd4 is not used because it does not support the old keyword COLUMNS and unpacks fields
with several numbers in a different order than PCL.
"""

from __future__ import annotations

import io
import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate, islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...columns.column_names import COLORS, standard_names
from ...columns.sweep import Sweep
from ...errors import CutShortError
from ...io.allowance import Allowance
from ...io.input_files import read_input
from ...motion.rotations import matrices
from ...numerics.arrays import AnyArray, Bytes, Floats, Ints, Records
from ...words import make_distinct, printable
from ..transform import affine
from .text_rows import COMMENT_PREFIXES, RowReader

_KEYWORDS = (
    "VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS",
)  # fmt: skip
_DATA = re.compile(rb"^DATA[ \t]+([^\r\n]*?)[ \t]*(?:\r?\n|\Z)", re.MULTILINE)
_STARTS = (b"# .PCD", b"VERSION", b"FIELDS", b"COLUMNS")  # prefixes of header lines
_PADDING = "_"  # name of padding fields in PCL
_KINDS = {
    ("F", 4): "<f4", ("F", 8): "<f8",
    ("I", 1): "<i1", ("I", 2): "<i2", ("I", 4): "<i4", ("I", 8): "<i8",
    ("U", 1): "<u1", ("U", 2): "<u2", ("U", 4): "<u4", ("U", 8): "<u8",
}  # fmt: skip
_LETTERS = {"f": "F", "i": "I", "u": "U"}  # {NumPy kind: TYPE}
_HEADER_MAX_BYTES = 1 << 20
_MAX_NUMBERS = 10_000  # maximum numbers per point; descriptors of PCL have up to 1,980
_MAX_QUATERNION_ERROR = 0.01  # maximum deviation of the norm of the quaternion from 1
_SMALLER = "write it uncompressed"
_RESOLVED = (*"xyz", "rgb", "rgba", *COLORS)  # column names that this module uses
_NO_VIEWPOINT = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class _Field:
    name: str
    kind: str  # NumPy type, such as "<f4"
    count: int  # numbers per point

    @property
    def size(self) -> int:
        """Size in bytes per point."""
        return np.dtype(self.kind).itemsize * self.count


class _Header(NamedTuple):
    fields: list[_Field]
    points: int
    height: int
    encoding: str
    viewpoint: tuple[float, ...]  # position x, y, z and quaternion w, x, y, z
    lines: int  # number of lines, including DATA


def read_pcd(path: Path) -> list[Sweep]:
    """Read a .pcd file, whose VIEWPOINT becomes the pose of the points.

    Fields with several numbers become the columns `name_0`, `name_1` and so on. The packed colors
    `rgb` and `rgba` become red, green, blue, and alpha unless it is constant. Padding fields (`_`)
    are skipped. The position of the scanner is that of VIEWPOINT, unless VIEWPOINT has its default
    value.

    Raises
    ------
    ValueError
        If the header is invalid or does not match the content. The message contains the line
        number.
    LidarError
        If the points would require much more memory than the size of the file.
    OSError
        If the file cannot be read.
    """
    data = read_input(path)
    header, start = _find_header(data)
    arrays = _read_body(header, memoryview(data)[start:], len(data))
    columns = _named_columns(header.fields, arrays)
    if missing := [axis for axis in "xyz" if axis not in columns]:
        names = ", ".join(field.name for field in header.fields)
        raise ValueError(
            f"its FIELDS are {printable(names)}, but it has no {', '.join(missing)}. The fields "
            "x, y and z are required, with one number each"
        )
    with np.errstate(invalid="ignore"):  # converting signaling NaN is an invalid operation
        positions = np.stack([columns.pop(axis) for axis in "xyz"], axis=1).astype(np.float64)
    pose = _pose(header.viewpoint)
    scanner = None if header.viewpoint == _NO_VIEWPOINT else pose[:3, 3]
    return [Sweep(positions, split_rgb(columns), pose=pose, scanner=scanner)]


def pcd_bytes(
    fields: Sequence[tuple[str, AnyArray]],
    position: Sequence[float],
    quaternion: Sequence[float],
    comment: str,
) -> bytes:
    """Return the content of a binary .pcd file.

    Parameters
    ----------
    fields
        Names and values of the fields. Each array has shape (n,).
    position, quaternion
        VIEWPOINT, as a position in meters and a quaternion in the order w, x, y, z.
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


def _find_header(data: bytes) -> tuple[_Header, int]:
    """Parse the header of a file, and return it with the position of the body."""
    end = _DATA.search(data, 0, _HEADER_MAX_BYTES)
    if end is None:
        is_header = any(line.startswith(_STARTS) for line in data[:_HEADER_MAX_BYTES].splitlines())
        failure = CutShortError if is_header else ValueError
        raise failure("its header has no DATA line")
    return _parse_header(data[: end.start()], end[1].decode("latin-1")), end.end()


def _read_body(header: _Header, body: memoryview, file_size: int) -> list[AnyArray]:
    """Read the fields of the points.

    Each array has shape (n, count).
    """
    if header.encoding == "ascii":
        return _read_text(header, body)
    if header.encoding == "binary":
        return _read_binary(header, body)
    return _read_compressed(header, body, file_size)


# -- the header ----------------------------------------------------------------------------------


def _parse_header(data: bytes, encoding: str) -> _Header:
    entries: dict[str, tuple[int, list[str]]] = {}  # {keyword: (line number, words)}
    lines = data.decode("latin-1").splitlines()
    for number, line in enumerate(lines, 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        # Before version 0.5 of the format, the keyword was COLUMNS.
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
        fields=_fields(entries),
        points=_count_of_points(entries),
        height=_whole_numbers(entries, "HEIGHT", [1], 1)[0],
        encoding=encoding,
        viewpoint=_viewpoint(entries),
        lines=len(lines) + 1,
    )


_Entries = Mapping[str, tuple[int, list[str]]]


def _fields(entries: _Entries) -> list[_Field]:
    """Return the fields of a header, or raise ValueError if they are invalid or inconsistent."""
    if not entries.get("FIELDS", (0, []))[1]:
        raise ValueError("its header has no FIELDS")
    names = entries["FIELDS"][1]
    # Before version 0.5 of the format, all fields were float32, and these lines did not exist.
    sizes = _whole_numbers(entries, "SIZE", [4] * len(names))
    letters = [word.upper() for word in entries.get("TYPE", (0, ["F"] * len(names)))[1]]
    counts = _whole_numbers(entries, "COUNT", [1] * len(names))
    for keyword, words in (("SIZE", sizes), ("TYPE", letters), ("COUNT", counts)):
        if len(words) != len(names):
            raise ValueError(
                f"its header has {len(names)} entries in FIELDS, but {len(words)} in {keyword}"
            )
    for name, letter, size in zip(names, letters, sizes, strict=True):
        if (letter, size) not in _KINDS:
            raise ValueError(
                f"its field {printable(name)[:40]!r} has TYPE {letter[:20]} and SIZE {size}. "
                "Expected F with 4 or 8 bytes, or I or U with 1, 2, 4 or 8 bytes"
            )
    if (numbers := sum(counts)) > _MAX_NUMBERS:
        raise ValueError(
            f"its header declares {numbers:,} numbers per point, but the limit is {_MAX_NUMBERS:,}"
        )
    if not numbers:
        raise ValueError("its header has a COUNT of 0 for all fields")
    return [
        _Field(name, _KINDS[letter, size], count)
        for name, letter, size, count in zip(names, letters, sizes, counts, strict=True)
        if count  # padding without numbers, which some sensor software writes
    ]


def _count_of_points(entries: _Entries) -> int:
    """Return POINTS, or WIDTH x HEIGHT if it is missing.

    Raise ValueError if the numbers are inconsistent.
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
    """Return the nonnegative integers in a header line, or `default` if the line is missing."""
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
    """Return the position and the normalized quaternion of the viewpoint.

    The quaternion has the order w, x, y, z. If all numbers are zero, return the default, because
    programs that do not support VIEWPOINT write zeros.
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
    *position, w, x, y, z = viewpoint
    return affine(matrices(np.array([[x, y, z, w]]))[0], np.array(position))


# -- the body ------------------------------------------------------------------------------------


def _read_binary(header: _Header, body: memoryview) -> list[AnyArray]:
    """Read the fields of binary rows.

    Each array has shape (n, count).
    """
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
    """Return the dtype of a row, whose fields are named by their indices."""
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
    """Raise CutShortError if a file contains fewer points than declared."""
    if header.points * row_size > size:
        raise CutShortError(
            f"{header.points:,} points of {row_size} bytes are declared, but only "
            f"{size // max(row_size, 1):,} are present"
        )


def _read_compressed(header: _Header, body: memoryview, file_size: int) -> list[AnyArray]:
    """Read the fields of a compressed body.

    Each array has shape (n, count). The fields are stored one after the other. PCL does not store
    padding, but other programs do.
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
    Allowance(file_size, _SMALLER).reserve(size)
    content = _decompress(body[8 : 8 + packed_size], size)
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


def _decompress(packed: memoryview, size: int) -> Bytes:
    """Decompress LZF data, or raise ValueError if it is corrupt."""
    from .lzf_loops import unpack_lzf  # importing numba is slow

    content = np.zeros(size, np.uint8)
    if size and unpack_lzf(np.frombuffer(bytearray(packed), np.uint8), content) != size:
        raise ValueError(
            "its compressed points are damaged, because their size is wrong after decompression"
        )
    return content


def _read_text(header: _Header, body: memoryview) -> list[AnyArray]:
    """Read the fields of text lines.

    Each array has shape (n, count). Floating-point fields are read in double precision regardless
    of their SIZE, since programs write more digits.
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
            numbers = _as_integers(numbers, field) if exact is None else exact
        arrays.append(numbers)
        start += field.count
    return arrays


def _exact_integers(field: _Field, body: memoryview, cells: Sequence[int]) -> AnyArray | None:
    """Parse the cells of a 64-bit integer field without rounding them to double precision.

    The result is None for other fields, or if a cell is not an integer.
    """
    if field.kind[2] != "8":
        return None
    try:
        return np.loadtxt(io.BytesIO(body), np.dtype(field.kind), usecols=cells, ndmin=2)
    except ValueError:
        return None


def _as_integers(values: Floats, field: _Field) -> AnyArray:
    """Convert floating-point numbers to the integer type of a field.

    NaN becomes 0, as in PCL. Raise ValueError if other numbers are not representable.
    """
    numbers = np.nan_to_num(values)
    limits = np.iinfo(field.kind)
    lowest = float(limits.min)
    stop = float(limits.max) + (field.kind[2] != "8")  # float() rounds 64-bit limits up
    if not ((numbers % 1 == 0) & (numbers >= lowest) & (numbers < stop)).all():
        raise ValueError(
            f"its field {printable(field.name)[:40]!r} must contain whole numbers from "
            f"{limits.min} to {limits.max}, according to its TYPE and SIZE"
        )
    return numbers.astype(field.kind)


# -- other points in the same format --------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class PCDRecords:
    """The points of a .pcd file as stored, from which files with other points are created.

    Attributes
    ----------
    records
        (n,): structured array with one field per number, named like the columns of `read_pcd`. In
        text files, floating-point fields have double precision, since programs write more digits.
    height
        Number of rows of an organized cloud, or 1.
    """

    records: Records
    height: int
    _header: _Header
    _counts: tuple[int, ...]  # stored numbers per point and field; 0 for omitted padding
    _text: bytes  # header lines, including DATA
    _body: bytes

    @classmethod
    def read(cls, path: Path) -> PCDRecords:
        """Read a .pcd file. Raises the same errors as `read_pcd`."""
        data = read_input(path)
        header, start = _find_header(data)
        body = memoryview(data)[start:]
        arrays = _read_body(header, body, len(data))
        columns = [
            (name, array[:, index])
            for field, array in zip(header.fields, arrays, strict=True)
            for index, name in zip(range(array.shape[1]), _column_names(field), strict=False)
        ]
        names = make_distinct(name for name, _ in columns)
        row = [(name, array.dtype) for name, (_, array) in zip(names, columns, strict=True)]
        records = np.empty(header.points, row)
        for name, (_, array) in zip(names, columns, strict=True):
            records[name] = array
        counts = tuple(array.shape[1] for array in arrays)
        return cls(records, header.height, header, counts, data[:start], bytes(body))

    def encode(self, rows: Records, template: Ints, height: int = 1) -> bytes:
        """Encode points in the format of this file, and return the bytes of a new file.

        Parameters
        ----------
        rows
            (m,): new points, with the dtype of `records`.
        template
            (m,): index of the stored record from which each point was derived. In text files,
            values that are equal to those of the record keep their digits.
        height
            Number of rows of an organized cloud, or 1.
        """
        text = self._text
        sizes = {b"WIDTH": len(rows) // height, b"HEIGHT": height, b"POINTS": len(rows)}
        for keyword, number in sizes.items():
            pattern = rb"^(" + keyword + rb"[ \t]+)\d+"
            text = re.sub(pattern, rb"\g<1>%d" % number, text, count=1, flags=re.M | re.I)
        if self._header.encoding == "ascii":
            return text + self._text_rows(rows, template)
        if self._header.encoding == "binary":
            return text + rows.tobytes()
        names = iter(rows.dtype.names or ())
        fields = [[*islice(names, count)] for count in self._counts]
        numbers = [np.stack([rows[name] for name in field], axis=1) for field in fields if field]
        content = b"".join(array.tobytes() for array in numbers)
        packed = _compress(content)
        return text + struct.pack("<II", len(packed), len(content)) + packed

    def _text_rows(self, rows: Records, template: Ints) -> bytes:
        comments = tuple(prefix.encode() for prefix in COMMENT_PREFIXES)
        lines = [
            line
            for line in map(bytes.strip, self._body.splitlines())
            if line and not line.startswith(comments)
        ]
        changed = rows != self.records[template]
        output = []
        for row, source, differs in zip(rows, template.tolist(), changed.tolist(), strict=True):
            output.append(self._text_row(row, source, lines[source]) if differs else lines[source])
        return b"".join(line + b"\n" for line in output)

    def _text_row(self, row: Any, source: int, line: bytes) -> bytes:
        words = line.split()
        if len(words) != len(row):  # the numbers are separated by commas
            words = line.replace(b",", b" ").split()
        numbers = zip(row.tolist(), self.records[source].tolist(), self._kinds(), strict=True)
        for index, (value, before, kind) in enumerate(numbers):
            if value != before and not (value != value and before != before):
                number = str(np.dtype(kind).type(value)) if kind[1] == "f" else str(value)
                words[index] = number.encode()
        return b" ".join(words)

    def _kinds(self) -> list[str]:
        return [field.kind for field in self._header.fields for _ in range(field.count)]


def _compress(content: bytes) -> bytes:
    """Compress data with LZF."""
    from .lzf_loops import pack_lzf, packed_limit  # importing numba is slow

    packed = np.zeros(packed_limit(len(content)), np.uint8)
    size = pack_lzf(np.frombuffer(bytearray(content), np.uint8), packed)
    return packed[:size].tobytes()


# -- columns -------------------------------------------------------------------------------------


def _column_names(field: _Field) -> list[str]:
    if field.count == 1:
        return [field.name]
    return [f"{field.name}_{index}" for index in range(field.count)]


def _named_columns(fields: Sequence[_Field], arrays: Sequence[AnyArray]) -> dict[str, AnyArray]:
    """Return the columns of all fields except padding."""
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


def split_rgb(columns: dict[str, AnyArray]) -> dict[str, AnyArray]:
    """Replace the packed column `rgb` or `rgba` with the columns red, green and blue.

    A column `alpha` is added unless alpha is constant.
    """
    for name in ("rgb", "rgba"):
        if name not in columns or not columns.keys().isdisjoint(COLORS):
            continue
        bits = _packed_colors(columns.pop(name))
        for shift, color in zip((16, 8, 0), COLORS, strict=True):
            columns[color] = (bits >> shift & 255).astype(np.uint8)
        alpha = (bits >> 24).astype(np.uint8)
        if (alpha != alpha[:1]).any():
            columns["alpha"] = alpha
    return columns


def _packed_colors(values: AnyArray) -> AnyArray:
    """Convert packed colors to integers in the form 0xAARRGGBB.

    Colors are stored as integers, or as the bits of floating-point numbers. The first versions of
    PCL instead converted the integer to a floating-point number, such as 4.2108e+06 for a gray. The
    two can be distinguished because the bits of a color without alpha are a floating-point number
    far below 1.
    """
    if values.dtype.kind in "iu":
        return values.astype(np.uint32)
    with np.errstate(invalid="ignore"):
        numbers = values.astype(np.float64)
    finite = numbers[np.isfinite(numbers)]
    if finite.any() and not (finite % 1).any() and finite.min() >= 0 and finite.max() < 1 << 24:
        return np.nan_to_num(numbers).astype(np.uint32)
    return values.astype("<f4").view("<u4")
