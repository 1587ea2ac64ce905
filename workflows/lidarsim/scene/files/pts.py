"""Reader of Leica .pts files, which consist of one or more point clouds.

A cloud consists of the number of points and a line for each point. Leica Cyclone writes x, y, z, an
intensity from -2048 to 2047, and red, green and blue. Other programs omit the intensity, the
colors, or the number of points.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from itertools import chain, islice
from pathlib import Path

import numpy as np

from ...columns.sweep import Sweep
from ...errors import CutShortError
from ...io.input_files import check_input, open_input
from ...numerics.arrays import AnyArray, Floats
from ...words import plural, printable
from .intensity_scales import LEICA_LOWEST
from .text_rows import RowReader

COLORS = ("red", "green", "blue")
_NAMES = {  # {number of cells in a line: names}
    3: ("x", "y", "z"),
    4: ("x", "y", "z", "intensity"),
    6: ("x", "y", "z", *COLORS),
    7: ("x", "y", "z", "intensity", *COLORS),
}


def read_pts(path: Path) -> list[Sweep]:
    """Read the clouds in a .pts file, all of which are in the same coordinate frame.

    If any intensity is negative, all intensities are shifted by 2048, since -2048 is the lowest
    value on Leica's scale.

    Raises
    ------
    ValueError
        If a line is invalid, or if the number of points in a cloud does not match the declared
        number. The message contains the line number.
    LidarError
        If the file is larger than the memory.
    OSError
        If the file cannot be read.
    """
    check_input(path)
    scans = []
    with io.TextIOWrapper(open_input(path), "utf-8-sig", "replace") as text:
        lines: Iterator[tuple[int, str]] = enumerate(text, 1)
        while (entry := next_line(lines)) is not None:
            number, line = entry
            count: int | None = None
            following = lines
            if line.strip().isdecimal():
                count = int(line)
            else:
                following = chain([entry], lines)
            scans.append(_read_cloud(following, number, count))
    if not scans:
        raise ValueError("it is empty, but the number of points was expected")
    intensities = [scan.columns["intensity"] for scan in scans if "intensity" in scan.columns]
    if any((values < 0).any() for values in intensities):
        for values in intensities:
            values -= LEICA_LOWEST
    return scans


def next_line(lines: Iterator[tuple[int, str]]) -> tuple[int, str] | None:
    """Return the next nonblank line with its line number, or None at the end of the file."""
    return next(((number, line) for number, line in lines if not line.isspace()), None)


def _read_cloud(lines: Iterator[tuple[int, str]], number: int, count: int | None) -> Sweep:
    """Read the next `count` points, or all points if `count` is None.

    `number` is the number of the line that declares the count.
    """
    if count == 0:
        return Sweep(np.zeros((0, 3)), {})
    first = next_line(lines)
    if first is None:
        raise CutShortError(f"line {number} declares {count:,} points, but none follow")
    names = cell_names(first, _NAMES)
    texts = (line for _, line in chain([first], lines))
    values = RowReader(names, range(len(names))).read(islice(texts, count), first[0])
    if count is not None and len(values) < count:
        raise CutShortError(f"line {number} declares {count:,} points, but {len(values):,} follow")
    return Sweep(values[:, :3], point_columns(values, names))


def cell_names(entry: tuple[int, str], names: dict[int, tuple[str, ...]]) -> tuple[str, ...]:
    """Return the names of the cells in a line, which depend on the number of cells.

    Raises
    ------
    ValueError
        If the number of cells is not among the keys of `names`.
    """
    number, line = entry
    count = len(line.split())
    if count not in names:
        expected = " or ".join(" ".join(cells) for cells in names.values())
        raise ValueError(
            f"line {number} is {printable(line)[:60]!r}, which has {plural(count, 'cell')}, but "
            f"{expected} was expected"
        )
    return names[count]


def point_columns(values: Floats, names: Sequence[str]) -> dict[str, AnyArray]:
    """Return the columns after x, y and z, keyed by name.

    `values` has shape (n, k). Colors from 0 to 255 are converted to bytes.
    """
    columns: dict[str, AnyArray] = {}
    for index, name in enumerate(names[3:], 3):
        columns[name] = values[:, index]
        if name in COLORS:
            columns[name] = np.clip(np.rint(values[:, index]), 0, 255).astype(np.uint8)
    return columns
