"""Show a run in Foxglove or Rerun, with its trajectories, planned path and finished sweeps.

The thread of the run only records which sweeps are finished. A separate thread reads their parts
and sends them, within a small share of a CPU core. If sweeps finish faster than that, every second
sweep is skipped.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import numpy as np

from lidarfiles.clouds.frame_names import WORLD
from lidarfiles.clouds.shown_sweeps import (
    FramePose,
    ShownSweep,
    Surface,
    Surroundings,
    SweepSequence,
    path_in_world,
    viewer_columns,
)
from lidarfiles.datasets.job_table import JobRow
from lidarfiles.parts.parts import read_part
from lidarlive.viewers.viewer import Viewer, open_viewer
from lidarscenario.plan import best
from lidarsim.columns.cloud import Cloud
from lidarsim.errors import LidarError
from lidarview.viewer.result_views import wait_for_interrupt

from ..run.pipeline.stage_messages import Receipt, ScanFrame
from ..run.progress import Progress
from ..run.run_page import RunPage
from ..run.run_result import RunResult
from ..run.store.stored_job import StoredJob
from .cpu_share import CpuShare

READING_SHARE = 0.05  # maximum share of a CPU core for the surroundings and sweeps
MAX_WAITING = 64  # If more finished sweeps are pending, every second sweep is skipped.
LAST_S = 0.3  # maximum time to send pending sweeps at the end of the run
SHOW_EVERY_S = 5.0  # minimum time between two jobs of a campaign
JOB_SWEEPS = 10  # number of sweeps that are shown per job of a campaign
CLOUD_POINTS = 150_000  # points of the final cloud
CLOUD_PARTS = 64
_WAIT_S = 0.05


class ViewerPage(RunPage):
    """Page that shows the sweeps of a run in a viewer.

    The sweeps of a survey are shown as they finish, and those of a campaign job by job.
    """

    def __init__(self, viewer: Viewer) -> None:
        self._viewer = viewer
        self._survey: SurveyFeed | None = None  # feed of the only job
        self._share = CpuShare(READING_SHARE)

    def on_survey_start(self, job: StoredJob) -> None:
        """Show the only job of the run."""
        self._survey = SurveyFeed(job, self._viewer)

    def on_parts(self, receipts: Sequence[Receipt]) -> None:
        """Record parts that the only job has committed."""
        if self._survey is not None:
            self._survey.add_receipts(receipts)

    def on_frame(self, frame: ScanFrame) -> None:
        """Record that a scan of the only job, and all earlier scans, have been stored."""
        if self._survey is not None:
            self._survey.finish_scan(frame.scan)

    def on_progress(
        self, progress: Progress, under_way: Callable[[], Sequence[Mapping[str, Any]]]
    ) -> None:
        """Show the planned path when all trials have ended."""
        if self._survey is not None:
            self._survey.show_path()

    def on_job_written(self, row: JobRow, job: StoredJob) -> None:
        """Show a finished job of a campaign before its parts are deleted."""
        if self._share.is_due:
            with self._share.use(SHOW_EVERY_S), suppress(LidarError):
                reader = SweepReader(job)
                reader.add_receipts(job.parts.ordered)
                self._viewer.show_surroundings(reader.surroundings())
                count = len(reader.sequence.sweeps)
                for sweep in np.unique(np.linspace(0, count - 1, JOB_SWEEPS).astype(int)).tolist():
                    self._viewer.show_sweep(reader.read_sweep(sweep))

    def finish(self, seconds: float, result: RunResult | None = None) -> None:
        """Show the result of a survey.

        Afterward, its parts may be removed.
        """
        if self._survey is not None:
            self._survey.close(result)

    def close(self) -> None:
        """Stop sending sweeps."""
        if self._survey is not None:
            self._survey.stop()

    def keep_open(self, cloud: Path | None = None) -> None:
        """Keep the viewer open until Ctrl-C is pressed."""
        click.echo(f"{self._viewer.description}. Press Ctrl-C to stop.", err=True)
        wait_for_interrupt()


@contextmanager
def viewer_page(name: str, title: str) -> Iterator[ViewerPage]:
    """Show a run in a viewer during the body, and print how to open the viewer."""
    with open_viewer(name, title=title) as viewer:
        click.echo(viewer.description, err=True)
        page = ViewerPage(viewer)
        try:
            yield page
        finally:
            page.close()


class SweepReader:
    """Reader for the sweeps of a job that are stored in parts."""

    def __init__(self, job: StoredJob) -> None:
        self._job = job.job
        self.sequence = SweepSequence(job.job.sweeps)
        self._points = job.points()  # reader for the points of parts
        self._parts: dict[int, Receipt] = {}  # by number of the first scan
        self._lock = threading.Lock()
        self._last: tuple[str, Cloud] | None = None  # most recently read part

    def add_receipts(self, receipts: Sequence[Receipt]) -> None:
        """Record that parts have been stored, without reading them."""
        with self._lock:
            self._parts |= {receipt.first: receipt for receipt in receipts}

    def surroundings(self) -> Surroundings:
        """Return the scene and trajectories of the job, which is slow for large scenes."""
        surroundings = Surroundings.from_sweeps(self.sequence.sweeps)
        if self._job.survey.coordinates != "world":
            return surroundings
        return replace(surroundings, surface=Surface.from_scene(self._job.scene))

    def read_sweep(self, sweep: int) -> ShownSweep:
        """Read a sweep whose parts have all been stored.

        Raises
        ------
        LidarError
            If a part cannot be read.
        """
        start, stop = self.sequence.sweeps.scans[sweep : sweep + 2].tolist()
        with self._lock:
            parts = [
                part for part in self._parts.values() if part.first < stop and start < part.stop
            ]
        clouds = [self._read(part.name) for part in sorted(parts, key=lambda part: part.first)]
        selected = [cloud[(start <= cloud["scan"]) & (cloud["scan"] < stop)] for cloud in clouds]
        return self.sequence.shown_sweep(sweep, Cloud.concatenate(selected))

    def _read(self, name: str) -> Cloud:
        if self._last is None or self._last[0] != name:
            self._last = name, self._points.cloud_of(read_part(self._points.storage, name))
        return self._last[1]


class SurveyFeed:
    """Thread that sends the finished sweeps of a run's only job to a viewer."""

    def __init__(self, job: StoredJob, viewer: Viewer) -> None:
        self._under_way = job
        self._viewer = viewer
        self._reader = SweepReader(job)
        sweeps = self._reader.sequence.sweeps
        self._last_scans = {scan - 1: sweep for sweep, scan in enumerate(sweeps.scans[1:].tolist())}
        self._waiting: list[int] = []  # numbers of pending sweeps
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._share = CpuShare(READING_SHARE)
        self._has_surroundings = threading.Event()
        self._has_path = False
        self.add_receipts(job.parts.ordered)
        self._thread = threading.Thread(target=self._send_sweeps, name="viewer", daemon=True)
        self._thread.start()

    # -- called by the run --------------------------------------------------------------

    def add_receipts(self, receipts: Sequence[Receipt]) -> None:
        """Record that parts have been stored, without reading them."""
        self._reader.add_receipts(receipts)

    def finish_scan(self, scan: int) -> None:
        """Record that a scan and all earlier scans have been stored."""
        if scan in self._last_scans:
            with self._lock:
                self._waiting.append(self._last_scans[scan])
                if len(self._waiting) > MAX_WAITING:
                    del self._waiting[1::2]

    def show_path(self) -> None:
        """Show the planned path when all trials have ended."""
        planning = self._under_way.job.planning
        if planning is None or self._has_path or not self._has_surroundings.is_set():
            return
        if len(self._under_way.trials) >= self._under_way.job.trials:
            self._has_path = True
            path = best(self._under_way.trials, planning).path
            self._viewer.show_path(path_in_world(path, self._under_way.job.scene.origin))

    def close(self, result: RunResult | None) -> None:
        """Send the pending sweeps until a timeout, then the path and points of the result."""
        self.stop()
        give_up_at = time.monotonic() + LAST_S
        while self._waiting and time.monotonic() < give_up_at:
            self._send_next()
        if result is None:
            return
        self.show_path()
        if result.survey.coordinates == "world" and len(result.points):
            self._viewer.show_sweep(self._whole_cloud(result))

    def stop(self) -> None:
        """Stop the thread after the current sweep."""
        self._ended.set()
        self._thread.join()

    # -- the thread ----------------------------------------------------------------------

    def _send_sweeps(self) -> None:
        with self._share.use():
            self._viewer.show_surroundings(self._reader.surroundings())
        self._has_surroundings.set()
        while not self._ended.wait(_WAIT_S):
            while self._waiting and self._share.is_due and not self._ended.is_set():
                with self._share.use():
                    self._send_next()

    def _send_next(self) -> None:
        """Send the oldest pending sweep.

        Unreadable parts are skipped, because the run reports them.
        """
        with self._lock:
            sweep = self._waiting.pop(0)
        with suppress(LidarError):
            self._viewer.show_sweep(self._reader.read_sweep(sweep))

    def _whole_cloud(self, result: RunResult) -> ShownSweep:
        """Return evenly spaced points of the result, relative to the origin of the scene."""
        cloud = result.points.sample(CLOUD_POINTS, CLOUD_PARTS)
        sequence = self._reader.sequence
        end_ns = sequence.start_ns + round(float(sequence.sweeps.ends_ns.max()))
        origin = result.scene.origin
        return ShownSweep(
            start_ns=end_ns,
            stamp_ns=end_ns,
            topic="/cloud",
            frame="cloud",
            positions=(cloud.positions - origin).astype(np.float32),
            columns=viewer_columns(cloud.columns),
            transforms=[FramePose(WORLD, "cloud", origin, np.array([0.0, 0.0, 0.0, 1.0]))],
        )
