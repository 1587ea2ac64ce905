"""The tasks of a run in bounded memory: totals, and some thousand records."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field

from .task_records import TaskRecord

MAX_RECORDS = 4096  # limit for a stage; beyond that every second record is dropped, repeatedly
MAX_MISPLACED = 20  # records of a stage; all are counted
MAX_SPANS = 2048  # busy spans of a stage


@dataclass(eq=False)
class StageTotals:
    """Totals of all tasks of a stage, and some of their records."""

    stage: str
    partition: str
    tasks: int = 0
    items: int = 0
    seconds: float = 0.0  # seconds of all tasks
    start: float = float("inf")  # start of the first task, seconds since the epoch
    stop: float = float("-inf")  # end of the last task
    workers: set[str] = field(default_factory=set)  # names
    # {resource: tasks that ran on workers with it}; "none" for workers without.
    resources: Counter[str] = field(default_factory=Counter)
    violations: int = 0  # tasks outside their partition
    misplaced: list[TaskRecord] = field(default_factory=list)  # the first of the violations
    # Times when at least one task was running, as far as known: (start, stop), in order.
    busy: list[tuple[float, float]] = field(default_factory=list)
    # Of the tasks, or of every n-th if there are thousands.
    records: list[TaskRecord] = field(default_factory=list, repr=False)
    _every: int = 1  # every n-th record is kept
    _gap: float = 1e-4  # seconds between spans that are joined

    def add(self, record: TaskRecord) -> None:
        """Count a task."""
        if self.tasks % self._every == 0:
            self.records.append(record)
            if len(self.records) > MAX_RECORDS:
                del self.records[1::2]
                self._every *= 2
        self.tasks += 1
        self.items += record.items
        self.seconds += record.seconds
        self.start = min(self.start, record.start)
        self.stop = max(self.stop, record.stop)
        self.workers.add(record.worker)
        self.resources.update(record.resources or ("none",))
        if record.misplaced:
            self.violations += 1
            if len(self.misplaced) < MAX_MISPLACED:
                self.misplaced.append(record)
        self.busy.append((record.start, record.stop))
        while len(self.busy) > MAX_SPANS:
            self.busy = union(self.busy, self._gap)
            # Coarser until the number halves, so that this is not repeated for each record.
            if len(self.busy) > MAX_SPANS // 2:
                self._gap *= 2
                self.busy = union(self.busy, self._gap)


class TaskBook:
    """Records the tasks of a run in bounded memory."""

    def __init__(self) -> None:
        self.stages: dict[str, StageTotals] = {}

    def add(self, record: TaskRecord) -> None:
        """Add a task."""
        new = StageTotals(record.stage, record.partition)
        self.stages.setdefault(record.stage, new).add(record)


def union(spans: Iterable[tuple[float, float]], gap: float = 0.0) -> list[tuple[float, float]]:
    """Return spans in order, merging spans that overlap or are at most `gap` apart."""
    merged: list[tuple[float, float]] = []
    for start, stop in sorted(spans):
        if merged and start <= merged[-1][1] + gap:
            merged[-1] = (merged[-1][0], max(stop, merged[-1][1]))
        else:
            merged.append((start, stop))
    return merged
