"""Web page of a data set, which lists its jobs and displays the points of each job."""

from __future__ import annotations

import re
import threading
from collections import Counter, OrderedDict
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lidarfiles.clouds.format_table import data_set_title
from lidarfiles.datasets.dataset import job_file
from lidarfiles.datasets.job_seconds import known_seconds
from lidarfiles.datasets.job_table import JobRow, Value, read_table
from lidarfiles.datasets.loader import read_index, sweeps
from lidarsim.io.storage import Storage
from lidarsim.sweeps.sweeps import SWEEPS_FILE, Sweeps
from lidarsim.words import format_rounded, plural
from lidarview.viewer.point_selection import ScanOrderedPoints
from lidarview.viewer.result_views import wait_for_interrupt
from lidarview.viewer.server import Answer, Arguments, announce_page, page_server
from lidarview.viewer.view import View

from .downloads import downloads
from .recorded import finite_points, merge_sweeps

MAX_LISTED = 1000  # maximum number of finished and of failed jobs in the table
_MAX_VIEWS = 4  # maximum number of jobs whose points are kept in memory
_AS_FIRED = (
    "The points are as fired, but their times are unknown. All points of a sweep are placed at the "
    "pose of the sweep."
)


class JobList:
    """Request handler for the page of a data set in a folder or at a URL.

    Raises
    ------
    LidarError
        If the data set is missing, unfinished or damaged.
    """

    def __init__(self, location: Path | Storage) -> None:
        self._storage = location if isinstance(location, Storage) else Storage.at(location)
        self.location = self._storage.url if isinstance(location, Storage) else str(location)
        self._index = read_index(self._storage)
        self.rows = [*read_table(self._storage, self._index["table"])]
        self._seconds = known_seconds(self._storage)
        self._rows = {row.number: row for row in self.rows}
        self._names = list(dict.fromkeys(name for row in self.rows for name in row.values))
        self._views: OrderedDict[int, View] = OrderedDict()
        self._lock = threading.Lock()
        self.title = self.location.rstrip("/").rpartition("/")[2] or self.location

    def answer(self, question: str, arguments: Arguments, abandoned: Callable[[], bool]) -> Answer:
        """Answer a request from the job list or from the viewer of a job."""
        if question == "jobs":
            return self._list(), {}
        match = re.fullmatch(r"job/(\d+)/(\w+)", question)
        if match is None:
            raise KeyError(question)
        return self.view_of(int(match[1])).answer(match[2], arguments, abandoned)

    def _list(self) -> dict[str, Any]:
        """Return the state of the page and the job list as JSON-compatible objects."""
        done = [row for row in self.rows if row.done]
        failed = [row for row in self.rows if not row.done]
        sums = Counter(points=0, rays=0)
        for row in done:
            sums.update(points=row.points, rays=row.rays)
        # The page shows the first job with points next to the list.
        shown = next((row for row in done if row.points), done[0] if done else None)
        return {
            "title": self.title,
            "names": self._names,
            "state": f"data set in {data_set_title(self._index['format'])} format",
            "over": True,
            "still": True,
            "count": len(self.rows),
            "done": len(done),
            "failed": len(failed),
            "time": "",
            "rate": "",
            "left": "",
            "slots": [],
            "busy": 0,
            "under_way": [],
            "failures": [self._entry(row) for row in failed[:MAX_LISTED]],
            "ended": [self._entry(row) for row in done[:MAX_LISTED]],
            "charts": 0,
            "newest": None if shown is None else [shown.number, shown.name],
            **sums,
        }

    def _entry(self, row: JobRow) -> dict[str, Any]:
        """Return the entry of the job list for a job."""
        return {
            "number": row.number,
            "name": row.name,
            "error": row.error,
            "points": row.points,
            "seconds": self._seconds.get(row.number),
            "values": [_format_value(row.values.get(name)) for name in self._names],
            "opens": row.done,
        }

    def view_of(self, number: int) -> View:
        """Return the view of a job.

        Raises
        ------
        KeyError
            If the job is unknown or failed.
        """
        row = self._rows[number]
        if not row.done:
            raise KeyError(number)
        with self._lock:
            if number not in self._views:
                self._views[number] = self._open(row)
            self._views.move_to_end(number)
            while len(self._views) > _MAX_VIEWS:
                self._views.popitem(last=False)
            return self._views[number]

    def _open(self, row: JobRow) -> View:
        """Read all sweeps of a job, and return a view of their points."""
        name = job_file(self._index["format"], row.name, SWEEPS_FILE)
        saved = Sweeps.load(self._storage.path(name), partial(self._storage.read, name))
        saved = replace(saved, coordinates="world")
        loaded = sweeps(self.location, jobs=[row.number])
        has_firings = loaded.have_firing_poses()
        read_sweep = loaded.fired if has_firings else loaded.__getitem__
        note = "" if has_firings or loaded.are_compensated() else _AS_FIRED
        posed = map(read_sweep, range(len(loaded)))
        read = [finite_points(sweep.replace(points=sweep.in_world())) for sweep in posed]
        scans = saved.scans[: len(read)].astype(np.int32).repeat([len(sweep) for sweep in read])
        cloud = merge_sweeps(read, scan=scans)
        title = f"job {row.name} - {self.title}"
        return View(
            ScanOrderedPoints(cloud), None, saved, note=note, title=title, downloads=downloads()
        )


def show_jobs(jobs: JobList, *, port: int, browser: bool = True) -> None:
    """Show a job list in the browser until Ctrl-C is pressed."""
    stopped = threading.Event()
    with page_server(jobs.answer, port, stopped.set, index="jobs.html") as page:
        words = f"{page.url} shows {plural(len(jobs.rows), 'job')}. Press Ctrl-C to stop."
        with announce_page(page, words, browser, on_stdout=True):
            wait_for_interrupt(stopped)


def _format_value(value: Value | None) -> str:
    """Format a varied value of a job, or return an empty string for None."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return str(value).lower()
    return format_rounded(value, 4) if isinstance(value, float) else str(value)
