"""The live page of a run: during the run, and until it is closed.

The run calls it in its own thread, and never waits for a browser: news are recorded, and drawn in
another thread from time to time, within a small share of a core.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Hashable, Iterator, Mapping
from contextlib import contextmanager, suppress
from html import escape
from pathlib import Path
from threading import Event

import click
import numpy as np
from numpy.typing import NDArray

from poolpart import Partition

from ..columns.table import SCAN, TABLE
from ..export.cloud_file import CloudFile
from ..pipeline import Frame
from ..plan import best
from ..run.job import Job
from ..run.picture_file import Pictured, sensor_ways
from ..run.progress import STAGES, Progress, Show, in_words, is_sure, time_in_words
from ..run.result import RunResult
from ..run.store import RunStore
from ..sensor.materials import MaterialTable
from .blocks import VIEW_POINTS, Blocks
from .live_points import LivePoints
from .page import PORT, LivePage, announced, live_page, redrawn
from .view import NO_RAYS, View

DRAW_EVERY_S = 0.2
BUSY_SHARE, IDLE_SHARE = 0.06, 0.7  # of a core, while the run goes on and when it is over
ASK_EVERY_S = 2.0  # how busy the partitions are
FRAMES_SHOWN = 40  # whose rays are shown

_BOX = '<div style="padding:0 0.8em 0.6em;font-size:0.85em;font-variant-numeric:tabular-nums">'


class LiveRun:
    """Connects a run and its page, in both directions."""

    def __init__(self, page: LivePage, job: Job) -> None:
        self.page, self._job = page, job
        self.stopped = Event()  # by a user of the page; --resume continues
        self._text = page.gui.add_html("")
        self._stop = page.gui.add_button("Stop", color="red")
        self._stop.on_click(lambda _: self.stopped.set())
        survey, scene, ways = job.survey, job.scene, sensor_ways(job.survey)
        table, nothing = MaterialTable.of(survey.materials, scene.all_names), np.zeros(0, np.int64)
        pictured = Pictured(
            scene, ways, nothing, NO_RAYS, job.planning, None, (), survey.duration_ns, (),
            table.reflectance,
        )  # fmt: skip
        self._models = pictured.models
        self._view = View(page, (SCAN, *survey.stored_columns), pictured)
        self._starting = "starting"  # the state before there is any progress
        self._newest = ""  # sensor and time of the newest frame
        self._shown = -1  # the last scan whose time was sent to the page
        self._store: RunStore | None = None
        self._points: LivePoints | None = None
        self._progress: Progress | None = None
        self._first: Progress | None = None  # that rates are taken from
        self._frames: deque[Frame] = deque(maxlen=FRAMES_SHOWN)
        self._partitions: Mapping[str, Partition] = {}
        self._busy: dict[str, tuple[int, int]] = {}  # {partition: busy slots, all slots}
        self._ask_at = 0.0
        self._over = False
        self._rays: NDArray[np.float32] | None = None  # of all the run, at its end

    # -- the run's side, in its thread ---------------------------------------------------

    def follow(self, store: RunStore) -> None:
        """Show what is committed from now on, and the scans of an earlier run."""
        points = LivePoints(store)
        points.add(store.db.ordered)
        if store.kept:
            self._progress = store.progress()
        store.on_parts = points.add
        self._store, self._points = store, points
        self._starting = "starting: workers, each with its own Python"

    def with_progress(self, show: Show, partitions: Mapping[str, Partition]) -> Show:
        """Return a function to call with the progress: it calls `show` and updates the page.

        It raises KeyboardInterrupt if a user of the page has stopped the run. The page shows the
        busy slots of `partitions`.
        """
        self._partitions = partitions
        self._starting = "starting: workers read the scene and make their trees"

        def tell(progress: Progress) -> None:
            show(progress)
            self.on_progress(progress)

        return tell

    def on_frame(self, frame: Frame, take: Callable[[Frame], None] | None = None) -> None:
        """Record a frame, which is displayed unless many others come at once, and call `take`."""
        self._frames.append(frame)
        if take is not None:
            take(frame)

    def on_progress(self, progress: Progress) -> None:
        """Record the progress; raises KeyboardInterrupt if the run was stopped."""
        self._first, self._progress = self._first or progress, progress
        now = time.monotonic()
        if now >= self._ask_at:
            self._ask_at = now + ASK_EVERY_S
            with suppress(OSError, RuntimeError):  # the run itself reports a lost cluster
                stats = {name: part.stats() for name, part in self._partitions.items()}
                self._busy = {name: (of.busy, of.slots) for name, of in stats.items()}
        if self.stopped.is_set():
            raise KeyboardInterrupt

    def finish(self, result: RunResult) -> None:
        """Show the whole result at the end of the run; its parts may then be removed."""
        if self._points is not None:
            self._points.finish(result)
        self._rays = result.sample_rays
        self._busy, self._over = {}, True
        self._stop.label = "Close"

    def stay(self, cloud: Path) -> None:
        """Keep the page until Ctrl-C or its button.

        More points are read from the written `cloud`, because the parts are gone.
        """
        own = [column for column in self._job.survey.stored_columns if column.name not in TABLE]
        file = CloudFile(cloud, own)
        if self._points is not None:
            self._points.show(file.choose(VIEW_POINTS)[0])
        self._view.cloud.blocks = Blocks(file, self._job.scene.origin, VIEW_POINTS)
        click.echo(f"the live page stays at {self.page.url}; Ctrl-C ends it", err=True)
        with suppress(KeyboardInterrupt):
            while not self.stopped.wait(0.2):  # one without limit is not left on Ctrl-C everywhere
                pass

    # -- the page's side -----------------------------------------------------------------

    def draw(self) -> float:
        """Draw what is new; returns the share of a core that this may take."""
        if self.page.get_clients():  # those that connect later are drawn for then
            self._text.content = self._panel()
            cloud, version, hits, path = None, 0, 0, None
            if (points := self._points) is not None:
                points.gather()
                cloud, version, hits, path = points.cloud, points.version, points.hits, self._path()
            # It is large, and changes visibly only with a tenth more hits.
            grown = round(math.log1p(hits) / math.log(1.1)), self._over
            self._view.draw(cloud, version, self._hits, grown, *self._newest_rays(), path)
        return IDLE_SHARE if self._over else BUSY_SHARE

    def _hits(self) -> NDArray[np.float64]:
        faces = len(self._job.scene.faces)
        return np.zeros(faces) if self._points is None else self._points.hit_counts()

    def _newest_rays(self) -> tuple[NDArray[np.float32], Hashable]:
        """Rays of the newest frames, or some of all in the end, and a version of them."""
        frames = list(self._frames)
        if frames and frames[-1].scan != self._shown:
            self._shown = frames[-1].scan
            time_ns = self._job.survey.begins_ns(self._shown)
            self._view.set_time(time_ns)
            of = f"{frames[-1].sensor}, " if frames[-1].sensor else ""
            self._newest = f"newest scan: {of}at {time_ns / 1e9:,.4g} s"
        if self._rays is not None:
            return self._rays, "all"
        starts = [np.full_like(frame.samples, frame.pose.position) for frame in frames]
        if not frames:
            return NO_RAYS, 0
        ends = np.concatenate([frame.samples for frame in frames])
        return np.stack([np.concatenate(starts), ends], axis=1), self._shown

    def _path(self) -> NDArray[np.float64] | None:
        """Return the planned path, once all trials have ended."""
        planning, store = self._job.planning, self._store
        if planning is None or store is None or len(store.db.trials) < self._job.trials:
            return None
        return best(store.db.trials, planning).path

    def _panel(self) -> str:
        """Write the progress of the run."""
        progress, points = self._progress, self._points
        if progress is None:
            return f"{_BOX}<b>{self._starting}</b></div>"
        lines = [f"<b>{self._words(progress)}</b>, {progress.seconds:,.0f} s{self._pace(progress)}"]
        lines += [
            _bar(label, getattr(progress, count), getattr(progress, total))
            for label, count, total in STAGES
            if getattr(progress, total)
        ]
        lines.append(escape(self._models))
        lines += [escape(self._newest)] if self._newest and not self._over else []
        shown = len(points.cloud) if points is not None and points.cloud is not None else 0
        some = "" if shown == progress.points else f", {shown:,} of them displayed"
        of_file = self._view.cloud.facts if self._view.cloud.blocks is not None else []
        lines += of_file or [f"<b>{progress.points:,} points</b>{some}"]
        lines += [_bar(f"{escape(name)}, slots busy", *slots) for name, slots in self._busy.items()]
        return _BOX + "".join(f"<div>{line}</div>" for line in lines) + "</div>"

    def _words(self, progress: Progress) -> str:
        if self._over:
            return "done"
        if self.stopped.is_set():
            return "stopping"
        if progress.waits_for:
            return f"waiting for slots of {escape(progress.waits_for)}"
        return "running" if self._first is not None and progress.cast else self._starting

    def _pace(self, progress: Progress) -> str:
        """Return scans a second, and the time left."""
        first, left = self._first, progress.scans - progress.collected
        if first is None or progress.collected <= first.collected or not left:
            return ""
        rate = (progress.collected - first.collected) / (progress.seconds - first.seconds)
        words = f", {in_words(rate)} scans/s"
        if is_sure(progress.collected, progress.scans, progress.seconds):
            words += f", {time_in_words(left / rate)} left"
        return words


def _bar(label: str, done: int, whole: int) -> str:
    share = 100 * done / max(whole, 1)
    return (
        '<div style="display:flex;margin-top:0.35em">'
        f'<span style="flex:1">{label}</span><span>{done:,} / {whole:,}</span></div>'
        '<div style="height:0.3em;border-radius:2px;background:rgba(128,134,142,0.3)">'
        f'<div style="height:100%;border-radius:2px;width:{share:.1f}%;background:#2f7fd6">'
        "</div></div>"
    )


@contextmanager
def live_run(job: Job, *, port: int = PORT, browser: bool = True) -> Iterator[LiveRun]:
    """Serve the live page of a run while the body runs; see `live_page` and `announced`."""
    with live_page("lidarpool", port) as page:
        live = LiveRun(page, job)
        with (
            announced(page, f"live page: {page.url}", browser),
            redrawn(live.draw, DRAW_EVERY_S),
        ):
            yield live
