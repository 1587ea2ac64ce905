"""A page in Dask's dashboard: partitions, stages, workers and pipes, as tables.

The scheduler makes it, and it reloads every two seconds, without scripts.
"""

from __future__ import annotations

import asyncio
import os
from collections.abc import Collection
from http import HTTPStatus
from typing import Any
from urllib.parse import urlsplit

from distributed import Client
from distributed.diagnostics.plugin import SchedulerPlugin
from tornado import web
from tornado.template import Template

from .errors import PipeClosed, PoolError
from .fence import fences_of
from .internals.names import PAGE, require
from .internals.scheduler import serve, serve_no_longer
from .other_sites import names_of_machine, refusal
from .pipe_states import pipes_of
from .stats import NAME as STATISTICS
from .stats import StageStats, forget_statistics, running_on, slots_of, statistics_of, stats_of
from .steward import NAME as STEWARD
from .workers import check_client, on_scheduler

NAME = "poolpart-page"
PATH = "partitions"
_ANY_ADDRESS = "0.0.0.0"  # dashboards listen on the network unless they are told otherwise
_HUB = "JUPYTERHUB_SERVICE_PREFIX"  # environment variable behind the proxy of a JupyterHub

# Names come from users: tornado escapes all that is written into a template.
_PAGE = Template("""<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta http-equiv="refresh" content="2">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Partitions</title>
<style>
:root { color-scheme: light dark; }
body { max-width: 70rem; margin: 1.5rem auto; padding: 0 1rem; font: 14px/1.5 system-ui, sans-serif;
  color: #1c1e21; background: #fff; }
@media (prefers-color-scheme: dark) { body { color: #e3e5e8; background: #16181c; } }
div { overflow-x: auto; margin-bottom: 2rem; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; white-space: nowrap; }
caption { text-align: left; font-size: 1.2rem; font-weight: 600; }
th, td { padding: .2rem 1rem .2rem 0; border-bottom: 1px solid #8885; text-align: right; }
th:first-child, td:first-child { text-align: left; }
</style>
{% for title, head, rows in tables %}{% if rows %}<div tabindex="0"><table>
<caption>{{ title }}</caption>
<tr>{% for cell in ["", *head] %}<th>{{ cell }}</th>{% end %}</tr>
{% for row in rows %}<tr>{% for cell in row %}<td>{{ str(cell)[:200] }}</td>{% end %}</tr>
{% end %}</table></div>
{% end %}{% end %}""")
_COUNTS = ("waiting", "queued", "running", "done", "failed", "seconds")
_OF_A_WORKER = ("partition", "slots", "busy", "tasks given", "status", "address")


def page_of(scheduler: Any) -> bytes:
    """Return the HTML of the current page."""
    workers = list(scheduler.workers.values())
    names = {name for worker in workers for name, slots in worker.resources.items() if slots}
    names |= fences_of(scheduler) | {name for name, _ in statistics_of(scheduler).ended if name}
    partitions: list[list[object]] = []
    stages: list[list[object]] = []
    pipes: list[list[object]] = []
    for p in stats_of([*sorted(names), ""], scheduler):
        title = f"{_shown(p.name)}{' (exclusive)' * p.exclusive}"
        partitions.append([title, p.workers, p.slots, p.busy, *_counts(p)])
        stages += [[name, _shown(p.name), *_counts(stage)] for name, stage in p.stages.items()]
    for name, pipe in pipes_of(scheduler).items():
        end = pipe.why_no_put()
        state = (
            "open" if end is None else "closed" if isinstance(end, PipeClosed) else f"failed: {end}"
        )
        pipes.append([name, pipe.queue.qsize(), pipe.queue.capacity, state])
    tables = [
        ("Partitions", ["workers", "slots", "busy", *_COUNTS], partitions),
        ("Stages", ["partition", *_COUNTS], stages),
        ("Workers", _OF_A_WORKER, [_worker(worker) for worker in workers]),
        ("Pipes", ["depth", "capacity", "state"], pipes),
    ]
    return _PAGE.generate(tables=tables)


def _shown(partition: str) -> str:
    return partition or "remainder"


def _counts(stats: StageStats) -> list[object]:
    return [*(getattr(stats, count) for count in _COUNTS[:-1]), f"{stats.seconds:.1f}"]


def _worker(worker: Any) -> list[object]:
    partition = next((name for name, slots in worker.resources.items() if slots), "")
    return [
        worker.name,
        _shown(partition),
        slots_of(worker, partition),
        running_on(worker, partition)[1],
        len(worker.processing),
        worker.status.name,
        "" if worker.name == worker.address else worker.address,
    ]


class _Handler(web.RequestHandler):
    """Sends the page, but to no other website; the browser may load and run the page alone."""

    def initialize(self, scheduler: Any, owners: PageOwners) -> None:
        self.scheduler = scheduler
        self.names = owners.names

    def prepare(self) -> None:
        """Refuse requests of other websites; only links to the page are followed."""
        reason = refusal(self.request.headers, self.names, is_page=True)
        if reason:
            self.set_status(HTTPStatus.FORBIDDEN)
            self.set_header("Content-Type", "text/plain; charset=utf-8")
            self.finish(f"{reason}; distributed.dashboard.link may have another name")

    def get(self) -> None:
        self.set_header("Cache-Control", "no-store")
        self.set_header("Content-Security-Policy", "default-src 'none'; style-src 'unsafe-inline'")
        self.finish(page_of(self.scheduler))


class PageOwners(SchedulerPlugin):
    """Serves the page until the last client that wanted the page has gone."""

    name = NAME

    def __init__(self, scheduler: Any, names: Collection[str]) -> None:
        self.owners: set[str] = set()  # clients, by id
        # Names that the page is asked by; None where a proxy has a name that is not known here.
        self.names: set[str] | None = None if _HUB in os.environ else {*names}
        self.began_to_count = STATISTICS not in scheduler.plugins
        # A `dask scheduler --dashboard-prefix` is part of the path.
        handlers = [(r"(?:/.*)?/" + PATH, _Handler, {"scheduler": scheduler, "owners": self})]
        self.page = web.Application(handlers)
        serve(scheduler, self.page)

    def add(self, owner: str, link: str | None) -> None:
        """Add a client that wants the page, with its link to the dashboard, None if unknown."""
        self.owners.add(owner)
        host = urlsplit(link or "").hostname
        if link and not host:  # relative to the page of a notebook
            self.names = None
        elif host and self.names is not None:
            self.names.add(host)

    def remove_client(self, scheduler: Any, client: str) -> None:
        """Record that a client has gone, or no longer wants the page."""
        self.owners.discard(client)
        if not self.owners:
            close_page(scheduler)
            if self.began_to_count and STEWARD not in scheduler.plugins:
                forget_statistics(scheduler)


def partitions_page(client: Client) -> str:
    """Add the page to the dashboard of the client's cluster, see `Pool.page`; returns its URL."""
    check_client(client)
    on_scheduler(client, _open, owner=client.id, link=_dashboard_link(client))
    link = page_link(client)
    if link is None:
        raise PoolError(
            f"The scheduler at {client.scheduler.address} has no HTTP server for a page: start "
            "it with a dashboard address, such as 127.0.0.1:8787."
        )
    return link


def page_link(client: Client) -> str | None:
    """Return the URL that the page has while it is open; None without an HTTP server."""
    link = _dashboard_link(client)
    return link and f"{link.removesuffix('/').removesuffix('/status')}/{PATH}"


def _dashboard_link(client: Client) -> str | None:
    """Return the URL of Dask's dashboard, or None if the scheduler has no such service."""
    try:
        return client.dashboard_link or None
    except KeyError:
        return None


def is_open(scheduler: Any) -> bool:
    """Return whether the scheduler serves the page."""
    return NAME in scheduler.plugins


async def _open(owner: str, link: str | None, dask_scheduler: Any = None) -> None:
    require(PAGE)
    # Looking up the domain may take seconds.
    names = await asyncio.to_thread(names_of_machine, _ANY_ADDRESS)
    if owner not in dask_scheduler.clients:  # killed, and already removed
        return
    if NAME not in dask_scheduler.plugins:
        dask_scheduler.add_plugin(PageOwners(dask_scheduler, names))
    dask_scheduler.plugins[NAME].add(owner, link)
    statistics_of(dask_scheduler)


async def leave_page(owner: str, dask_scheduler: Any = None) -> None:
    """Remove the page for a client; the page stays for further clients. Runs on the scheduler."""
    if NAME in dask_scheduler.plugins:
        dask_scheduler.plugins[NAME].remove_client(dask_scheduler, owner)


def close_page(scheduler: Any) -> None:
    """Stop serving the page."""
    if NAME in scheduler.plugins:
        serve_no_longer(scheduler, scheduler.plugins[NAME].page)
        scheduler.remove_plugin(NAME)
