"""Reader of Leica .ptx files, in which each scan has a header and a line for each grid cell.

The ten header lines contain the number of columns and rows, the position of the scanner, its x, y
and z axes, and a transformation matrix with four rows. Points are row vectors that are multiplied
by the matrix from the right, so its last row is the translation. Points without a return are zeros.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np

from ...columns.sweep import Sweep
from ...errors import CutShortError
from ...io.input_files import check_input, open_input
from ...numerics.arrays import Floats
from ...numerics.vectors import matmul
from ...words import plural, printable
from ..transform import affine
from .pts import COLORS, cell_names, next_line, point_columns
from .text_rows import RowReader

_NAMES = {  # {number of cells in a line: names}
    4: ("x", "y", "z", "intensity"),
    7: ("x", "y", "z", "intensity", *COLORS),
}
_HEADER_LINES = (  # (number of values, meaning)
    (1, "the number of columns"),
    (1, "the number of rows"),
    (3, "the position of the scanner"),
    (3, "the x axis of the scanner"),
    (3, "the y axis of the scanner"),
    (3, "the z axis of the scanner"),
    (4, "the first row of the transformation"),
    (4, "the second row of the transformation"),
    (4, "the third row of the transformation"),
    (4, "the last row of the transformation"),
)
_MAX_ROTATION_ERROR = 1e-3  # tolerance for rounded axes in the transformation

_Lines = Iterator[tuple[int, str]]


def read_ptx(path: Path) -> list[Sweep]:
    """Read the scans in a .ptx file.

    Points are in the frame of their scanner, and each sweep contains the pose of the scanner.

    Raises
    ------
    ValueError
        If a line is invalid, or if a scan has fewer points than its header declares. The message
        contains the line number.
    LidarError
        If the file is larger than the memory.
    OSError
        If the file cannot be read.
    """
    size = check_input(path)
    scans = []
    with io.TextIOWrapper(open_input(path), "utf-8-sig", "replace") as text:
        lines = enumerate(text, 1)
        while (entry := next_line(lines)) is not None:
            scans.append(_read_scan(entry, lines, size))
    if not scans:
        raise ValueError("it is empty, but a .ptx header was expected")
    return scans


def _read_scan(entry: tuple[int, str], lines: _Lines, size: int) -> Sweep:
    """Read the scan whose header starts with the given line.

    `size` is the size of the file in bytes.
    """
    start = entry[0]
    header = [_header_numbers(entry, *_HEADER_LINES[0])]
    for width, meaning in _HEADER_LINES[1:]:
        following = next_line(lines)
        if following is None:
            raise CutShortError(
                f"its header of ten lines, which starts in line {start}, has only "
                f"{plural(len(header), 'line')}. Expected {meaning} next"
            )
        header.append(_header_numbers(following, width, meaning))
    (columns,), (rows,), position = header[:3]
    if min(columns, rows) < 0 or columns % 1 or rows % 1:
        raise ValueError(
            f"line {start} and the next line are {columns:g} and {rows:g}, but the numbers of "
            "columns and rows were expected"
        )
    count = int(columns) * int(rows)
    pose = _pose(np.array(header[6:]), start)
    # Programs that write points in the frame of the file write an identity matrix.
    is_placed = np.array_equal(pose, np.eye(4))
    scanner = np.array(position) if is_placed else pose[:3, 3]
    if not count:
        return Sweep(np.zeros((0, 3)), {}, pose=pose, scanner=scanner)
    first = next_line(lines)
    names = ("x", "y", "z", "intensity") if first is None else cell_names(first, _NAMES)
    values = np.zeros((0, len(names)))
    # A line has at least a digit and a separator for each of four numbers.
    if first is not None and 8 * count <= size:
        texts = (line for _, line in lines)
        values = RowReader(names, range(len(names))).read(
            _with_first(first[1], islice(texts, count - 1)), first[0]
        )
    if len(values) < count:
        following_points = f"{len(values):,} follow" if len(values) else "there are fewer"
        raise CutShortError(
            f"line {start} and the next line declare {int(columns):,} x {int(rows):,} points, but "
            f"{following_points}"
        )
    values = values[values[:, :3].any(axis=1)]
    return Sweep(values[:, :3], point_columns(values, names), pose=pose, scanner=scanner)


def _with_first(first: str, lines: Iterator[str]) -> Iterator[str]:
    yield first
    yield from lines


def _header_numbers(entry: tuple[int, str], width: int, meaning: str) -> list[float]:
    """Parse a header line, or raise ValueError if it does not contain `width` numbers."""
    number, line = entry
    try:
        values = list(map(float, line.split()))
    except ValueError:
        values = []
    if len(values) != width or not np.isfinite(values).all():
        raise ValueError(
            f"line {number} is {printable(line)[:60]!r}, but {meaning} "
            f"({plural(width, 'number')}) was expected"
        )
    return values


def _pose(matrix: Floats, start: int) -> Floats:
    """Return the transform from scan coordinates to file coordinates.

    `matrix` is the transformation in the file, whose header starts at line `start`. Raise
    ValueError if the matrix is not a rotation and a translation.
    """
    rotation = matrix[:3, :3]
    error = np.abs(matmul(rotation, rotation.T) - np.eye(3)).max()
    if error > _MAX_ROTATION_ERROR or not np.array_equal(matrix[:, 3], [0, 0, 0, 1]):
        raise ValueError(
            f"the transformation in the header that starts in line {start} must be a rotation "
            "(three rows that end with 0) followed by a position (a row that ends with 1)"
        )
    return affine(rotation.T, matrix[3, :3])
