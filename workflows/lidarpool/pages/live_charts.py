"""Charts of a run's jobs, which are drawn using a small fraction of a CPU core."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from contextlib import suppress
from copy import deepcopy

from lidarfiles.datasets.figures import DataSetStatistics
from lidarfiles.datasets.job_table import JobRow
from lidarsim.errors import LidarError

from ..report.charts import draw_results, draw_varied
from .cpu_share import CpuShare

DRAWING_SHARE = 0.06  # maximum share of a CPU core, since drawing takes 0.5 to 1 s


class Charts:
    """Charts of varied quantities and results, which are updated while a browser displays them.

    Only a few numbers of each job are kept. At the end, the run draws its own pictures first,
    because Matplotlib can only draw in one thread.
    """

    def __init__(self, names: Sequence[str], count: int) -> None:
        self._figures = DataSetStatistics(names)
        self._count = count
        self._lock = threading.Lock()
        self._drawing = threading.Lock()
        self._share = CpuShare(DRAWING_SHARE)
        self._drawn = 0
        self._svg = ""

    def add_job(self, row: JobRow) -> None:
        """Add the table row of a job to the statistics."""
        with self._lock:
            self._figures.add_job(row)

    def version(self, over: bool) -> int:
        """Return the number of jobs that the charts would show if `draw` were called now.

        The number only changes if the charts are due to be drawn again.
        """
        with self._lock:
            jobs = self._figures.jobs
            done_count = self._figures.done
        is_due = self._share.is_due and done_count
        return jobs if over or (is_due and jobs < self._count) else self._drawn

    def draw(self, over: bool) -> str:
        """Return the charts as HTML elements, redrawing them if an update is due."""
        with self._drawing:
            if self.version(over) != self._drawn:
                with self._lock:  # held briefly, so that the run does not wait for the drawing
                    figures = deepcopy(self._figures)
                self._drawn = figures.jobs
                with self._share.use(), suppress(LidarError):
                    pages = draw_varied(figures), draw_results(figures)
                    drawn = (f"<figure>{page.svg()}</figure>" for page in pages if page is not None)
                    self._svg = "".join(drawn)
            return self._svg
