"""Casting times of a data set's jobs, which are stored in a file next to its report.

Casting times vary between runs. The job table does not contain them, because its bytes must be the
same in every run.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator, Mapping

from lidarsim.errors import LidarError, message_of
from lidarsim.io.storage import Storage

from .job_table import JobRow

SECONDS_FILE = "report.csv"
_HEADER = ["number", "seconds"]


def writing_seconds(storage: Storage, jobs: Iterable[JobRow]) -> Iterator[JobRow]:
    """Yield the rows of jobs unchanged, and write their casting times to SECONDS_FILE.

    The file appears after the last row.
    """
    with storage.writing(SECONDS_FILE) as file:
        file.write(f"{','.join(_HEADER)}\n".encode())
        for row in jobs:
            seconds = "" if row.seconds is None else repr(row.seconds)
            file.write(f"{row.number},{seconds}\n".encode())
            yield row


def read_seconds(storage: Storage) -> Mapping[int, float]:
    """Return the known casting times of jobs as {job number: seconds}.

    Raises
    ------
    LidarError
        If the file is missing or damaged.
    """
    try:
        header, *rows = csv.reader(io.StringIO(storage.read(SECONDS_FILE).decode()), strict=True)
        if header != _HEADER:
            raise ValueError("its header is invalid")
        return {int(number): float(seconds) for number, seconds in rows if seconds}
    except (OSError, ValueError, csv.Error) as error:
        raise LidarError(
            f"The casting times of the jobs cannot be read from {storage.path(SECONDS_FILE)}: "
            f"{message_of(error)}"
        ) from error


def known_seconds(storage: Storage) -> Mapping[int, float]:
    """Return the known casting times, or an empty dictionary if the file cannot be read."""
    try:
        return read_seconds(storage)
    except LidarError:
        return {}
