"""Numeric tables with a header, whose columns may have various spellings and units.

Every column must either be known, including its unit, or be ignored explicitly. Otherwise, the
table is rejected, because a column that is silently skipped may, for example, contain the rotation
of the sensor.
"""

from __future__ import annotations

import csv
import operator
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import islice
from typing import NamedTuple, cast

import numpy as np

from ..numerics.arrays import Floats
from ..words import (
    did_you_mean_each,
    format_rounded,
    format_yaml_list,
    join_alternatives,
    join_names,
    matches_pattern,
    printable,
)
from .time_units import SECONDS, TimeUnit, seconds_of

# {unit: number of units per first unit}
METERS = {"m": 1.0, "cm": 1e2, "mm": 1e3, "km": 1e-3}
DEGREES = {"deg": 1.0, "rad": np.pi / 180}
RADIANS = {"rad": 1.0, "deg": 180 / np.pi}
NUMBERS = {"": 1.0}
_UNIT_WORDS = {"s": "seconds", "deg": "degrees", "rad": "radians", "m": "meters"}
_UNIT_SPELLINGS = {
    "s": ("sec", "secs", "second", "seconds"),
    "ms": ("msec", "msecs", "millisecond", "milliseconds"),
    "us": ("usec", "usecs", "µs", "μs", "microsecond", "microseconds"),
    "ns": ("nsec", "nsecs", "nanosec", "nanosecs", "nanosecond", "nanoseconds"),
    "m": ("meter", "meters", "metre", "metres"),
    "cm": (),
    "mm": (),
    "km": (),
    "deg": ("degs", "degree", "degrees", "°"),
    "rad": ("rads", "radian", "radians"),
    "": ("-", "1"),
}
_UNITS = {word: unit for unit, words in _UNIT_SPELLINGS.items() for word in (unit, *words)}
_BRACKETS = re.compile(r"(.*?)\s*[\[(]\s*([^\])]*?)\s*[\])]")
# A column name with its unit, such as "q_w []", in a header that is separated by spaces.
_WORD = re.compile(r"[^\s\[(]+(?:\s*[\[(][^\[(\])]*[\])])?")
_IN_BRACKETS = re.compile(r"[\[(][^\[(\])]*[\])]")
_SEPARATORS = ",;\t"
_HEADER_MARK = re.compile(r"^[#%\s]*(?:HEADER:)?")  # prefix of a header in a comment
_BETWEEN = re.compile(r"[\s_\-./:]+")  # separator between the words of a name
_SUFFIX = re.compile(r"(.+?)[\s_\-./:]+([^\s_\-./:]+)")
_CAMEL = re.compile(r"(?<=[a-z])(?=[A-Z])")  # word boundary in names such as timeStamp
_SHOWN = 40  # maximum number of columns listed in a message
_MAX_NAME = 200  # characters in a name with its unit; longer text takes too long to split


@dataclass(frozen=True)
class Quantity:
    """A quantity that a table column may contain.

    Parameters
    ----------
    name
        Name under which the column is returned, including its unit, for example "yaw_deg".
    spellings
        Names in headers, without a unit. Case and separators such as spaces, underscores, hyphens
        and dots are ignored.
    units
        Units that a header may state, for example `SECONDS`. Values are returned in the first unit.
    bare
        Unit of a column whose header does not state one, or None to reject such a column.
    evident_above
        A column without a stated unit is rejected as ambiguous if its largest magnitude is greater
        than zero but does not exceed this value.
    exact
        Whether `name` itself is the only additional spelling. Case is ignored.
    """

    name: str
    spellings: tuple[str, ...]
    units: Mapping[str, float]
    bare: str | None
    evident_above: float = 0.0
    exact: bool = False


@dataclass(frozen=True)
class TableFormat:
    """A table format with columns that are defined in a specification.

    Parameters
    ----------
    name
        Name of the format.
    marker
        Name of a column that only this format has.
    bare
        Mapping from quantities to the units that apply if the header does not state one.
    unused
        Columns that the specification defines but that are not read. May contain `*` and `?`.
    """

    name: str
    marker: str
    bare: Mapping[str, str]
    unused: tuple[str, ...] = ()


class Header(NamedTuple):
    """Header of a table."""

    cells: list[str]  # column names as they appear in the file
    separator: str | None  # None if the cells are separated by spaces
    body: int  # index of the line at which the rows start
    comment: bool  # whether the header is a comment that starts with #


class ColumnName(NamedTuple):
    """A column name in a header, split into its parts.

    The comments show the parts of the name "Yaw [deg]".
    """

    stem: str  # name without the unit: "Yaw"
    words: str  # stem in lowercase without separators: "yaw"
    unit: str | None  # unit in lowercase, or None if the header does not state one: "deg"


def column_name(cell: str) -> ColumnName:
    """Split a column name in a header into its stem and its unit."""
    text = cell.strip()
    if len(text) > _MAX_NAME:
        return ColumnName(text, text, None)
    if (bracketed := _BRACKETS.fullmatch(text)) is not None:
        stem = bracketed[1]
        unit = bracketed[2].lower()
        return ColumnName(stem, _letters(stem), _UNITS.get(unit, unit))
    suffixed = _SUFFIX.fullmatch(_CAMEL.sub("_", text))
    if suffixed is not None and (unit := suffixed[2].lower()) in _UNITS and unit.isalpha():
        return ColumnName(suffixed[1], _letters(suffixed[1]), _UNITS[unit])
    return ColumnName(text, _letters(text), None)


def ignored_columns(names: Sequence[str], ignore: Sequence[str]) -> set[int]:
    """Return the indices of the columns that match patterns with `*` and `?`, ignoring case.

    Raises
    ------
    ValueError
        If a pattern does not match any column.
    """
    indices = set[int]()
    unmatched: list[str] = []
    for pattern in ignore:
        matches = {
            index
            for index, name in enumerate(names)
            if matches_pattern(name.lower(), pattern.lower())
        }
        unmatched += [] if matches else [repr(pattern)]
        indices |= matches
    if unmatched:
        columns = "columns" if len(unmatched) > 1 else "column"
        raise ValueError(
            f"ignore contains the unknown {columns} {join_names(unmatched)}. The columns are "
            f"{_listed(names)}"
        )
    return indices


def _letters(name: str) -> str:
    """Convert a name to lowercase and remove its separators."""
    return _BETWEEN.sub("", name).lower()


def find_header(
    lines: Sequence[str], is_known: Callable[[str], bool] = lambda name: True
) -> Header | None:
    """Find the header of a table, or return None if the table has no header.

    The header is the first line that is neither empty nor a comment, unless all its cells are
    numbers. In that case, the header is the last comment before the rows with as many names as the
    first row has cells. `is_known` must be true for at least half of these names, or for at least
    four of them.
    """
    body = next((i for i, line in enumerate(lines) if not _is_remark(line)), len(lines))
    if body < len(lines) and not _all_numbers(lines[body]):
        names = lines[body].lstrip("% ")
        separator = _separator_of(names)
        return Header(_cells(names, separator), separator, body + 1, False)
    for line in reversed(lines[:body]):
        names = _HEADER_MARK.sub("", line).strip()
        # A comment may use a different separator than the rows.
        cells = _cells(names, _separator_of(names))
        separator = _separator_of(lines[body]) if body < len(lines) else _separator_of(names)
        count = len(_cells(lines[body], separator)) if body < len(lines) else len(cells)
        if cells and len(cells) == count and sum(map(is_known, cells)) >= min(4, count / 2):
            return Header(cells, separator, body, True)
    return None


def _is_remark(line: str) -> bool:
    """Return whether a line is empty or a comment."""
    return not line.strip() or line.lstrip().startswith("#")


def _all_numbers(line: str) -> bool:
    """Return whether every cell in a line is empty or a number."""
    cells = [cell for cell in _cells(line, _separator_of(line)) if cell]
    return all(map(_is_number, cells))


def _is_number(cell: str) -> bool:
    """Return whether a cell is a number, which may be infinite or NaN."""
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _is_finite(cell: str) -> bool:
    return _is_number(cell) and bool(np.isfinite(float(cell)))


def _separator_of(line: str) -> str | None:
    """Return the most frequent separator outside brackets, or None if spaces separate the cells."""
    outside = _IN_BRACKETS.sub("", line)
    separator = max(_SEPARATORS, key=outside.count)
    return separator if separator in outside else None


def _cells(line: str, separator: str | None) -> list[str]:
    """Split a line into cells and remove quotes.

    Raise ValueError if the line cannot be parsed, for example because a cell is too long.
    """
    if separator is None:
        return [word.strip('"') for word in _WORD.findall(line)]
    try:
        (cells,) = csv.reader([line], delimiter=separator, skipinitialspace=True)
    except csv.Error as error:
        reason = str(error)
        if len(line) > csv.field_size_limit():
            reason = f"a cell has more than {csv.field_size_limit():,} characters"
        raise ValueError(f"one of its lines cannot be parsed as a table row: {reason}") from error
    return [cell.strip().strip('"') for cell in cells]


def read_table(
    text: str,
    quantities: Sequence[Quantity],
    *,
    required: Callable[[Mapping[str, Floats]], Sequence[str]] = lambda columns: (),
    columns: Mapping[str, str] | None = None,
    ignore: Sequence[str] = (),
    formats: Sequence[TableFormat] = (),
    unused: Sequence[str] = (),
    refused: Mapping[str, str] | None = None,
    bare: Mapping[str, str] | None = None,
    time_unit: TimeUnit | None = None,
) -> dict[str, Floats]:
    """Read a numeric table, rejecting columns that are neither known nor ignored.

    Parameters
    ----------
    text
        A header and rows. Cells are separated by commas, semicolons, tabs or spaces. Lines that
        start with # are comments.
    quantities
        Quantities that the columns may contain.
    required
        Function that returns the names of the quantities that a table with the given columns must
        have.
    columns
        Mapping from quantity names, including their units, to column names in the file. Use it for
        columns with other spellings. If it is None, users cannot set it, and error messages do not
        mention it.
    ignore
        Names of columns to skip. May contain `*` and `?`.
    formats
        Table formats with specified columns.
    unused
        Names of additional columns to skip silently.
    refused
        Mapping from spellings to the reason why such a column cannot be used.
    bare
        Mapping from quantities to the units that apply if the header does not state one.
    time_unit
        Unit of times that the user specified. It overrides the unit in the header.

    Returns
    -------
    dict
        Mapping from quantity names to float64 arrays with shape (k,), in the first unit of each
        quantity.

    Raises
    ------
    ValueError
        If the header is missing, a column is unknown, missing or ambiguous, a unit is unknown or
        missing, a cell is not a finite number, or the unit of times is implausible.
    """
    lines = text.splitlines()
    spellings = {_letters(name): quantity for quantity in quantities for name in quantity.spellings}
    exact = {quantity.name.lower(): quantity for quantity in quantities if quantity.exact}
    exact |= {quantity.name: quantity for quantity in quantities if quantity.exact}
    header = find_header(
        lines, lambda cell: column_name(cell).words in spellings or cell.lower() in exact
    )
    if header is None:
        example = ",".join(quantity.name for quantity in quantities[:4])
        raise ValueError(
            f"it has no header. Name its columns in the first line, for example {example}"
        )
    reader = _ColumnReader(header, quantities, spellings, exact, time_unit)
    reader.choose(columns)
    reader.leave_out(ignore)
    reader.assign(formats, unused, refused or {}, bare or {})
    names = {name: number for name, (number, _) in reader.assigned.items()}
    required_names = required(dict.fromkeys(names, np.empty(0)))
    if missing := [repr(name) for name in required_names if name not in names]:
        columns_word = "columns" if len(missing) > 1 else "column"
        raise ValueError(
            f"it has no {columns_word} {join_names(missing)}. Its columns are "
            f"{_listed(header.cells)}"
        )
    values = _numbers(lines, header, names, [*required_names, *(columns or {})])
    return {
        name: reader.convert_units(name, values[:, i]) for i, name in enumerate(reader.assigned)
    }


class _UnitMissingError(ValueError):
    """An error for a column without a unit."""


class _ColumnReader:
    """Assignment of header columns to quantities."""

    def __init__(
        self,
        header: Header,
        quantities: Sequence[Quantity],
        spellings: Mapping[str, Quantity],
        exact: Mapping[str, Quantity],
        time_unit: TimeUnit | None,
    ) -> None:
        self.cells = [cell.lstrip("#%").strip() for cell in header.cells]
        self.quantities = quantities
        self.spellings = spellings
        self.exact = exact
        self.time_unit = time_unit
        # {quantity name: (column index, unit, or None if the header does not state one)}
        self.assigned: dict[str, tuple[int, str | None]] = {}
        self.left_out: set[int] = set()  # indices of ignored columns
        self.can_choose = False  # whether users can set `columns`, so that messages recommend it

    def quantity_of(self, cell: str) -> tuple[Quantity, str | None] | None:
        """Return the quantity and stated unit of a column name, or None if the name is unknown."""
        if (quantity := self.exact.get(cell) or self.exact.get(cell.lower())) is not None:
            return quantity, None
        name = column_name(cell)
        quantity = self.spellings.get(name.words) or self.exact.get(name.stem.lower())
        return None if quantity is None else (quantity, name.unit)

    def choose(self, columns: Mapping[str, str] | None) -> None:
        self.can_choose = columns is not None
        faults: list[str] = []
        for name, file_name in (columns or {}).items():
            try:
                self._choose(name, file_name)
            except ValueError as error:
                faults.append(str(error))
        _refuse(faults)

    def _choose(self, name: str, file_name: str) -> None:
        match = self.quantity_of(name)
        if match is None:
            raise ValueError(
                f"columns contains the unknown name {name!r}. Possible names are {self.possible}"
            )
        quantity, unit = match
        spelling = file_name.lstrip("#%").strip()
        matches = [i for i, cell in enumerate(self.cells) if cell == spelling] or [
            i for i, cell in enumerate(self.cells) if cell.lower() == spelling.lower()
        ]
        if not matches:
            raise ValueError(
                f"it has no column {file_name!r}. Its columns are {_listed(self.cells)}"
            )
        if len(matches) > 1:
            raise ValueError(f"its column {file_name!r} occurs {len(matches)} times")
        stated = column_name(spelling).unit
        if unit is not None and stated in quantity.units and stated != unit:
            raise ValueError(
                f"columns reads {file_name!r} as {name}, but the header states the unit {stated}"
            )
        if unit is None:
            unit = self._unit(quantity, file_name, stated, {})
        elif quantity.units is SECONDS and self.time_unit not in (None, unit):
            raise ValueError(
                f"columns reads {file_name!r} as {name}, which cannot be combined with time_unit: "
                f"{self.time_unit}"
            )
        self._add(quantity, matches[0], unit)

    def leave_out(self, ignore: Sequence[str]) -> None:
        self.left_out |= ignored_columns(self.cells, ignore)

    def assign(
        self,
        formats: Sequence[TableFormat],
        unused: Sequence[str],
        refused: Mapping[str, str],
        bare: Mapping[str, str],
    ) -> None:
        """Assign the remaining columns by name.

        Raise ValueError with a message about all columns that cannot be assigned.
        """
        chosen = {index for index, _ in self.assigned.values()} | self.left_out
        words = [column_name(cell).words for cell in self.cells]
        matching = [form for form in formats if _letters(form.marker) in words]
        names = [name for form in matching for name in form.unused]
        patterns = [_letters(name) for name in (*names, *unused)]
        units = reduce(operator.or_, (form.bare for form in matching), dict(bare))
        unknown: list[str] = []
        without_unit: list[tuple[Quantity, str]] = []
        faults: list[str] = []
        for index, cell in enumerate(self.cells):
            if index in chosen or not cell or re.fullmatch(r"unnamed: \d+", cell.lower()):
                continue  # columns without a name are checked together with the rows
            if (match := self.quantity_of(cell)) is not None:
                quantity, unit = match
                try:
                    self._add(quantity, index, self._unit(quantity, cell, unit, units))
                except _UnitMissingError:
                    without_unit.append((quantity, printable(cell)))
                except ValueError as error:
                    faults.append(str(error))
            elif reason := next((refused[w] for w in refused if _letters(w) == words[index]), ""):
                faults.append(f"its column {printable(cell)!r} {reason}")
            elif not any(matches_pattern(words[index], pattern) for pattern in patterns):
                unknown.append(cell)
        if without_unit:
            faults.insert(0, self._lacking_units(without_unit))
        if unknown:  # last, because this message ends with the long list of known columns
            faults.append(self._unknown(unknown))
        _refuse(faults)

    def _unknown(self, cells: Sequence[str]) -> str:
        columns = "columns" if len(cells) > 1 else "column"
        pronoun = "them" if len(cells) > 1 else "it"
        hint = did_you_mean_each(cells, [quantity.name for quantity in self.quantities])
        return (
            f"unknown {columns} {_listed([repr(cell) for cell in cells])}.{hint} Rename "
            f"{pronoun}, or ignore {pronoun} with `{_ignoring(cells)}`. The known "
            f"columns are {self.possible}"
        )

    def _lacking_units(self, columns: Sequence[tuple[Quantity, str]]) -> str:
        """Return a message about columns without a unit.

        Each column is specified by its quantity and its name in the file.
        """
        if len(columns) == 1:
            return str(self._unit_missing(*columns[0]))
        names = [
            f"{quantity.name} ({_UNIT_WORDS[next(iter(quantity.units))]})"
            for quantity, _ in columns
        ]
        pairs = ", ".join(f"{quantity.name}: {cell}" for quantity, cell in columns)
        return (
            f"its columns {join_names([repr(cell) for _, cell in columns])} have no unit. Rename "
            f"them to {join_names(names)}" + f", or set `columns: {{{pairs}}}`" * self.can_choose
        )

    def _unit_missing(self, quantity: Quantity, cell: str) -> _UnitMissingError:
        first, *other_units = quantity.units
        stem = quantity.name.removesuffix(f"_{first}")
        choice = f", or set `columns: {{{quantity.name}: {printable(cell)}}}`" * self.can_choose
        unit_option = ", or set time_unit" * (quantity.units is SECONDS)
        names = [f"{quantity.name} ({_UNIT_WORDS[first]})"]
        names += [f"{stem}_{other_unit}" for other_unit in other_units]
        return _UnitMissingError(
            f"its column {printable(cell)!r} has no unit. Rename it to "
            f"{join_alternatives(names)}{choice}{unit_option}"
        )

    def _unit(
        self, quantity: Quantity, cell: str, unit: str | None, units: Mapping[str, str]
    ) -> str | None:
        """Return the unit of a column, or None if neither the column nor an option states it.

        In the latter case, the unit is `quantity.bare`, and the values must be checked as well.
        """
        if quantity.units is SECONDS and self.time_unit is not None:
            return self.time_unit
        if unit is not None:
            if unit not in quantity.units:
                units_read = join_alternatives([name or "none" for name in quantity.units])
                raise ValueError(
                    f"its column {printable(cell)!r} has the unit {printable(unit)!r}, "
                    f"which is not supported. Convert it to {units_read}"
                )
            return unit
        if (implied := units.get(quantity.name)) is not None:
            return implied
        if quantity.bare is None:
            raise self._unit_missing(quantity, cell)
        return None

    def _add(self, quantity: Quantity, index: int, unit: str | None) -> None:
        """Assign a column to a quantity. Raise ValueError if the quantity already has a column."""
        if (earlier := self.assigned.get(quantity.name)) is not None:
            earlier_cell = self.cells[earlier[0]]
            cell = self.cells[index]
            if earlier_cell == cell:
                raise ValueError(f"its column {printable(cell)!r} occurs twice")
            raise ValueError(
                f"its columns {printable(earlier_cell)!r} and {printable(cell)!r} both correspond "
                f"to {quantity.name}. Ignore one of them, for example with `{_ignoring([cell])}`"
            )
        self.assigned[quantity.name] = index, unit

    def convert_units(self, name: str, values: Floats) -> Floats:
        """Convert the values of a quantity to its first unit.

        Raise ValueError if the unit is ambiguous or implausible.
        """
        index, unit = self.assigned[name]
        quantity = next(quantity for quantity in self.quantities if quantity.name == name)
        if unit is None:
            unit = quantity.bare
            largest = np.abs(values).max(initial=0.0)
            if 0 < largest <= quantity.evident_above:
                stem = name.removesuffix(f"_{unit}")
                names = " or ".join(f"{stem}_{unit_name}" for unit_name in quantity.units)
                raise ValueError(
                    f"the unit of its column {printable(self.cells[index])!r} is ambiguous, "
                    f"because its values do not exceed {format_rounded(largest)}. Rename the "
                    f"column to {names}"
                )
        assert unit is not None  # set above
        if quantity.units is SECONDS:
            return seconds_of(values, self.time_unit, cast(TimeUnit, unit))
        count = quantity.units[unit]
        return values if count == 1 else values / count

    @property
    def possible(self) -> str:
        """Names of all quantities, each with its names in other units."""
        names = []
        for quantity in self.quantities:
            first, *other_units = quantity.units
            stem = quantity.name.removesuffix(f"_{first}")
            units = (
                []
                if quantity.bare == first
                else [f"{stem}_{other_unit}" for other_unit in other_units]
            )
            names.append(f"{quantity.name} (or {', '.join(units)})" if units else quantity.name)
        return ", ".join(names)


def _refuse(faults: Sequence[str]) -> None:
    """Raise a ValueError that lists all faults, if there are any."""
    if faults:
        first, *others = faults
        raise ValueError(". ".join([first, *(fault[0].upper() + fault[1:] for fault in others)]))


def _listed(cells: Sequence[str]) -> str:
    """Join the first column names, with an ellipsis if there are more."""
    return ", ".join(printable(cell) for cell in cells[:_SHOWN]) + ", …" * (len(cells) > _SHOWN)


def _ignoring(cells: Sequence[str]) -> str:
    return f"{{file: …, ignore: {format_yaml_list(cells)}}}"


def _numbers(
    lines: Sequence[str], header: Header, names: Mapping[str, int], required_names: Sequence[str]
) -> Floats:
    """Parse the numbers in the named columns.

    The result has shape (rows, columns). Raise ValueError, naming the column and line, if a cell is
    not a finite number.
    """
    body = lines[header.body :]
    rows = [line for line in body if not _is_remark(line)]
    if not rows:
        raise ValueError("it has no rows of numbers")
    _check_widths(lines, header)
    _check_unnamed(rows, header)
    if not names:
        return np.empty((len(rows), 0))
    try:
        values = np.loadtxt(
            rows,
            ndmin=2,
            delimiter=header.separator,
            quotechar='"',
            comments=None,
            usecols=[*names.values()],
        )
        if not np.isfinite(values).all():
            raise ValueError("it contains NaN or infinite values")
    except ValueError as error:
        for number, cells in _rows_of(lines, header):
            for name, index in names.items():
                if not _is_finite(cells[index]):
                    alternative = (
                        ""
                        if name in required_names
                        else (". Correct the value, or ignore the column")
                    )
                    raise ValueError(
                        f"its column {printable(header.cells[index])!r} contains "
                        f"{printable(cells[index])!r} in line {number}. Each row must have a "
                        f"number in this column{alternative}"
                    ) from error
        raise
    return np.asarray(values, np.float64)


def _rows_of(lines: Sequence[str], header: Header) -> Iterator[tuple[int, list[str]]]:
    """Yield the line number, starting at 1, and the cells of each row."""
    for number, line in enumerate(islice(lines, header.body, None), header.body + 1):
        if not _is_remark(line):
            yield number, _cells(line, header.separator)


def _check_widths(lines: Sequence[str], header: Header) -> None:
    """Raise ValueError unless each row has as many cells as the header.

    A row may have an additional empty cell at the end.
    """
    width = len(header.cells)
    for number, line in enumerate(islice(lines, header.body, None), header.body + 1):
        if _is_remark(line):
            continue
        if header.separator is None:
            count = len(line.split())
        elif '"' in line:
            count = len(_cells(line, header.separator))
        else:
            count = line.count(header.separator) + 1
        if count == width + 1 and header.separator and line.rstrip().endswith(header.separator):
            continue
        if count != width:
            raise ValueError(f"line {number} has {count} cells, but the header has {width}")


def _check_unnamed(rows: Sequence[str], header: Header) -> None:
    """Raise ValueError if a column without a name contains anything but row numbers.

    Row numbers start at 0. Cells may also be empty.
    """
    for index, cell in enumerate(header.cells):
        if cell and not re.fullmatch(r"unnamed: \d+", cell.lower()):
            continue
        for number, row in enumerate(rows):
            cells = _cells(row, header.separator)
            text = cells[index] if index < len(cells) else ""
            if text not in ("", str(number)):
                raise ValueError(
                    f"its column {index + 1} has no name, but contains {text[:20]!r}. Name it in "
                    "the header"
                )
