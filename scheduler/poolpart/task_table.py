"""Table of a partition's individual tasks, as returned by `Partition.tasks`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from datetime import UTC, datetime
from typing import Any, NamedTuple, SupportsIndex, overload

from .errors import PoolError
from .html_table import format_seconds, html_paragraph, html_table, text_table

MAX_ENDED_TASKS = 1_000  # number of finished tasks that are kept per partition
_SHOWN = 20  # number of rows that a printed table shows
STATES = ("waiting", "queued", "running", "done", "failed")
_ENDED = STATES.index("done")  # this and later states have ended
_HEAD = ("state", "key", "function", "worker", "slots", "queued", "started", "seconds", "error")


class TaskRow(NamedTuple):
    """Row of a `TaskTable`, which describes one task.

    Parameters
    ----------
    state
        "waiting" for results of other tasks, "queued" for a worker or for a slot of a worker,
        "running", "done" or "failed". The scheduler is not notified when a task starts, so it
        assumes that a worker runs as many of its tasks as it has slots.
    key
        Key of the task and of its future. The key of a task of `Partition.map` ends with the
        indices of its items, for example ``-item-7`` or ``-items-8-to-11``.
    function
        Prefix of the key, which is the name of the function for most tasks.
    worker
        Name of the worker that runs or has run the task, or "" if there is none yet.
    slots
        Number of slots of the partition that the task takes while it runs.
    queued
        Time when all inputs were available and the task began to wait for a slot. None if this has
        not happened yet, or if the task existed before counting began.
    started, finished
        Times when the task started and finished according to the scheduler's clock, or None. The
        start of a running task is unknown until the first heartbeat of its worker.
    error
        Error of a failed task on a single line, or "" for other tasks.
    seconds
        Running time in seconds, or None if the start is unknown. For a running task, the time until
        now.
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
    seconds: float | None = None


class TaskTable(tuple[TaskRow, ...]):
    """Table of a partition's tasks.

    Unfinished tasks are listed first, grouped by state. They are followed by the finished tasks,
    newest first.

    `since` is the time in UTC when counting began. Tasks that finished earlier are not included.
    A slice of a table is a table as well.

    Examples
    --------
    >>> gpu.tasks().to_pandas().groupby("function")["seconds"].sum()   # doctest: +SKIP
    """

    since: datetime | None = None

    @classmethod
    def from_rows(cls, rows: Iterable[TaskRow], since: datetime | None = None) -> TaskTable:
        """Create a table from rows, sorted by state.

        Rows with the same state keep their order, and so do all rows of finished tasks.
        """
        table = cls(sorted(rows, key=lambda row: min(STATES.index(row.state), _ENDED)))
        table.since = since
        return table

    @overload
    def __getitem__(self, index: SupportsIndex) -> TaskRow: ...

    @overload
    def __getitem__(self, index: slice) -> TaskTable: ...

    def __getitem__(self, index: SupportsIndex | slice) -> TaskRow | TaskTable:
        if not isinstance(index, slice):
            return super().__getitem__(index)
        table = type(self)(super().__getitem__(index))
        table.since = self.since
        return table

    def __repr__(self) -> str:
        table = text_table(_HEAD, [_cells(row) for row in self[:_SHOWN]])
        return "\n".join(filter(None, (table, self._omission)))

    def _repr_html_(self) -> str:
        table = html_table("Tasks", _HEAD, [_cells(row) for row in self[:_SHOWN]])
        return table + (html_paragraph(self._omission) if self._omission else "")

    @property
    def _omission(self) -> str:
        """Note with the number of tasks in each state, or "" if the table is not truncated."""
        if len(self) <= _SHOWN:
            return ""
        counts = Counter(row.state for row in self)
        by_state = ", ".join(f"{counts[state]:,} {state}" for state in STATES if counts[state])
        return (
            f"… The first {_SHOWN} of {len(self):,} tasks: {by_state}. `to_pandas()` returns all."
        )

    def to_pandas(self) -> Any:
        """Return a DataFrame with a row for each task.

        Raises
        ------
        PoolError
            If pandas is not installed.
        """
        try:
            import pandas as pd
        except ImportError:
            raise PoolError(
                "pandas is not installed. Install it with `pip install pandas`."
            ) from None
        return pd.DataFrame(list(self), columns=list(TaskRow._fields))


def _cells(row: TaskRow) -> tuple[str, ...]:
    """Return the table cells of a task, with times of day in UTC."""
    seconds = "" if row.seconds is None else format_seconds(row.seconds)
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


def to_datetime(seconds: float | None) -> datetime | None:
    """Convert seconds since 1970 to a datetime in UTC."""
    return None if seconds is None else datetime.fromtimestamp(seconds, UTC)
