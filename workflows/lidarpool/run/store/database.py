"""Database of a run, which records the parts and trials of the result.

The database is a single SQLite file. A batch belongs to the result once its receipt has been
committed to the database. Before that, work may be lost or repeated. Afterwards, a second receipt
is ignored. Recovering or resuming a run offers all uncommitted batches again. When a job ends, its
row is added to the database and its receipts are deleted.
"""

from __future__ import annotations

import json
import re
import secrets
import sqlite3
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from lidarfiles.datasets.job_table import MAX_JOBS
from lidarfiles.parts.parts import part_name
from lidarscenario.plan import Trial
from lidarsim.errors import LidarError

from ..pipeline.committed_results import CommittedResults
from ..pipeline.stage_messages import Receipt

FORMAT = 10
FILE = "run.db"

_TABLES = """
CREATE TABLE meta (
    name TEXT PRIMARY KEY, value TEXT NOT NULL, crc INTEGER NOT NULL
) WITHOUT ROWID;
CREATE TABLE parts (
    job INTEGER, first INTEGER, stop INTEGER NOT NULL, rows INTEGER NOT NULL, size INTEGER NOT NULL,
    hits INTEGER NOT NULL, cells TEXT NOT NULL, summaries BLOB NOT NULL, crc INTEGER NOT NULL,
    PRIMARY KEY (job, first)
);
CREATE TABLE trials (
    job INTEGER, trial INTEGER, data TEXT NOT NULL, crc INTEGER NOT NULL, PRIMARY KEY (job, trial)
);
CREATE TABLE frames (job INTEGER PRIMARY KEY, count INTEGER NOT NULL, crc INTEGER NOT NULL);
CREATE TABLE input_hashes (job INTEGER PRIMARY KEY, hash TEXT NOT NULL, crc INTEGER NOT NULL);
CREATE TABLE jobs (
    number INTEGER PRIMARY KEY, failed INTEGER NOT NULL, data TEXT NOT NULL, crc INTEGER NOT NULL
);
"""
# Columns of each table except `crc`, which is the CRC-32 of the other columns.
_COLUMNS = {
    "meta": ("name", "value"),
    "parts": ("job", "first", "stop", "rows", "size", "hits", "cells", "summaries"),
    "trials": ("job", "trial", "data"),
    "frames": ("job", "count"),
    "input_hashes": ("job", "hash"),
    "jobs": ("number", "failed", "data"),
}
_DISK_ERRORS = ("locked", "full", "disk i/o", "unable to open", "readonly", "out of memory")
_JOB_TABLES = ("parts", "trials", "frames", "input_hashes")  # tables for jobs in flight
PARTS_FOLDER = re.compile("run-[0-9a-f]{16}")  # pattern of the names that `parts_folder` returns


class DamagedError(LidarError):
    """Raised if a database cannot be read."""


class RunDatabase:
    """Database of a run's committed parts and trials, and of jobs that have ended.

    Jobs in flight also keep their committed results in memory. All methods that write raise
    LidarError if the disk is full or fails.

    Parameters
    ----------
    path
        Path of the database, which is created if it does not exist.
    durable
        Whether commits survive a power failure.
    values
        Initial values of the `meta` table in a new database.

    Raises
    ------
    LidarError
        If the database is damaged, has a different format, is in use by another run, or cannot be
        written.
    """

    def __init__(self, path: Path, *, durable: bool = True, **values: str) -> None:
        self.path = path
        self._durable = durable
        self.meta: dict[str, str] = {}
        self.begun: set[int] = set()  # jobs in flight with committed parts, trials or frames
        self.ended_count = 0  # number of jobs that have ended
        self._ended = bytearray()  # one byte per job, which is 1 if the job has ended
        self._frames: dict[int, int] = {}  # {job: number of frames in the database}
        with _explained(self.path):
            self._sql = sqlite3.connect(
                path, isolation_level=None, timeout=1.0, check_same_thread=False
            )
            try:
                self._open({"format": str(FORMAT), "mark": secrets.token_hex(8)} | values)
            except BaseException:
                self._sql.close()
                raise

    def _open(self, values: Mapping[str, str]) -> None:
        # The lock is held while the database is open, so that no other run writes to it. A
        # write-ahead log is not used, because it does not work on network file systems.
        self._sql.execute("PRAGMA locking_mode = EXCLUSIVE")
        self._sql.execute(f"PRAGMA synchronous = {'FULL' if self._durable else 'OFF'}")
        self._sql.execute("BEGIN IMMEDIATE")
        if not self._sql.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]:
            for statement in _TABLES.split(";"):
                self._sql.execute(statement)
            self._insert("meta", values.items())
        self._sql.execute("COMMIT")
        self.meta = dict(self._sql.execute("SELECT name, value FROM meta"))
        if (version := self.meta.get("format")) != str(FORMAT):
            raise sqlite3.DatabaseError(
                f"its format is {version}, but this version reads only format {FORMAT}"
            )
        _validate_location(self.meta)
        (state,) = self._sql.execute("PRAGMA integrity_check(1)").fetchone()  # pages and indices
        if state != "ok":
            raise sqlite3.DatabaseError(" ".join(state.split()))
        # Since Python 3.12, an unfinished cursor in a traceback keeps a closed file locked.
        for table, columns in _COLUMNS.items():
            query = f"SELECT {', '.join(columns)}, crc FROM {table}"
            with closing(self._sql.execute(query)) as rows:
                count = sum(crc != _crc32(*values) for *values, crc in rows)
            if count:
                raise sqlite3.DatabaseError(
                    f"{count:,} rows of the table {table} have a wrong checksum"
                )
        with closing(self._sql.execute("SELECT number FROM jobs")) as rows:
            for (number,) in rows:
                self._mark_ended(number)
        for table in _JOB_TABLES:
            self.begun.update(job for (job,) in self._rows(f"SELECT DISTINCT job FROM {table}"))

    def _rows(self, query: str, *values: Any) -> list[tuple[Any, ...]]:
        with _explained(self.path):
            return self._sql.execute(query, values).fetchall()

    # -- reading -------------------------------------------------------------------------

    def read(self, job: CommittedResults) -> None:
        """Load the committed results of a job into memory."""
        if job.number in self.begun:
            with _explained(self.path):
                self._read(job)

    def _read(self, job: CommittedResults) -> None:
        number = job.number
        scans = job.scans
        query = "SELECT first, stop, rows, size, hits, cells FROM parts WHERE job = ?"
        for first, stop, *counts, cells in self._rows(query, number):
            if not scans.start <= first < stop <= scans.stop:
                raise ValueError(
                    f"a part contains scans {first} to {stop}, which are not in {scans}"
                )
            name = part_name(self.meta["mark"], number, first, stop)
            box = json.loads(cells)
            point_count, size, hit_count = counts
            job.parts.add(
                Receipt(
                    job=number,
                    first=first,
                    stop=stop,
                    name=name,
                    point_count=point_count,
                    size=size,
                    hit_count=hit_count,
                    cell_box=tuple(box),
                    summaries=b"",
                )
            )
        query = "SELECT data FROM trials WHERE job = ? ORDER BY trial"
        for data in (json.loads(text) for (text,) in self._rows(query, number)):
            waypoints = np.array(data.pop("waypoints"), np.float64).reshape(-1, 2)
            job.trials.append(Trial(waypoints=waypoints, **data))
        for (count,) in self._rows("SELECT count FROM frames WHERE job = ?", number):
            self._frames[number] = int(count)
            job.advance_frames(int(count))

    @property
    def has_results(self) -> bool:
        """True if results have been committed, even if they were removed later."""
        return "forgot" in self.meta or bool(self.ended_count or self.begun)

    def has_ended(self, number: int) -> bool:
        """Return True if a job has ended."""
        return number < len(self._ended) and self._ended[number] != 0

    def failed_jobs(self) -> list[int]:
        """Return the numbers of all failed jobs in ascending order."""
        query = "SELECT number FROM jobs WHERE failed ORDER BY number"
        return [number for (number,) in self._rows(query)]

    def input_hash(self, number: int) -> str:
        """Return the input hash of a job in flight, or an empty string if none was stored."""
        rows = self._rows("SELECT hash FROM input_hashes WHERE job = ?", number)
        return "".join(text for (text,) in rows)

    def job_rows(self) -> Iterator[dict[str, Any]]:
        """Yield the stored rows of all ended jobs, sorted by job number."""
        with (
            _explained(self.path),
            closing(self._sql.execute("SELECT data FROM jobs ORDER BY number")) as rows,
        ):
            for (data,) in rows:
                yield json.loads(data)

    def summaries(self, part: Receipt) -> bytes:
        """Return the scan summaries of a committed part."""
        query = "SELECT summaries FROM parts WHERE job = ? AND first = ?"
        with _explained(self.path):
            ((data,),) = self._rows(query, part.job, part.first)
        return bytes(data)

    # -- writing -------------------------------------------------------------------------

    def set(self, **values: str) -> None:
        """Store values in the table `meta`."""
        with self._transaction():
            self._insert("meta", values.items(), "OR REPLACE")
        self.meta |= values

    def commit(self, receipts: Iterable[tuple[CommittedResults, Receipt]]) -> list[Receipt]:
        """Commit parts in a single transaction, and return those that are new.

        Parts that contain a scan that has already been committed are skipped. The number of
        delivered frames in these jobs is also committed.
        """
        new: list[tuple[CommittedResults, Receipt]] = []
        for job, part in receipts:
            span = part.first, part.stop
            if job.parts.missing(*span) == [span]:
                job.parts.add(part)
                new.append((job, part))
        if not new:
            return []
        rows = [
            (
                p.job,
                p.first,
                p.stop,
                p.point_count,
                p.size,
                p.hit_count,
                json.dumps(p.cell_box),
                p.summaries,
            )
            for _, p in new
        ]
        try:
            with self._transaction():
                self._insert("parts", rows)
                self._write_frames(job for job, _ in new)
        except BaseException:
            for job, part in new:
                job.parts.remove(part)
            raise
        self.begun.update(job.number for job, _ in new)
        return [part for _, part in new]

    def set_input_hash(self, number: int, text: str) -> None:
        """Store the input hash of a job in flight."""
        with self._transaction():
            self._insert("input_hashes", [(number, text)], "OR REPLACE")

    def drop(self, job: CommittedResults, receipts: Sequence[Receipt]) -> None:
        """Remove parts that the storage has lost, so that their scans are cast again."""
        with self._transaction():
            self._sql.executemany(
                "DELETE FROM parts WHERE job = ? AND first = ?",
                [(job.number, part.first) for part in receipts],
            )
        for part in receipts:
            job.parts.remove(part)

    def add_trials(self, job: CommittedResults, trials: Sequence[Trial]) -> None:
        """Commit the planning trials of a job."""
        with self._transaction():
            # JSON preserves floats exactly.
            rows = [
                (job.number, trial.trial, json.dumps(vars(trial), default=np.ndarray.tolist))
                for trial in trials
            ]
            self._insert("trials", rows, "OR IGNORE")
        self.begun.add(job.number)
        job.trials += trials

    def end_jobs(self, jobs: Iterable[tuple[int, bool, Mapping[str, Any]]]) -> None:
        """Store the rows of ended jobs, and delete their parts, trials and frames.

        Each job is given as its number, whether it failed, and its row. The row of a job that has
        already ended is replaced.
        """
        ended = {number: (int(failed), json.dumps(data)) for number, failed, data in jobs}
        rows = [(number, *row) for number, row in ended.items()]
        with self._transaction():
            self._insert("jobs", rows, "OR REPLACE")
            self._delete(ended)
        self.begun -= ended.keys()
        for number in ended:
            self._mark_ended(number)

    def forget_jobs(self, numbers: Iterable[int]) -> None:
        """Reset ended jobs, so that they are cast again.

        The database still counts as used, even if it becomes empty, because the output files of the
        jobs exist.
        """
        self.set(forgot="jobs")
        forgotten = [(number,) for number in numbers]
        with self._transaction():
            self._sql.executemany("DELETE FROM jobs WHERE number = ?", forgotten)
        for (number,) in forgotten:
            self._mark_ended(number, False)

    def restart(self, job: CommittedResults) -> None:
        """Delete all committed results of a job in flight."""
        with self._transaction():
            self._delete([job.number])
        self.begun.discard(job.number)
        job.reset()

    def save_frames(self, jobs: Iterable[CommittedResults]) -> None:
        """Commit the number of delivered frames for each job in which the number has changed."""
        unsaved = [job for job in jobs if self._has_unsaved_frames(job)]
        if unsaved:
            with self._transaction():
                self._write_frames(unsaved)

    def copy(self) -> bytes:
        """Return the content of the database file after the last transaction."""
        with _explained(self.path):
            return self._sql.serialize()

    def close(self) -> None:
        """Close the database file."""
        self._sql.close()

    def _delete(self, numbers: Iterable[int]) -> None:
        parameters = [(number,) for number in numbers if number in self.begun]
        for table in _JOB_TABLES:
            self._sql.executemany(f"DELETE FROM {table} WHERE job = ?", parameters)
        for (number,) in parameters:
            self._frames.pop(number, None)

    def _mark_ended(self, number: int, ended: bool = True) -> None:
        if not 0 <= number < MAX_JOBS:
            raise ValueError(f"{number} is not a valid job number")
        if number >= len(self._ended):
            self._ended.extend(bytes(number + 1 - len(self._ended)))
        self.ended_count += ended - self._ended[number]
        self._ended[number] = ended

    def _write_frames(self, jobs: Iterable[CommittedResults]) -> None:
        for job in jobs:
            if self._has_unsaved_frames(job):
                row = (job.number, job.frames)
                self._insert("frames", [row], "OR REPLACE")
                self._frames[job.number] = job.frames

    def _has_unsaved_frames(self, job: CommittedResults) -> bool:
        return job.frames != self._frames.get(job.number, job.scans.start)

    def _insert(self, table: str, rows: Iterable[Sequence[Any]], conflict: str = "") -> None:
        """Insert rows and their CRC-32, using a conflict clause such as ``OR REPLACE``."""
        # The checksum is not computed in a function that SQLite calls, because an interrupt in that
        # function would look like damage.
        sealed_rows = [(*row, _crc32(*row)) for row in rows]
        placeholders = ", ".join("?" * (len(_COLUMNS[table]) + 1))
        self._sql.executemany(
            f"INSERT {conflict} INTO {table} VALUES ({placeholders})", sealed_rows
        )

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        with _explained(self.path):
            try:
                self._sql.execute("BEGIN IMMEDIATE")
                yield
                self._sql.execute("COMMIT")
            except BaseException:
                if self._sql.in_transaction:
                    self._sql.execute("ROLLBACK")
                raise


@contextmanager
def _explained(path: Path) -> Iterator[None]:
    """Convert SQLite errors in the body to a LidarError that names the database."""
    try:
        yield
    except (sqlite3.Error, ValueError, LookupError, TypeError, OverflowError) as error:
        words = str(error)
        # Other operational errors, such as a missing column or invalid UTF-8, indicate damage.
        is_disk_error = any(phrase in words.lower() for phrase in _DISK_ERRORS)
        if not isinstance(error, sqlite3.OperationalError) or not is_disk_error:
            raise DamagedError(
                f"{path} is damaged ({words}). Remove the run with `--restart`, or choose a "
                "different folder."
            ) from error
        if "locked" in words:
            raise LidarError(f"Another run is using {path.parent}.") from error
        raise LidarError(
            f"{path} cannot be written ({words}). Free disk space, or choose a different folder."
        ) from error


def _crc32(*values: Any) -> int:
    """Return the CRC-32 of a row's values.

    The values must have the types that SQLite returns.
    """
    crc = 0
    for value in values:
        crc = zlib.crc32(value if isinstance(value, bytes) else f"{value!r},".encode(), crc)
    return crc


def parts_folder(mark: str) -> str:
    """Return the name of a run's parts folder in a location shared by several runs."""
    return f"run-{mark}"


def _validate_location(meta: Mapping[str, str]) -> tuple[str, str]:
    """Return the mark and parts location from a table `meta`.

    Raise ValueError if they are invalid.
    """
    mark = meta["mark"]
    location = meta.get("parts", "")
    if not re.fullmatch("[0-9a-f]{16}", mark):
        raise ValueError(f"{mark!r} is not the mark of a run")
    if location and not location.endswith(f"/{parts_folder(mark)}"):
        raise ValueError(f"{location!r} is not the location of this run's parts")
    return mark, location


def read_parts_location(path: Path) -> tuple[str, str] | None:
    """Read the mark of a run and the location of its parts from a database.

    Returns
    -------
    The mark and the location, which is empty if the parts are in the run folder. None if the
    database is missing or damaged.

    Raises
    ------
    LidarError
        If a run is using the database, or if it belongs to a different program.
    """
    if not path.exists():
        return None
    try:
        # In read-only mode, SQLite could not roll back an interrupted transaction.
        with closing(
            sqlite3.connect(f"{path.absolute().as_uri()}?mode=rw", uri=True, timeout=1.0)
        ) as sql:
            tables = {name for (name,) in sql.execute("SELECT name FROM sqlite_master")}
            if tables and not tables >= {"meta", "parts", "trials"}:
                raise LidarError(
                    f"{path} is not a run database. Move it elsewhere, or choose a different "
                    "folder."
                )
            rows = sql.execute("SELECT name, value, crc FROM meta").fetchall()
            if any(_crc32(name, value) != crc for name, value, crc in rows):
                return None
            return _validate_location({name: value for name, value, _ in rows})
    except sqlite3.Error as error:
        if "locked" in str(error):
            raise LidarError(f"Another run is using {path.parent}.") from error
        return None
    except (ValueError, LookupError, TypeError, OverflowError):
        return None
