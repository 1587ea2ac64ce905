"""Where tasks ran, reported by the tasks themselves."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, TypeVar

from distributed import get_worker

from poolpart.workers import declared_resources

T = TypeVar("T")


@dataclass(frozen=True)
class TaskRecord:
    """One task that ran: its worker, the worker's resources, and when.

    `start` and `stop` are seconds since the epoch by the worker's clock; `items` is the task's own
    count.
    """

    stage: str
    partition: str
    worker: str
    resources: tuple[str, ...]
    start: float
    stop: float
    items: int = 1

    @property
    def seconds(self) -> float:
        """Time from start to stop, seconds."""
        return self.stop - self.start

    @property
    def misplaced(self) -> bool:
        """True if the worker was not in the task's partition."""
        return self.partition not in self.resources


class Recorder:
    """Records time and worker of the current task."""

    def __init__(self, stage: str, partition: str) -> None:
        self.stage = stage
        self.partition = partition
        self.start = time.time()
        # The clock may be set while the task runs; its time must not become hours, or negative.
        self._start_s = time.perf_counter()

    def finish(self, items: int = 1) -> TaskRecord:
        """Return the record of the task until now, with a number of items."""
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


def recorded(
    stage: str, partition: str, function: Callable[..., T], /, *args: Any, **kwargs: Any
) -> tuple[T, TaskRecord]:
    """Run `function` on a worker and return its result with the record of the run."""
    recorder = Recorder(stage, partition)
    result = function(*args, **kwargs)
    return result, recorder.finish()


def placement_violations(records: Iterable[TaskRecord]) -> list[TaskRecord]:
    """Select the records of tasks that ran outside their partition."""
    return [record for record in records if record.misplaced]
