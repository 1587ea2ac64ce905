"""A page in Dask's dashboard: partitions, stages, workers and pipes, as tables.

The scheduler makes it, and it reloads every two seconds, without scripts.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from html import escape
from typing import Any

from distributed import Client
from distributed.diagnostics.plugin import SchedulerPlugin
from tornado import web

from .errors import PoolError
from .fence import fences_of
from .internals import link_from_dashboard, serve, serve_no_longer
from .pipe import pipes_of
from .stats import NAME as STATISTICS
from .stats import (
    StageStats,
    forget_statistics,
    running_on,
    slots_of,
    statistics_of,
    stats_of,
)
from .steward import NAME as STEWARD
from .workers import on_scheduler

NAME = "poolpart-page"
PATH = "partitions"
_LONGEST = 200  # characters of a cell

_HEAD = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta http-equiv="refresh" content="2">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Partitions</title>
<style>
:root { color-scheme: light dark; }
body { max-width: 70rem; margin: 1.5rem auto; font: 14px/1.5 system-ui, sans-serif; }
table { border-collapse: collapse; margin-bottom: 2rem; font-variant-numeric: tabular-nums; }
caption { text-align: left; font-size: 1.2rem; font-weight: 600; }
th, td { padding: .2rem 1rem .2rem 0; border-bottom: 1px solid #8885; text-align: right; }
th:first-child, td:first-child { text-align: left; }
</style>
"""

_COUNTS = ("waiting", "queued", "running", "done", "failed", "seconds")


def page_of(scheduler: Any) -> str:
    """HTML of the current page."""
    statistics = statistics_of(scheduler)
    workers = list(scheduler.workers.values())
    names = {name for worker in workers for name, slots in worker.resources.items() if slots}
    names |= fences_of(scheduler) | {name for name, _ in statistics.tallies if name}
    partitions = stats_of([*sorted(names), ""], scheduler)
    stages = [
        [stage, _shown(p.name), *_counts(counts)]
        for p in partitions
        for stage, counts in p.stages.items()
    ]
    rows = [
        [f"{_shown(p.name)}{' (exclusive)' * p.exclusive}", p.workers, p.slots, p.busy, *_counts(p)]
        for p in partitions
    ]
    given = ["", "partition", "slots", "busy", "tasks given", "status", "address"]
    sections = [
        _HEAD,
        _table("Partitions", ["", "workers", "slots", "busy", *_COUNTS], rows),
        _table("Stages", ["", "partition", *_COUNTS], stages),
        _table("Workers", given, [_worker(worker) for worker in workers]),
        _table("Pipes", ["", "depth", "state"], _pipes(scheduler)),
    ]
    return "".join(sections)


def _table(title: str, head: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    """Make a table, or nothing without rows. Names come from users: all text is escaped."""

    def line(tag: str, cells: Iterable[object]) -> str:
        texts = (escape(str(cell)[:_LONGEST]) for cell in cells)
        return "<tr>" + "".join(f"<{tag}>{text}</{tag}>" for text in texts) + "</tr>\n"

    body = "".join(line("td", row) for row in rows)
    if not body:
        return ""
    return f"<table>\n<caption>{title}</caption>\n{line('th', head)}{body}</table>\n"


def _shown(partition: str) -> str:
    return partition or "remainder"


def _counts(stats: StageStats) -> list[object]:
    return [*(getattr(stats, count) for count in _COUNTS[:-1]), f"{stats.seconds:.1f}"]


def _worker(worker: Any) -> list[object]:
    partition = next((name for name, slots in worker.resources.items() if slots), "")
    slots, busy = slots_of(worker, partition), running_on(worker, partition)[1]
    given, status = len(worker.processing), worker.status.name
    return [worker.name, _shown(partition), slots, busy, given, status, worker.address]


def _pipes(scheduler: Any) -> Iterator[list[object]]:
    for name, state in pipes_of(scheduler).items():
        failed = state.failure and f"failed: {state.failure}"
        shown = failed or ("closed" if state.closed else "open")
        yield [name, len(state.items), shown]


class _Handler(web.RequestHandler):
    """Sends the page; the browser may load and run nothing else."""

    def initialize(self, scheduler: Any) -> None:
        self.scheduler = scheduler

    def get(self) -> None:
        self.set_header("Cache-Control", "no-store")
        self.set_header("Content-Security-Policy", "default-src 'none'; style-src 'unsafe-inline'")
        self.finish(page_of(self.scheduler))


class PageApplication(web.Application):
    """Adds the page to the scheduler's HTTP server, and removes it."""


class PageOwners(SchedulerPlugin):
    """Removes the page when the last client that wanted it has gone."""

    name = NAME

    def __init__(self, scheduler: Any) -> None:
        self.owners: set[str] = set()  # clients, by id
        self.began_to_count = STATISTICS not in scheduler.plugins

    def remove_client(self, scheduler: Any, client: str) -> None:
        """Record that a client has gone, or no longer wants the page."""
        self.owners.discard(client)
        if not self.owners:
            close_page(scheduler)
            if self.began_to_count and STEWARD not in scheduler.plugins:
                forget_statistics(scheduler)


def partitions_page(client: Client) -> str:
    """Add the page to the dashboard of the client's cluster, see `Pool.page`; returns its URL."""
    on_scheduler(client, _open, owner=client.id)
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


def leave_page(client: Client) -> None:
    """Remove the page, unless others want it, as when the client leaves."""
    on_scheduler(client, _leave, owner=client.id)


async def _open(owner: str, dask_scheduler: Any = None) -> None:
    if owner not in dask_scheduler.clients:  # killed, and already removed
        return
    if NAME not in dask_scheduler.plugins:
        dask_scheduler.add_plugin(PageOwners(dask_scheduler))
        # A `dask scheduler --dashboard-prefix` is part of the path.
        handlers = [(r"(?:/.*)?/" + PATH, _Handler, {"scheduler": dask_scheduler})]
        serve(dask_scheduler, PageApplication(handlers))
        link_from_dashboard(dask_scheduler, PATH, True)
    dask_scheduler.plugins[NAME].owners.add(owner)
    statistics_of(dask_scheduler)


async def _leave(owner: str, dask_scheduler: Any = None) -> None:
    if NAME in dask_scheduler.plugins:
        dask_scheduler.plugins[NAME].remove_client(dask_scheduler, owner)


def close_page(scheduler: Any) -> None:
    """Stop serving the page."""
    if NAME in scheduler.plugins:
        serve_no_longer(scheduler, PageApplication)
        link_from_dashboard(scheduler, PATH, False)
        scheduler.remove_plugin(NAME)
