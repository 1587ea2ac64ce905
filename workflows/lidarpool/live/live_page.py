"""The live page of a run: its jobs, or the only one, during the run and until it is closed.

The run calls it in its own thread, and never waits for a browser: it hands over what is new. Parts
are read when a page asks for news, or by the thread that removes what is left of ended jobs, and
charts are drawn when a page asks for them; all within small shares of a core.
"""

from __future__ import annotations

import re
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import numpy as np

from lidarsim.base.arrays import Floats, Floats32
from lidarsim.base.errors import LidarError
from lidarsim.base.storage import Storage
from lidarsim.columns.cloud import Cloud
from lidarsim.columns.cloud_file import CloudFile
from lidarsim.sweeps.sweeps import SWEEPS_FILE
from lidarview.picture_file import PictureContent
from lidarview.viewer.point_selection import HeldPoints
from lidarview.viewer.server import (
    PORT,
    VIEWER,
    Answer,
    Arguments,
    PageServer,
    announced,
    page_server,
)
from lidarview.viewer.view import View, open_result, wait_for_interrupt
from poolpart import Partition, PartitionStats

from ..columns.parts import read_part
from ..datasets.dataset import DataSet, job_file
from ..datasets.figures import Figures
from ..datasets.job_table import JobRow, Value
from ..plan import best
from ..report.charts import draw_results, draw_varied
from ..report.picture_content import planning_picture
from ..run.pipeline.messages import Receipt, ScanFrame
from ..run.progress import STAGES, Pace, Progress, in_words, time_in_words, waiting_reason
from ..run.run_page import RunPage
from ..run.run_result import RunResult
from ..run.store.job_under_way import JobUnderWay
from .opened import downloads

DRAWING_SHARE = 0.06  # of a core, for charts: they take half a second to a second
READING_SHARE = 0.05  # of a core, for points
LOOK_EVERY_S = 5.0  # at most, for the points of another job
LIST_EVERY_S = 0.5  # jobs under way
ASK_EVERY_S = 1.0  # how busy the partitions are
LOADS_KEPT = 6  # answers to that, over which it is averaged
WATCHED_S = 10.0  # after a question somebody looks at the page
# rows of the table
ENDED_MOST = 10
FAILED_MOST = 6
UNDER_WAY_MOST = 12
VIEWS_KEPT = 4  # jobs whose points are kept: a browser may show, or ask for, an earlier one
LIVE_POINTS = 150_000  # in the browser at a time
PARTS_NOTED = 64  # parts that wait to be read; of more, every second is skipped
PARTS_AT_ONCE = 8  # parts read for one drawing
FRAMES_SHOWN = 40  # whose rays are shown


class LivePage(RunPage):
    """Connects a run and its page, in both directions: the list of jobs, or the only one."""

    page: PageServer

    def __init__(self, jobs: int, names: Sequence[str], title: str) -> None:
        self.stopped = threading.Event()  # by a user of the page; --resume continues
        self._count = jobs
        self._names = names
        self._title = title
        self._charts = Charts(names, jobs)
        self._state = "starting"
        self._over = False
        self._progress: Progress | None = None
        # what is left is a time
        self._pace = Pace()
        self._rate = ""
        self._left = ""
        self._partitions: Mapping[str, Partition] = {}
        self._loads: deque[tuple[float, dict[str, PartitionStats]]] = deque(maxlen=LOADS_KEPT)
        self._written: Storage | None = None  # folders of jobs, which can be opened
        self._results: dict[int, View] = {}  # {number: what its page shows of a written job}
        self._under_way: Sequence[Mapping[str, Any]] = ()
        self._ask_at = self._list_at = 0.0
        self._looked_for = float("-inf")  # when a browser last wanted points of the newest job
        self._reading = CpuShare(READING_SHARE)
        self._sums = Counter(done=0, failed=0, points=0, rays=0)
        self._ended: deque[dict[str, Any]] = deque(maxlen=ENDED_MOST)
        self._failures: deque[dict[str, Any]] = deque(maxlen=FAILED_MOST)
        self._jobs: dict[int, LiveJob] = {}  # {number: its points}, the newest last

    # -- the run's side ------------------------------------------------------------------

    def begun(self, job: JobUnderWay) -> None:
        """Show the only job: what is committed from now on, and the scans of an earlier run."""
        if job.committed_in_words:
            self._progress = job.progress()
        self._jobs = {0: LiveJob(job)}
        self._state = "starting: workers, each with its own Python"

    def follow(self, partitions: Mapping[str, Partition], dataset: DataSet | None = None) -> None:
        """Show the jobs under way, the busy slots of partitions, and jobs that were written."""
        self._partitions = partitions
        if dataset is not None and dataset.format == "folder" and dataset.storage.is_local:
            self._written = dataset.storage
        self._state = "starting: workers read the scene and make their trees"

    def on_parts(self, receipts: Sequence[Receipt]) -> None:
        """Record parts of the only job."""
        self._jobs[0].add(receipts)

    def on_frame(self, frame: ScanFrame) -> None:
        """Record a frame, which is displayed unless many others come at once."""
        self._jobs[0].frames.append(frame)

    def on_progress(
        self, progress: Progress, under_way: Callable[[], Sequence[Mapping[str, Any]]]
    ) -> None:
        """Record the progress; KeyboardInterrupt if a user of the page has stopped the run."""
        if self.stopped.is_set():
            raise KeyboardInterrupt
        self._progress = progress
        now = time.monotonic()
        counts = (progress.collected, progress.scans)
        unit = ""
        if progress.jobs:
            counts = (progress.jobs_done, progress.jobs)
            unit = " jobs"
        if rate := self._pace.rate(progress.seconds, counts[0]):
            each, rate = ("min", 60 * rate) if unit and rate < 1 else ("s", rate)
            self._rate = f"{in_words(rate)}{unit}/{each}"
            self._left = self._pace.time_left(progress.seconds, *counts)
        over = 0 < progress.jobs == progress.jobs_done
        if now >= self._list_at or over:
            self._list_at = now + LIST_EVERY_S
            self._under_way = under_way()
        if over:
            self._state = "writing the table and the card"
        elif progress.cast or any(job["stored"] for job in self._under_way):
            self._state = "running"
        if now >= self._ask_at:
            self._ask_at = now + ASK_EVERY_S
            with suppress(OSError, RuntimeError):  # the run itself reports a lost cluster
                stats = {name: part.stats() for name, part in self._partitions.items()}
                self._loads.append((now, stats))

    def ended(self, row: JobRow) -> None:
        """Count a job, and list it among the last ones."""
        told = {name: getattr(row, name) for name in ("name", "error", "points", "seconds")}
        told |= {"number": row.number, "opens": row.done and self._written is not None}
        told["values"] = self._words(row.values)
        (self._ended if row.done else self._failures).append(told)
        ended = "done" if row.done else "failed"
        self._sums.update({ended: 1, "points": row.points, "rays": row.rays})
        self._charts.add(row)

    def look(self, row: JobRow, job: JobUnderWay) -> None:
        """Read points of a job, if a browser shows them and there is time for it."""
        watched = time.monotonic() - self._looked_for <= WATCHED_S and self._reading.due
        if self._count > 1 and self._jobs and not watched:
            return
        with self._reading.taken(LOOK_EVERY_S):
            live = self._jobs.get(row.number) or LiveJob(job, row.name)
            live.read_all()
            if len(live.cloud):
                jobs = self._jobs | {row.number: live}
                self._jobs = {number: jobs[number] for number in [*jobs][-VIEWS_KEPT:]}

    def finish(self, seconds: float, result: RunResult | None = None) -> None:
        """Show that the run is over, and the result of a survey; its parts may then be removed."""
        if self._count == 1 and 0 in self._jobs:
            self._jobs[0].finish(result)
        if self._progress is not None:
            points = self._progress.points if result is None else len(result.points)
            self._progress = replace(self._progress, seconds=seconds, points=points)
        self._under_way = ()
        self._left = ""
        self._loads.clear()
        self._state = "done"
        self._over = True

    def stay(self, cloud: Path | None = None) -> None:
        """Keep the page until Ctrl-C or its button.

        Points of a survey are read from the written `cloud`, because the parts are gone.
        """
        if cloud is not None:
            self._jobs[0].show_file(cloud)
        click.echo(f"the live page stays at {self.page.url}; Ctrl-C ends it", err=True)
        wait_for_interrupt(self.stopped)

    # -- the page's side -----------------------------------------------------------------

    def answer(self, what: str, asked: Arguments, abandoned: Callable[[], bool]) -> Answer:
        """Answer a question of the list, or of the viewer of a job."""
        if what == "jobs":
            if asked.get("newest"):
                self._looked_for = time.monotonic()
            return self._news(), {}
        if what == "charts":
            return {"svg": self._charts.drawn(self._over)}, {}
        found = re.fullmatch(r"(?:job/(\d+)/)?(\w+)", what)
        if found is None:
            raise KeyError(what)
        number = int(found[1] or 0)
        question = found[2]
        if self._count > 1:
            with self._reading.taken():
                return self._view_of(number).answer(question, asked, abandoned)
        if question == "state" and number not in self._jobs:  # it has not begun
            return self._news(), {}
        return self._of_only(self._jobs[number], question, asked, abandoned)

    def _view_of(self, number: int) -> View:
        """View of a job that was read, or of a listed one that is written; else KeyError."""
        if number in self._jobs:
            return self._jobs[number].view
        if number not in self._results and self._written is not None:
            names = {job["number"]: job["name"] for job in list(self._ended)}
            file = self._written.local(job_file("folder", names[number], SWEEPS_FILE))
            self._results[number] = open_result(file.parent, downloads())
        return self._results[number]

    def _of_only(self, job: LiveJob, question: str, *asked: Any) -> Answer:
        """Answer a question of the viewer of the only job, which is shown while it goes on."""
        points = {"points": (self._progress and self._progress.points) or self._sums["points"]}
        if question == "news":
            if self._reading.due and not self._over:
                with self._reading.taken():
                    job.gather()
            header, arrays = job.news()
            return self._news() | header | points, arrays
        header, arrays = job.view.answer(question, *asked)
        if question == "state":
            header |= {"live": True, "sampled": not isinstance(job.view.points, CloudFile)} | points
        return header, arrays

    def _news(self) -> dict[str, Any]:
        progress = self._progress
        under_way = self._under_way
        jobs = self._jobs
        state = self._state
        newest = next(reversed(jobs), None)
        if not self._over:
            if self.stopped.is_set():
                state = "stopping"
            elif progress is not None:
                state = waiting_reason(progress) or state
        return dict(self._sums) | {
            "title": self._title,
            "names": list(self._names),
            "state": state,
            "over": self._over,
            "count": self._count,
            "time": "" if progress is None else time_in_words(progress.seconds),
            "seconds": None if progress is None else progress.seconds,
            "rate": self._rate,
            "left": self._left,
            "stages": [
                [label, getattr(progress, count), getattr(progress, total)]
                for label, count, total in STAGES
                if progress is not None and getattr(progress, total)
            ],
            "slots": busy_slots(list(self._loads)),
            "busy": len(under_way),
            "under_way": [
                {**job, "values": self._words(job["values"])} for job in under_way[:UNDER_WAY_MOST]
            ],
            "failures": [*reversed(list(self._failures))],
            "ended": [
                job | {"opens": job["opens"] or job["number"] in jobs}
                for job in reversed(list(self._ended))
            ],
            "charts": self._charts.version(self._over),
            "newest": None if newest is None else [newest, jobs[newest].name],
        }

    def _words(self, values: Mapping[str, Value]) -> list[str]:
        """Values in the order of the table's columns; "" for one that is not there."""
        shown = (values.get(name, "") for name in self._names)
        words = (f"{one:.4g}" if isinstance(one, float) else one for one in shown)
        return [str(one).lower() if isinstance(one, bool) else str(one) for one in words]


def busy_slots(loads: Sequence[tuple[float, Mapping[str, PartitionStats]]]) -> list[Any]:
    """Share of busy slots of each partition, and its slots, over moments: (seconds, statistics).

    Short tasks end between two moments, long ones after all: of the slots that ended tasks took,
    and of those that were held at the moments, the larger counts.
    """
    (begin, first), *_, (end, last) = [*loads, *loads] or [(0.0, {})] * 2
    found = []
    for name, now in last.items():
        held = sum(of[name].busy for _, of in loads) / len(loads)
        took = (now.seconds - first[name].seconds) / max(end - begin, ASK_EVERY_S)
        share = min(max(held, took) / max(now.slots, 1), 1.0)
        found.append([f"{name}, slots busy", share, now.slots])
    return found


class CpuShare:
    """A share of a core that something may take; processor time, since waiting does not count."""

    def __init__(self, share: float) -> None:
        self._share = share
        self._at = 0.0

    @property
    def due(self) -> bool:
        """Whether it may be done again."""
        return time.monotonic() >= self._at

    @contextmanager
    def taken(self, pause_s: float = 0.0) -> Iterator[None]:
        """Put off the next time by what the body takes, and at least by a pause."""
        started = time.thread_time()
        try:
            yield
        finally:
            self._at = max(self._at, time.monotonic() + pause_s)
            self._at += (time.thread_time() - started) / self._share


class Charts:
    """How jobs were varied, and what came of it, drawn again and again while somebody asks.

    A few numbers of each job are kept. Near the end it lets the run draw its own pictures first,
    since Matplotlib draws in one thread only.
    """

    def __init__(self, names: Sequence[str], count: int) -> None:
        self._figures = Figures(names)
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
        """Return how many jobs `drawn` draws, or has drawn if it is not yet time to do it again."""
        with self._lock:
            jobs = self._figures.jobs
            done = self._figures.done
        is_due = self._share.due and done
        return jobs if over or (is_due and jobs < self._count) else self._drawn

    def drawn(self, over: bool) -> str:
        """Draw them, if it is time, as elements of HTML."""
        with self._drawing:
            if self.version(over) != self._drawn:
                with self._lock:  # shortly: the run waits for no drawing
                    figures = deepcopy(self._figures)
                self._drawn = figures.jobs
                with self._share.taken(), suppress(LidarError):
                    pages = draw_varied(figures), draw_results(figures)
                    drawn = (f"<figure>{page.svg()}</figure>" for page in pages if page is not None)
                    self._svg = "".join(drawn)
            return self._svg


@contextmanager
def live_page(
    jobs: int = 1,
    names: Sequence[str] = (),
    title: str = "lidarpool",
    *,
    port: int = PORT,
    browser: bool = True,
) -> Iterator[LivePage]:
    """Serve the page of a run while the body runs; see `announced`."""
    live = LivePage(jobs, names, title)
    index = VIEWER if jobs == 1 else "jobs.html"
    with (
        page_server(live.answer, port, live.stopped.set, index=index) as live.page,
        announced(live.page, f"live page: {live.page.url}", browser),
    ):
        yield live


class LiveJob:
    """Points and hits of a job, from as many of its parts as there is time to read, and its view.

    The run's thread records parts, the page's threads read them. At the end an evenly spaced
    sample of the whole result replaces them, so skipped parts do not matter.
    """

    def __init__(self, under_way: JobUnderWay, name: str = "", most: int = LIVE_POINTS) -> None:
        self.name = name
        self._under_way = under_way
        self._most = most
        self._job = under_way.job
        self._points = under_way.points()  # knows what a part holds
        self._waiting: list[str] = []  # names of parts
        self._lock = threading.Lock()
        self._random = np.random.default_rng(0)
        self._share = 1.0  # of the points of a part that are taken
        self._counts = np.zeros(self._job.scene.counters, np.int64)
        self._hits = 0  # of the parts that were read
        self.cloud = replace(self._points, names=(), rows=()).load()  # none, with their columns
        self.frames: deque[ScanFrame] = deque(maxlen=FRAMES_SHOWN)  # the last ones
        self._view: View | None = None  # until somebody asks
        self._making = threading.Lock()
        self._whole = False  # all parts were read
        self._ends = 0  # how often something came at the run's end that the page must ask for
        self.add(under_way.parts.ordered)

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
                self._counts = result.hit_counts
                self._hits = result.hits
                self.cloud = result.points.sample(self._most, PARTS_NOTED)
            self._show()
            self.view.rays = result.sample_rays
            self.view.path = None if result.plan is None else result.plan.path
        self._ends += 1

    def show_file(self, cloud: Path) -> None:
        """Show the written cloud, with its sweeps: the parts are gone."""
        view = self.view
        view.sweeps = self._job.sweeps
        view.show(CloudFile(cloud, () if view.pictured is None else view.pictured.extra_columns))
        self._ends += 1

    # -- the page's side -----------------------------------------------------------------

    def gather(self) -> None:
        """Read some of the waiting parts, without those that cannot be read: the run says so."""
        with self._lock:
            names = self._waiting[:PARTS_AT_ONCE]
            self._waiting = self._waiting[PARTS_AT_ONCE:]
            clouds = [self.cloud]
            for name in names:
                with suppress(LidarError):
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
                cloud = cloud[self._random.random(len(cloud)) < 0.5]
            self.cloud = cloud
        self._show()

    def hit_counts(self) -> Floats:
        """Hits by counters of the scene, scaled up to all hits if some parts were not read."""
        with self._lock:
            return np.asarray(self._counts * (self._under_way.parts.hits / max(self._hits, 1)))

    @property
    def view(self) -> View:
        """What its page shows, made when it is first asked for."""
        with self._making:
            if self._view is None:
                job = self._job
                planning = planning_picture(job.planning)
                pictured, drawn = PictureContent.before_casting(job.scene, job.survey, planning)
                sweeps = job.sweeps if self._whole else None
                title = f"job {self.name} - lidarpool" if self.name else "lidarpool"
                self._view = View(
                    HeldPoints(self.cloud), pictured, sweeps, title=title, downloads=downloads()
                )
                self._view.hits = lambda: drawn.hits(self.hit_counts())
            return self._view

    def _show(self) -> None:
        with self._making:
            if self._view is not None:
                self._view.show(HeldPoints(self.cloud))

    def news(self) -> Answer:
        """Tell what is new of the job while it goes on, and at its end."""
        view = self.view
        frames = [] if self._ends else list(self.frames)
        planning = self._job.planning
        trials = self._under_way.trials
        is_new = view.path is None and not self._ends
        if planning is not None and is_new and len(trials) >= self._job.trials:
            view.path = best(trials, planning).path
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


def _rays_of(frames: list[ScanFrame]) -> Floats32:
    """Return some rays (n, 2, 3) of frames, local."""
    pairs = ((np.full_like(one.samples, one.pose.position), one.samples) for one in frames)
    return np.concatenate([np.stack(pair, axis=1) for pair in pairs]).astype(np.float32)
