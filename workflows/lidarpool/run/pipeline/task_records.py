"""Records of where and when a task ran. Each task creates its own record."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, TypeVar

T = TypeVar("T")


@dataclass(frozen=True)
class TaskRecord:
    """Record of a finished task."""

    stage: str
    partition: str
    worker: str  # name of the worker
    resources: tuple[str, ...]  # resources of the worker
    start: float  # seconds since the epoch on the clock of the worker
    stop: float
    items: int = 1  # number of items that the task processed, such as scans

    @property
    def seconds(self) -> float:
        """Duration of the task in seconds."""
        return self.stop - self.start

    @property
    def is_misplaced(self) -> bool:
        """True if the task ran on a worker outside its partition."""
        return self.partition not in self.resources


class Recorder:
    """Recorder of the duration and worker of the current task."""

    def __init__(self, stage: str, partition: str) -> None:
        self.stage = stage
        self.partition = partition
        self.start = time.time()
        # The duration must remain correct if the system clock is changed while the task is running.
        self._start_s = time.perf_counter()

    def finish(self, items: int = 1) -> TaskRecord:
        """Return the record of the task until now, with the number of processed items."""
        # Imported late, because commands that read records but run no tasks do not need Dask.
        from distributed import get_worker

        from poolpart.workers import declared_resources

        worker = get_worker()
        return TaskRecord(
            stage=self.stage,
            partition=self.partition,
            worker=str(worker.name),
            resources=declared_resources(worker),
            start=self.start,
            stop=self.start + (time.perf_counter() - self._start_s),
            items=items,
        )


def call_recorded(
    stage: str, partition: str, function: Callable[..., T], /, *args: Any, **kwargs: Any
) -> tuple[T, TaskRecord]:
    """Call a function in a task, and return its result with the record of the task."""
    recorder = Recorder(stage, partition)
    result = function(*args, **kwargs)
    return result, recorder.finish()


def placement_violations(records: Iterable[TaskRecord]) -> list[TaskRecord]:
    """Return the records of tasks that ran outside their partition."""
    return [record for record in records if record.is_misplaced]
