"""What a run tells its live page."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from poolpart import Partition

from ..export.jobs import JobRow, Value
from ..pipeline import Frame
from ..pipeline.messages import Receipt
from ..scenario.job import Job
from .job_points import JobPoints
from .progress import Progress
from .result import CampaignRun, RunResult


class JobNow(NamedTuple):
    """A job that is being cast or written, at one moment.

    `stored` of its `scans` are in storage, with `points`; `seconds` is the casting time so far.
    """

    name: str
    values: Mapping[str, Value]
    stored: int
    scans: int
    points: int
    seconds: float
    writing: bool


class Page:
    """What a run tells its live page, see `lidarpool.live`; here of no page.

    Methods are called in the run's thread and must return at once, `look` in a thread that removes
    what is left of ended jobs.
    """

    def follow(self, partitions: Mapping[str, Partition]) -> None:
        """Show what goes on from now on, on these partitions."""

    def begun(self, job: Job, points: JobPoints) -> None:
        """Show what is committed of the only job from now on, and what an earlier run has left."""

    def on_parts(self, receipts: Sequence[Receipt]) -> None:
        """Show parts of the only job."""

    def on_frame(self, frame: Frame) -> None:
        """Show a frame of the only job."""

    def on_progress(self, progress: Progress, under_way: Callable[[], Sequence[JobNow]]) -> None:
        """Show the progress; KeyboardInterrupt if a user of the page has stopped the run."""

    def ended(self, row: JobRow) -> None:
        """Show a job that has ended, in this run or an earlier one."""

    def look(self, row: JobRow, points: JobPoints) -> None:
        """Read points of a job that is done, before its parts are removed, if they are shown."""

    def finish(self, result: RunResult | CampaignRun) -> None:
        """Show the whole result; parts may then be removed."""

    def stay(self, cloud: Path | None = None) -> None:
        """Keep the page until its user ends it; points are read from the written `cloud`."""
