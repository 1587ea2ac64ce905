"""Job table of a data set, and point statistics of a job.

`jobs.csv` contains one row per job. The columns are number, name and split, then the varied values,
then the results, then the number of points of each class, then the visibility of boxes. Varied
values are written as in JSON, such as ``12``, ``0.5`` or ``true``, so that they keep their type. A
string is written without quotes unless it could be mistaken for such a value, as in ``"12"``. The
cell is empty if the job has no such value. Text that a spreadsheet would interpret as a formula is
prefixed with an apostrophe, as OWASP recommends against CSV injection.
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

from lidarsim.columns.cloud import Cloud, CloudLike
from lidarsim.errors import LidarError, as_sentence, explain_os_errors
from lidarsim.io.input_files import open_input
from lidarsim.io.named_files import is_plain
from lidarsim.io.storage import Storage
from lidarsim.words import join_names, printable

Value = bool | int | float | str

TABLE_FILE = "jobs.csv"
PARQUET_FILE = "jobs.parquet"
WRITE_AGAIN = "run the campaign again with `--resume` to rewrite the table"
ROW_GROUP = 2_000  # number of rows of jobs.parquet in memory at a time
MAX_JOBS = 100_000_000  # maximum number of jobs in a campaign
MAX_ERROR_LETTERS = 4_000  # longer errors are truncated; csv.reader rejects cells above 131,072

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
# Columns of the visibility of boxes, if the jobs determine it (see `summarize_boxes`).
_BOXES = {
    "boxes": int,
    "boxes_with_points": int,
    "visible_fraction": float,
    "truncation": float,
    "nearest_ray_m": float,
}
_CLASS = re.compile(r"class_(\d+)", re.ASCII)
_UTF8 = codecs.getwriter("utf-8")
_ESCAPED = "backslashreplace"  # preserves parts of names that are not valid UTF-8
# Spreadsheets interpret text that starts with one of these characters as a formula. Leading
# apostrophes are included, because such text could otherwise not be read back unchanged.
_FORMULA = re.compile(r"'*[=+\-@\t\r\n\uff1d\uff0b\uff0d\uff20]")
# Prefix for the name of a varied value that could be mistaken for another column.
_VARIED = "varied."


@dataclass(frozen=True)
class JobRow:
    """Table row of a job in a campaign.

    Parameters
    ----------
    number
        Job number, from 0.
    name
        Name of the job in file names.
    split
        Split that the job belongs to, such as "train", or "" without splits.
    values
        {path: varied value}. For a sample of objects, the value is the number of objects. A value
        of None means that the job does not have it.
    error
        Error message if the job failed, otherwise "".
    scans, sweeps, rays, hits, points
        Numbers of scans, sweeps, rays, hits and points.
    seconds
        Total casting time of all tasks, or None if it is unknown, for example because the job
        failed. This is the only field that varies between runs, so it is not part of the table (see
        `job_seconds`).
    sha256
        Hash of the points (see `Tally`), which is the same on any cluster.
    classes
        {class: number of points}. Empty if the points have no ``class`` column.
    boxes
        Visibility of the boxes in all sweeps as returned by `summarize_boxes`. Empty if the survey
        does not determine it.
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
    boxes: Mapping[str, int | float] = field(default_factory=dict)

    @property
    def done(self) -> bool:
        """Whether the job succeeded and its points are in the data set."""
        return not self.error

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> JobRow:
        """Create a row from a JSON object.

        Raises ValueError if a field is missing, unknown or has the wrong type, or if the name or
        the split is not a plain file name.
        """
        data = {"boxes": {}, **data}  # missing in rows from earlier versions
        if differing := data.keys() ^ {entry.name for entry in fields(cls)}:
            raise ValueError(
                f"a job row has a missing or unknown entry, such as {min(differing)!r}"
            )
        kinds = {**_HEAD, **_TAIL, "seconds": int | float | None, "values": dict, "classes": dict}
        kinds["boxes"] = dict
        for name, kind in kinds.items():
            if not isinstance(data[name], kind):
                raise ValueError(f"the {name} of a job has the invalid value {data[name]!r}")
        classes = {int(number): int(count) for number, count in data["classes"].items()}
        return _with_plain_names(cls(**{**data, "classes": classes}))


class Tally:
    """Point counts and hash of a job, updated with consecutive chunks of its points.

    Examples
    --------
    >>> cloud = Cloud(np.zeros((3, 3)), {"class": np.array([6, 2, 6])})
    >>> tally = Tally.from_cloud(cloud)
    >>> tally.points, tally.classes
    (3, {2: 1, 6: 2})
    >>> again = Tally()
    >>> for piece in cloud.chunks(2):
    ...     again.add_points(piece)
    >>> again.sha256 == tally.sha256
    True
    """

    def __init__(self) -> None:
        self.points = 0
        self._classes: Counter[int] = Counter()
        self._columns: dict[str, Any] = {}  # {column name and type: hash of the values}

    @classmethod
    def from_cloud(cls, cloud: CloudLike) -> Tally:
        """Compute the tally of an entire cloud."""
        tally = cls()
        for chunk in cloud.chunks():
            tally.add_points(chunk)
        return tally

    def add_points(self, chunk: Cloud) -> None:
        """Add the next chunk of points.

        Raises LidarError if its columns differ from those of earlier chunks.
        """
        if not len(chunk):
            return
        # Points read from a file and points of a run may have different data types.
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
        """Number of points in each class that occurs, as {class: points}.

        The dictionary is empty if the points have no ``class`` column.
        """
        return dict(sorted(self._classes.items()))

    @property
    def sha256(self) -> str:
        """Hash of the positions and columns, as 64 hexadecimal digits.

        Each column contributes a line with its name, type and hash, starting with the positions,
        and the result is the hash of these lines. It does not depend on the division into chunks,
        nor on whether positions are float32 or float64 if their values are equal.
        """
        lines = (f"{name} {digest.hexdigest()}\n" for name, digest in self._columns.items())
        return hashlib.sha256("".join(lines).encode()).hexdigest()


def write_table(
    storage: Storage, names: Sequence[str], jobs: Callable[[], Iterable[JobRow]]
) -> None:
    """Write the job table to jobs.csv, and to jobs.parquet if pyarrow is installed.

    Rows are not kept in memory. They are read once to determine the columns, and once more for each
    file.

    Parameters
    ----------
    storage
        Folder of the data set, which must exist.
    names
        Names of the varied values, in column order.
    jobs
        Function that returns the rows in order. Every call must return the same rows.

    Raises
    ------
    LidarError
        If a row has a value that is not listed in `names`, or if the table cannot be written.
    """
    with explain_os_errors(
        f"The job table cannot be written to {storage}",
        "free some disk space, or check the permissions of the folder",
    ):
        classes, kinds, has_boxes = _columns(names, jobs())
        boxes = [*_BOXES] if has_boxes else []
        header = [*_HEAD, *map(_column_of, names), *_TAIL, *(f"class_{n}" for n in classes), *boxes]
        with storage.writing(TABLE_FILE) as file:
            writer = csv.writer(_UTF8(file, _ESCAPED), lineterminator="\n")
            writer.writerow(map(_shielded, header))
            for row in jobs():
                writer.writerow(_cells(row, names, classes, boxes))
        if find_spec("pyarrow") is not None:
            with storage.writing(PARQUET_FILE) as file:
                _write_parquet(file, header, names, kinds, iter(jobs()))


def read_table(storage: Storage, checksum: Sequence[int] | None = None) -> Iterator[JobRow]:
    """Yield the rows of jobs.csv in order.

    Parameters
    ----------
    storage
        Folder or URL of the data set.
    checksum
        Expected size in bytes and CRC-32 of the file. By default, they are not checked.

    Raises
    ------
    LidarError
        If the table is missing or damaged. A table is damaged if its checksum is wrong, if job
        numbers do not increase, or if a row does not match the header.
    """
    with ExitStack() as stack:
        with explain_os_errors(f"{storage.path(TABLE_FILE)} cannot be read", WRITE_AGAIN):
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
            unknown = next((name for name in counted if not _is_counted(name)), None)
            if unknown is not None:
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
    ambiguous = name in _HEAD | _TAIL or _is_counted(name) or name.startswith(_VARIED)
    return f"{_VARIED}{name}" if ambiguous else name


def _is_counted(name: str) -> bool:
    """Return whether a column contains the points of a class or the visibility of boxes."""
    return bool(_CLASS.fullmatch(name)) or name in _BOXES


def _columns(
    names: Sequence[str], jobs: Iterable[JobRow]
) -> tuple[list[int], dict[str, set[type]], bool]:
    """Return all classes in the rows, the types of the varied values, and whether boxes occur."""
    has_boxes = False
    classes: set[int] = set()
    kinds: dict[str, set[type]] = {name: set() for name in names}
    for row in jobs:
        if unknown := [name for name in row.values if name not in kinds]:
            raise LidarError(
                f"Job {row.name} has a value for {unknown[0]!r}, which is not a varied "
                f"quantity. The varied quantities are {join_names(names) or 'none'}."
            )
        classes.update(row.classes)
        has_boxes = has_boxes or bool(row.boxes)
        for name, value in row.values.items():
            if value is not None:
                kinds[name].add(_kind(value))
    return sorted(classes), kinds, has_boxes


def _cells(
    row: JobRow, names: Sequence[str], classes: Sequence[int], boxes: Sequence[str]
) -> Iterator[str]:
    for name, kind in (_HEAD | _TAIL).items():
        if name == "error":
            for value in names:
                yield format_cell(row.values.get(value))
        entry = getattr(row, name)
        # Before Python 3.13, csv.writer left a bare carriage return unquoted.
        if kind is str:
            yield _shielded("\n".join(entry[:MAX_ERROR_LETTERS].splitlines()))
        else:
            yield json.dumps(entry)
    for number in classes:
        yield str(int(row.classes.get(number, 0)))
    for name in boxes:
        yield format_cell(row.boxes.get(name))


def _row(header: Sequence[str], names: Sequence[str], cells: Sequence[str]) -> JobRow:
    """Parse a row of jobs.csv, or raise ValueError if it is invalid."""
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
    boxes = {name: kind(fixed[name]) for name, kind in _BOXES.items() if fixed.get(name)}
    varied = zip(names, cells[first:stop], strict=True)
    values = {name: _read(text) if text else None for name, text in varied}
    return _with_plain_names(JobRow(values=values, classes=classes, boxes=boxes, **entries))


def _with_plain_names(row: JobRow) -> JobRow:
    """Return the row, or raise ValueError if its name or split is not a valid file name.

    Both are used as parts of file names, so other values could lead outside the data set.
    """
    for kind, text in (("name", row.name), ("split", row.split)):
        if text and not is_plain(text):
            raise ValueError(
                f"the {kind} {printable(text)!r} of job {row.number} is not a plain file name"
            )
    return row


def _plain(value: Any) -> Any:
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


def format_cell(value: Any) -> str:
    """Format a varied value as a table cell from which its value and type can be restored.

    The cell is empty for None.
    """
    if value is None:
        return ""
    plain = _plain(value)
    if not isinstance(plain, str):
        return json.dumps(plain)
    # Text with unprintable characters, such as line breaks, is also quoted.
    if plain and plain.isprintable() and _parsed(plain) == plain:
        return _shielded(plain)
    return json.dumps(plain)


def _shielded(text: str) -> str:
    """Return text that spreadsheets do not interpret as a formula.

    Examples
    --------
    >>> [_shielded(text) for text in ("=1+1", "-5 dB", "'@home", "wet")]
    ["'=1+1", "'-5 dB", "''@home", 'wet']
    """
    return f"'{text}" if _FORMULA.match(text) else text


def _unshielded(text: str) -> str:
    return text[1:] if text.startswith("'") and _FORMULA.match(text) else text


def _read(text: str) -> Value:
    plain = _unshielded(text)
    return _parsed(text) if plain == text else plain


def _parsed(text: str) -> Value:
    """Parse a JSON scalar, or return any other text unchanged."""
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
    """Write the job table to jobs.parquet.

    If a varied value is a string in any row, it is stored as a string in all rows.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    plain = {int: pa.int64(), float: pa.float64(), str: pa.string(), bool: pa.bool_()}

    def type_of(name: str) -> Any:
        kinds_of_name = kinds[name]
        if len(kinds_of_name) == 1:
            return plain[next(iter(kinds_of_name))]
        return pa.float64() if kinds_of_name == {int, float} else pa.string()

    types = {_column_of(name): type_of(name) for name in names}
    types |= {name: plain[kind] for name, kind in (_HEAD | _TAIL | _BOXES).items()}
    schema = pa.schema([(name, types.get(name, pa.int64())) for name in header])
    columns = {_column_of(name): name for name in names}

    def cell(row: JobRow, name: str) -> Any:
        if match := _CLASS.fullmatch(name):
            return row.classes.get(int(match[1]), 0)
        if name in _BOXES:
            return row.boxes.get(name)
        value = getattr(row, name) if name not in columns else row.values.get(columns[name])
        if value is None or types[name] != pa.string():
            plain = _plain(value)
            # Older versions of pyarrow refuse to convert integers above 2^53 to floats.
            return float(plain) if types[name] == pa.float64() and value is not None else plain
        text = value if isinstance(value, str) else json.dumps(_plain(value))
        return text.encode("utf-8", _ESCAPED).decode()

    with pq.ParquetWriter(file, schema) as writer:
        while group := list(islice(rows, ROW_GROUP)):
            table = {name: [cell(row, name) for row in group] for name in header}
            writer.write_table(pa.table(table, schema=schema))
