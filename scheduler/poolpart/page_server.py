"""What the page of partitions is made of, on the scheduler: its handlers and its data."""

from __future__ import annotations

import base64
import hashlib
import re
import time
from importlib.resources import files
from typing import Any

from tornado import web

from .fence_plugin import fences_of, kept_out
from .stats import statistics_of, told
from .stats_plugin import Ran, running_on, slots_of

PATH = "partitions"
MOST_RUNNING = 64  # running tasks that are told of a worker
_FAILURE_LENGTH = 200


def snapshot(scheduler: Any, since: int) -> dict[str, Any]:
    """Gather what the page shows now.

    Parameters
    ----------
    scheduler
        The scheduler.
    since
        Number of tasks that the page has heard of: `ran` of the last snapshot.

    Returns
    -------
    dict
        Plain values, for JSON.
    """
    statistics = statistics_of(scheduler)
    workers = list(scheduler.workers.values())
    names = {name for worker in workers for name, slots in worker.resources.items() if slots}
    names |= fences_of(scheduler) | {name for name, _ in statistics.tallies if name}
    return {
        "time": time.time(),
        "ran": statistics.ran,
        "tasks": [_task(ran) for ran in statistics.since(since)],
        "partitions": [told(scheduler, name) for name in [*sorted(names), ""]],
        "workers": [_worker(worker) for worker in workers],
        "pipes": _pipes(scheduler),
        "totals": {name: str(value)[:40] for name, value in statistics.totals.items()},
        "kept_out": kept_out(scheduler),
    }


def _task(ran: Ran) -> list[Any]:
    return [ran.worker, ran.stage, round(ran.start, 4), round(ran.stop, 4), int(ran.failed)]


def _worker(worker: Any) -> dict[str, Any]:
    partition = next((name for name, slots in worker.resources.items() if slots), "")
    slots = slots_of(worker, partition)
    executing = [  # by the last heartbeat: the scheduler is told of nothing else but ends
        [str(task.key), task.prefix.name, round(worker.last_seen - seconds, 3)]
        for task, seconds in list(worker.executing.items())[:MOST_RUNNING]
        if task.processing_on is worker
    ]
    return {
        "name": str(worker.name),
        "address": worker.address,
        "partition": partition,
        "threads": worker.nthreads,
        "slots": slots,
        "busy": min(running_on(worker, partition).total(), slots),
        "status": worker.status.name,
        "given": len(worker.processing),
        "seen": round(worker.last_seen, 3),
        "executing": executing,
    }


def _pipes(scheduler: Any) -> list[dict[str, Any]]:
    """Pipes are queues beside which there is a variable of their name with a pipe's state."""
    queues, variables = scheduler.extensions["queues"], scheduler.extensions["variables"]
    pipes = []
    for name, queue in queues.queues.items():
        state = variables.variables.get(name, {}).get("value")
        if isinstance(state, dict) and {"closed", "failure"} <= state.keys():
            failure = str(state["failure"])[:_FAILURE_LENGTH]
            shown = "failed" if failure else "closed" if state["closed"] else "open"
            pipe = {"name": name, "depth": queue.qsize(), "state": shown, "failure": failure}
            pipes.append(pipe)
    return pipes


class _Handler(web.RequestHandler):
    def initialize(self, scheduler: Any) -> None:
        self.scheduler = scheduler

    def set_default_headers(self) -> None:
        self.set_header("Cache-Control", "no-store")
        self.set_header("X-Content-Type-Options", "nosniff")
        self.set_header("Referrer-Policy", "no-referrer")


class PageHandler(_Handler):
    """The page, one file; the browser is told to load and run nothing else."""

    def get(self) -> None:
        """Send the page."""
        text = files(__package__).joinpath("page.html").read_text(encoding="utf-8")
        [script] = re.findall(r"<script>(.*?)</script>", text, re.DOTALL)
        digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
        self.set_header(
            "Content-Security-Policy",
            f"default-src 'none'; script-src 'sha256-{digest}'; style-src 'unsafe-inline'; "
            "connect-src 'self'; base-uri 'none'; form-action 'none'",
        )
        self.finish(text)


class DataHandler(_Handler):
    """The page's data."""

    def get(self) -> None:
        """Send what has changed since the last time."""
        since = self.get_query_argument("since", "0")
        self.finish(snapshot(self.scheduler, int(since) if since.isdecimal() else 0))


class PageApplication(web.Application):
    """The page, as the scheduler's HTTP server takes it and gives it back."""


def open_page(scheduler: Any) -> None:
    """Serve the page from the scheduler's own HTTP server."""
    if not is_open(scheduler):
        # A `dask scheduler --dashboard-prefix` is part of the path.
        handlers = [
            (r"(?:/.*)?/" + PATH, PageHandler, {"scheduler": scheduler}),
            (r"(?:/.*)?/" + PATH + r"/data", DataHandler, {"scheduler": scheduler}),
        ]
        scheduler.http_application.add_application(PageApplication(handlers))
    statistics_of(scheduler)


def is_open(scheduler: Any) -> bool:
    """Whether the page is served."""
    applications = scheduler.http_application.applications
    return any(isinstance(other, PageApplication) for other in applications)


def close_page(scheduler: Any) -> None:
    """Serve it no longer."""
    applications = scheduler.http_application.applications
    applications[:] = [a for a in applications if not isinstance(a, PageApplication)]
