"""Batches: consecutive scans of a job on their way through stages 2 and 4."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass, field
from enum import Enum

from .pipeline_job import PipelineJob


class BatchState(Enum):
    """State of a batch."""

    WAITING = "waiting"  # the next offer goes to a GPU worker
    CASTING = "casting"  # offered to one
    CAST = "cast"  # its columns are on that worker
    COLLECTING = "collecting"  # assigned to a collector


class Outcome(Enum):
    """State of a casting task, or the reason why its batches are offered again."""

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
    """Consecutive uncommitted scans of a job on their way to a part."""

    job: PipelineJob
    first: int
    stop: int
    number: int  # count of earlier batches of all jobs; limits the span from oldest to newest
    order: int = 0  # waiting batches are offered in this order
    state: BatchState = BatchState.WAITING
    since: float = 0.0  # monotonic time of the last change of state
    key: str = ""  # key of the casting task; "" while waiting
    worker: str = ""  # address of the GPU worker
    collector: str = ""  # name of the task of stage 4
    deaths: Counter[str] = field(default_factory=Counter)  # {stage: workers that died with it}
    single_job: bool = False  # True if it must not be cast with batches of other jobs

    def __post_init__(self) -> None:
        self.share = len(self) / self.job.scans_per_task  # share of the memory of a task

    def __len__(self) -> int:
        return self.stop - self.first

    @property
    def scans(self) -> range:
        """Numbers of the scans."""
        return range(self.first, self.stop)

    def move(self, state: BatchState) -> None:
        """Set the state, and the time of the change."""
        self.state = state
        self.since = time.monotonic()
