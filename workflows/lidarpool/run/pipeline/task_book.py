"""Totals and sampled records of a run's tasks, which occupy a limited amount of memory."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field

from .task_records import TaskRecord

MAX_RECORDS = 4096  # maximum number of records per stage, beyond which half of them are dropped
MAX_MISPLACED = 20  # maximum number of records of misplaced tasks per stage
MAX_SPANS = 2048  # maximum number of busy spans per stage


@dataclass(eq=False)
class StageTotals:
    """Totals over all tasks of a stage, and some of their records."""

    stage: str
    partition: str
    tasks: int = 0
    items: int = 0
    seconds: float = 0.0  # total duration of all tasks
    start: float = float("inf")  # start of the first task in seconds since the epoch
    stop: float = float("-inf")  # end of the last task in seconds since the epoch
    workers: set[str] = field(default_factory=set)  # names of the workers
    # Number of tasks by the resources of their workers, or "none" for workers without resources.
    resources: Counter[str] = field(default_factory=Counter)
    violations: int = 0  # number of tasks that ran outside their partition
    misplaced: list[TaskRecord] = field(default_factory=list)  # records of the first violations
    # Start and stop of the spans in which at least one task was running. Spans that are close to
    # each other may be merged.
    busy: list[tuple[float, float]] = field(default_factory=list)
    # Records of all tasks, or of every n-th task if there are thousands.
    records: list[TaskRecord] = field(default_factory=list, repr=False)
    _every: int = 1  # interval n at which records are kept
    _gap: float = 1e-4  # maximum gap between spans that are merged, in seconds

    def add_task(self, record: TaskRecord) -> None:
        """Add the record of a task to the totals."""
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
        if record.is_misplaced:
            self.violations += 1
            if len(self.misplaced) < MAX_MISPLACED:
                self.misplaced.append(record)
        self.busy.append((record.start, record.stop))
        while len(self.busy) > MAX_SPANS:
            self.busy = union(self.busy, self._gap)
            # Halve the number of spans, so that this is not repeated for each record.
            if len(self.busy) > MAX_SPANS // 2:
                self._gap *= 2
                self.busy = union(self.busy, self._gap)


class TaskBook:
    """Totals of the tasks in a run, grouped by stage."""

    def __init__(self) -> None:
        self.stages: dict[str, StageTotals] = {}

    def add_task(self, record: TaskRecord) -> None:
        """Add the record of a task."""
        new = StageTotals(record.stage, record.partition)
        self.stages.setdefault(record.stage, new).add_task(record)


def union(spans: Iterable[tuple[float, float]], gap: float = 0.0) -> list[tuple[float, float]]:
    """Sort time spans, and merge those that overlap or are at most `gap` apart."""
    merged: list[tuple[float, float]] = []
    for start, stop in sorted(spans):
        if merged and start <= merged[-1][1] + gap:
            merged[-1] = (merged[-1][0], max(stop, merged[-1][1]))
        else:
            merged.append((start, stop))
    return merged
