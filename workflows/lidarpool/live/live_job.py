"""A job on the live page: its growing cloud, read from the parts that a run commits."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..base.arrays import Floats, Floats32
from ..base.errors import LidarpoolError
from ..columns.cloud import Cloud
from ..columns.cloud_file import CloudFile
from ..columns.parts import read_part
from ..export.sweeps import Sweeps
from ..pipeline import Frame, Receipt
from ..plan import best
from ..run.job_points import JobPoints
from ..run.picture_file import Pictured
from ..run.result import RunResult
from .points import HeldPoints
from .server import Answer
from .view import View

LIVE_POINTS = 150_000  # in the browser at a time
PARTS_NOTED = 64  # parts that wait to be read; of more, every second is skipped
PARTS_AT_ONCE = 8  # parts read for one drawing
FRAMES_SHOWN = 40  # whose rays are shown


class LiveJob:
    """Points and hits of a job, from as many of its parts as there is time to read, and its view.

    The run's thread records parts, the page's threads read them. At the end an evenly spaced
    sample of the whole result replaces them, so skipped parts do not matter.
    """

    def __init__(self, points: JobPoints, name: str = "", most: int = LIVE_POINTS) -> None:
        self.name, self._points_of, self._most = name, points, most
        self._job = points.job
        self._points = points.points()  # knows what a part holds
        self._waiting: list[str] = []  # names of parts
        self._lock = threading.Lock()
        self._random = np.random.default_rng(0)
        self._share = 1.0  # of the points of a part that are taken
        self._counts = np.zeros(self._job.scene.counters, np.int64)
        self._hits = 0  # of the parts that were read
        self.cloud = replace(self._points, names=(), rows=()).load()  # none, with their columns
        self.frames: deque[Frame] = deque(maxlen=FRAMES_SHOWN)  # the last ones
        self._view: View | None = None  # until somebody asks
        self._making = threading.Lock()
        self._whole = False  # all parts were read
        self._ends = 0  # how often something came at the run's end that the page must ask for
        self.add(points.parts.ordered)

    # -- the run's side ------------------------------------------------------------------

    def add(self, receipts: Sequence[Receipt]) -> None:
        """Record parts that are in storage; quick, reads nothing."""
        with self._lock:
            self._waiting += [part.name for part in receipts]
            while len(self._waiting) > PARTS_NOTED:
                del self._waiting[1::2]

    def read_all(self) -> None:
        """Read all parts that wait: the job is done, and they are about to be removed."""
        while self._waiting:
            self.gather()
        self._whole = True

    def finish(self, result: RunResult | None) -> None:
        """Take a sample of all points, and all hits; the parts may then be removed."""
        if result is not None:
            with self._lock:
                self._waiting = []
                self._counts, self._hits = result.hit_counts, result.hits
                self.cloud = result.points.sample(self._most, PARTS_NOTED)
            self._show()
            self.view.rays = result.sample_rays
            self.view.path = None if result.plan is None else result.plan.path
        self._ends += 1

    def show_file(self, cloud: Path) -> None:
        """Show the written cloud, with its sweeps: the parts are gone."""
        view = self.view
        view.sweeps = Sweeps.of(self._job.survey, self._job.scene)
        view.show(CloudFile(cloud, () if view.pictured is None else view.pictured.own))
        self._ends += 1

    # -- the page's side -----------------------------------------------------------------

    def gather(self) -> None:
        """Read some of the waiting parts, without those that cannot be read: the run says so."""
        with self._lock:
            names, self._waiting = self._waiting[:PARTS_AT_ONCE], self._waiting[PARTS_AT_ONCE:]
            clouds = [self.cloud]
            for name in names:
                with suppress(LidarpoolError):
                    part = read_part(self._points.storage, name)
                    self._counts[part.triangles] += part.hits
                    self._hits += int(part.hits.sum())
                    rows = np.flatnonzero(self._random.random(len(part)) < self._share)
                    clouds.append(self._points.cloud_of(part, rows))
            if not names:
                return
            cloud = Cloud.joined(clouds)
            while len(cloud) > self._most:
                self._share /= 2
                cloud = cloud.part(np.flatnonzero(self._random.random(len(cloud)) < 0.5))
            self.cloud = cloud
        self._show()

    def hit_counts(self) -> Floats:
        """Hits by counters of the scene, scaled up to all hits if some parts were not read."""
        with self._lock:
            return np.asarray(self._counts * (self._points_of.parts.hits / max(self._hits, 1)))

    @property
    def view(self) -> View:
        """What its page shows, made when it is first asked for."""
        with self._making:
            if self._view is None:
                self._view = self._made()
            return self._view

    def _made(self) -> View:
        job, (pictured, drawn) = self._job, Pictured.before(self._job)
        sweeps = Sweeps.of(job.survey, job.scene) if self._whole else None
        title = f"job {self.name} - lidarpool" if self.name else "lidarpool"
        view = View(HeldPoints(self.cloud), pictured, sweeps, title=title)
        view.hits = lambda: drawn.hits(self.hit_counts())
        return view

    def _show(self) -> None:
        with self._making:
            if self._view is not None:
                self._view.show(HeldPoints(self.cloud))

    def news(self) -> Answer:
        """Tell what is new of the job while it goes on, and at its end."""
        view, frames = self.view, [] if self._ends else list(self.frames)
        if view.path is None and not self._ends:
            view.path = self._planned()
        newest = frames[-1].scan if frames else -1
        header = {
            "version": view.version,
            # It is large, and changes visibly only with a tenth more hits.
            "hits_version": round(10 * np.log1p(self._hits)),
            "rays_version": newest,
            "time": self._job.survey.begins_ns(newest) / 1e9 if frames else None,
            "path": view.planned,
            "ends": self._ends,
        }
        return header, {"rays": _rays_of(frames) if frames else view.rays_shown}

    def _planned(self) -> Floats | None:
        """Return the planned path, once all trials have ended."""
        planning, trials = self._job.planning, self._points_of.parts.trials
        if planning is None or len(trials) < self._job.trials:
            return None
        return best(trials, planning).path


def _rays_of(frames: list[Frame]) -> Floats32:
    """Return some rays (n, 2, 3) of frames, local."""
    starts = [np.full_like(frame.samples, frame.pose.position) for frame in frames]
    ends = np.concatenate([frame.samples for frame in frames])
    return np.stack([np.concatenate(starts), ends], axis=1).astype(np.float32)
