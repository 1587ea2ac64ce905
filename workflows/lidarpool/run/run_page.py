"""Interface between a run and its live page (`lidarpool.pages.live_page`)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidarfiles.datasets.job_table import JobRow
from poolpart import Partition

from .pipeline.stage_messages import Receipt, ScanFrame
from .progress import Progress
from .run_result import RunResult
from .store.stored_job import StoredJob

if TYPE_CHECKING:
    from lidarfiles.datasets.dataset import DataSet


class RunPage:
    """Interface of the live page of a run.

    The methods of this base class do nothing. They are called in the thread of the run and must
    return immediately, except for `on_job_written`, which is called in the thread that removes the
    parts of ended jobs.
    """

    def on_survey_start(self, job: StoredJob) -> None:
        """Show the job of a survey, including any results from an earlier run."""

    def follow(self, partitions: Mapping[str, Partition], dataset: DataSet | None = None) -> None:
        """Start showing the tasks on the given partitions.

        `dataset` is the data set that the jobs of a campaign are written to.
        """

    def on_parts(self, receipts: Sequence[Receipt]) -> None:
        """Show newly committed parts of a survey."""

    def on_frame(self, frame: ScanFrame) -> None:
        """Show a frame of a survey."""

    def on_progress(
        self, progress: Progress, in_flight: Callable[[], Sequence[Mapping[str, Any]]]
    ) -> None:
        """Show the progress of the run.

        Parameters
        ----------
        progress
            Progress of the run.
        in_flight
            Function that returns the states of the jobs that are being cast or written. A state
            contains the `name` and the `values` of the job, the number of its `scans`, the number
            of scans that are `stored`, the number of their `points`, the casting time in `seconds`,
            and whether the files of the job are being written (`writing`).

        Raises
        ------
        KeyboardInterrupt
            If a user of the page has stopped the run.
        """

    def on_job_end(self, row: JobRow) -> None:
        """Show a job that has ended in this run or in an earlier run."""

    def on_job_written(self, row: JobRow, job: StoredJob) -> None:
        """Read the points of a finished job before its parts are deleted."""

    def finish(self, seconds: float, result: RunResult | None = None) -> None:
        """Show that the run has ended, with its duration in seconds and any result of a survey.

        The parts may be removed afterwards.
        """

    def keep_open(self, cloud: Path | None = None) -> None:
        """Keep the page open until the user closes it.

        Points are read from the written file `cloud`.
        """
