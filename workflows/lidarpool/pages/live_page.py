"""Live page of a run, which shows the run's jobs until the page is closed.

The run calls the page in its own thread, passes updates to it, and never waits for a browser. Parts
are read when a page requests updates, or by the thread that removes the files of ended jobs. Charts
are drawn when a page requests them. Each of these activities is limited to a small share of a CPU
core.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from lidarfiles.datasets.dataset import DataSet
from lidarfiles.datasets.job_table import JobRow
from lidarsim.columns.cloud_file import CloudFile
from lidarview.viewer.result_views import wait_for_interrupt
from lidarview.viewer.server import (
    PORT,
    VIEWER,
    Answer,
    Arguments,
    PageServer,
    announce_page,
    page_server,
)
from poolpart import Partition

from ..run.pipeline.stage_messages import Receipt, ScanFrame
from ..run.progress import Progress
from ..run.run_page import RunPage
from ..run.run_result import RunResult
from ..run.store.stored_job import StoredJob
from .job_views import JobViews
from .listed_jobs import RecentJobs
from .live_charts import Charts
from .live_job import LiveJob
from .run_status import PartitionLoads, RunStatus


class LivePage(RunPage):
    """Live page of a run that has one or several jobs."""

    page: PageServer

    def __init__(self, jobs: int, names: Sequence[str], title: str) -> None:
        # set by the stop button of the page; the run can be resumed
        self.stopped = threading.Event()
        self._count = jobs
        self._title = title
        self._status = RunStatus()
        self._loads = PartitionLoads()
        self._listed = RecentJobs(names)
        self._charts = Charts(names, jobs)
        self._views = JobViews()

    # -- called by the run --------------------------------------------------------------

    def on_survey_start(self, job: StoredJob) -> None:
        """Show the only job of a run, including scans that were committed earlier."""
        if job.committed_text:
            self._status.progress = job.progress()
        self._views.jobs = {0: LiveJob(job)}
        self._status.state = "starting the worker processes"

    def follow(self, partitions: Mapping[str, Partition], dataset: DataSet | None = None) -> None:
        """Show running jobs, busy slots and written jobs."""
        self._loads.partitions = partitions
        if dataset is not None:
            self._views.follow(dataset)
        self._status.state = (
            "workers are reading the scene and building its acceleration structures"
        )

    def on_parts(self, receipts: Sequence[Receipt]) -> None:
        """Record parts that the only job has committed."""
        self._views.jobs[0].add_receipts(receipts)

    def on_frame(self, frame: ScanFrame) -> None:
        """Record a frame to be shown. Frames are skipped if many arrive at once."""
        self._views.jobs[0].frames.append(frame)

    def on_progress(
        self, progress: Progress, under_way: Callable[[], Sequence[Mapping[str, Any]]]
    ) -> None:
        """Record the progress of the run.

        Raises
        ------
        KeyboardInterrupt
            If a user has stopped the run on the page.
        """
        if self.stopped.is_set():
            raise KeyboardInterrupt
        self._status.update(progress)
        all_done = 0 < progress.jobs == progress.jobs_done
        self._listed.update(under_way, is_last=all_done)
        if all_done:
            self._status.state = "writing the job table and the data set card"
        elif progress.cast or any(job["stored"] for job in self._listed.under_way):
            self._status.state = "running"
        self._loads.poll()

    def on_job_end(self, row: JobRow) -> None:
        """Count a job that has ended, and move it from the running jobs to the ended jobs."""
        self._listed.add_ended_job(row, opens=row.done and self._views.opens_written)
        self._charts.add_job(row)

    def on_job_written(self, row: JobRow, job: StoredJob) -> None:
        """Read the points of a job if a browser displays points and the CPU limit permits it.

        Those of the last job are always read, so that the page of a finished run shows them.
        """
        sums = self._listed.sums
        is_last = self._count == 1 or sums["done"] + sums["failed"] == self._count
        self._views.read(row, job, is_last=is_last)

    def finish(self, seconds: float, result: RunResult | None = None) -> None:
        """Show that the run has finished, with the result if it was a survey.

        Afterward, the parts of the survey may be removed.
        """
        if self._count == 1 and 0 in self._views.jobs:
            self._views.jobs[0].finish(result)
        self._listed.under_way = ()
        self._loads.clear()
        self._status.finish(seconds, None if result is None else len(result.points))

    def keep_open(self, cloud: Path | None = None) -> None:
        """Keep the page open until Ctrl-C is pressed or a user stops it.

        The points of a survey are read from the written `cloud`, because the parts have been
        removed.
        """
        if cloud is not None:
            self._views.jobs[0].show_file(cloud)
        click.echo(
            f"The live page remains available at {self.page.url}. Press Ctrl-C to stop.", err=True
        )
        wait_for_interrupt(self.stopped)

    # -- called by the page -------------------------------------------------------------

    def answer(self, question: str, arguments: Arguments, abandoned: Callable[[], bool]) -> Answer:
        """Answer a request from the job list or from the viewer of a job."""
        if question == "jobs":
            if arguments.get("newest"):
                self._views.request_newest()
            return self._news(), {}
        if question == "charts":
            return {"svg": self._charts.draw(self._status.over)}, {}
        match = re.fullmatch(r"(?:job/(\d+)/)?(\w+)", question)
        if match is None:
            raise KeyError(question)
        number = int(match[1] or 0)
        viewer_question = match[2]
        if self._count > 1:
            with self._views.reading.use():
                view = self._views.view(number, self._listed.name_of)
                return view.answer(viewer_question, arguments, abandoned)
        jobs = self._views.jobs
        if viewer_question == "state" and number not in jobs:  # the job has not started
            return self._news(), {}
        return self._answer_for_only_job(jobs[number], viewer_question, arguments, abandoned)

    def _answer_for_only_job(self, job: LiveJob, question: str, *arguments: Any) -> Answer:
        """Answer a request from the viewer of the only job."""
        progress = self._status.progress
        points = {"points": (progress and progress.points) or self._listed.sums["points"]}
        if question == "news":
            reading = self._views.reading
            if reading.is_due and not self._status.over:
                with reading.use():
                    job.gather()
            header, arrays = job.news()
            return self._news() | header | points, arrays
        header, arrays = job.view.answer(question, *arguments)
        if question == "state":
            is_sample = not isinstance(job.view.points, CloudFile)
            suffix = "" if self._title == "lidarpool" else " - lidarpool"
            title = f"{self._title}{suffix}"
            header |= {"live": True, "sampled": is_sample, "title": title} | points
        return header, arrays

    def _news(self) -> dict[str, Any]:
        """Return the state of the run and its job lists as JSON-compatible objects."""
        jobs = self._views.jobs
        newest = next(reversed(jobs), None)
        return {
            "title": self._title,
            "count": self._count,
            **self._status.news(self.stopped.is_set()),
            **self._listed.news(jobs),
            "slots": self._loads.slots(),
            "charts": self._charts.version(self._status.over),
            "newest": None if newest is None else [newest, jobs[newest].name],
        }


@contextmanager
def live_page(
    jobs: int = 1,
    names: Sequence[str] = (),
    title: str = "lidarpool",
    *,
    port: int = PORT,
    browser: bool = True,
) -> Iterator[LivePage]:
    """Serve the live page of a run during the body, and print its address."""
    live = LivePage(jobs, names, title)
    index = VIEWER if jobs == 1 else "jobs.html"
    with (
        page_server(live.answer, port, live.stopped.set, index=index) as live.page,
        announce_page(live.page, f"live page: {live.page.url}", browser),
    ):
        yield live
