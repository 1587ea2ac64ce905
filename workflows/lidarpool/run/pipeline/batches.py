"""Batches of consecutive scans, which pass through stages 2 and 4 of the pipeline."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass, field
from enum import Enum

from .pipeline_job import PipelineJob


class BatchState(Enum):
    """State of a batch."""

    WAITING = "waiting"  # has to be offered to a GPU worker
    CASTING = "casting"  # has been offered to a GPU worker
    CAST = "cast"  # its columns are on this worker
    COLLECTING = "collecting"  # has been assigned to a collector


class Outcome(Enum):
    """Outcome of a casting task.

    If the batches of the task must be cast again, the value is the reason.
    """

    PENDING = "pending"
    DONE = "done"
    DIED = "its worker died"
    GONE = "its worker has left or does not respond"
    REFUSED = "its worker accepts no tasks"
    LATE = "it is late"
    NO_RIG = "its worker no longer has the scene"
    SEPARATE_JOBS = "its task failed, possibly because of a different job"


@dataclass(eq=False)
class Batch:
    """Consecutive uncommitted scans of a job that will become a part."""

    job: PipelineJob
    first: int
    stop: int
    number: int  # sequence number over all jobs, which limits the span from oldest to newest
    order: int = 0  # priority, so that waiting batches are offered in ascending order
    state: BatchState = BatchState.WAITING
    since: float = 0.0  # monotonic time of the last state change
    key: str = ""  # key of the casting task, or empty while waiting
    worker: str = ""  # address of the GPU worker
    collector: str = ""  # name of the collector (stage 4)
    deaths: Counter[str] = field(default_factory=Counter)  # {stage: workers that died with it}
    single_job: bool = False  # True if it must not share a task with batches of other jobs

    def __post_init__(self) -> None:
        self.share = len(self) / self.job.scans_per_task  # fraction of the memory of a task

    def __len__(self) -> int:
        return self.stop - self.first

    @property
    def scans(self) -> range:
        """Numbers of the scans in the batch."""
        return range(self.first, self.stop)

    def set_state(self, state: BatchState) -> None:
        """Change the state, and record the time of the change."""
        self.state = state
        self.since = time.monotonic()
