"""Sections of campaign files, and random numbers that determine the values of jobs."""

from __future__ import annotations

import csv
import hashlib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from decimal import Context, Decimal
from fractions import Fraction
from functools import cached_property, lru_cache
from itertools import accumulate
from math import isclose, isfinite, lcm
from pathlib import Path
from statistics import NormalDist
from typing import Annotated, Any, Literal, NamedTuple, get_args, get_origin

import numpy as np
import yaml
from pydantic import (
    BaseModel,
    BeforeValidator,
    Field,
    TypeAdapter,
    ValidationError,
    model_validator,
)

from lidarfiles.clouds.built_in_formats import DATA_SETS, LAYOUTS
from lidarfiles.clouds.writing import ExportSpec
from lidarfiles.datasets.job_table import Value
from lidarsim.errors import LidarError, MissingFileError, Mistakes, message_of
from lidarsim.io.input_files import not_found
from lidarsim.io.tables import ignored_columns
from lidarsim.io.textfile import read_text
from lidarsim.io.yamlfile import load_yaml
from lidarsim.schema.checks import check_fields
from lidarsim.schema.declared import (
    FileSection,
    MinMax,
    Seed,
    Several,
    Text,
    TextOrTexts,
    UnitShare,
    about,
    accept_short_form,
    describe_allowed,
    is_text,
    not_allowed_error,
    require_one_of,
)
from lidarsim.schema.error_sentences import convert_validation_errors
from lidarsim.schema.section_fields import sections_in
from lidarsim.schema.value_texts import one_line
from lidarsim.words import did_you_mean_each, format_yaml_list, join_names, printable

from ..sections import IgnoredColumns, Section, allow_empty

# Normally distributed numbers are limited to this many standard deviations from the mean. Numbers
# outside the limit, 2 in a billion, are drawn again.
SIGMAS = 6.0
MIN_SHARE = 0.01  # minimum share of a normal distribution within its limits

_EXACT = Context(prec=40)
_DIGITS = 12  # numbers are rounded, so that tables are readable and contain the exact values


class JobRandom:
    """Reproducible stream of random numbers for one quantity of a job.

    Each number is computed from a hash of the campaign seed, the job number, the name of the
    quantity, and the number of earlier draws. The numbers of a quantity therefore do not change if
    other quantities are added, removed or reordered, or if the number of jobs changes.

    The numbers are the same on every machine. They are computed with integers, with basic
    floating-point operations, and with functions of `decimal`, which are correctly rounded. The
    functions of the C library and NumPy are not used, because their results differ in the last bit
    between processors and library versions.

    Examples
    --------
    >>> JobRandom(7, 417, "weather.visibility_km").uniform(0.2, 20)
    18.853258822
    """

    def __init__(self, seed: int, number: int, purpose: str) -> None:
        self._hash = hashlib.sha256(f"{seed}\n{number}\n{purpose}\n".encode())
        self._drawn = 0

    def bits(self, count: int = 64) -> int:
        """Draw an integer with `count` random bits. The maximum count is 256."""
        self._drawn += 1
        digest = self._hash.copy()
        digest.update(str(self._drawn).encode())
        return int.from_bytes(digest.digest(), "big") >> (256 - count)

    def below(self, count: int) -> int:
        """Draw an integer from 0 to `count` - 1."""
        return self.bits(128) * count >> 128

    def integer(self, minimum: int, maximum: int) -> int:
        """Draw an integer from `minimum` to `maximum`, inclusive."""
        return minimum + self.below(maximum - minimum + 1)

    def unit(self) -> float:
        """Draw a number from the half-open interval [0, 1)."""
        return self.bits(53) * 2.0**-53

    def uniform(self, minimum: float, maximum: float) -> float:
        """Draw a uniformly distributed number."""
        return _clip(_round(minimum + (maximum - minimum) * self.unit()), minimum, maximum)

    def log_uniform(self, minimum: float, maximum: float) -> float:
        """Draw a number whose logarithm is uniformly distributed."""
        log_minimum, log_maximum = (_EXACT.ln(Decimal(limit)) for limit in (minimum, maximum))
        fraction = _as_fraction(self.bits(53))
        number = _EXACT.exp(
            _EXACT.add(
                log_minimum, _EXACT.multiply(fraction, _EXACT.subtract(log_maximum, log_minimum))
            )
        )
        return _clip(_round(float(number)), minimum, maximum)

    def normal(self, mean: float, std: float, limits: tuple[float, float] | None = None) -> float:
        """Draw a normally distributed number.

        Numbers outside the limits are drawn again. By default, the limits are `SIGMAS` standard
        deviations below and above the mean.
        """
        minimum, maximum = limits or (mean - SIGMAS * std, mean + SIGMAS * std)
        while True:
            number = _round(mean + std * self._standard_normal())
            if minimum <= number <= maximum:
                return number

    def _standard_normal(self) -> float:
        """Draw a standard normal number with the polar method (Marsaglia and Bray, 1964)."""
        while True:
            x, y = (_as_fraction(2 * self.bits(53) + 1 - 2**53) for _ in range(2))
            square = _EXACT.fma(x, x, _EXACT.multiply(y, y))
            if square < 1:
                ratio = _EXACT.divide(_EXACT.multiply(Decimal(-2), _EXACT.ln(square)), square)
                return float(_EXACT.multiply(x, _EXACT.sqrt(ratio)))

    def index(self, count: int, weights: Sequence[float] = ()) -> int:
        """Draw an index below `count`, either uniformly or with the given weights."""
        if not weights:
            return self.below(count)
        cumulative = list(accumulate(weights))
        number = self.unit() * cumulative[-1]
        return next((i for i, upper in enumerate(cumulative) if number < upper), count - 1)

    def subset(self, count: int, chosen: int) -> list[int]:
        """Draw distinct integers below `count`, and return them in ascending order (Floyd, 1987).

        `chosen` is the number of integers to draw.
        """
        numbers: set[int] = set()
        for last in range(count - chosen, count):
            number = self.below(last + 1)
            numbers.add(last if number in numbers else number)
        return sorted(numbers)

    def permutation(self, count: int) -> list[int]:
        """Draw a permutation of the integers below `count` with the Fisher-Yates shuffle."""
        numbers = list(range(count))
        for last in range(count - 1, 0, -1):
            partner = self.below(last + 1)
            numbers[last], numbers[partner] = numbers[partner], numbers[last]
        return numbers

    def generator(self) -> np.random.Generator:
        """Return a NumPy generator for functions that draw random numbers themselves."""
        return np.random.Generator(np.random.Philox(key=self.bits(128)))


def _as_fraction(bits: int) -> Decimal:
    return _EXACT.divide(Decimal(bits), Decimal(2**53))


def _round(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")


def _clip(value: float, minimum: float, maximum: float) -> float:
    return min(max(value, minimum), maximum)


MAX_JOBS = 10_000_000
# Longer lists and mappings are shown in the job table by their position in the list of choices.
_MAX_LABEL_LENGTH = 60

Options = Annotated[
    Annotated[Several[Any], Field(min_length=1)]
    | Annotated[dict[Text, Any], Field(min_length=1)]
    | None,
    describe_allowed("a list of values, or a mapping of names to values"),
]
Weight = Annotated[float, Field(ge=0, le=1e9)]


class NormalDistribution(Section):
    """A normal distribution, optionally truncated.

    Numbers outside `limits` are drawn again.
    """

    mean: Annotated[float, about("mean")]
    std: Annotated[float, about("standard deviation", gt=0)]
    limits: Annotated[
        MinMax[float] | None,
        about(
            "minimum and maximum (default: 6 standard deviations below and above the mean)", [0, 1]
        ),
    ] = None

    @model_validator(mode="after")
    def _check_limits(self) -> NormalDistribution:
        """Raise ValueError if numbers would overflow or the limits exclude nearly all of them."""
        if self.limits is not None:
            lower_fraction, upper_fraction = map(NormalDist(self.mean, self.std).cdf, self.limits)
            if upper_fraction - lower_fraction < MIN_SHARE:
                raise ValueError(
                    f"`limits` must include at least {MIN_SHARE:.0%} of the distribution."
                )
        if not isfinite(self.limit_values[1] - self.limit_values[0]):
            raise ValueError("The numbers of the distribution are too large.")
        return self

    @property
    def limit_values(self) -> tuple[float, float]:
        """Smallest and largest number that can be drawn."""
        reach = SIGMAS * self.std
        return self.limits or (self.mean - reach, self.mean + reach)


class RowSample(Section):
    """Random rows of a table, which are appended to a list such as `actors`."""

    file: Annotated[
        Text,
        about(
            ".csv table whose header contains fields of an entry, such as name, box and "
            "trajectory.points; relative to the folder of the base",
            alias="from",
        ),
    ]
    count: Annotated[
        MinMax[Annotated[int, Field(ge=0)]],
        accept_short_form(lambda v: type(v) is int, lambda v: [v, v], int | list[int]),
        about("number of rows in a job, or [minimum, maximum]"),
    ]
    ignore: IgnoredColumns = ()


_KINDS = ("uniform", "log_uniform", "normal", "integer", "choice", "each", "sample")


class ValueRule(Section):
    """Rule that chooses a value for each job.

    Exactly one field other than `weights` must be set.
    """

    uniform: Annotated[
        MinMax[float] | None,
        about("uniformly distributed number between a minimum and a maximum", [0.5, 2]),
    ] = None
    log_uniform: Annotated[
        MinMax[Annotated[float, Field(gt=0)]] | None,
        about("number whose logarithm is uniformly distributed between two limits", [0.2, 20]),
    ] = None
    normal: Annotated[
        NormalDistribution | None, about("normally distributed number", {"mean": 0, "std": 1})
    ] = None
    integer: Annotated[
        MinMax[int] | None, about("random integer from a minimum to a maximum, inclusive", [1, 6])
    ] = None
    choice: Annotated[
        Options,
        about(
            "random value from a list, or from a mapping of names to values",
            ["velodyne/vlp16", "my.yaml"],
        ),
    ] = None
    weights: Annotated[
        Several[Weight] | None, about("relative probabilities of the values of choice", [3, 1])
    ] = None
    each: Annotated[
        Options,
        about(
            "all values of a list in turn; several fields with each form a grid in which the "
            "first field changes fastest"
        ),
    ] = None
    sample: Annotated[
        RowSample | None,
        about(
            "random rows of a table that are added to a list",
            {"from": "parked.csv", "count": [0, 40]},
        ),
    ] = None

    _one_kind = require_one_of(*_KINDS)

    @model_validator(mode="after")
    def _check_weights(self) -> ValueRule:
        """Raise ValueError unless there is one weight for each value of `choice`."""
        if self.weights is not None:
            if self.choice is None or len(self.weights) != len(self.choice):
                raise ValueError("`weights` must have one weight for each value of `choice`.")
            if not sum(self.weights):
                raise ValueError("At least one of the `weights` must be greater than 0.")
        return self

    @property
    def kind(self) -> str:
        """Name of the field that is set, such as "uniform"."""
        return next(name for name in _KINDS if getattr(self, name) is not None)

    @cached_property
    def options(self) -> list[tuple[Any, Value | None]]:
        """Values of `choice` or `each`, with their labels in the job table."""
        values = self.choice if self.choice is not None else self.each
        if isinstance(values, Mapping):
            return [(value, name) for name, value in values.items()]
        return [(value, _table_label(value, index)) for index, value in enumerate(values or ())]

    @property
    def limit_values(self) -> list[Any]:
        """Representative values, which are validated instead of all possible values.

        For a range, these are its limits. For a list, these are all of its values.
        """
        if self.normal is not None:
            return list(self.normal.limit_values)
        chosen = [value for value, _ in self.options]
        return list(self.uniform or self.log_uniform or self.integer or chosen)

    def draw(self, rng: JobRandom) -> tuple[Any, Value | None]:
        """Draw a value, and return it with its label in the job table.

        The label None results in an empty cell. `each` and `sample` are not supported, because they
        require more than the random numbers of a job.
        """
        if self.choice is not None:
            return self.options[rng.index(len(self.options), self.weights or ())]
        if self.normal is not None:
            value = rng.normal(self.normal.mean, self.normal.std, self.normal.limits)
        else:
            value = getattr(rng, self.kind)(*self.limit_values)
        return value, value

    def hint(self, error: str) -> str:
        """Return advice for the error message about an invalid limit, or an empty string."""
        if self.integer is None and "whole number" in error and not self.options:
            return " Use `integer: [MIN, MAX]`."
        has_limits = self.normal is None or self.normal.limits is not None
        return "" if has_limits else " Set `limits`."

    @property
    def words(self) -> str:
        """Description of the possible values, such as "0.2 to 20, log_uniform"."""
        if self.sample is not None:
            min_rows, max_rows = self.sample.count
            rows = f"{min_rows:,}" if min_rows == max_rows else f"{min_rows:,} to {max_rows:,}"
            return f"{rows} of {self.sample.file}"
        if self.normal is not None:
            minimum, maximum = self.normal.limit_values
            shape = f"normal, {self.normal.mean:g} ± {self.normal.std:g}"
            return f"{minimum:g} to {maximum:g}, {shape}"
        if limits := self.uniform or self.log_uniform or self.integer:
            return f"{limits[0]:.12g} to {limits[1]:.12g}, {self.kind}"
        shown = ["none" if label is None else str(label) for _, label in self.options]
        if self.weights is not None:
            shown = [f"{text} ({w:g})" for text, w in zip(shown, self.weights, strict=True)]
        listed = ", ".join(shown[:8])
        if len(shown) > 8:
            listed = f"{listed}, … ({len(shown):,} values)"
        if self.each is not None:
            return f"each of {listed}, in turn"
        return f"chosen from {listed}{', with these weights' * (self.weights is not None)}"


def _check_rule(value: Any) -> Any:
    """Return an entry of `vary`, or raise an error if it does not define a choice."""
    if not isinstance(value, (dict, ValueRule)):
        raise not_allowed_error(
            "a mapping that defines the choice, such as {uniform: [0, 1]} or {choice: [1, 4]}"
        )
    return value


ValueRuleEntry = Annotated[
    ValueRule, BeforeValidator(_check_rule, json_schema_input_type=ValueRule)
]


def _table_label(value: Any, index: int) -> Value | None:
    """Return the label of a value in the job table.

    `index` is the index of the value in the list of choices, which replaces long lists and
    mappings.
    """
    if isinstance(value, (list, dict)):
        text = json.dumps(value, ensure_ascii=False, default=str)
        return text if len(text) <= _MAX_LABEL_LENGTH else f"choice {index + 1}"
    is_plain = value is None or isinstance(value, (bool, int, float, str))
    return value if is_plain else str(value)  # dates and times


@dataclass(frozen=True)
class DatasetFormat(FileSection):
    """Format of a data set.

    The constructor raises LidarError if the format or layout is unknown.
    """

    format: Annotated[
        Literal[tuple(DATA_SETS)],  # type: ignore[valid-type]
        about(
            "format of the files: kitti, nuscenes, webdataset, mcap, parquet, images, or folder "
            "for one cloud per job"
        ),
    ] = "kitti"
    layout: Annotated[
        Literal[tuple(LAYOUTS)],  # type: ignore[valid-type]
        about("point layout (mcap only)"),
    ] = "velodyne"
    compensated: Annotated[
        bool,
        about(
            "whether points are motion-compensated to the start of the sweep and have no times; "
            "otherwise, each point is in the sensor frame at the time of its firing (mcap only)"
        ),
    ] = False

    compensated_actors: Annotated[
        bool,
        about(
            "whether points of actors are moved to the pose of the actor at the start of the "
            "sweep, so that they are inside its box; otherwise, they are at the pose at the time "
            "of their firing (not for parquet and folder)"
        ),
    ] = False
    pose_rate_hz: Annotated[
        float | None,
        about(
            "poses per second on /tf in mcap (default: one at the start of each sweep)",
            gt=0,
            le=10_000,
        ),
    ] = None

    __repr__ = one_line

    def __post_init__(self) -> None:
        check_fields(self)
        _ = self.export_spec  # raises LidarError if the fields cannot be combined

    @property
    def export_spec(self) -> ExportSpec:
        """Format of the files that are written for each job."""
        return ExportSpec(
            DATA_SETS[self.format],
            self.layout,
            self.compensated,
            compensated_actors=self.compensated_actors,
            pose_rate_hz=self.pose_rate_hz,
        )


DatasetFormatEntry = Annotated[
    DatasetFormat,
    accept_short_form(
        lambda v: v is None or is_text(v),
        lambda v: {"format": v} if v else {},
        Text | DatasetFormat | None,
    ),
]


class CampaignSection(Section):
    """A campaign, whose jobs are base scenarios with fields that vary between jobs.

    File names are relative to the folder of the base scenario. The file name of the base scenario
    is relative to the folder of the campaign file.
    """

    base: Annotated[
        TextOrTexts,
        about("scenario or mesh file, or a list of them that the jobs use in turn", min_length=1),
    ]
    count: Annotated[
        int | None,
        about(
            "number of jobs; if no value is random, the default is one job for each combination of "
            "bases and values of each",
            1000,
            ge=1,
            le=MAX_JOBS,
        ),
    ] = None
    seed: Annotated[Seed, about("random seed; the same seed results in the same values")] = 0
    vary: Annotated[
        dict[Text, ValueRuleEntry],
        allow_empty(dict[Text, ValueRule]),
        about(
            "mapping from the path of a field to the rule that chooses its value; a path consists "
            "of keys, and of the indices or names of list entries",
            {"weather.visibility_km": {"log_uniform": [0.2, 20]}},
            {"sensors.roof.model": {"choice": ["velodyne/vlp16", "ouster/os1-64"]}},
        ),
    ] = {}  # noqa: RUF012 - the model is frozen
    keep: Annotated[DatasetFormatEntry, about("format of the data set")] = DatasetFormat()
    splits: Annotated[
        dict[str, UnitShare],
        allow_empty(dict[str, UnitShare]),
        about(
            "mapping from the name of a split to its share of the jobs; the shares add up to 1",
            {"train": 0.8, "val": 0.1, "test": 0.1},
        ),
    ] = {}  # noqa: RUF012 - the model is frozen
    license: Annotated[str, about("license of the data set, for its card", "CC-BY-4.0")] = ""
    title: Annotated[str, about("title of the data set (default: the file name)")] = ""

    @model_validator(mode="after")
    def _check_splits(self) -> CampaignSection:
        """Raise ValueError if the name or fraction of a split is invalid."""
        for name in self.splits:
            if not re.fullmatch(r"[A-Za-z0-9_-]+", name):
                raise ValueError(
                    "The name of a split may only contain the characters a-z, A-Z, 0-9, - and _, "
                    f"but is {name!r}."
                )
        if self.splits and not isclose(sum(self.splits.values()), 1, abs_tol=1e-6):
            raise ValueError(
                "The shares of `splits` must add up to 1, but add up to "
                f"{sum(self.splits.values()):.6g}."
            )
        return self


class Splits:
    """Random assignment of jobs to the splits of a data set.

    Jobs are divided into blocks, and each block is distributed over the splits in exact proportion
    to their shares. For example, with shares of 0.8, 0.1 and 0.1, every block of ten jobs
    contributes 8, 1 and 1 jobs. The split of a job therefore does not depend on the number of jobs.
    Blocks are as short as possible, but no longer than `MAX_BLOCK`, in which case the shares are
    rounded.
    """

    MAX_BLOCK = 1000

    def __init__(self, shares: Mapping[str, float], seed: int) -> None:
        self._seed = seed
        exact = {name: Fraction(str(fraction)) for name, fraction in shares.items()}
        total = sum(exact.values())
        exact = {name: fraction / total for name, fraction in exact.items()}
        size = min(lcm(*(fraction.denominator for fraction in exact.values())), self.MAX_BLOCK)
        self._block: list[str] = []
        cumulative = Fraction(0)
        for name, fraction in exact.items():
            cumulative += fraction
            self._block += [name] * (round(cumulative * size) - len(self._block))

    def __call__(self, number: int) -> str:
        """Return the split of a job, or an empty string if there are no splits."""
        if not self._block:
            return ""
        block, offset = divmod(number, len(self._block))
        return self._block[_block_order(self._seed, block, len(self._block))[offset]]


@lru_cache
def _block_order(seed: int, block: int, count: int) -> list[int]:
    return JobRandom(seed, block, "splits").permutation(count)


_DELIMITERS = ",;\t"
_INTEGER = re.compile(r"[-+]?[0-9]+")
_REAL = re.compile(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?")
_WORDS = {"true": True, "false": False}


def read_rows(path: Path, kind: Any, ignore: Sequence[str] = ()) -> list[Any]:
    """Read the entries of a list from a table.

    Each column contains the values of a field, such as `box` or `at.0.position`. A cell contains a
    number, true, false, a list or mapping in YAML, or text. If a cell is empty, the field is
    omitted. Lines that begin with # are comments.

    Parameters
    ----------
    path
        Path of the table, a .csv file.
    kind
        Type annotation of the list.
    ignore
        Names of columns to ignore, which may contain * and ?.

    Raises
    ------
    LidarError
        If the file cannot be read, the field is not a list, or a row is not a valid entry. For
        invalid rows, the message contains the line.
    """
    entry = next(_entry_types(kind), None)
    if entry is None:
        raise LidarError(
            "`sample` can only be used on a list such as `actors`, but this field is not a list."
        )
    try:
        table = _read_cells(path)
        ignored = ignored_columns(table.header, ignore)
        names = [name for index, name in enumerate(table.header) if index not in ignored]
        if twice := next((name for name in names if names.count(name) > 1), None):
            raise ValueError(f"it has the column {twice!r} twice")
        model = next(sections_in(entry), BaseModel)
        _check_columns(names, model)
    except FileNotFoundError as error:
        raise MissingFileError(not_found(path)) from error
    except (OSError, ValueError, csv.Error, LidarError) as error:
        raise LidarError(f"{path} cannot be used as a table: {message_of(error)}") from error
    adapter = TypeAdapter(entry)
    mistakes = Mistakes()
    rows = []
    for line, cells in table.rows:
        source = f"{path}, line {line}"
        with mistakes.collect(), convert_validation_errors(model, source):
            if len(cells) > len(table.header):
                raise LidarError(
                    f"{source}: The line has {len(cells)} cells, but the header has "
                    f"{len(table.header)}."
                )
            values = [cell for index, cell in enumerate(cells) if index not in ignored]
            rows.append(_validate_row(adapter, dict(zip(names, values, strict=False))))
    mistakes.raise_if_any()
    return rows


class _Cells(NamedTuple):
    header: list[str]
    rows: list[tuple[int, list[str]]]  # (line in the file, cells without surrounding spaces)


def _read_cells(path: Path) -> _Cells:
    """Read the cells of a table.

    Raise ValueError if the table is empty.
    """
    lines = read_text(path).splitlines()
    first = next((line for line in lines if line.strip() and line.lstrip()[0] != "#"), "")
    reader = csv.reader(lines, delimiter=max(_DELIMITERS, key=first.count))
    cells = [
        (reader.line_num, [cell.strip() for cell in row])
        for row in reader
        if any(cell.strip() for cell in row) and not row[0].lstrip().startswith("#")
    ]
    if not cells:
        raise ValueError("it is empty")
    (_, header), *rows = cells
    return _Cells(header, rows)


def _check_columns(names: Sequence[str], model: Any) -> None:
    """Raise ValueError if a column name is neither a field of an entry nor a list index."""
    fields = [field.alias or name for name, field in getattr(model, "model_fields", {}).items()]
    unknown = [
        name
        for name in names
        if name and fields and (first := name.split(".")[0]) not in fields and not first.isdigit()
    ]
    if unknown:
        noun = "columns" if unknown[1:] else "column"
        pronoun = "them" if unknown[1:] else "it"
        shown = join_names([printable(name) for name in unknown])
        raise ValueError(
            f"it contains the unknown {noun} {shown}.{did_you_mean_each(unknown, fields)} Rename "
            f"{pronoun}, or set `ignore: {format_yaml_list(unknown)}`. The available columns are "
            f"{', '.join(fields)}"
        )


def _validate_row(adapter: TypeAdapter[Any], cells: dict[str, str]) -> Any:
    """Convert the cells of a row, keyed by column, to a validated entry.

    Raise ValidationError if the row is not a valid entry.
    """
    values = {name: _parse_cell(cell) for name, cell in cells.items() if cell}
    try:
        return adapter.validate_python(_nest(values))
    except ValidationError as error:
        # Text fields may contain numbers. For example, the name of a car may be 7.
        wrong = {".".join(map(str, detail["loc"])) for detail in error.errors()}
        text = {name: cells[name] for name in wrong & values.keys()}
        with suppress(ValidationError):
            return adapter.validate_python(_nest(values | text))
        raise


def _parse_cell(cell: str) -> Any:
    """Convert a cell to a number, truth value, list or mapping, or else return its text."""
    if _INTEGER.fullmatch(cell):
        with suppress(ValueError):  # Python does not convert integers with thousands of digits
            return int(cell)
    if _REAL.fullmatch(cell):
        return float(cell)
    if cell[0] in "[{":
        with suppress(ValueError, RecursionError):
            return json.loads(cell)  # a hundred times faster than YAML
        with suppress(yaml.YAMLError, ValueError, OverflowError, RecursionError):
            return load_yaml(cell)
    return _WORDS.get(cell.lower(), cell)


def _nest(values: dict[str, Any]) -> Any:
    """Convert dotted names to nested mappings and lists, such as {"box.0": 4} to {"box": [4]}."""
    result: dict[str, Any] = {}
    for name, value in values.items():
        *outer, last = name.split(".")
        node = result
        for step in outer:
            node = node.setdefault(step, {})
            if not isinstance(node, dict):
                return result | {name: value}  # validation reports it as an unknown field
        node[last] = value
    return _convert_to_lists(result)


def _convert_to_lists(node: Any) -> Any:
    """Convert all mappings with the keys "0", "1", … to lists, including nested ones."""
    if not isinstance(node, dict):
        return node
    inner = {key: _convert_to_lists(value) for key, value in node.items()}
    numbered = bool(inner) and list(inner) == [str(i) for i in range(len(inner))]
    return list(inner.values()) if numbered else inner


def _entry_types(kind: Any) -> Iterator[Any]:
    """Yield the entry types of all lists in a type annotation.

    For example, yield X for `tuple[X, ...] | None`.
    """
    args = get_args(kind)
    if get_origin(kind) is tuple and len(args) == 2 and args[1] is Ellipsis:
        yield args[0]
    else:
        for inner in args:
            yield from _entry_types(inner)
