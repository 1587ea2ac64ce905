"""Reader of text point clouds (.xyz, .txt, .asc and .csv), with or without a header.

CloudCompare starts files with `//X Y Z R G B` and the number of points. Other programs write
headers such as `x,y,z`, `# x y z` or `X;Y;Z`. Without a header, the first numbers in a line are x,
y and z.
"""

from __future__ import annotations

import codecs
import io
import re
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...columns.sweep import Sweep
from ...errors import CutShortError
from ...io.input_files import check_input, open_input, read_input
from ...io.tables import column_name
from ...numerics.arrays import AnyArray, Floats
from ...schema.vocabulary import UNITS_M
from ...words import make_distinct, plural, printable
from .text_rows import COMMENT_PREFIXES, RowReader, cells_of

_SEPARATORS = (";", "\t", ",", None)
_HEAD_BYTES = 1 << 12
_MAX_HEAD_LINES = 1_000  # maximum number of comment lines before the first point
# A name in a space-separated header and its unit, such as X [m]
_WORD = re.compile(r"[^\s\[(]+(?:\s*[\[(][^\])]*[\])])?")
# {name in lower case without separators: axis}. The first name in this order has precedence.
_AXES = {
    **{axis: axis for axis in "xyz"},
    **{f"points{index}": axis for index, axis in enumerate("xyz")},  # ParaView
    **{f"pointsmxyz{index}": axis for index, axis in enumerate("xyz")},  # newer VeloView versions
    "easting": "x",
    "northing": "y",
    "east": "x",
    "north": "y",
    "elevation": "z",
    "height": "z",
    "altitude": "z",
    "up": "z",
}
_QUATERNION = {"qx", "qy", "qz", "qw"}
_DEGREES = {"lat", "latitude", "lon", "lng", "longitude"}
_TUM_COLUMNS = 8  # time, position and quaternion
_KITTI_COLUMNS = 12  # the first three rows of a homogeneous matrix
_RASTER = b"ncols"  # first word of an Esri ASCII grid
_MIN_AMBIGUOUS = 6  # as many cells between commas could be three numbers with decimal commas
_MAX_EXACT = 1 << 53  # integers below this are exact in double precision
_MANY_POINTS = 3  # minimum number of points for detecting a column that numbers them


class _Head(NamedTuple):
    """The lines of a file up to the first point."""

    names: list[str] | None  # column names, or None without a header
    names_line: int  # line number of the header
    is_remark: bool  # whether the header is a comment
    announced: int | None  # number of points if it is declared in a separate line
    first: str  # line of the first point
    first_line: int


def read_text_cloud(path: Path) -> list[Sweep]:
    """Read a point cloud with one point per line.

    Columns are named by the header. Without a header, the columns after z are named `column_4`,
    `column_5` and so on. Columns are separated by spaces, tabs, commas or semicolons. Decimal
    commas are supported if columns have a different separator. Text columns are skipped.

    Raises
    ------
    ValueError
        If a line is invalid, or if the columns are not those of a point cloud. The message contains
        the line number.
    LidarError
        If the file is larger than the memory.
    OSError
        If the file cannot be read.
    """
    check_input(path)
    _check_text(read_input(path, _HEAD_BYTES))
    with io.TextIOWrapper(open_input(path), "utf-8-sig", "replace") as lines:
        head = _read_head(lines)
        separator = _separator(head.first)
        first_cells = cells_of(head.first, separator)
        if not first_cells[-1] and len(first_cells) != len(head.names or ()):
            first_cells.pop()  # a separator at the end of the line
        names = _names(head, first_cells, separator)
        axes, units_m = _axes(head, names)
        numeric = _numeric_cells(head, first_cells, separator, axes)
        used = None if len(numeric) == len(first_cells) else numeric
        reader = RowReader(names, axes, separator, used)
        values = reader.read(chain([head.first], lines), head.first_line)
    _check_rows(head, reader, values)
    arrays = {
        index: _column(values[:, position], first_cells[index])
        for position, index in enumerate(numeric)
    }
    positions = np.stack([arrays.pop(index) for index in axes], axis=1).astype(np.float64)
    others = make_distinct(["x", "y", "z", *(names[index] for index in arrays)])[3:]
    columns = dict(zip(others, arrays.values(), strict=True))
    unread = tuple(name for index, name in enumerate(names) if index not in numeric)
    return [Sweep(positions, columns, units_m=units_m, skipped=unread)]


def is_text_raster(path: Path) -> bool:
    """Return whether a text file starts like an Esri ASCII grid, which is an elevation raster."""
    return _begins_as_raster(read_input(path, _HEAD_BYTES))


def _begins_as_raster(start: bytes) -> bool:
    return start.lstrip()[: len(_RASTER)].lower() == _RASTER


def _check_text(start: bytes) -> None:
    """Raise ValueError if a file does not start with UTF-8 text, or is a raster."""
    if start.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise ValueError("it is encoded in UTF-16. Save it as UTF-8")
    if b"\0" in start:
        raise ValueError("it is a binary file, but a text file was expected")
    if _begins_as_raster(start):
        raise ValueError("it is an elevation raster, not a point cloud. Use it as a scene")


# -- the head ------------------------------------------------------------------------------------


def _read_head(lines: Iterator[str]) -> _Head:
    """Read the lines up to the first point, or raise ValueError if there are no points."""
    names: list[str] | None = None
    names_line = 0
    is_remark = False
    announced: int | None = None
    for number, line in enumerate(lines, 1):
        text = line.strip()
        if names is None and (header := _header_names(text.lstrip("#/% "))) is not None:
            names = header
            names_line = number
            is_remark = text.startswith(COMMENT_PREFIXES)
        elif not text or text.startswith(COMMENT_PREFIXES):
            if number > _MAX_HEAD_LINES:
                raise ValueError(f"its first {_MAX_HEAD_LINES:,} lines contain no points")
        elif text.isdecimal() and announced is None:
            announced = int(text)
        elif names is None and not _begins_with_numbers(text):
            raise ValueError(
                f"line {number} is {printable(text)[:60]!r}, but x, y and z or a header with "
                "column names were expected"
            )
        else:
            return _Head(names, names_line, is_remark, announced, line, number)
    raise ValueError("it is empty" if not names else f"it has no points after line {names_line}")


def _header_names(text: str) -> list[str] | None:
    """Return the column names in a line, or None if the line is not a header."""
    for separator in _SEPARATORS:
        cells = cells_of(text, separator) if separator else _WORD.findall(text)
        words = [column_name(cell).words for cell in cells]
        if {_AXES.get(word) for word in words} >= {"x", "y", "z"} or len(
            _DEGREES.intersection(words)
        ) >= 2:
            return cells
    return None


def _begins_with_numbers(text: str) -> bool:
    """Return whether the first three cells in a line are numbers."""
    separator = _separator(text)
    cells = cells_of(text, separator)[:3]
    return len(cells) == 3 and all(_is_number(cell, separator) for cell in cells)


def _separator(line: str) -> str | None:
    """Return the separator of the cells in a line of numbers, or None for spaces and tabs."""
    if ";" in line:
        return ";"
    words = line.split()
    if "," in line and not (
        len(words) >= 3 and all(word[-1] != "," and _is_number(word, None) for word in words)
    ):
        return "\t" if line.count("\t") >= 2 else ","
    return "\t" if _is_number(line.split("\t")[0].strip(), "\t") and line.count("\t") >= 2 else None


def _is_number(cell: str, separator: str | None) -> bool:
    """Return whether a cell is a number.

    Decimal commas are allowed unless the separator is a comma.
    """
    if separator != "," and cell.count(",") == 1:
        cell = cell.replace(",", ".")
    try:
        float(cell)
    except ValueError:
        return False
    return "_" not in cell


# -- the columns ---------------------------------------------------------------------------------


def _names(head: _Head, first_cells: Sequence[str], separator: str | None) -> list[str]:
    """Return the names of all cells, or raise ValueError if they do not match the header."""
    names = head.names or []
    count = len(first_cells)
    if count < len("xyz"):
        raise ValueError(
            f"line {head.first_line} has {plural(count, 'cell')}, but x, y and z were expected"
        )
    if len(names) == count + 1 and not names[-1]:
        names = names[:-1]
    if len(names) == count:
        return [name or f"column_{index + 1}" for index, name in enumerate(names)]
    # A comment in prose, such as "x y z in meters", only names these three columns.
    if not names or (head.is_remark and [name.lower() for name in names[:3]] == ["x", "y", "z"]):
        return ["x", "y", "z", *(f"column_{index + 1}" for index in range(3, count))]
    hint = ""
    if separator == "," and count > len(names):
        hint = (
            ". To use decimal commas, separate the columns with a different character, such as a "
            "semicolon"
        )
    raise ValueError(
        f"line {head.names_line} names {plural(len(names), 'column')} "
        f"({printable(', '.join(names))}), but line {head.first_line} has "
        f"{plural(count, 'cell')}{hint}"
    )


def _axes(head: _Head, names: Sequence[str]) -> tuple[list[int], tuple[float, float, float] | None]:
    """Return the indices of the columns x, y and z, and their units in meters.

    The units are None if the file does not state them. Raise ValueError if the columns belong to a
    trajectory, or if the coordinates are not lengths.
    """
    columns = [column_name(name) for name in names]
    words = [column.words for column in columns]
    if _QUATERNION.issubset(words):
        raise ValueError(
            f"line {head.names_line} names a quaternion ({printable(', '.join(names))}), so the "
            "file is a trajectory, not a point cloud"
        )
    if not {_AXES.get(word) for word in words} >= {"x", "y", "z"}:
        raise ValueError(
            f"line {head.names_line} names latitude and longitude, but x and y in a unit of "
            "length were expected. Project the cloud first"
        )
    indices = []
    units_m = []
    for axis in "xyz":
        word = next(word for word, name in _AXES.items() if name == axis and word in words)
        index = words.index(word)
        unit = columns[index].unit
        if unit is not None and unit not in UNITS_M:
            raise ValueError(
                f"line {head.names_line} names {printable(names[index])!r}, but {axis} in a unit "
                f"of length was expected ({', '.join(UNITS_M)})"
            )
        indices.append(index)
        units_m.append(1.0 if unit is None else UNITS_M[unit])
    x_m, y_m, z_m = units_m
    stated = any(columns[index].unit is not None for index in indices)
    return indices, (x_m, y_m, z_m) if stated else None


def _numeric_cells(
    head: _Head, first_cells: Sequence[str], separator: str | None, axes: Sequence[int]
) -> list[int]:
    """Return the indices of numeric cells, or raise ValueError if x, y or z is not numeric."""
    numeric = [
        index
        for index, cell in enumerate(first_cells)
        if _is_number(cell, separator) or (not cell and index not in axes)
    ]
    for axis, index in zip("xyz", axes, strict=True):
        if index not in numeric:
            raise ValueError(
                f"line {head.first_line} has {printable(first_cells[index])[:40]!r} as {axis}, "
                "but a number was expected"
            )
    return numeric


def _column(values: Floats, first_cell: str) -> AnyArray:
    """Convert a column to integers if its numbers are written as integers.

    For example, the class 2 is written as an integer, but the fraction 1.0 is not.
    """
    if not first_cell.strip("+-").isdecimal() or (values % 1 != 0).any():  # also NaN
        return values
    return values.astype(np.int64) if np.abs(values).max(initial=0) < _MAX_EXACT else values


# -- the points ----------------------------------------------------------------------------------


def _check_rows(head: _Head, reader: RowReader, values: Floats) -> None:
    """Check the number of points.

    In a file without a header, also check that the rows are points.
    """
    if head.announced is not None and len(values) != head.announced:
        failure = CutShortError if len(values) < head.announced else ValueError
        raise failure(
            f"the header declares {plural(head.announced, 'point')}, but the number of lines is "
            f"{len(values):,}"
        )
    if head.names is not None:
        return
    width = len(reader.names)
    if reader.separator == "," and width >= _MIN_AMBIGUOUS and not reader.point_line:
        raise ValueError(
            "its numbers have no decimal points, and its commas may separate decimals as well as "
            "columns. Write decimal points, or name the columns in a header, as in x,y,z"
        )
    if _are_poses(values):
        raise ValueError(
            "its lines appear to be the poses of a trajectory. If the file is a point cloud, "
            "name its columns in a header"
        )
    counts_points = len(values) >= _MANY_POINTS and (np.diff(values[:, 0]) == 1).all()
    if width > 3 and counts_points and values[0, 0] in (0, 1):
        raise ValueError(
            "its first column appears to number the points. Name the columns in a header, as in "
            "id x y z"
        )


def _are_poses(values: Floats) -> bool:
    """Return whether rows are poses in TUM or KITTI format."""
    if values.shape[1] == _TUM_COLUMNS:
        units = values[:, None, 4:]
    elif values.shape[1] == _KITTI_COLUMNS:
        units = values.reshape(-1, 3, 4)[:, :, :3]
    else:
        return False
    return bool((np.abs((units**2).sum(axis=2) - 1) < 0.01).all())
