"""The live page of a run: its jobs, or the only job, during the run and until the page is closed.

The run calls the page in the run's own thread, hands over news, and never waits for a browser.
Parts are read when a page asks for news, or by the thread that removes the files of ended jobs, and
charts are drawn when a page asks for charts; all within small shares of a core.
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
from lidarview.viewer.result_views import open_result, wait_for_interrupt
from lidarview.viewer.server import (
    PORT,
    VIEWER,
    Answer,
    Arguments,
    PageServer,
    announced,
    page_server,
)
from lidarview.viewer.view import View
from poolpart import Partition, PartitionStats

from ...columns.parts import read_part
from ...datasets.dataset import DataSet, job_file
from ...datasets.figures import Figures
from ...datasets.job_table import JobRow, Value
from ...plan import best
from ...report.charts import draw_results, draw_varied
from ...report.picture_content import planning_picture
from ...run.pipeline.messages import Receipt, ScanFrame
from ...run.progress import STAGES, Pace, Progress, in_words, time_in_words, waiting_reason
from ...run.run_page import RunPage
from ...run.run_result import RunResult
from ...run.store.job_under_way import JobUnderWay
from .cpu_share import CpuShare
from .downloads import downloads

DRAWING_SHARE = 0.06  # of a core, for charts: they take half a second to a second
READING_SHARE = 0.05  # of a core, for points
LOOK_EVERY_S = 5.0  # at most, for the points of another job
LIST_EVERY_S = 0.5  # jobs under way
ASK_EVERY_S = 1.0  # how busy the partitions are
MAX_LOADS = 6  # answers to that, over which it is averaged
WATCHED_S = 10.0  # after a question, in which the page counts as watched
# rows of the table
MAX_ENDED = 10
MAX_FAILED = 6
MAX_UNDER_WAY = 12
MAX_VIEWS = 4  # jobs whose points are kept: a browser may show, or ask for, an earlier one
LIVE_POINTS = 150_000  # in the browser at a time
MAX_WAITING_PARTS = 64  # parts that wait to be read; of more, every second is skipped
PARTS_PER_READ = 8  # parts read for one drawing
MAX_FRAMES = 40  # whose rays are shown


class LivePage(RunPage):
    """Connects a run and its page, in both directions: the list of jobs, or the only job."""

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
        # rate, and the remaining time, in words
        self._pace = Pace()
        self._rate = ""
        self._time_left = ""
        self._partitions: Mapping[str, Partition] = {}
        self._loads: deque[tuple[float, dict[str, PartitionStats]]] = deque(maxlen=MAX_LOADS)
        self._written: Storage | None = None  # folders of jobs, which can be opened
        self._results: dict[int, View] = {}  # {number: view of a written job}
        self._under_way: Sequence[Mapping[str, Any]] = ()
        self._ask_at = self._list_at = 0.0
        self._looked_for = float("-inf")  # when a browser last wanted points of the newest job
        self._reading = CpuShare(READING_SHARE)
        self._sums = Counter(done=0, failed=0, points=0, rays=0)
        self._ended: deque[dict[str, Any]] = deque(maxlen=MAX_ENDED)
        self._failures: deque[dict[str, Any]] = deque(maxlen=MAX_FAILED)
        self._jobs: dict[int, LiveJob] = {}  # {number: its points}, the newest last

    # -- the run's side ------------------------------------------------------------------

    def begun(self, job: JobUnderWay) -> None:
        """Show the only job: scans of an earlier run, and scans committed from now on."""
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
        """Record a frame, which is displayed unless many frames come at once."""
        self._jobs[0].frames.append(frame)

    def on_progress(
        self, progress: Progress, under_way: Callable[[], Sequence[Mapping[str, Any]]]
    ) -> None:
        """Record the progress; KeyboardInterrupt if a user of the page has stopped the run."""
        if self.stopped.is_set():
            raise KeyboardInterrupt
        self._progress = progress
        time_s = time.monotonic()
        counts = (progress.collected, progress.scans)
        unit = ""
        if progress.jobs:
            counts = (progress.jobs_done, progress.jobs)
            unit = " jobs"
        if rate := self._pace.rate(progress.seconds, counts[0]):
            period = "s"
            if unit and rate < 1:
                period = "min"
                rate *= 60
            self._rate = f"{in_words(rate)}{unit}/{period}"
            self._time_left = self._pace.time_left(progress.seconds, *counts)
        over = 0 < progress.jobs == progress.jobs_done
        if time_s >= self._list_at or over:
            self._list_at = time_s + LIST_EVERY_S
            self._under_way = under_way()
        if over:
            self._state = "writing the table and the card"
        elif progress.cast or any(job["stored"] for job in self._under_way):
            self._state = "running"
        if time_s >= self._ask_at:
            self._ask_at = time_s + ASK_EVERY_S
            with suppress(OSError, RuntimeError):  # the run itself reports a lost cluster
                stats = {name: part.stats() for name, part in self._partitions.items()}
                self._loads.append((time_s, stats))

    def ended(self, row: JobRow) -> None:
        """Count a job, and move its entry from the jobs under way to the last jobs."""
        self._under_way = [job for job in self._under_way if job["name"] != row.name]
        entry = {name: getattr(row, name) for name in ("name", "error", "points", "seconds")}
        entry |= {"number": row.number, "opens": row.done and self._written is not None}
        entry["values"] = self._words(row.values)
        (self._ended if row.done else self._failures).append(entry)
        ended = "done" if row.done else "failed"
        self._sums.update({ended: 1, "points": row.points, "rays": row.rays})
        self._charts.add(row)

    def look(self, row: JobRow, job: JobUnderWay) -> None:
        """Read points of a job, if a browser shows the points and reading is due."""
        watched = time.monotonic() - self._looked_for <= WATCHED_S and self._reading.due
        if self._count > 1 and self._jobs and not watched:
            return
        with self._reading.use(LOOK_EVERY_S):
            live = self._jobs.get(row.number) or LiveJob(job, row.name)
            live.read_all()
            if len(live.cloud):
                jobs = self._jobs | {row.number: live}
                self._jobs = {number: jobs[number] for number in [*jobs][-MAX_VIEWS:]}

    def finish(self, seconds: float, result: RunResult | None = None) -> None:
        """Show that the run is over, and the result of a survey; its parts may then be removed."""
        if self._count == 1 and 0 in self._jobs:
            self._jobs[0].finish(result)
        if self._progress is not None:
            points = self._progress.points if result is None else len(result.points)
            self._progress = replace(self._progress, seconds=seconds, points=points)
        self._under_way = ()
        self._time_left = ""
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

    def answer(self, question: str, arguments: Arguments, abandoned: Callable[[], bool]) -> Answer:
        """Answer a question of the list, or of the viewer of a job."""
        if question == "jobs":
            if arguments.get("newest"):
                self._looked_for = time.monotonic()
            return self._news(), {}
        if question == "charts":
            return {"svg": self._charts.drawn(self._over)}, {}
        match = re.fullmatch(r"(?:job/(\d+)/)?(\w+)", question)
        if match is None:
            raise KeyError(question)
        number = int(match[1] or 0)
        viewer_question = match[2]
        if self._count > 1:
            with self._reading.use():
                return self._view_of(number).answer(viewer_question, arguments, abandoned)
        if viewer_question == "state" and number not in self._jobs:  # the job has not begun
            return self._news(), {}
        return self._answer_of_only_job(self._jobs[number], viewer_question, arguments, abandoned)

    def _view_of(self, number: int) -> View:
        """Return the view of a job that was read or, if listed, written; else KeyError."""
        if number in self._jobs:
            return self._jobs[number].view
        if number not in self._results and self._written is not None:
            names = {job["number"]: job["name"] for job in list(self._ended)}
            file = self._written.local(job_file("folder", names[number], SWEEPS_FILE))
            self._results[number] = open_result(file.parent, downloads())
        return self._results[number]

    def _answer_of_only_job(self, job: LiveJob, question: str, *arguments: Any) -> Answer:
        """Answer a question of the viewer of the only job, also while the job is under way."""
        points = {"points": (self._progress and self._progress.points) or self._sums["points"]}
        if question == "news":
            if self._reading.due and not self._over:
                with self._reading.use():
                    job.gather()
            header, arrays = job.news()
            return self._news() | header | points, arrays
        header, arrays = job.view.answer(question, *arguments)
        if question == "state":
            header |= {"live": True, "sampled": not isinstance(job.view.points, CloudFile)} | points
        return header, arrays

    def _news(self) -> dict[str, Any]:
        """Return the state of the run and its lists of jobs, for JSON."""
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
            "left": self._time_left,
            "stages": [
                [label, getattr(progress, count), getattr(progress, total)]
                for label, count, total in STAGES
                if progress is not None and getattr(progress, total)
            ],
            "slots": busy_slots(list(self._loads)),
            "busy": len(under_way),
            "under_way": [
                {**job, "values": self._words(job["values"])} for job in under_way[:MAX_UNDER_WAY]
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
        """Return values in the order of the table's columns; "" for a missing value."""
        shown = (values.get(name, "") for name in self._names)
        words = (f"{value:.4g}" if isinstance(value, float) else value for value in shown)
        return [str(value).lower() if isinstance(value, bool) else str(value) for value in words]


def busy_slots(loads: Sequence[tuple[float, Mapping[str, PartitionStats]]]) -> list[Any]:
    """Return [label, share of busy slots, slots] of each partition, over moments.

    `loads` are (seconds, statistics) of the moments. Short tasks end between two moments, long
    tasks after all: the larger counts, of the slots of ended tasks and the slots held at moments.
    """
    (begin, first), *_, (end, last) = [*loads, *loads] or [(0.0, {})] * 2
    shares = []
    for name, load in last.items():
        held = sum(earlier[name].busy for _, earlier in loads) / len(loads)
        took = (load.seconds - first[name].seconds) / max(end - begin, ASK_EVERY_S)
        share = min(max(held, took) / max(load.slots, 1), 1.0)
        shares.append([f"{name}, slots busy", share, load.slots])
    return shares


class Charts:
    """Charts of varied quantities and of results, drawn again while a browser shows the charts.

    A few numbers of each job are kept. At the end the run draws its pictures first, since
    Matplotlib draws in one thread only.
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


@contextmanager
def live_page(
    jobs: int = 1,
    names: Sequence[str] = (),
    title: str = "lidarpool",
    *,
    port: int = PORT,
    browser: bool = True,
) -> Iterator[LivePage]:
    """Serve the page of a run while the body runs, and announce its address."""
    live = LivePage(jobs, names, title)
    index = VIEWER if jobs == 1 else "jobs.html"
    with (
        page_server(live.answer, port, live.stopped.set, index=index) as live.page,
        announced(live.page, f"live page: {live.page.url}", browser),
    ):
        yield live


class LiveJob:
    """Points and hits of a job, from the parts that there is time to read, and its view.

    The run's thread records parts, the page's threads read parts. At the end an evenly spaced
    sample of the complete result replaces the points, so skipped parts do not matter.
    """

    def __init__(
        self, under_way: JobUnderWay, name: str = "", max_points: int = LIVE_POINTS
    ) -> None:
        self.name = name
        self._under_way = under_way
        self._max_points = max_points
        self._job = under_way.job
        self._points = under_way.points()  # of the columns of parts
        self._waiting: list[str] = []  # names of parts
        self._lock = threading.Lock()
        self._random = np.random.default_rng(0)
        self._share = 1.0  # of the points of a part that are taken
        self._counts = np.zeros(self._job.scene.counters, np.int64)
        self._hits = 0  # of the parts that were read
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
        """Take a sample of all points, and all hits; the parts may then be removed."""
        if result is not None:
            with self._lock:
                self._waiting = []
                self._counts = result.hit_counts
                self._hits = result.hits
                self.cloud = result.points.sample(self._max_points, MAX_WAITING_PARTS)
            self._show()
            self.view.rays = result.sample_rays
            self.view.path = None if result.plan is None else result.plan.path
        self._end_version += 1

    def show_file(self, cloud: Path) -> None:
        """Show the written cloud, with its sweeps: the parts are gone."""
        view = self.view
        view.sweeps = self._job.sweeps
        view.show(CloudFile(cloud, () if view.pictured is None else view.pictured.extra_columns))
        self._end_version += 1

    # -- the page's side -----------------------------------------------------------------

    def gather(self) -> None:
        """Read a few of the waiting parts; the run reports parts that cannot be read."""
        with self._lock:
            names = self._waiting[:PARTS_PER_READ]
            self._waiting = self._waiting[PARTS_PER_READ:]
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
            while len(cloud) > self._max_points:
                self._share /= 2
                cloud = cloud[self._random.random(len(cloud)) < 0.5]
            self.cloud = cloud
        self._show()

    def hit_counts(self) -> Floats:
        """Return hits by counters of the scene, scaled up to all hits if parts were not read."""
        with self._lock:
            return np.asarray(self._counts * (self._under_way.parts.hits / max(self._hits, 1)))

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
                    HeldPoints(self.cloud), pictured, sweeps, title=title, downloads=downloads()
                )
                self._view.hits = lambda: drawn.hits(self.hit_counts())
            return self._view

    def _show(self) -> None:
        """Show the points in the view, if there is a view."""
        with self._making:
            if self._view is not None:
                self._view.show(HeldPoints(self.cloud))

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
            "hits_version": round(10 * np.log1p(self._hits)),
            "rays_version": newest,
            "time": self._job.survey.begins_ns(newest) / 1e9 if frames else None,
            "path": view.planned,
            "ends": self._end_version,
        }
        return header, {"rays": _rays_of(frames) if frames else view.rays_shown}


def _rays_of(frames: list[ScanFrame]) -> Floats32:
    """Return sample rays (n, 2, 3) of frames, local coordinates."""
    pairs = ((np.full_like(frame.samples, frame.pose.position), frame.samples) for frame in frames)
    return np.concatenate([np.stack(pair, axis=1) for pair in pairs]).astype(np.float32)
