"""A page in Dask's dashboard: partitions, their workers and tasks, and pipes."""

from __future__ import annotations

import base64
import hashlib
import re
import time
from importlib.resources import files
from typing import Any

from distributed import Client
from tornado import web

from .errors import PoolError
from .fence import fences_of, kept_out
from .internals import depth_of, queues_of, serve, serve_no_longer, serves, state_of
from .remote import on_scheduler
from .stats import TOTALS_TOPIC, Ran, running_on, slots_of, statistics_of, told

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
        "busy": running_on(worker, partition)[1],
        "status": worker.status.name,
        "given": len(worker.processing),
        "seen": round(worker.last_seen, 3),
        "executing": executing,
    }


def _pipes(scheduler: Any) -> list[dict[str, Any]]:
    """Pipes are queues beside which there is a variable of their name with a pipe's state."""
    pipes = []
    for name in queues_of(scheduler):
        state = state_of(scheduler, name)
        if isinstance(state, dict) and {"closed", "failure"} <= state.keys():
            failure = str(state["failure"])[:_FAILURE_LENGTH]
            shown = "failed" if failure else "closed" if state["closed"] else "open"
            depth = depth_of(scheduler, name)
            pipes.append({"name": name, "depth": depth, "state": shown, "failure": failure})
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
        serve(scheduler, PageApplication(handlers))
    statistics_of(scheduler)


def is_open(scheduler: Any) -> bool:
    """Whether the page is served."""
    return serves(scheduler, PageApplication)


def close_page(scheduler: Any) -> None:
    """Serve it no longer."""
    serve_no_longer(scheduler, PageApplication)


def partitions_page(client: Client) -> str:
    """Add the page to the dashboard of the client's cluster; returns its URL.

    The page shows workers by partition, tasks over time, depths of pipes and totals, for all
    users of the cluster. It is there until `remove_partitions_page` or the scheduler's end.
    It reads; nobody can change anything with it. It needs no bokeh, and is as open as the
    dashboard is: on a shared network, whoever reaches the one sees the other.

    Raises
    ------
    PoolError
        If the scheduler lacks this package, or runs no HTTP server.
    """
    on_scheduler(client, _open)
    link: str | None
    try:
        link = client.dashboard_link
    except KeyError:  # no such service
        link = None
    if not link:
        raise PoolError(
            f"The scheduler at {client.scheduler.address} has no HTTP server for a page: start "
            "it with a dashboard address, such as 127.0.0.1:8787."
        )
    return link.removesuffix("/").removesuffix("/status") + f"/{PATH}"


def has_partitions_page(client: Client) -> bool:
    """Whether somebody has added the page."""
    return bool(on_scheduler(client, _is_open))


def remove_partitions_page(client: Client) -> None:
    """Take the page away; a browser that has it open shows that it is gone."""
    on_scheduler(client, _close)


def tell_page(client: Client, **totals: Any) -> None:
    """Have the page show totals, such as ``replayed=3``; where no tasks are counted, nothing."""
    client.log_event(TOTALS_TOPIC, totals)


async def _open(dask_scheduler: Any = None) -> None:
    open_page(dask_scheduler)


async def _is_open(dask_scheduler: Any = None) -> bool:
    return is_open(dask_scheduler)


async def _close(dask_scheduler: Any = None) -> None:
    close_page(dask_scheduler)
