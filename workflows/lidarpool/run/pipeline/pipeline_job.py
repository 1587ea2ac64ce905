"""A job in the pipeline: how it is cast, and its progress."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass, field

from ...processes.tracing import trace
from .committed_results import CommittedResults


@dataclass(eq=False)
class PipelineJob:
    """A job in the pipeline.

    The dispatcher and the pipeline change its progress, and the run's database changes its
    committed results.
    """

    committed: CommittedResults
    run: str  # id of the run, for traces
    scene_name: str  # jobs with the same scene may be cast in one task
    scans_per_task: int  # scans that fit into the memory of a casting task
    # Scans of all jobs of the run that have not ended. If many jobs follow, batches need not be
    # divided among all slots.
    scans_of_run: int
    packed: bytes = b""  # the survey, pickled, for stage 1
    # Progress.
    generated: int = field(init=False)  # one past the last scan that was taken from stage 1
    sorted: int = field(init=False)  # one past the last scan that stage 3 has returned in order
    sorted_at: float = field(init=False)  # monotonic time of the last answer of stage 3
    cast: int = field(init=False, default=0)  # scans that stage 2 has finished
    seconds: float = field(init=False, default=0.0)  # casting time of committed batches
    condemned: list[str] = field(init=False, default_factory=list)  # why scans cannot be done

    def __post_init__(self) -> None:
        committed = self.committed
        self.number = committed.number
        self.scans = committed.scans
        # If all scans are committed, stage 1 need not describe any scan.
        self.generated = self.scans.start if committed.missing_count else self.scans.stop
        self.sorted = committed.frames
        self.sorted_at = time.monotonic()

    @property
    def complete(self) -> bool:
        """True if all scans are committed and, in a job with frames, sorted."""
        is_sorted = not self.committed.has_frames or self.sorted == self.scans.stop
        return is_sorted and not self.committed.missing_count

    def trace(self, event: str, stage: str, scans: Iterable[int], **details: str) -> None:
        """Emit a trace event of the driver about scans of this job."""
        details |= {"run": self.run, "stage": stage}
        trace(f"driver.{event}", job=self.number, scans=list(scans), **details)
