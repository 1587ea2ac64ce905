"""Jobs in the pipeline, and their progress."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass, field

from ...processes.tracing import trace
from .committed_results import CommittedResults


@dataclass(eq=False)
class PipelineJob:
    """Job that is in the pipeline.

    Its progress is modified by the dispatcher and the pipeline, and its committed results are
    modified by the run's database.
    """

    committed: CommittedResults
    run: str  # ID of the run, for traces
    scene_name: str  # jobs with the same scene may be cast in one task
    scans_per_task: int  # number of scans that fit in the memory of a casting task
    # Estimated number of scans in all jobs of the run that have not ended. If many jobs follow,
    # batches do not have to be divided among all slots.
    scans_of_run: int
    packed: bytes = b""  # pickled survey for stage 1
    # Progress.
    generated: int = field(init=False)  # one past the last scan that was received from stage 1
    sorted: int = field(init=False)  # one past the last scan that stage 3 has returned in order
    sorted_at: float = field(init=False)  # monotonic time of the last response from stage 3
    cast: int = field(init=False, default=0)  # number of scans that stage 2 has cast
    seconds: float = field(init=False, default=0.0)  # casting time of committed batches
    condemned: list[str] = field(init=False, default_factory=list)  # why scans cannot be cast

    def __post_init__(self) -> None:
        committed = self.committed
        self.number = committed.number
        self.scans = committed.scans
        # If all scans are committed, stage 1 does not have to describe any.
        self.generated = self.scans.start if committed.missing_count else self.scans.stop
        self.sorted = committed.frames
        self.sorted_at = time.monotonic()

    @property
    def is_complete(self) -> bool:
        """True if all scans have been committed and, in a job with frames, sorted."""
        is_sorted = not self.committed.has_frames or self.sorted == self.scans.stop
        return is_sorted and not self.committed.missing_count

    def trace(self, event: str, stage: str, scans: Iterable[int], **details: str) -> None:
        """Trace an event of the driver that concerns scans of this job."""
        details |= {"run": self.run, "stage": stage}
        trace(f"driver.{event}", job=self.number, scans=list(scans), **details)
