"""The database of a run: which parts and trials, or jobs, belong to the result.

One SQLite file. A batch belongs to the result once its receipt is in here; before that anything may
be lost or done twice, after that a second receipt is ignored. Recovery and resuming offer all other
batches again.
"""

from __future__ import annotations

import bisect
import json
import re
import secrets
import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..base.arrays import Ints
from ..base.errors import LidarpoolError
from ..columns.parts import part_name
from ..plan import Trial
from .messages import Receipt

FORMAT = 7
FILE = "run.db"

_TABLES = """
CREATE TABLE meta (name TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE parts (
    first INTEGER PRIMARY KEY, stop INTEGER NOT NULL, rows INTEGER NOT NULL, size INTEGER NOT NULL,
    hits INTEGER NOT NULL, cells TEXT NOT NULL, summaries BLOB NOT NULL
);
CREATE TABLE trials (trial INTEGER PRIMARY KEY, data TEXT NOT NULL);
CREATE TABLE jobs (number INTEGER PRIMARY KEY, failed INTEGER NOT NULL, data TEXT NOT NULL);
"""


class RunDatabase:
    """Committed parts and trials of one run.

    A file that does not exist is made, and begins with the values `new`. Commits survive a power
    failure if they are `durable`. All methods that write raise LidarpoolError if the disk is full
    or fails.

    LidarpoolError if it is damaged, of another version, in use by another run, or cannot be
    written.
    """

    def __init__(self, path: Path, scan_count: int, *, durable: bool = True, **new: str) -> None:
        self.path, self.scan_count, self._durable = path, scan_count, durable
        self.meta: dict[str, str] = {}
        self.parts: dict[int, Receipt] = {}  # {first scan: its part}
        self.trials: list[Trial] = []
        self.jobs: dict[int, int] = {}  # {number of a job that has ended: whether it failed}
        self.committed = np.zeros(scan_count, bool)
        self.scans_done = 0
        self.point_count = self.hits = 0
        self._firsts: list[int] = []  # of the parts, in order
        self._frames_written = 0
        self.frames = 0  # scans that were handed out as frames, from the first on
        with self._explained():
            self._sql = sqlite3.connect(
                path, isolation_level=None, timeout=1.0, check_same_thread=False
            )
            try:
                self._open({"format": str(FORMAT), "mark": secrets.token_hex(8)} | new)
            except BaseException:
                self._sql.close()
                raise

    def _open(self, new: Mapping[str, str]) -> None:
        # The lock is held while the database is open, so that no second run writes to it.
        self._sql.execute("PRAGMA locking_mode = EXCLUSIVE")
        self._sql.execute(f"PRAGMA synchronous = {'FULL' if self._durable else 'OFF'}")
        self._sql.execute("BEGIN IMMEDIATE")
        if not self._sql.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]:
            for statement in _TABLES.split(";"):
                self._sql.execute(statement)
            for name, value in new.items():
                self._set(name, value)
        self._sql.execute("COMMIT")
        self.meta = dict(self._sql.execute("SELECT name, value FROM meta"))
        if (made := self.meta.get("format")) != str(FORMAT):
            raise sqlite3.DatabaseError(f"it is of format {made}, and this version reads {FORMAT}")
        mark = _checked_place(self.meta)[0]
        self.frames = self._frames_written = int(self.meta.get("frames", 0))
        rows = self._sql.execute(
            "SELECT first, stop, rows, size, hits, cells, "
            "CASE WHEN stop > ? THEN summaries ELSE x'' END FROM parts ORDER BY first",
            (self.frames,),
        )
        # From Python 3.12 on, an unfinished cursor in a traceback keeps a closed file locked.
        with closing(rows):
            for first, stop, count, size, hits, cells, summaries in rows:
                name, box = part_name(mark, first, stop), tuple(json.loads(cells))
                self._enter(Receipt(first, stop, name, count, size, hits, box, summaries))
        trials = self._sql.execute("SELECT data FROM trials ORDER BY trial").fetchall()
        self.trials = [_trial_of(json.loads(data)) for (data,) in trials]
        self.jobs = dict(self._sql.execute("SELECT number, failed FROM jobs"))

    # -- reading -------------------------------------------------------------------------

    @property
    def complete(self) -> bool:
        """Whether all scans are committed and were handed out."""
        return self.scans_done == self.scan_count and self.frames == self.scan_count

    @property
    def used(self) -> bool:
        """Whether anything is committed, or was."""
        return bool(self.scans_done or self.trials or self.jobs) or "forgot" in self.meta

    @property
    def ordered(self) -> list[Receipt]:
        """The parts in scan order."""
        return [self.parts[first] for first in self._firsts]

    @property
    def cells(self) -> Ints | None:
        """Lowest and highest cell of all points, (2, 3); None without points."""
        found = [part.cells for part in self.parts.values() if part.cells]
        if not found:
            return None
        table = np.array(found, np.int64).reshape(-1, 2, 3)
        return np.stack([table[:, 0].min(axis=0), table[:, 1].max(axis=0)])

    def unframed(self) -> list[Receipt]:
        """Parts with scans that were not handed out as frames, in order."""
        at = max(0, bisect.bisect_right(self._firsts, self.frames) - 1)
        return [p for first in self._firsts[at:] if (p := self.parts[first]).stop > self.frames]

    def forget_summaries(self, part: Receipt) -> None:
        """Drop the summaries of a part from memory, because all were handed out."""
        self.parts[part.first] = replace(part, summaries=b"", record=None)

    def summaries_of(self, scans: Sequence[int]) -> list[tuple[int, bytes]]:
        """Summaries of the parts that hold some scans: (first scan, summaries), in order."""
        found: dict[int, bytes] = {}
        with self._explained():
            for scan in scans:
                part = self.part_of(scan)
                if part.first not in found:
                    query = "SELECT summaries FROM parts WHERE first = ?"
                    found[part.first] = self._sql.execute(query, (part.first,)).fetchone()[0]
        return sorted(found.items())

    def part_of(self, scan: int) -> Receipt:
        """Part of a committed scan; KeyError if it is not committed."""
        at = bisect.bisect_right(self._firsts, scan) - 1
        part = self.parts[self._firsts[at]] if at >= 0 else None
        if part is None or scan >= part.stop:
            raise KeyError(scan)
        return part

    def missing(self, first: int, stop: int) -> list[tuple[int, int]]:
        """Return the scans from `first` to `stop` that are not committed, as half-open ranges."""
        absent = np.flatnonzero(~self.committed[first:stop]) + first
        cuts = np.flatnonzero(np.diff(absent) > 1) + 1
        return [(int(run[0]), int(run[-1]) + 1) for run in np.split(absent, cuts) if len(run)]

    def job_rows(self) -> Iterator[dict[str, Any]]:
        """Yield what was stored of the jobs that have ended, by number; one at a time."""
        with (
            self._explained(),
            closing(self._sql.execute("SELECT data FROM jobs ORDER BY number")) as rows,
        ):
            for (data,) in rows:
                yield json.loads(data)

    # -- writing -------------------------------------------------------------------------

    def set(self, **values: str) -> None:
        """Store some values."""
        with self._transaction():
            for name, value in values.items():
                self._set(name, value)
        self.meta |= values

    def commit(self, receipts: Sequence[Receipt]) -> list[Receipt]:
        """Commit parts in one transaction; returns those that were new.

        A part with a scan that is committed already is left out.
        """
        new: list[Receipt] = []
        taken: set[int] = set()
        for receipt in receipts:
            scans = range(receipt.first, receipt.stop)
            if not self.committed[receipt.first : receipt.stop].any() and taken.isdisjoint(scans):
                new.append(receipt)
                taken.update(scans)
        if new:
            with self._transaction():
                self._sql.executemany(
                    "INSERT INTO parts VALUES (?, ?, ?, ?, ?, ?, ?)",
                    [
                        (p.first, p.stop, p.rows, p.size, p.hits, json.dumps(p.cells), p.summaries)
                        for p in new
                    ],
                )
                self._write_frames()
            for receipt in new:
                self._enter(receipt)
        return new

    def drop(self, receipts: Sequence[Receipt]) -> None:
        """Remove parts that are missing in storage, so that their scans are offered again."""
        with self._transaction():
            self._sql.executemany(
                "DELETE FROM parts WHERE first = ?", [(p.first,) for p in receipts]
            )
        for part in receipts:
            del self.parts[part.first]
            self._firsts.remove(part.first)
            self.committed[part.first : part.stop] = False
            self.scans_done -= part.stop - part.first
            self.point_count -= part.rows
            self.hits -= part.hits

    def add_trial(self, trial: Trial) -> None:
        """Store a planning trial."""
        with self._transaction():
            self._sql.execute(
                "INSERT OR IGNORE INTO trials VALUES (?, ?)",
                # To the bit: a float is written with the digits that identify it.
                (trial.trial, json.dumps(vars(trial), default=np.ndarray.tolist)),
            )
        self.trials.append(trial)

    def end_jobs(self, jobs: Iterable[tuple[int, bool, Mapping[str, Any]]]) -> None:
        """Store which jobs of a campaign have ended or failed, and what is to be known of them."""
        with self._transaction():
            for number, failed, data in jobs:
                row = (number, failed, json.dumps(data))
                self._sql.execute("INSERT OR REPLACE INTO jobs VALUES (?, ?, ?)", row)
                self.jobs[number] = int(failed)

    def forget_jobs(self, numbers: Iterable[int]) -> None:
        """Let some jobs be done again: there are files of them, also if there is nothing else."""
        self.set(forgot="jobs")
        with self._transaction():
            for number in numbers:
                self._sql.execute("DELETE FROM jobs WHERE number = ?", (number,))
                del self.jobs[number]

    def save_frames(self) -> None:
        """Store how many frames were handed out; each commit does so anyway."""
        if self.frames != self._frames_written:
            with self._transaction():
                self._write_frames()

    def copy(self) -> bytes:
        """Content of the file after the last transaction."""
        with self._explained():
            return self._sql.serialize()

    def close(self) -> None:
        """Close the file."""
        self._sql.close()

    def _enter(self, part: Receipt) -> None:
        self.parts[part.first] = part
        bisect.insort(self._firsts, part.first)
        self.committed[part.first : part.stop] = True
        self.scans_done += part.stop - part.first
        self.point_count += part.rows
        self.hits += part.hits

    def _set(self, name: str, value: str) -> None:
        self._sql.execute("INSERT OR REPLACE INTO meta VALUES (?, ?)", (name, value))

    def _write_frames(self) -> None:
        if self.frames != self._frames_written:
            self._set("frames", str(self.frames))
            self._frames_written = self.frames

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        with self._explained():
            self._sql.execute("BEGIN IMMEDIATE")
            try:
                yield
                self._sql.execute("COMMIT")
            except BaseException:
                if self._sql.in_transaction:
                    self._sql.execute("ROLLBACK")
                raise

    @contextmanager
    def _explained(self) -> Iterator[None]:
        """Translate an error of SQLite."""
        try:
            yield
        except sqlite3.OperationalError as error:
            if "locked" in str(error):
                raise LidarpoolError(f"Another run is using {self.path.parent}.") from error
            if "no such" in str(error):  # table or column
                raise self._damaged(error) from error
            raise LidarpoolError(
                f"{self.path} cannot be written ({error}): make room on its disk, or give another "
                "folder."
            ) from error
        except (sqlite3.Error, ValueError, TypeError, KeyError) as error:
            raise self._damaged(error) from error

    def _damaged(self, error: Exception) -> LidarpoolError:
        return LidarpoolError(
            f"{self.path} is damaged ({error}): drop the run with --fresh, or give another folder."
        )


def _trial_of(data: dict[str, Any]) -> Trial:
    waypoints = np.array(data.pop("waypoints"), np.float64).reshape(-1, 2)
    return Trial(waypoints=waypoints, **data)


def parts_folder(mark: str) -> str:
    """Name of the folder of the parts in a place that runs share."""
    return f"run-{mark}"


def mark_of_folder(name: str) -> str:
    """Mark of the run whose `parts_folder` has a name; empty for any other name."""
    found = re.fullmatch("run-([0-9a-f]{16})", name)
    return found[1] if found else ""


def _checked_place(meta: Mapping[str, str]) -> tuple[str, str]:
    """Mark and place of parts of a database's values; ValueError if they are not of a run."""
    mark, place = meta["mark"], meta.get("parts", "")
    if not re.fullmatch("[0-9a-f]{16}", mark):
        raise ValueError(f"{mark!r} is not the mark of a run")
    if place and not place.endswith(f"/{parts_folder(mark)}"):
        raise ValueError(f"{place!r} is not the place of this run's parts")
    return mark, place


def read_place(path: Path) -> tuple[str, str] | None:
    """Mark of a run, and the place of its parts or "", from its database.

    None if there is no database, or a damaged one; LidarpoolError if a run is using it, or if it is
    another program's.
    """
    if not path.exists():
        return None
    try:
        # Not read-only: then SQLite could not undo a transaction that was interrupted.
        with closing(
            sqlite3.connect(f"{path.absolute().as_uri()}?mode=rw", uri=True, timeout=1.0)
        ) as sql:
            tables = {name for (name,) in sql.execute("SELECT name FROM sqlite_master")}
            if tables and not tables >= {"meta", "parts", "trials"}:
                raise LidarpoolError(
                    f"{path} is not the database of a run: move it elsewhere, or give another "
                    "folder."
                )
            return _checked_place(dict(sql.execute("SELECT name, value FROM meta")))
    except sqlite3.Error as error:
        if "locked" in str(error):
            raise LidarpoolError(f"Another run is using {path.parent}.") from error
        return None
    except (ValueError, TypeError, KeyError):
        return None
