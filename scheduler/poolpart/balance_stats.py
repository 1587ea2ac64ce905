"""Statistics of balanced groups, for users."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime

from .html_table import format_seconds, html_table, text_table

_HEAD = ("partition", "workers", "demand", "backlog", "tasks/s", "task seconds", "wait seconds")
HEAD_OF_MOVES = ("time", "worker", "from", "to", "reason")
_SHOWN_MOVES = 10  # number of moves that a representation contains


@dataclass(frozen=True)
class WorkerMove:
    """A worker that was moved between two partitions of a balanced group.

    Parameters
    ----------
    time
        Time in UTC when the worker had arrived.
    worker
        Name of the worker.
    source, destination
        Names of the partitions.
    reason
        Demands of both partitions when the move was decided.
    """

    time: datetime
    worker: str
    source: str
    destination: str
    reason: str

    @property
    def cells(self) -> list[object]:
        """Table cells in the order of the columns."""
        time = f"{self.time:%H:%M:%S}"
        return [time, self.worker, self.source, self.destination, self.reason]


@dataclass(frozen=True)
class DemandStats:
    """Load of a partition in a balanced group, averaged over about six task durations.

    Parameters
    ----------
    workers
        Number of workers, including those that are being moved into the partition, but without
        those that are being restarted.
    demand
        Number of workers that the work keeps busy, plus up to a quarter if tasks wait.
    backlog
        Number of unfinished tasks, plus the number of items in the pipes of the partition.
    rate
        Number of tasks per second that arrive or finish, whichever is higher.
    task_s
        Mean running time of a task in seconds, without the time that it waits for pipes.
    wait_s
        Expected waiting time of a task or item that arrives now, in seconds.
    """

    workers: int = 0
    demand: float = 0.0
    backlog: float = 0.0
    rate: float = 0.0
    task_s: float = 0.0
    wait_s: float = 0.0

    @property
    def cells(self) -> list[object]:
        """Table cells in the order of the columns."""
        return [
            self.workers,
            f"{self.demand:.1f}",
            f"{self.backlog:g}",
            f"{self.rate:.3g}",
            format_seconds(self.task_s),
            format_seconds(self.wait_s),
        ]


@dataclass(frozen=True, repr=False)
class BalanceStats:
    """Loads of the partitions in a balanced group, and the workers that were moved.

    Parameters
    ----------
    partitions
        Load of each partition, by name. Empty if the group no longer exists.
    moves
        The last 1,000 workers that were moved, oldest first.
    """

    partitions: Mapping[str, DemandStats]
    moves: Sequence[WorkerMove] = ()

    @property
    def _rows(self) -> list[list[object]]:
        return [[name, *stats.cells] for name, stats in self.partitions.items()]

    @property
    def _last_moves(self) -> list[list[object]]:
        return [move.cells for move in self.moves[-_SHOWN_MOVES:]]

    def __repr__(self) -> str:
        count = len(self.moves)
        title = f"<BalanceStats: {count} {'move' if count == 1 else 'moves'}>"
        tables = [text_table(_HEAD, self._rows)]
        if self.moves:
            tables.append(text_table(HEAD_OF_MOVES, self._last_moves))
        return "\n".join([title, *tables])

    def _repr_html_(self) -> str:
        tables = html_table("Balanced partitions", _HEAD, self._rows)
        if self.moves:
            tables += html_table("Moves", HEAD_OF_MOVES, self._last_moves)
        return tables
