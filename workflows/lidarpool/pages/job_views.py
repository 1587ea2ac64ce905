"""Views that show the points of a run's jobs, either from memory or from the data set."""

from __future__ import annotations

import time
from collections.abc import Callable

from lidarfiles.datasets.dataset import DataSet, job_file
from lidarfiles.datasets.job_table import JobRow
from lidarsim.io.storage import Storage
from lidarsim.sweeps.sweeps import SWEEPS_FILE
from lidarview.viewer.result_views import open_result
from lidarview.viewer.view import View

from ..run.store.stored_job import StoredJob
from .cpu_share import CpuShare
from .downloads import downloads
from .live_job import LiveJob

READING_SHARE = 0.05  # maximum share of a CPU core for reading points
READ_EVERY_S = 5.0  # minimum time between reading the points of two jobs
WATCHED_S = 10.0  # time after a request during which the page counts as open
MAX_VIEWS = 4  # maximum number of jobs with points, since a browser may show an earlier job


class JobViews:
    """Views that show the points of jobs in the browser.

    The points are in memory, or in the folder of a job that was written to a data set.
    """

    def __init__(self) -> None:
        self.jobs: dict[int, LiveJob] = {}  # by job number, newest last
        self.reading = CpuShare(READING_SHARE)
        self._written: Storage | None = None  # data set whose job folders can be opened
        self._results: dict[int, View] = {}  # views of written jobs by number
        # time at which a browser last requested points of the newest job
        self._requested_at = float("-inf")

    @property
    def opens_written(self) -> bool:
        """Whether a job can be opened after it has been written."""
        return self._written is not None

    def follow(self, dataset: DataSet) -> None:
        """Let users open the written jobs of a data set, if each job has a local folder."""
        if dataset.format == "folder" and dataset.storage.is_local:
            self._written = dataset.storage

    def request_newest(self) -> None:
        """Record that a browser has requested points of the newest job."""
        self._requested_at = time.monotonic()

    def read(self, row: JobRow, job: StoredJob, is_last: bool) -> None:
        """Read the points of a job if a browser shows points of jobs.

        The points of the first and of the last job are always read. Those of other jobs are only
        read if the CPU share permits it.
        """
        watched = time.monotonic() - self._requested_at <= WATCHED_S and self.reading.is_due
        if self.jobs and not (is_last or watched):
            return
        with self.reading.use(READ_EVERY_S):
            live = self.jobs.get(row.number) or LiveJob(job, row.name)
            live.read_all()
            if len(live.cloud):
                jobs = self.jobs | {row.number: live}
                self.jobs = {number: jobs[number] for number in [*jobs][-MAX_VIEWS:]}

    def view(self, number: int, name_of: Callable[[int], str]) -> View:
        """Return the view of a job that has been read or written.

        Raises
        ------
        KeyError
            If the job is unknown or cannot be opened.
        """
        if number in self.jobs:
            return self.jobs[number].view
        if number not in self._results and self._written is not None:
            file = self._written.local(job_file("folder", name_of(number), SWEEPS_FILE))
            self._results[number] = open_result(file.parent, downloads())
        return self._results[number]
