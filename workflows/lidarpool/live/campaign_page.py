"""The page of a campaign: its jobs, during the run and until it is closed.

The run calls it in its own thread, and never waits for a browser: it hands over a row for each job
that ends. Charts are drawn by a thread of their own, and points of single jobs are read by the
thread that removes what is left of them, both within a small share of a core.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from queue import Empty, SimpleQueue
from typing import Any

from poolpart import Partition

from ..base.errors import LidarpoolError
from ..export.jobs import JobRow, Value
from ..export.sweeps import Sweeps
from ..report.campaign_figures import Figures
from ..report.campaign_pictures import draw_results, draw_varied
from ..run.bars import standing_still
from ..run.campaign import CampaignPage, CampaignRun, UnderWay
from ..run.job import Job
from ..run.progress import Progress, in_words, is_sure, time_in_words
from ..run.store import RunStore
from ..scenario.campaign import Campaign
from .live_points import LivePoints
from .points import HeldPoints
from .run_page import LivePage, view_of
from .server import PORT, Answer, Arguments, announced, page_server
from .view import View

DRAWING_SHARE = 0.06  # of a core, for charts: they take half a second to a second
READING_SHARE = 0.05  # of a core, for points of single jobs
LOOK_EVERY_S = 5.0  # at most, for the points of another job
LIST_EVERY_S = 0.5  # jobs under way
WATCHED_S = 10.0  # after a question somebody looks at the page
ENDED_MOST, FAILED_MOST, UNDER_WAY_MOST = 10, 6, 12  # rows of the table
VIEWS_KEPT = 4  # jobs whose points are kept: a browser may show, or ask for, an earlier one


class LiveCampaign(LivePage, CampaignPage):
    """Connects the run of a campaign and its page."""

    def __init__(self, campaign: Campaign) -> None:
        super().__init__()
        self._title, self._count = campaign.title or "campaign", campaign.count
        self._names = campaign.names
        self.charts = Charts(self._names, self._count)
        self._left = ""  # time
        self._under_way: Sequence[UnderWay] = ()
        self._list_at = self._look_at = 0.0
        self._looked_for = float("-inf")  # when a browser last wanted points of the newest job
        self._done = self._failed = self._points = self._rays = 0
        self._ended: deque[dict[str, Any]] = deque(maxlen=ENDED_MOST)
        self._failures: deque[dict[str, Any]] = deque(maxlen=FAILED_MOST)
        self._jobs: dict[int, _Shown] = {}  # {number: its points}, the newest last

    # -- the run's side ------------------------------------------------------------------

    def ended(self, row: JobRow) -> None:
        """Count a job, and list it among the last ones."""
        told = {"name": row.name, "values": self._words(row.values)}
        if row.error:
            self._failed += 1
            self._failures.append(told | {"error": row.error})
        else:
            self._done += 1
            self._points += row.points
            self._rays += row.rays
            self._ended.append(told | {"points": row.points, "seconds": row.seconds})
        self.charts.add(row)

    def follow(self, partitions: Mapping[str, Partition]) -> None:
        """Show the jobs under way, and the busy slots of partitions."""
        self._partitions = partitions
        self._state = "starting: workers read the scene and make their trees"

    def on_progress(self, progress: Progress, under_way: Callable[[], Sequence[UnderWay]]) -> None:
        """Record the progress; KeyboardInterrupt if a user of the page has stopped the run."""
        if self.stopped.is_set():
            raise KeyboardInterrupt
        self._progress, now = progress, time.monotonic()
        rate = self._pace.rate(progress.seconds, progress.jobs_done)
        if rate:
            self._rate = (
                f"{in_words(rate)} jobs/s" if rate >= 1 else f"{in_words(60 * rate)} jobs/min"
            )
            left = progress.jobs - progress.jobs_done
            sure = is_sure(progress.jobs_done, progress.jobs, progress.seconds) and left
            self._left = time_in_words(left / rate) if sure else ""
        over = progress.jobs_done == progress.jobs
        if now >= self._list_at or over:
            self._list_at = now + LIST_EVERY_S
            self._under_way = under_way()
            if over:
                self._state = "writing the table and the card"
            elif any(job.stored for job in self._under_way):
                self._state = "running"
        self.ask_partitions()

    def look(self, row: JobRow, store: RunStore) -> None:
        """Read points of a job, if a browser shows them and there is time for it."""
        now = time.monotonic()
        if self._jobs and (now < self._look_at or now - self._looked_for > WATCHED_S):
            return
        started, points = time.thread_time(), LivePoints(store)
        points.add(store.db.ordered)
        while points.waiting:
            points.gather()
        if points.cloud is not None:
            jobs = self._jobs | {row.number: _Shown(row.name, store.job, points)}
            self._jobs = {number: jobs[number] for number in [*jobs][-VIEWS_KEPT:]}
        self._look_at = now + LOOK_EVERY_S
        self._count_reading(started)

    def _count_reading(self, started: float) -> None:
        """Put off the next job by what was spent; processor time, since waiting does not count."""
        spent = time.thread_time() - started
        self._look_at = max(self._look_at, time.monotonic()) + spent / READING_SHARE

    def finish(self, run: CampaignRun) -> None:
        """Show that the run is over."""
        self._state, self._over = "done", True
        self._under_way, self._busy, self._left = (), {}, ""
        if self._progress is not None:
            self._progress = replace(self._progress, seconds=run.seconds)
        self.charts.finish()

    def stay(self) -> None:
        """Keep the page until Ctrl-C or its button."""
        self.keep()

    # -- the page's side -----------------------------------------------------------------

    def answer(self, what: str, asked: Arguments, abandoned: Callable[[], bool]) -> Answer:
        """Answer a question of the page, or of the viewer of a job."""
        if what == "news":
            if asked.get("newest"):
                self._looked_for = time.monotonic()
            return self._news(), {}
        if what == "charts":
            return {"version": self.charts.version, "svg": self.charts.svg}, {}
        folder, number, question = what.split("/", 2)  # ValueError if there is no such question
        if folder != "job":
            raise KeyError(what)
        started = time.thread_time()
        try:
            return self._jobs[int(number)].view.answer(question, asked, abandoned)
        finally:
            self._count_reading(started)

    def _news(self) -> dict[str, Any]:
        self.charts.wanted()
        progress, jobs = self._progress, self._jobs
        under_way = self._under_way
        newest = next(reversed(jobs), None)
        state = self._state
        if not self._over:
            if self.stopped.is_set():
                state = "stopping"
            elif progress is not None:
                state = standing_still(progress) or state
        return {
            "title": self._title,
            "names": list(self._names),
            "state": state,
            "over": self._over,
            "stopping": self.stopped.is_set(),
            "count": self._count,
            "done": self._done,
            "failed": self._failed,
            "casting": len(under_way) - sum(job.writing for job in under_way),
            "writing": sum(job.writing for job in under_way),
            "points": self._points,
            "rays": self._rays,
            "seconds": 0.0 if progress is None else progress.seconds,
            "rate": self._rate,
            "left": self._left,
            "slots": [[name, *slots] for name, slots in self._busy.items()],
            "under_way": [self._told(job) for job in under_way[:UNDER_WAY_MOST]],
            "failures": [*reversed(list(self._failures))],
            "ended": [*reversed(list(self._ended))],
            "charts": self.charts.version,
            "newest": None if newest is None else [newest, jobs[newest].name],
        }

    def _told(self, job: UnderWay) -> dict[str, Any]:
        return {
            "name": job.name,
            "values": self._words(job.values),
            "points": job.points,
            "seconds": job.seconds,
            "share": 1.0 if job.writing else job.stored / max(job.scans, 1),
            "writing": job.writing,
        }

    def _words(self, values: Mapping[str, Value]) -> list[str]:
        """Values in the order of the table's columns; "" for one that is not there."""
        return [_word(values.get(name, "")) for name in self._names]


def _word(value: Value) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:.4g}" if isinstance(value, float) else str(value)


class _Shown:
    """Points of a job, and their view in its scene once somebody asks for it."""

    def __init__(self, name: str, job: Job, points: LivePoints) -> None:
        self.name, self._job, self._points = name, job, points
        self._lock = threading.Lock()
        self._view: View | None = None

    @property
    def view(self) -> View:
        """What its page shows."""
        with self._lock:
            if self._view is None:
                self._view = self._made()
            return self._view

    def _made(self) -> View:
        drawn, view = view_of(self._job, f"job {self.name} - lidarpool")
        points, faces = self._points, len(drawn.scene.faces)
        assert points.cloud is not None, "others are not kept"
        view.hits = lambda: drawn.hits(points.hit_counts())[:faces]
        view.sweeps = Sweeps.of(self._job.survey, self._job.scene)
        view.show(HeldPoints(points.cloud))
        return view


class Charts:
    """How jobs were varied, and what came of it, drawn again and again while somebody looks.

    One thread counts the jobs, and draws: a few numbers of each job are kept. Near the end it lets
    the run draw its own pictures first, since Matplotlib draws in one thread only.
    """

    def __init__(self, names: Sequence[str], count: int) -> None:
        self._names, self._count = names, count
        self._rows: SimpleQueue[JobRow | None] = SimpleQueue()
        self._wanted = float("-inf")  # when somebody asked
        self._finished = self._closed = False
        self.version, self.svg = 0, ""
        self._thread = threading.Thread(target=self._work, name="charts", daemon=True)
        self._thread.start()

    def add(self, row: JobRow) -> None:
        """Count a job."""
        self._rows.put(row)

    def wanted(self) -> None:
        """Note that somebody looks."""
        self._wanted = time.monotonic()

    def finish(self) -> None:
        """Draw all jobs."""
        self._finished = True
        self._rows.put(None)

    def close(self) -> None:
        """Draw nothing more."""
        self._closed = True
        self._rows.put(None)
        self._thread.join()

    def _work(self) -> None:
        figures, drawn, draw_at = Figures(self._names), 0, 0.0
        while not self._closed:
            with suppress(Empty):
                row = self._rows.get(timeout=0.5)
                while True:
                    if row is not None:
                        figures.add(row)
                    row = self._rows.get_nowait()
            now = time.monotonic()
            is_due = now >= draw_at and figures.done and figures.jobs < self._count
            if figures.jobs == drawn or now - self._wanted > WATCHED_S:
                continue
            if is_due or self._finished:
                started, drawn = time.thread_time(), figures.jobs
                with suppress(LidarpoolError):
                    self.svg = _drawn(figures, self._finished)
                    self.version += 1
                draw_at = time.monotonic() + (time.thread_time() - started) / DRAWING_SHARE


def _drawn(figures: Figures, complete: bool) -> str:
    pages = [draw_varied(figures)]
    if complete or pages[0] is None:
        pages.append(draw_results(figures))
    return "".join(f"<figure>{page.svg()}</figure>" for page in pages if page is not None)


@contextmanager
def live_campaign(
    campaign: Campaign, *, port: int = PORT, browser: bool = True
) -> Iterator[LiveCampaign]:
    """Serve the page of a campaign while the body runs; see `announced`."""
    live = LiveCampaign(campaign)
    try:
        with (
            page_server(live.answer, port, live.stopped.set, index="campaign.html") as live.page,
            announced(live.page, f"live page: {live.page.url}", browser),
        ):
            yield live
    finally:
        live.charts.close()
