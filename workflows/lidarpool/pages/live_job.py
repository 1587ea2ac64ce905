"""Points and hits of a running job, read from as many of its parts as time permits."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from lidarfiles.parts.parts import read_part
from lidarfiles.picture_file import PictureContent
from lidarscenario.plan import best
from lidarsim.columns.cloud import Cloud
from lidarsim.columns.cloud_file import CloudFile
from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import Floats, Floats32
from lidarview.viewer.point_selection import InMemoryPoints
from lidarview.viewer.server import Answer
from lidarview.viewer.view import View

from ..report.picture_content import planning_picture
from ..run.pipeline.stage_messages import Receipt, ScanFrame
from ..run.run_result import RunResult
from ..run.store.stored_job import StoredJob
from .downloads import downloads

LIVE_POINTS = 150_000  # maximum number of points in the browser
MAX_WAITING_PARTS = 64  # If more parts are pending, every second part is skipped.
PARTS_PER_READ = 8  # number of parts that are read for each update
MAX_FRAMES = 40  # maximum number of frames whose rays are shown


class LiveJob:
    """View of a running job, which samples as many of its parts as time permits.

    The thread of the run adds parts, and the threads of the page read them. When the run ends, an
    evenly spaced sample of the complete result replaces the points, so skipped parts do not matter.
    """

    def __init__(self, under_way: StoredJob, name: str = "", max_points: int = LIVE_POINTS) -> None:
        self.name = name
        self._under_way = under_way
        self._max_points = max_points
        self._job = under_way.job
        self._points = under_way.points()  # reader for the points of parts
        self._waiting: list[str] = []  # names of pending parts
        self._lock = threading.Lock()
        self._random = np.random.default_rng(0)
        self._share = 1.0  # share of the points of a part that are kept
        self._counts = np.zeros(self._job.scene.counters, np.int64)
        self._hit_count = 0  # number of hits in the parts that were read
        self.cloud = replace(self._points, names=(), rows=()).load()  # empty, but with all columns
        self.frames: deque[ScanFrame] = deque(maxlen=MAX_FRAMES)  # most recent frames
        self._view: View | None = None  # None before the first request
        self._making = threading.Lock()
        self._all_read = False  # whether all parts were read
        self._end_version = 0  # incremented at the end of the run to make the page reload
        self.add_receipts(under_way.parts.ordered)

    # -- called by the run --------------------------------------------------------------

    def add_receipts(self, receipts: Sequence[Receipt]) -> None:
        """Record that parts have been stored, without reading them."""
        with self._lock:
            self._waiting += [part.name for part in receipts]
            while len(self._waiting) > MAX_WAITING_PARTS:
                del self._waiting[1::2]

    def read_all(self) -> None:
        """Read all pending parts of a finished job before they are deleted."""
        while self._waiting:
            self.gather()
        self._all_read = True

    def finish(self, result: RunResult | None) -> None:
        """Show a sample of the result's points, and its hit counts.

        Afterward, the parts may be removed.
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
        """Show the written cloud and its sweeps, because the parts have been deleted."""
        view = self.view
        view.sweeps = self._job.sweeps
        view.replace_points(
            CloudFile(cloud, () if view.pictured is None else view.pictured.extra_columns)
        )
        self._end_version += 1

    # -- called by the page -------------------------------------------------------------

    def gather(self) -> None:
        """Read some of the pending parts.

        Unreadable parts are skipped, because the run reports them.
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
        """Return the values of the scene's hit counters.

        If some parts were not read, the counts are scaled to the total number of hits.
        """
        with self._lock:
            return np.asarray(
                self._counts * (self._under_way.parts.hit_count / max(self._hit_count, 1))
            )

    @property
    def view(self) -> View:
        """View of the job, which is created when it is first used."""
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
        with self._making:
            if self._view is not None:
                self._view.replace_points(InMemoryPoints(self.cloud))

    def news(self) -> Answer:
        """Return what has changed since the last request, both during and after the run."""
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
            # The surface is large, and only changes visibly after 10 % more hits.
            "hits_version": round(10 * np.log1p(self._hit_count)),
            "rays_version": newest,
            "time": self._job.survey.begins_ns(newest) / 1e9 if frames else None,
            "path": view.planned_path,
            "ends": self._end_version,
        }
        return header, {"rays": _sample_rays(frames) if frames else view.displayed_rays}


def _sample_rays(frames: list[ScanFrame]) -> Floats32:
    """Return the start and end points of sample rays, in local coordinates.

    The array has shape (n, 2, 3).
    """
    pairs = ((np.full_like(frame.samples, frame.pose.position), frame.samples) for frame in frames)
    return np.concatenate([np.stack(pair, axis=1) for pair in pairs]).astype(np.float32)
