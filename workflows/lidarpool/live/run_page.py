"""The page of a run: during the run, and until it is closed.

The run calls it in its own thread, and never waits for a browser: news are recorded, and parts
are read when a page asks for news, within a small share of a core.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from html import escape
from pathlib import Path

import click
import numpy as np

from poolpart import Partition

from ..base.arrays import Floats, Floats32
from ..columns.cloud_file import CloudFile
from ..columns.table import SCAN, TABLE
from ..export.sweeps import Sweeps
from ..pipeline import Frame
from ..plan import best
from ..run.bars import Pace, standing_still
from ..run.conductor import Page
from ..run.job import Job
from ..run.picture_file import Pictured, reflectances_of, sensor_ways
from ..run.progress import STAGES, Progress, Show
from ..run.result import RunResult
from ..run.store import RunStore
from ..scene.drawn import Drawn, cut
from .live_points import LivePoints
from .points import HeldPoints, no_points
from .server import PORT, Answer, Arguments, PageServer, announced, page_server
from .view import IN_SENSOR_AXES, View

READING_SHARE = 0.06  # of a core, to read parts while the run goes on
ASK_EVERY_S = 2.0  # how busy the partitions are
FRAMES_SHOWN = 40  # whose rays are shown


class LivePage:
    """What the pages of a run and of a campaign have in common."""

    page: PageServer

    def __init__(self) -> None:
        self.stopped = threading.Event()  # by a user of the page; --resume continues
        self._state = "starting"
        self._progress: Progress | None = None
        self._pace, self._rate = Pace(), ""
        self._partitions: Mapping[str, Partition] = {}
        self._busy: dict[str, tuple[int, int]] = {}  # {partition: busy slots, all slots}
        self._ask_at = 0.0
        self._over = False

    def ask_partitions(self) -> None:
        """Ask how busy the partitions are, now and then."""
        now = time.monotonic()
        if now >= self._ask_at:
            self._ask_at = now + ASK_EVERY_S
            with suppress(OSError, RuntimeError):  # the run itself reports a lost cluster
                stats = {name: part.stats() for name, part in self._partitions.items()}
                self._busy = {name: (of.busy, of.slots) for name, of in stats.items()}

    def keep(self) -> None:
        """Keep the page until Ctrl-C or its button."""
        click.echo(f"the live page stays at {self.page.url}; Ctrl-C ends it", err=True)
        with suppress(KeyboardInterrupt):
            while not self.stopped.wait(0.2):  # one without limit is not left on Ctrl-C everywhere
                pass


class LiveRun(LivePage, Page):
    """Connects a run and its page, in both directions."""

    def __init__(self, job: Job) -> None:
        super().__init__()
        self._job = job
        self._drawn, self._view = view_of(job, "lidarpool")
        self._view.hits = self._hits
        self._store: RunStore | None = None
        self._points: LivePoints | None = None
        self._frames: deque[Frame] = deque(maxlen=FRAMES_SHOWN)
        self._read_at = 0.0  # from when on parts are read
        self._ends = 0  # how often something came at the run's end that the page must ask for

    # -- the run's side, in its thread ---------------------------------------------------

    def follow(self, store: RunStore) -> None:
        """Show what is committed from now on, and the scans of an earlier run."""
        points = LivePoints(store)
        points.add(store.db.ordered)
        if store.kept:
            self._progress = store.progress()
        store.on_parts = points.add
        self._store, self._points = store, points
        self._state = "starting: workers, each with its own Python"

    def with_progress(self, show: Show, partitions: Mapping[str, Partition]) -> Show:
        """Return a function to call with the progress: it calls `show` and updates the page.

        It raises KeyboardInterrupt if a user of the page has stopped the run. The page shows the
        busy slots of `partitions`.
        """
        self._partitions = partitions
        self._state = "starting: workers read the scene and make their trees"

        def tell(progress: Progress) -> None:
            show(progress)
            self.on_progress(progress)

        return tell

    def on_frame(self, frame: Frame, take: Callable[[Frame], None] = lambda frame: None) -> None:
        """Record a frame, which is displayed unless many others come at once, and call `take`."""
        self._frames.append(frame)
        take(frame)

    def on_progress(self, progress: Progress) -> None:
        """Record the progress; raises KeyboardInterrupt if the run was stopped."""
        self._progress = progress
        if progress.cast:
            self._state = "running"
        self._rate = self._pace.told(progress.seconds, progress.collected, progress.scans)
        self.ask_partitions()
        if self.stopped.is_set():
            raise KeyboardInterrupt

    def finish(self, result: RunResult) -> None:
        """Show the whole result at the end of the run; its parts may then be removed."""
        if self._points is not None:
            self._points.finish(result)
            if self._points.cloud is not None:
                self._view.show(HeldPoints(self._points.cloud))
        self._view.rays = result.sample_rays
        self._view.path = None if result.plan is None else result.plan.path
        if self._progress is not None:
            self._progress = replace(self._progress, points=len(result.points))
        self._busy, self._over = {}, True
        self._ends += 1

    def stay(self, cloud: Path) -> None:
        """Keep the page until Ctrl-C or its button.

        Points are read from the written `cloud`, because the parts are gone.
        """
        own = [column for column in self._job.survey.stored_columns if column.name not in TABLE]
        self._view.sweeps = Sweeps.of(self._job.survey, self._job.scene)
        self._view.show(CloudFile(cloud, own))
        self._ends += 1
        self.keep()

    # -- the page's side -----------------------------------------------------------------

    def answer(self, what: str, asked: Arguments, abandoned: Callable[[], bool]) -> Answer:
        """Answer a question of the page."""
        if what == "news":
            self._read_parts()
            return self._news()
        header, arrays = self._view.answer(what, asked, abandoned)
        if what == "state":
            some = not isinstance(self._view.points, CloudFile)
            header |= {"live": True, "sampled": some, "points": self._count}
        return header, arrays

    def _read_parts(self) -> None:
        """Read some of the parts that were committed."""
        points = self._points
        if points is None or self._over or time.monotonic() < self._read_at:
            return
        before, started = points.version, time.thread_time()
        points.gather()
        # Processor time: waiting does not count.
        self._read_at = time.monotonic() + (time.thread_time() - started) / READING_SHARE
        if points.version != before and points.cloud is not None and not self._over:
            self._view.show(HeldPoints(points.cloud))

    def _news(self) -> Answer:
        view, frames = self._view, list(self._frames)
        newest = frames[-1] if frames and not self._over else None
        time_s = None if newest is None else self._job.survey.begins_ns(newest.scan) / 1e9
        if view.path is None and not self._over:
            view.path = self._planned()
        header = {
            "version": view.version,
            "points": self._count,
            # It is large, and changes visibly only with a tenth more hits.
            "hits_version": round(10 * np.log1p(self._points.hits)) if self._points else 0,
            "rays_version": -1 if newest is None else newest.scan,
            "time": time_s,
            "panel": self._panel(),
            "path": view.planned,
            "over": self._over,
            "ends": self._ends,
            "stopping": self.stopped.is_set(),
        }
        return header, {"rays": _rays_of(frames) if newest is not None else view.rays_shown}

    @property
    def _count(self) -> int:
        """Points that were committed."""
        return 0 if self._progress is None else self._progress.points

    def _hits(self) -> Floats:
        faces = len(self._drawn.scene.faces)
        if self._points is None:
            return np.zeros(faces)
        return np.asarray(self._drawn.hits(self._points.hit_counts())[:faces])

    def _planned(self) -> Floats | None:
        """Return the planned path, once all trials have ended."""
        planning, store = self._job.planning, self._store
        if planning is None or store is None or len(store.db.trials) < self._job.trials:
            return None
        return best(store.db.trials, planning).path

    def _panel(self) -> str:
        """Write the progress of the run, as HTML."""
        progress = self._progress
        if progress is None:
            return f"<b>{self._state}</b>"
        lines = [f"<b>{self._words(progress)}</b>, {progress.seconds:,.0f} s"]
        if self._over:
            return lines[0]
        if self._rate:
            lines[0] += f", {self._rate}"
        lines += [
            _bar(label, getattr(progress, count), getattr(progress, total))
            for label, count, total in STAGES
            if getattr(progress, total)
        ]
        lines += [_bar(f"{escape(name)}, slots busy", *slots) for name, slots in self._busy.items()]
        return "".join(f"<div>{line}</div>" for line in lines)

    def _words(self, progress: Progress) -> str:
        if self._over:
            return "done"
        if self.stopped.is_set():
            return "stopping"
        return escape(standing_still(progress)) or self._state


def view_of(job: Job, title: str) -> tuple[Drawn, View]:
    """Return the scene of a survey as it is drawn, and a view of both, without points."""
    survey, scene = job.survey, job.scene
    ways = sensor_ways(survey)
    drawn = Drawn.of(cut(scene), near=[way.positions for way in ways])
    pictured = Pictured(
        drawn.scene, ways, np.zeros(0, np.int64),
        np.zeros((0, 2, 3), np.float32), job.planning, None, (), survey.duration_ns, (),
        reflectances_of(scene, survey),
    )  # fmt: skip
    view = View(title, no_points((SCAN, *survey.stored_columns)), pictured)
    if survey.coordinates != "world":
        view.note = IN_SENSOR_AXES
    return drawn, view


def _rays_of(frames: list[Frame]) -> Floats32:
    """Return some rays (n, 2, 3) of frames, local."""
    starts = [np.full_like(frame.samples, frame.pose.position) for frame in frames]
    ends = np.concatenate([frame.samples for frame in frames])
    return np.stack([np.concatenate(starts), ends], axis=1).astype(np.float32)


def _bar(label: str, done: int, whole: int) -> str:
    share = 100 * done / max(whole, 1)
    return (
        f'<div class="bar"><div><span>{label}</span><span>{done:,} / {whole:,}</span></div>'
        f'<i><b style="width:{share:.1f}%"></b></i></div>'
    )


@contextmanager
def live_run(job: Job, *, port: int = PORT, browser: bool = True) -> Iterator[LiveRun]:
    """Serve the page of a run while the body runs; see `announced`."""
    live = LiveRun(job)
    with (
        page_server(live.answer, port, live.stopped.set) as live.page,
        announced(live.page, f"live page: {live.page.url}", browser),
    ):
        yield live
