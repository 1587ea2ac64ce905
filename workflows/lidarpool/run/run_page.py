"""Interface of a run to its live page (`lidarpool.pages.live_page`)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from poolpart import Partition

from ..datasets.dataset import DataSet
from ..datasets.job_table import JobRow
from .pipeline.stage_messages import Receipt, ScanFrame
from .progress import Progress
from .run_result import RunResult
from .store.stored_job import StoredJob


class RunPage:
    """Live page of a run.

    This base class shows no page.

    Methods are called in the run's thread and must return at once, `look` in a thread that removes
    the parts of ended jobs.
    """

    def begun(self, job: StoredJob) -> None:
        """Show the only job of a run, and the results of an earlier run."""

    def follow(self, partitions: Mapping[str, Partition], dataset: DataSet | None = None) -> None:
        """Show the work on these partitions from now on.

        Jobs are written to the data set.
        """

    def on_parts(self, receipts: Sequence[Receipt]) -> None:
        """Show parts of the only job that were committed."""

    def on_frame(self, frame: ScanFrame) -> None:
        """Show a frame of the only job."""

    def on_progress(
        self, progress: Progress, in_flight: Callable[[], Sequence[Mapping[str, Any]]]
    ) -> None:
        """Show the progress.

        Raises KeyboardInterrupt if a user of the page has stopped the run.

        `in_flight` returns the states of the jobs that are being cast or written: `name` and
        `values` of the job, the number of its `scans`, how many of them are `stored` and with how
        many `points`, the casting time so far in `seconds`, and whether its files are being
        written (`writing`).
        """

    def ended(self, row: JobRow) -> None:
        """Show a job that has ended, in this run or an earlier run."""

    def look(self, row: JobRow, job: StoredJob) -> None:
        """Read points of a finished job, if they are shown, before its parts are removed."""

    def finish(self, seconds: float, result: RunResult | None = None) -> None:
        """Show the end of the run after `seconds`, and the result of a survey.

        The parts may be removed afterwards.
        """

    def stay(self, cloud: Path | None = None) -> None:
        """Keep the page until its user ends the page.

        Points are read from the written `cloud`.
        """
