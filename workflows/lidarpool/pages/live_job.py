"""Points and hits of a job under way, from the parts that there is time to read."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from lidarsim.columns.cloud import Cloud
from lidarsim.columns.cloud_file import CloudFile
from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import Floats, Floats32
from lidarview.picture_file import PictureContent
from lidarview.viewer.point_selection import InMemoryPoints
from lidarview.viewer.server import Answer
from lidarview.viewer.view import View

from ..columns.parts import read_part
from ..plan import best
from ..report.picture_content import planning_picture
from ..run.pipeline.stage_messages import Receipt, ScanFrame
from ..run.run_result import RunResult
from ..run.store.stored_job import StoredJob
from .downloads import downloads

LIVE_POINTS = 150_000  # points in the browser at a time
MAX_WAITING_PARTS = 64  # parts that wait to be read; of more, every second is skipped
PARTS_PER_READ = 8  # parts read for one drawing
MAX_FRAMES = 40  # whose rays are shown


class LiveJob:
    """Points and hits of a job, from the parts that there is time to read, and its view.

    The run's thread records parts, the page's threads read parts. At the end an evenly spaced
    sample of the complete result replaces the points, so skipped parts do not matter.
    """

    def __init__(self, under_way: StoredJob, name: str = "", max_points: int = LIVE_POINTS) -> None:
        self.name = name
        self._under_way = under_way
        self._max_points = max_points
        self._job = under_way.job
        self._points = under_way.points()  # points of the columns of parts
        self._waiting: list[str] = []  # names of parts
        self._lock = threading.Lock()
        self._random = np.random.default_rng(0)
        self._share = 1.0  # share of the points of a part that are taken
        self._counts = np.zeros(self._job.scene.counters, np.int64)
        self._hit_count = 0  # hits of the parts that were read
        self.cloud = replace(self._points, names=(), rows=()).load()  # no points, with the columns
        self.frames: deque[ScanFrame] = deque(maxlen=MAX_FRAMES)  # the last frames
        self._view: View | None = None  # None before the first question
        self._making = threading.Lock()
        self._all_read = False  # all parts were read
        self._end_version = 0  # changes at the end of the run that the page must ask for
        self.add(under_way.parts.ordered)

    # -- the run's side ------------------------------------------------------------------

    def add(self, receipts: Sequence[Receipt]) -> None:
        """Record parts that are in storage, without reading."""
        with self._lock:
            self._waiting += [part.name for part in receipts]
            while len(self._waiting) > MAX_WAITING_PARTS:
                del self._waiting[1::2]

    def read_all(self) -> None:
        """Read all waiting parts of a job that is done, before they are removed."""
        while self._waiting:
            self.gather()
        self._all_read = True

    def finish(self, result: RunResult | None) -> None:
        """Take a sample of all points, and all hits.

        The parts may then be removed.
        """
        if result is not None:
            with self._lock:
                self._waiting = []
                self._counts = result.hit_counts
                self._hit_count = result.hit_count
                self.cloud = result.points.sample(self._max_points, MAX_WAITING_PARTS)
            self._show()
            self.view.rays = result.sample_rays
            self.view.path = None if result.plan is None else result.plan.path
        self._end_version += 1

    def show_file(self, cloud: Path) -> None:
        """Show the written cloud, with its sweeps: the parts are gone."""
        view = self.view
        view.sweeps = self._job.sweeps
        view.replace_points(
            CloudFile(cloud, () if view.pictured is None else view.pictured.extra_columns)
        )
        self._end_version += 1

    # -- the page's side -----------------------------------------------------------------

    def gather(self) -> None:
        """Read a few of the waiting parts.

        The run reports parts that cannot be read.
        """
        with self._lock:
            names = self._waiting[:PARTS_PER_READ]
            self._waiting = self._waiting[PARTS_PER_READ:]
            clouds = [self.cloud]
            for name in names:
                with suppress(LidarError):
                    part = read_part(self._points.storage, name)
                    self._counts[part.triangles] += part.hits
                    self._hit_count += int(part.hits.sum())
                    rows = np.flatnonzero(self._random.random(len(part)) < self._share)
                    clouds.append(self._points.cloud_of(part, rows))
            if not names:
                return
            cloud = Cloud.concatenate(clouds)
            while len(cloud) > self._max_points:
                self._share /= 2
                cloud = cloud[self._random.random(len(cloud)) < 0.5]
            self.cloud = cloud
        self._show()

    def hit_counts(self) -> Floats:
        """Return hits by counters of the scene, scaled up to all hits if parts were not read."""
        with self._lock:
            return np.asarray(
                self._counts * (self._under_way.parts.hit_count / max(self._hit_count, 1))
            )

    @property
    def view(self) -> View:
        """View of the job, created on first use."""
        with self._making:
            if self._view is None:
                job = self._job
                planning = planning_picture(job.planning)
                pictured, drawn = PictureContent.before_casting(job.scene, job.survey, planning)
                sweeps = job.sweeps if self._all_read else None
                title = f"job {self.name} - lidarpool" if self.name else "lidarpool"
                self._view = View(
                    InMemoryPoints(self.cloud), pictured, sweeps, title=title, downloads=downloads()
                )
                self._view.read_hit_counts = lambda: drawn.triangle_hit_counts(self.hit_counts())
            return self._view

    def _show(self) -> None:
        """Show the points in the view, if there is a view."""
        with self._making:
            if self._view is not None:
                self._view.replace_points(InMemoryPoints(self.cloud))

    def news(self) -> Answer:
        """Return the news of the job, under way or at its end."""
        view = self.view
        frames = [] if self._end_version else list(self.frames)
        planning = self._job.planning
        trials = self._under_way.trials
        is_new = view.path is None and not self._end_version
        if planning is not None and is_new and len(trials) >= self._job.trials:
            view.path = best(trials, planning).path
        newest = frames[-1].scan if frames else -1
        header = {
            "version": view.version,
            # The surface is large, and changes visibly only with a tenth more hits.
            "hits_version": round(10 * np.log1p(self._hit_count)),
            "rays_version": newest,
            "time": self._job.survey.begins_ns(newest) / 1e9 if frames else None,
            "path": view.planned_path,
            "ends": self._end_version,
        }
        return header, {"rays": _rays_of(frames) if frames else view.displayed_rays}


def _rays_of(frames: list[ScanFrame]) -> Floats32:
    """Return sample rays (n, 2, 3) of frames, local coordinates."""
    pairs = ((np.full_like(frame.samples, frame.pose.position), frame.samples) for frame in frames)
    return np.concatenate([np.stack(pair, axis=1) for pair in pairs]).astype(np.float32)
