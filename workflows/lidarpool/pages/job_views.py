"""Views of the jobs of a run: the only job, or the newest jobs that were read, and written jobs."""

from __future__ import annotations

import time
from collections.abc import Callable

from lidarsim.io.storage import Storage
from lidarsim.sweeps.sweeps import SWEEPS_FILE
from lidarview.viewer.result_views import open_result
from lidarview.viewer.view import View

from ..datasets.dataset import DataSet, job_file
from ..datasets.job_table import JobRow
from ..run.store.stored_job import StoredJob
from .cpu_share import CpuShare
from .downloads import downloads
from .live_job import LiveJob

READING_SHARE = 0.05  # share of a core, for points
LOOK_EVERY_S = 5.0  # at most, for the points of another job
WATCHED_S = 10.0  # time after a question while the page counts as watched
MAX_VIEWS = 4  # jobs whose points are kept: a browser may show, or ask for, an earlier one


class JobViews:
    """Jobs whose points were read, and views of jobs that were written to a data set."""

    def __init__(self) -> None:
        self.jobs: dict[int, LiveJob] = {}  # {number: its points}, the newest last
        self.reading = CpuShare(READING_SHARE)
        self._written: Storage | None = None  # folders of jobs, which can be opened
        self._results: dict[int, View] = {}  # {number: view of a written job}
        self._looked_for = float("-inf")  # when a browser last wanted points of the newest job

    @property
    def opens_written(self) -> bool:
        """True if jobs can be opened after they were written."""
        return self._written is not None

    def follow(self, dataset: DataSet) -> None:
        """Open jobs of a data set, if each of its jobs has a folder on this machine."""
        if dataset.format == "folder" and dataset.storage.is_local:
            self._written = dataset.storage

    def want_newest(self) -> None:
        """Record that a browser wants points of the newest job."""
        self._looked_for = time.monotonic()

    def read(self, row: JobRow, job: StoredJob, is_only: bool) -> None:
        """Read points of a job, if it is the only job, or a browser shows points of jobs.

        Points of the first job are read in any case, of others if reading is due.
        """
        watched = time.monotonic() - self._looked_for <= WATCHED_S and self.reading.due
        if self.jobs and not (is_only or watched):
            return
        with self.reading.use(LOOK_EVERY_S):
            live = self.jobs.get(row.number) or LiveJob(job, row.name)
            live.read_all()
            if len(live.cloud):
                jobs = self.jobs | {row.number: live}
                self.jobs = {number: jobs[number] for number in [*jobs][-MAX_VIEWS:]}

    def view(self, number: int, name_of: Callable[[int], str]) -> View:
        """Return the view of a job that was read or, with a name, written, else KeyError."""
        if number in self.jobs:
            return self.jobs[number].view
        if number not in self._results and self._written is not None:
            file = self._written.local(job_file("folder", name_of(number), SWEEPS_FILE))
            self._results[number] = open_result(file.parent, downloads())
        return self._results[number]
