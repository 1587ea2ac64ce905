"""Readers for rows of numbers in text files.

NumPy is ten times as fast as parsing cells in Python. However, it neither reports the line with an
error nor reads decimal commas, text columns and empty cells. It is therefore used first, and cells
are parsed one by one if it fails.
"""

from __future__ import annotations

import csv
from array import array
from collections.abc import Collection, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import islice

import numpy as np

from ...numerics.arrays import Floats
from ...words import plural, printable

COMMENT_PREFIXES = ("#", "//", "%")  # prefixes of comment lines
_BLOCK = 1 << 16  # lines that are read at once
_SHOWN = 40  # maximum number of characters of a cell in an error message


def cells_of(line: str, separator: str | None) -> list[str]:
    """Split a line into cells, and remove quotes and surrounding whitespace."""
    if separator is not None and '"' in line:
        with suppress(csv.Error):
            (cells,) = csv.reader([line.strip()], delimiter=separator, skipinitialspace=True)
            return [cell.strip() for cell in cells]
    return [cell.strip().strip('"') for cell in line.split(separator)]


@dataclass
class RowReader:
    """A reader of lines that have the same cells.

    Parameters
    ----------
    names
        Names of the cells in a line.
    required
        Indices of the cells that must contain a number. Other cells can be empty and are read as
        NaN.
    separator
        Separator of the cells, or None for spaces and tabs.
    used
        Indices of the cells to read, or None for all.
    """

    names: Sequence[str]
    required: Collection[int]
    separator: str | None = None
    used: Sequence[int] | None = None
    point_line: int = field(default=0, init=False)  # first line with a decimal point, or 0
    comma_line: int = field(default=0, init=False)  # first line with a decimal comma, or 0

    def read(self, lines: Iterable[str], number: int) -> Floats:
        """Read the numbers in all lines except blank lines and comments.

        `number` is the line number of the first line. The shape is (n, k).

        Raises
        ------
        ValueError
            If a line is invalid, with its line number in the message.
        """
        width = len(self.names if self.used is None else self.used)
        blocks = [np.empty((0, width))]
        iterator = iter(lines)
        while block := list(islice(iterator, _BLOCK)):
            blocks.append(self._read_block(block, number, width))
            number += len(block)
        if self.point_line and self.comma_line:
            raise ValueError(
                f"line {self.point_line} has decimal points and line {self.comma_line} decimal "
                "commas. Use the same format for all numbers"
            )
        return np.concatenate(blocks)

    def _read_block(self, lines: list[str], number: int, width: int) -> Floats:
        has_points = any("." in line for line in lines)
        has_commas = self.separator != "," and any("," in line for line in lines)
        if self.used is None and not (has_points and has_commas):
            filled = [line for line in lines if not line.isspace()]
            if has_commas:
                filled = [line.replace(",", ".") for line in filled]
            try:
                values = np.loadtxt(filled, delimiter=self.separator, comments=None, ndmin=2)
            except ValueError:
                pass  # parsing cell by cell reports the line number
            else:
                if values.shape == (len(filled), width):
                    if has_points and not self.point_line:
                        self.point_line = _line_with(".", lines, number)
                    if has_commas and not self.comma_line:
                        self.comma_line = _line_with(",", lines, number)
                    return np.asarray(values, np.float64)
        return self._read_cells(lines, number, width)

    def _read_cells(self, lines: list[str], number: int, width: int) -> Floats:
        numbers = array("d")
        used = range(width) if self.used is None else self.used
        for line_number, line in enumerate(lines, number):
            text = line.strip()
            if not text or text.startswith(COMMENT_PREFIXES):
                continue
            cells = cells_of(text, self.separator)
            if len(cells) == len(self.names) + 1 and not cells[-1]:
                cells.pop()  # a separator at the end of the line
            if len(cells) != len(self.names):
                raise ValueError(self._wrong_width(line_number, cells))
            numbers.extend(self._number(cells[index], index, line_number) for index in used)
        return np.frombuffer(numbers, np.float64).reshape(-1, width)

    def _number(self, cell: str, index: int, line_number: int) -> float:
        """Parse the number in a cell and record its decimal mark."""
        text = cell
        if "." in cell and not self.point_line:
            self.point_line = line_number
        if "," in cell and self.separator != ",":
            text = cell.replace(",", ".")
            self.comma_line = self.comma_line or line_number
        if not text and index not in self.required:
            return float("nan")
        try:
            return float(text.replace("_", "no"))  # Python allows underscores in numbers
        except ValueError as error:
            raise ValueError(
                f"line {line_number} has {printable(cell)[:_SHOWN]!r} as {self.names[index]}, but "
                "a number was expected"
            ) from error

    def _wrong_width(self, line_number: int, cells: Sequence[str]) -> str:
        names = printable(", ".join(self.names))
        message = (
            f"line {line_number} has {plural(len(cells), 'cell')}, but {len(self.names)} were "
            f"expected ({names})"
        )
        if self.separator == "," and len(cells) > len(self.names):
            message += (
                ". To use decimal commas, separate the columns with a different character, such "
                "as a semicolon"
            )
        return message


def _line_with(mark: str, lines: Sequence[str], number: int) -> int:
    """Return the number of the first line that contains a given character.

    `number` is the line number of `lines[0]`.
    """
    return number + next(index for index, line in enumerate(lines) if mark in line)
