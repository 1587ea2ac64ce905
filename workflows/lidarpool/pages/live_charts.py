"""Charts of the jobs of a run, drawn within a small share of a core."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from contextlib import suppress
from copy import deepcopy

from lidarsim.errors import LidarError

from ..datasets.figures import DataSetStatistics
from ..datasets.job_table import JobRow
from ..report.charts import draw_results, draw_varied
from .cpu_share import CpuShare

DRAWING_SHARE = 0.06  # share of a core, for charts: they take half a second to a second


class Charts:
    """Charts of varied quantities and of results, drawn again while a browser shows the charts.

    A few numbers of each job are kept. At the end the run draws its pictures first, since
    Matplotlib draws in one thread only.
    """

    def __init__(self, names: Sequence[str], count: int) -> None:
        self._figures = DataSetStatistics(names)
        self._count = count
        self._lock = threading.Lock()
        self._drawing = threading.Lock()
        self._share = CpuShare(DRAWING_SHARE)
        self._drawn = 0
        self._svg = ""

    def add(self, row: JobRow) -> None:
        """Count a job."""
        with self._lock:
            self._figures.add(row)

    def version(self, over: bool) -> int:
        """Return the number of jobs in `drawn`, which draws again only if due."""
        with self._lock:
            jobs = self._figures.jobs
            done_count = self._figures.done
        is_due = self._share.due and done_count
        return jobs if over or (is_due and jobs < self._count) else self._drawn

    def drawn(self, over: bool) -> str:
        """Return the charts as elements of HTML, drawn again if due."""
        with self._drawing:
            if self.version(over) != self._drawn:
                with self._lock:  # shortly: the run waits for no drawing
                    figures = deepcopy(self._figures)
                self._drawn = figures.jobs
                with self._share.use(), suppress(LidarError):
                    pages = draw_varied(figures), draw_results(figures)
                    drawn = (f"<figure>{page.svg()}</figure>" for page in pages if page is not None)
                    self._svg = "".join(drawn)
            return self._svg
