"""Tasks of a partition one by one, as `Partition.tasks` returns them."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import UTC, datetime
from typing import Any, NamedTuple

from .errors import PoolError
from .html_table import html_table, shown_seconds

KEPT = 1_000  # tasks of a partition that have ended
STATES = ("waiting", "queued", "running", "done", "failed")
_ENDED = STATES.index("done")  # this and later states have ended
_HEAD = ("state", "key", "function", "worker", "slots", "queued", "started", "seconds", "error")


class TaskRow(NamedTuple):
    """A task of a partition.

    Parameters
    ----------
    state
        "waiting" for results of others, "queued" for a worker or for its turn on one, "running",
        "done" or "failed". The scheduler does not see when a task starts: of a worker's tasks, as
        many count as running as the worker has slots.
    key
        Key of the task, as of its future.
    function
        Prefix of the key, for most tasks the function's name.
    worker
        Name of the worker that runs or ran it; "" for none yet.
    slots
        Slots of the partition that it holds while it runs.
    queued
        When it could run: all its inputs were there, and it waited for a slot. None before, and of
        tasks that were there before tasks were counted.
    started, finished
        When it started and ended, by the clock of the scheduler; None before it has ended.
    error
        The error of a failed task, in a line; "" for none.
    """

    state: str
    key: str
    function: str
    worker: str
    slots: int
    queued: datetime | None = None
    started: datetime | None = None
    finished: datetime | None = None
    error: str = ""

    @property
    def seconds(self) -> float | None:
        """Running time of a task that has ended, seconds."""
        if self.started is None or self.finished is None:
            return None
        return (self.finished - self.started).total_seconds()


class TaskTable(tuple[TaskRow, ...]):
    """Tasks of a partition: those under way by state, then those that have ended, newest first."""

    __slots__ = ()

    @classmethod
    def of_rows(cls, rows: Iterable[TaskRow]) -> TaskTable:
        """Return the table of rows.

        Rows of a state keep their order. So do rows that ended.
        """
        return cls(sorted(rows, key=lambda row: min(STATES.index(row.state), _ENDED)))

    def __repr__(self) -> str:
        cells = [_HEAD, *(_cells(row) for row in self)]
        widths = [max(len(row[column]) for row in cells) for column in range(len(_HEAD))]
        return "\n".join(
            "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
            for row in cells
        )

    def _repr_html_(self) -> str:
        """Return the table that notebooks show."""
        return html_table("Tasks", _HEAD, [_cells(row) for row in self])

    def to_pandas(self) -> Any:
        """Return a DataFrame with a row for each task.

        Raises PoolError if pandas is not installed.
        """
        try:
            import pandas as pd
        except ImportError:
            raise PoolError("pandas is not installed: pip install pandas.") from None
        return pd.DataFrame(
            [(*row, row.seconds) for row in self], columns=[*TaskRow._fields, "seconds"]
        )


def _cells(row: TaskRow) -> tuple[str, ...]:
    """Return the cells of a row, with times of the day in UTC."""
    seconds = "" if row.seconds is None else shown_seconds(row.seconds)
    times = [_time(row.queued), _time(row.started)]
    return (
        row.state,
        row.key,
        row.function,
        row.worker,
        str(row.slots),
        *times,
        seconds,
        row.error,
    )


def _time(moment: datetime | None) -> str:
    return "" if moment is None else f"{moment:%H:%M:%S}"


def moment(seconds: float | None) -> datetime | None:
    """Return a time in seconds since 1970 as a date in UTC."""
    return None if seconds is None else datetime.fromtimestamp(seconds, UTC)
