"""Tasks of a partition one by one, as `Partition.tasks` returns them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from datetime import UTC, datetime
from typing import Any, NamedTuple

from .errors import PoolError
from .html_table import html_paragraph, html_table, shown_seconds, text_table

KEPT = 1_000  # tasks of a partition that have ended
_SHOWN = 20  # rows of a table that is printed
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
    """Tasks of a partition: unfinished tasks by state, then finished tasks, newest first.

    `since` is when counting began, in UTC: tasks that had finished before are missing.
    """

    since: datetime | None = None

    @classmethod
    def from_rows(cls, rows: Iterable[TaskRow], since: datetime | None = None) -> TaskTable:
        """Return the table of rows.

        Rows of a state keep their order. So do rows of finished tasks.
        """
        table = cls(sorted(rows, key=lambda row: min(STATES.index(row.state), _ENDED)))
        table.since = since
        return table

    def __repr__(self) -> str:
        table = text_table(_HEAD, [_cells(row) for row in self[:_SHOWN]])
        return "\n".join(filter(None, (table, self._omission)))

    def _repr_html_(self) -> str:
        """Return the table that notebooks show."""
        table = html_table("Tasks", _HEAD, [_cells(row) for row in self[:_SHOWN]])
        return table + (html_paragraph(self._omission) if self._omission else "")

    @property
    def _omission(self) -> str:
        """What follows a table of the first tasks, or "" if these are all."""
        if len(self) <= _SHOWN:
            return ""
        counts = Counter(row.state for row in self)
        by_state = ", ".join(f"{counts[state]:,} {state}" for state in STATES if counts[state])
        return f"… the first {_SHOWN} of {len(self):,} tasks: {by_state}. to_pandas() has all."

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
