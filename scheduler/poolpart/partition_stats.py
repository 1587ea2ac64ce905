"""Figures of partitions and their stages, as users and ``/metrics`` get them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime

from .html_table import html_table, shown_seconds, text_table
from .rules import workers_in_words

COUNTS = ("waiting", "queued", "running", "done", "failed")  # task states, in the order of tables
_HEAD_OF_STAGES = ("stage", *COUNTS, "seconds")
_HEAD_OF_PARTITIONS = ("partition", "workers", "slots", "busy", *COUNTS, "seconds")


def size_in_words(workers: int, target: int | None, slots: int) -> str:
    """Return the size of a partition in words, such as "1 of 2 workers, 4 slots"."""
    counted = workers_in_words(workers)
    if target is not None and target != workers:
        counted = f"{workers} of {workers_in_words(target)}"
    return f"{counted}, {slots} {'slot' if slots == 1 else 'slots'}"


@dataclass(frozen=True)
class StageStats:
    """Tasks of a stage, that is, with a common key prefix.

    Parameters
    ----------
    waiting
        Tasks that wait for results of others.
    queued
        Tasks that wait for a worker, or for their turn on one.
    running
        Running tasks. The scheduler does not see when a task starts: of a worker's tasks, as many
        count as running as the worker has slots.
    done
        Successful runs of tasks, including those whose result was lost and recomputed.
    failed
        Tasks that raised an error or were given up after too many dead workers. Their dependents,
        which never ran, do not count.
    seconds
        Running time of tasks, including failed ones, without those lost with their worker.
    queued_seconds
        Time that these tasks waited for a worker or for a slot, after all their inputs were there.
    """

    waiting: int = 0
    queued: int = 0
    running: int = 0
    done: int = 0
    failed: int = 0
    seconds: float = 0.0
    queued_seconds: float = 0.0

    def _repr_html_(self) -> str:
        """Return the table that notebooks show."""
        return html_table(type(self).__name__, _HEAD_OF_STAGES[1:], [self._figures])

    @property
    def _figures(self) -> list[object]:
        """Cells of a row of a table: the counts, and the running time in seconds."""
        return [*(getattr(self, count) for count in COUNTS), shown_seconds(self.seconds)]


@dataclass(frozen=True, repr=False)
class PartitionStats(StageStats):
    """Current and finished tasks of a partition.

    Finished tasks are counted since the cluster was divided, a client submitted its first task to
    a partition, statistics were first requested, or the page was opened, whichever came first.

    Parameters
    ----------
    name
        Name of the partition.
    workers
        Workers that it has now.
    target
        Workers that its rule asks for, or None if the rule, such as `rest`, has no such number.
        More than `workers` after the loss of a worker.
    slots, busy
        Slots of these workers, and how many are held by a task.
    exclusive
        Whether a fence keeps other tasks out.
    stages
        The same counts by stage.
    since
        When counting began, in UTC.
    """

    name: str = ""
    workers: int = 0
    slots: int = 0
    busy: int = 0
    exclusive: bool = False
    stages: Mapping[str, StageStats] = field(default_factory=dict)
    since: datetime | None = None
    target: int | None = None

    def __repr__(self) -> str:
        size = size_in_words(self.workers, self.target, self.slots)
        since = f", counted since {self.since:%H:%M:%S} UTC" if self.since else ""
        stages = [[stage, *stats._figures] for stage, stats in self.stages.items()]
        title = f"<PartitionStats {self.name!r}: {size}, {self.busy} busy{since}>"
        return f"{title}\n{text_table(_HEAD_OF_STAGES, [*stages, ['all', *self._figures]])}"

    def _repr_html_(self) -> str:
        """Return the tables that notebooks show: the partition, and its stages."""
        name = self.name or "remainder"
        row = [name, self.workers, self.slots, self.busy, *self._figures]
        tables = html_table("Partition", _HEAD_OF_PARTITIONS, [row])
        if self.stages:
            stages = [[stage, *stats._figures] for stage, stats in self.stages.items()]
            tables += html_table("Stages", _HEAD_OF_STAGES, stages)
        return tables
