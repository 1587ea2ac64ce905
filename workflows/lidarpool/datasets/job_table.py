"""The table of the jobs of a data set, and the tally of a job's points.

`jobs.csv` has a row for each job: number, name, split, then varied values, then results, then the
points of each class. A varied value is written as JSON writes it, so that it is read with its type:
``12``, ``0.5``, ``true``; text is written as it is unless it looks like such a value, as ``"12"``
does. The cell is empty where a job has no such value. Text that a spreadsheet would run as a
formula has a leading apostrophe, as OWASP advises against CSV injection.
"""

from __future__ import annotations

import codecs
import csv
import hashlib
import json
import re
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, fields
from importlib.util import find_spec
from io import TextIOWrapper
from itertools import islice
from pathlib import Path
from typing import IO, Any

import numpy as np

from lidarsim.base.errors import LidarError, as_sentence, explained
from lidarsim.base.input_files import open_input
from lidarsim.base.named_files import is_plain
from lidarsim.base.storage import Storage
from lidarsim.base.words import joined, printable
from lidarsim.columns.cloud import Cloud, CloudLike

Value = bool | int | float | str

TABLE_FILE = "jobs.csv"
PARQUET_FILE = "jobs.parquet"
WRITE_AGAIN = "run the campaign again with `--resume` to rewrite the table"
ROW_GROUP = 2_000  # rows of jobs.parquet in memory at a time
MAX_JOBS = 100_000_000  # limit for a campaign: a larger number is not a job's
MAX_ERROR_LETTERS = 4_000  # limit for an error in the table: csv.reader refuses cells of 131,072

_HEAD = {"number": int, "name": str, "split": str}
_TAIL = {
    "error": str,
    "scans": int,
    "sweeps": int,
    "rays": int,
    "hits": int,
    "points": int,
    "sha256": str,
}
_CLASS = re.compile(r"class_(\d+)", re.ASCII)
_UTF8 = codecs.getwriter("utf-8")
_ESCAPED = "backslashreplace"  # keeps parts of names that are not UTF-8
# Text with such a start is a formula for spreadsheets. Leading apostrophes count as well: without
# that, a cell that begins with an apostrophe would be read back without it.
_FORMULA = re.compile(r"'*[=+\-@\t\r\n\uff1d\uff0b\uff0d\uff20]")
# Before the name of a varied value that would look like another column.
_VARIED = "varied."


@dataclass(frozen=True)
class JobRow:
    """A job of a campaign.

    Parameters
    ----------
    number
        From 0.
    name
        Its name in files.
    split
        Its split, such as "train"; "" without splits.
    values
        {path: varied value}; for a sample of objects, their number. None if the job has no value.
    error
        Why it failed; "" for a job that is done.
    scans, sweeps, rays, hits, points
        Numbers of scans, sweeps, rays, hits and points.
    seconds
        Casting time of all its tasks; None if it is unknown, as for a failed job. The only entry
        that differs between runs: the table has no such column (`job_seconds`).
    sha256
        Hash of its points (`Tally`): the same on any cluster.
    classes
        {class: points}; empty if the points have no column ``class``.

    """

    number: int
    name: str
    split: str = ""
    values: Mapping[str, Value | None] = field(default_factory=dict)
    error: str = ""
    scans: int = 0
    sweeps: int = 0
    rays: int = 0
    hits: int = 0
    points: int = 0
    seconds: float | None = None
    sha256: str = ""
    classes: Mapping[int, int] = field(default_factory=dict)

    @property
    def done(self) -> bool:
        """True if the points of the job are in the data set."""
        return not self.error

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> JobRow:
        """Return a row from its JSON object.

        ValueError if an entry is missing, unknown or of another type, or if its name or split is
        not a plain file name.
        """
        if differing := data.keys() ^ {entry.name for entry in fields(cls)}:
            raise ValueError(
                f"a job row has a missing or unknown entry, such as {min(differing)!r}"
            )
        kinds = {**_HEAD, **_TAIL, "seconds": int | float | None, "values": dict, "classes": dict}
        for name, kind in kinds.items():
            if not isinstance(data[name], kind):
                raise ValueError(f"the {name} of a job has the invalid value {data[name]!r}")
        classes = {int(number): int(count) for number, count in data["classes"].items()}
        return _with_plain_names(cls(**{**data, "classes": classes}))


class Tally:
    """Counts and hash of the points of a job, added in chunks and in order.

    Examples
    --------
    >>> cloud = Cloud(np.zeros((3, 3)), {"class": np.array([6, 2, 6])})
    >>> tally = Tally.from_cloud(cloud)
    >>> tally.points, tally.classes
    (3, {2: 1, 6: 2})
    >>> again = Tally()
    >>> for piece in cloud.chunks(2):
    ...     again.add(piece)
    >>> again.sha256 == tally.sha256
    True
    """

    def __init__(self) -> None:
        self.points = 0
        self._classes: Counter[int] = Counter()
        self._columns: dict[str, Any] = {}  # {name and type: hash of the values}

    @classmethod
    def from_cloud(cls, cloud: CloudLike) -> Tally:
        """Return the tally of a whole cloud."""
        tally = cls()
        for chunk in cloud.chunks():
            tally.add(chunk)
        return tally

    def add(self, chunk: Cloud) -> None:
        """Count the next points.

        LidarError if their columns differ from the columns of earlier points.
        """
        if not len(chunk):
            return
        # Points of a file and of a run are of different types.
        arrays = {"positions <f8": chunk.positions.astype("<f8", copy=False)}
        for column in chunk.table:
            values = chunk.columns[column.name]
            little = values.dtype.newbyteorder("<")
            arrays[f"{column.name} {little.str}"] = values.astype(little, copy=False)
        if not self.points:
            self._columns = {name: hashlib.sha256() for name in arrays}
        if self._columns.keys() != arrays.keys():
            raise LidarError(
                "All points of a job must have the same columns, but the columns change from "
                f"{', '.join(self._columns)} to {', '.join(arrays)}."
            )
        for name, array in arrays.items():
            self._columns[name].update(np.ascontiguousarray(array))
        if "class" in chunk.columns:
            counts = np.bincount(chunk["class"])
            self._classes.update({int(k): int(counts[k]) for k in np.flatnonzero(counts)})
        self.points += len(chunk)

    @property
    def classes(self) -> dict[int, int]:
        """Points of each class that has any, {class: points}.

        The result is empty without a column ``class``.
        """
        return dict(sorted(self._classes.items()))

    @property
    def sha256(self) -> str:
        """Hash of positions and columns, 64 hexadecimal digits.

        It is the hash of the columns' names, types and hashes, a line each, positions first: the
        same for float32 and float64 positions of equal value, and for any division into chunks.
        """
        lines = (f"{name} {digest.hexdigest()}\n" for name, digest in self._columns.items())
        return hashlib.sha256("".join(lines).encode()).hexdigest()


def write_table(
    storage: Storage, names: Sequence[str], jobs: Callable[[], Iterable[JobRow]]
) -> None:
    """Write the table of jobs: jobs.csv, and jobs.parquet if pyarrow is installed.

    Rows are not held in memory: they are read once for the columns, and again for each file.

    Parameters
    ----------
    storage
        Folder of the data set, which must exist.
    names
        Names of the varied values, in the order of their columns.
    jobs
        Gives the rows in order, the same each time.

    Raises
    ------
    LidarError
        If a row has a value that is not in `names`, or the table cannot be written.
    """
    with explained(
        f"The job table cannot be written to {storage}",
        "free some disk space, or check the permissions of the folder",
    ):
        classes, kinds = _columns(names, jobs())
        header = [*_HEAD, *map(_column_of, names), *_TAIL, *(f"class_{n}" for n in classes)]
        with storage.writing(TABLE_FILE) as file:
            writer = csv.writer(_UTF8(file, _ESCAPED), lineterminator="\n")
            writer.writerow(map(_shielded, header))
            for row in jobs():
                writer.writerow(_cells(row, names, classes))
        if find_spec("pyarrow") is not None:
            with storage.writing(PARQUET_FILE) as file:
                _write_parquet(file, header, names, kinds, iter(jobs()))


def read_table(storage: Storage, checksum: Sequence[int] | None = None) -> Iterator[JobRow]:
    """Yield the rows of jobs.csv in order.

    `checksum` has the bytes and the CRC-32 that the file must have.

    Raises
    ------
    LidarError
        If the table is missing or damaged: another checksum, numbers that do not increase,
        or a row that does not fit the table.
    """
    with ExitStack() as stack:
        with explained(f"{storage.path(TABLE_FILE)} cannot be read", WRITE_AGAIN):
            if storage.is_local:
                path = storage.local(TABLE_FILE)
            else:
                folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="lidarpool-"))
                path = Path(folder, TABLE_FILE)
                storage.get(TABLE_FILE, path)
            if checksum is not None and Storage(str(path.parent)).checksum(path.name) != checksum:
                raise LidarError(
                    f"{storage.path(TABLE_FILE)} is damaged or has been edited, because its "
                    "checksum does not match the checksum in the data set. "
                    f"{as_sentence(WRITE_AGAIN)}"
                )
            file = TextIOWrapper(open_input(path), encoding="utf-8", newline="")
            stack.enter_context(file)
        reader = csv.reader(file, strict=True)
        try:
            header = [_unshielded(name) for name in next(reader, [])]
            first = len(_HEAD)
            last = header.index("error")
            tail = header[last : last + len(_TAIL)]
            if header[:first] != [*_HEAD] or tail != [*_TAIL]:
                raise ValueError("it is not a job table")
            counted = header[last + len(_TAIL) :]
            if unknown := next((name for name in counted if not _CLASS.fullmatch(name)), None):
                raise ValueError(f"it has the unknown column {unknown!r}")
            if len(set(header)) < len(header):
                raise ValueError("it has two columns with the same name")
            names = [name.removeprefix(_VARIED) for name in header[first:last]]
            last_number = -1
            for cells in reader:
                row = _row(header, names, cells)
                if not last_number < row.number < MAX_JOBS:
                    raise ValueError(f"job {row.number} must not follow job {last_number}")
                last_number = row.number
                yield row
        except (ValueError, csv.Error) as error:
            raise LidarError(
                f"{storage.path(TABLE_FILE)} is damaged near line {reader.line_num}: {error}. "
                f"{as_sentence(WRITE_AGAIN)}"
            ) from error


def _column_of(name: str) -> str:
    """Return the name of the column of a varied value."""
    ambiguous = name in _HEAD or name in _TAIL or _CLASS.fullmatch(name) or name.startswith(_VARIED)
    return f"{_VARIED}{name}" if ambiguous else name


def _columns(
    names: Sequence[str], jobs: Iterable[JobRow]
) -> tuple[list[int], dict[str, set[type]]]:
    """Return the classes in the rows, and the types of each varied value."""
    classes: set[int] = set()
    kinds: dict[str, set[type]] = {name: set() for name in names}
    for row in jobs:
        if unknown := [name for name in row.values if name not in kinds]:
            raise LidarError(
                f"Job {row.name} has a value for {unknown[0]!r}, which is not a varied "
                f"quantity. The varied quantities are {joined(names) or 'none'}."
            )
        classes.update(row.classes)
        for name, value in row.values.items():
            if value is not None:
                kinds[name].add(_kind(value))
    return sorted(classes), kinds


def _cells(row: JobRow, names: Sequence[str], classes: Sequence[int]) -> Iterator[str]:
    """Yield the cells of a row of jobs.csv."""
    for name, kind in (_HEAD | _TAIL).items():
        if name == "error":
            for value in names:
                yield _written(row.values.get(value))
        entry = getattr(row, name)
        # Before Python 3.13, csv.writer left a bare carriage return unquoted.
        if kind is str:
            yield _shielded("\n".join(entry[:MAX_ERROR_LETTERS].splitlines()))
        else:
            yield json.dumps(entry)
    for number in classes:
        yield str(int(row.classes.get(number, 0)))


def _row(header: Sequence[str], names: Sequence[str], cells: Sequence[str]) -> JobRow:
    """Return the job of a row of jobs.csv.

    Raises ValueError for an invalid row.
    """
    if len(cells) != len(header):
        raise ValueError(f"the row has {len(cells)} cells, but the header has {len(header)}")
    first = len(_HEAD)
    stop = len(_HEAD) + len(names)
    fixed = dict(zip(header[:first], cells, strict=False))
    fixed |= dict(zip(header[stop:], cells[stop:], strict=True))
    kinds = _HEAD | _TAIL
    entries: dict[str, Any] = {
        name: _unshielded(fixed[name]) if kind is str else kind(fixed[name])
        for name, kind in kinds.items()
    }
    classes = {
        int(match[1]): int(text)
        for name, text in fixed.items()
        if (match := _CLASS.fullmatch(name)) and text != "0"
    }
    varied = zip(names, cells[first:stop], strict=True)
    values = {name: _read(text) if text else None for name, text in varied}
    return _with_plain_names(JobRow(values=values, classes=classes, **entries))


def _with_plain_names(row: JobRow) -> JobRow:
    """Return a row that was read. Its name and split are parts of names of files.

    Raises ValueError if one of them would lead elsewhere.
    """
    for kind, text in (("name", row.name), ("split", row.split)):
        if text and not is_plain(text):
            raise ValueError(
                f"the {kind} {printable(text)!r} of job {row.number} is not a plain file name"
            )
    return row


def _plain(value: Any) -> Any:
    """Return a value of NumPy as an object of Python."""
    return value.item() if isinstance(value, np.generic) else value


def _kind(value: Any) -> type:
    plain = _plain(value)
    kind = type(plain)
    if kind is int and not -(2**63) <= plain < 2**63:
        return str
    if kind not in (bool, int, float, str):
        raise LidarError(
            f"The varied value {value!r} ({kind.__name__}) is not supported. Use a number, a "
            "string, true or false."
        )
    return kind


def _written(value: Any) -> str:
    """Return a cell for a varied value, which is read back with its type; empty for None."""
    if value is None:
        return ""
    plain = _plain(value)
    if not isinstance(plain, str):
        return json.dumps(plain)
    # Quotes as well for letters that a line of a file cannot show or hold.
    if plain and plain.isprintable() and _parsed(plain) == plain:
        return _shielded(plain)
    return json.dumps(plain)


def _shielded(text: str) -> str:
    """Return text that no spreadsheet runs as a formula.

    Examples
    --------
    >>> [_shielded(text) for text in ("=1+1", "-5 dB", "'@home", "wet")]
    ["'=1+1", "'-5 dB", "''@home", 'wet']
    """
    return f"'{text}" if _FORMULA.match(text) else text


def _unshielded(text: str) -> str:
    """Return the text before `_shielded`."""
    return text[1:] if text.startswith("'") and _FORMULA.match(text) else text


def _read(text: str) -> Value:
    """Return the varied value of a cell."""
    plain = _unshielded(text)
    return _parsed(text) if plain == text else plain


def _parsed(text: str) -> Value:
    """Return the value that a text is as JSON, else the text."""
    try:
        value = json.loads(text) if text.lstrip()[:1] not in "[{" else text
    except ValueError:
        return text
    return value if isinstance(value, bool | int | float | str) else text


def _write_parquet(
    file: IO[bytes],
    header: Sequence[str],
    names: Sequence[str],
    kinds: Mapping[str, set[type]],
    rows: Iterator[JobRow],
) -> None:
    """Write jobs.parquet. A varied value that is text in any row is text in all rows."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    plain = {int: pa.int64(), float: pa.float64(), str: pa.string(), bool: pa.bool_()}

    def type_of(name: str) -> Any:
        kinds_of_name = kinds[name]
        if len(kinds_of_name) == 1:
            return plain[next(iter(kinds_of_name))]
        return pa.float64() if kinds_of_name == {int, float} else pa.string()

    types = {_column_of(name): type_of(name) for name in names}
    types |= {name: plain[kind] for name, kind in (_HEAD | _TAIL).items()}
    schema = pa.schema([(name, types.get(name, pa.int64())) for name in header])
    columns = {_column_of(name): name for name in names}

    def cell(row: JobRow, name: str) -> Any:
        if match := _CLASS.fullmatch(name):
            return row.classes.get(int(match[1]), 0)
        value = getattr(row, name) if name not in columns else row.values.get(columns[name])
        if value is None or types[name] != pa.string():
            plain = _plain(value)
            # An older pyarrow refuses whole numbers beyond 2^53 as floats.
            return float(plain) if types[name] == pa.float64() and value is not None else plain
        text = value if isinstance(value, str) else json.dumps(_plain(value))
        return text.encode("utf-8", _ESCAPED).decode()

    with pq.ParquetWriter(file, schema) as writer:
        while group := list(islice(rows, ROW_GROUP)):
            table = {name: [cell(row, name) for row in group] for name in header}
            writer.write_table(pa.table(table, schema=schema))
