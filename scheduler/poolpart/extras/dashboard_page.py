"""A page in Dask's dashboard that shows partitions, their queues, workers, pipes and moves.

The scheduler renders the page, which contains no scripts and reloads every two seconds.
"""

from __future__ import annotations

import asyncio
import os
from collections.abc import Collection
from http import HTTPStatus
from typing import Any
from urllib.parse import urlencode, urlsplit

from distributed import Client
from distributed.diagnostics.plugin import SchedulerPlugin
from tornado import web
from tornado.template import Template

from ..balance_stats import HEAD_OF_MOVES
from ..balancing import MAX_MOVES, recent_moves
from ..errors import PoolError
from ..features import FEATURES, Feature
from ..fence import fence_names
from ..html_table import TEXT_COLUMNS
from ..internals.names import PAGE, require_feature
from ..internals.scheduler import add_pages, remove_pages
from ..membership import partition_names, release_statistics
from ..partition_stats import (
    HEAD_OF_CLIENTS,
    HEAD_OF_COUNTS,
    HEAD_OF_QUEUES,
    NO_PARTITION,
)
from ..pipe_states import pipes_of
from ..stats import NAME as STATISTICS
from ..stats import (
    running_on,
    slots_of,
    statistics_of,
    stats_of,
    workers_of,
)
from ..steward import NAME as STEWARD
from ..workers import check_client, run_on_scheduler
from .other_sites import names_of_machine, refusal

NAME = "poolpart-page"
PATH = "partitions"
_ONLY = "partition"  # query parameter that selects a partition
_SHOWN_MOVES = 20  # number of moves of balanced groups on the page
_ANY_ADDRESS = "0.0.0.0"  # dashboards listen on all interfaces by default
_HUB = "JUPYTERHUB_SERVICE_PREFIX"  # environment variable that JupyterHub sets behind its proxy

# Names come from users, and tornado escapes everything that is inserted into a template.
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
h1 { margin: 0; font-size: 1.6rem; }
h1 + p { margin: 0 0 1.5rem; color: #667; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; margin-bottom: 2rem; }
caption { text-align: left; font-size: 1.2rem; font-weight: 600; }
th, td { padding: .2rem 1rem .2rem 0; border-bottom: 1px solid #8885; text-align: right; }
td.words { overflow-wrap: anywhere; }
th { font-weight: 400; color: #667; }
.words { text-align: left; }
/* On narrow windows each row is a paragraph: its name, then the names and values of its cells. */
@media (max-width: 760px) {
  table, caption, tbody { display: block; }
  tr { display: flex; flex-wrap: wrap; gap: 0 1rem; padding: .4rem 0;
    border-bottom: 1px solid #8885; }
  tr:first-of-type { display: none; }
  td { padding: 0; border: 0; }
  td:first-child { flex-basis: 100%; font-weight: 600; }
  td:not(:first-child)::before { content: attr(data-name) " "; color: #667; }
}
@media (prefers-color-scheme: dark) { h1 + p, th, td::before { color: #9aa !important; } }
</style>
<h1>Cluster partitions</h1>
<p>{{ address }}: {{ counts }}</p>
{% for title, head, rows in tables %}{% if rows %}<table>
<caption>{{ title }}</caption>
<tr>{% for name in head %}\
<th{% if name in words %} class="words"{% end %}>{{ name }}</th>{% end %}</tr>
{% for row in rows %}<tr>{% for name, cell in zip(head, row) %}\
<td data-name="{{ name }}"{% if name in words %} class="words"{% end %}>{{ str(cell)[:200] }}</td>\
{% end %}</tr>
{% end %}</table>
{% end %}{% end %}""")
_OF_A_WORKER = ("worker", "partition", "slots", "busy", "assigned tasks", "status", "address")


def render_page(scheduler: Any, only: str = "") -> bytes:
    """Return the page as HTML, with the current state of the cluster.

    If the name of a partition is passed as `only`, the page shows this partition and no pipes.
    """
    workers = workers_of(scheduler, only) if only else list(scheduler.workers.values())
    names = {*partition_names(scheduler)} | fence_names(scheduler)
    names |= {name for name, _ in statistics_of(scheduler).ended if name}
    shown = [only] if only else [*sorted(names), ""]
    partitions: list[list[object]] = []
    stages: list[list[object]] = []
    queues: list[list[object]] = []
    clients: list[list[object]] = []
    pipes: list[list[object]] = []
    for p in stats_of(shown, scheduler):
        title = f"{_label(p.name)}{' (exclusive)' * p.exclusive}"
        partitions.append([title, p.workers, p.slots, p.busy, *p.cells])
        stages += [[name, _label(p.name), *stage.cells] for name, stage in p.stages.items()]
        clients += [[client, _label(p.name), *stats.cells] for client, stats in p.clients.items()]
        if p.queue:
            queues.append([p.name, *p.queue.cells])
    rows_of_workers = sorted(
        (_worker_row(worker) for worker in workers), key=_by_partition_and_name
    )
    for name, pipe in pipes_of(scheduler).items() if not only else ():
        pipes.append([name, *pipe.summary])
    moves = recent_moves(scheduler, MAX_MOVES if only else _SHOWN_MOVES)
    if only:
        moves = [move for move in moves if only in (move.source, move.destination)]
    tables = [
        ("Partitions", ["partition", "workers", "slots", "busy", *HEAD_OF_COUNTS], partitions),
        ("Stages", ["stage", "partition", *HEAD_OF_COUNTS], stages),
        ("Clients", [HEAD_OF_CLIENTS[0], "partition", *HEAD_OF_CLIENTS[1:]], clients),
        ("Shared queues", HEAD_OF_QUEUES, queues),
        ("Workers", _OF_A_WORKER, rows_of_workers),
        ("Pipes", ["pipe", "depth", "capacity", "state"], pipes),
        ("Moves", HEAD_OF_MOVES, [move.cells for move in moves[:_SHOWN_MOVES]]),
    ]
    counts = f"workers {len(workers)}"
    if not only:
        counts += f", partitions {len(partitions) - 1}, pipes {len(pipes)}"
    return _PAGE.generate(
        tables=tables, counts=counts, words=TEXT_COLUMNS, address=scheduler.address
    )


def _label(partition: str) -> str:
    return partition or NO_PARTITION


def _worker_row(worker: Any) -> list[object]:
    partition = next((name for name, slots in worker.resources.items() if slots), "")
    return [
        worker.name,
        _label(partition),
        slots_of(worker, partition),
        running_on(worker, partition)[1],
        len(worker.processing),
        worker.status.name,
        "" if worker.name == worker.address else worker.address,
    ]


def _by_partition_and_name(row: list[object]) -> tuple[bool, str, int, str]:
    """Return the key by which a worker's row is sorted.

    The key sorts 9 before 10, and workers without a partition last.
    """
    name = str(row[0])
    partition = str(row[1])
    return partition == _label(""), partition, len(name), name


class _Handler(web.RequestHandler):
    """Request handler that sends the page and rejects requests from other websites.

    Its content security policy does not allow the browser to load or run anything else.
    """

    def initialize(self, scheduler: Any, owners: PageOwners) -> None:
        self.scheduler = scheduler
        self.names = owners.names

    def prepare(self) -> None:
        """Reject requests that come from other websites, except for links to the page."""
        reason = refusal(self.request.headers, self.names, is_page=True)
        if reason:
            self.set_status(HTTPStatus.FORBIDDEN)
            self.set_header("Content-Type", "text/plain; charset=utf-8")
            self.finish(f"{reason} Another name can be set in `distributed.dashboard.link`.")

    def get(self) -> None:
        self.set_header("Cache-Control", "no-store")
        self.set_header("Content-Security-Policy", "default-src 'none'; style-src 'unsafe-inline'")
        self.finish(render_page(self.scheduler, self.get_query_argument(_ONLY, "")))


class PageOwners(SchedulerPlugin):
    """Scheduler plugin that serves the page until all clients that opened it have left."""

    name = NAME

    def __init__(self, scheduler: Any, names: Collection[str]) -> None:
        self.owners: set[str] = set()  # IDs of the clients that have opened the page
        # Host names that requests may use. None behind a proxy whose name is unknown.
        self.names: set[str] | None = None if _HUB in os.environ else {*names}
        statistics = scheduler.plugins.get(STATISTICS)
        self.began_to_count = statistics is None or not statistics.is_kept
        # The path includes the prefix of `dask scheduler --dashboard-prefix`.
        handlers = [(r"(?:/.*)?/" + PATH, _Handler, {"scheduler": scheduler, "owners": self})]
        self.page = web.Application(handlers)
        add_pages(scheduler, self.page)

    def add_owner(self, owner: str, link: str | None) -> None:
        """Record that a client has opened the page. Keep its link to the dashboard, if known."""
        self.owners.add(owner)
        host = urlsplit(link or "").hostname
        if link and not host:  # a link relative to the page of a notebook
            self.names = None
        elif host and self.names is not None:
            self.names.add(host)

    def remove_client(self, scheduler: Any, client: str) -> None:
        """Record that a client has left or has closed the page."""
        self.owners.discard(client)
        if not self.owners:
            close_page(scheduler)
            if self.began_to_count and STEWARD not in scheduler.plugins:
                release_statistics(scheduler)


def open_page(client: Client, only: str = "") -> str:
    """Add the page to the dashboard of the client's cluster, and return its URL.

    If the name of a partition is passed as `only`, the page at the URL shows this partition.
    """
    check_client(client)
    run_on_scheduler(client, _open_page, owner=client.id, link=_dashboard_link(client))
    link = page_link(client)
    if link is None:
        raise PoolError(
            f"The scheduler at {client.scheduler.address} has no HTTP server for the page. Start "
            "the scheduler with a dashboard address, for example 127.0.0.1:8787."
        )
    return f"{link}?{urlencode({_ONLY: only})}" if only else link


def page_link(client: Client) -> str | None:
    """Return the URL that the page has while it is open, or None without an HTTP server."""
    link = _dashboard_link(client)
    return link and f"{link.removesuffix('/').removesuffix('/status')}/{PATH}"


def _dashboard_link(client: Client) -> str | None:
    """Return the URL of Dask's dashboard, or None if the scheduler has none."""
    try:
        return client.dashboard_link or None
    except KeyError:
        return None


def is_page_open(scheduler: Any) -> bool:
    """Return whether the scheduler serves the page."""
    return NAME in scheduler.plugins


async def _open_page(owner: str, link: str | None, dask_scheduler: Any = None) -> None:
    require_feature(PAGE)
    # Resolving the domain may take seconds.
    names = await asyncio.to_thread(names_of_machine, _ANY_ADDRESS)
    if owner not in dask_scheduler.clients:  # the client was killed and already removed
        return
    if NAME not in dask_scheduler.plugins:
        dask_scheduler.add_plugin(PageOwners(dask_scheduler, names))
    dask_scheduler.plugins[NAME].add_owner(owner, link)
    statistics_of(dask_scheduler)


async def leave_page(owner: str, dask_scheduler: Any = None) -> None:
    """Close the page on behalf of a client.

    The page stays open for other clients. Runs on the scheduler.
    """
    if NAME in dask_scheduler.plugins:
        dask_scheduler.plugins[NAME].remove_client(dask_scheduler, owner)


def close_page(scheduler: Any) -> None:
    """Stop serving the page."""
    if NAME in scheduler.plugins:
        remove_pages(scheduler, scheduler.plugins[NAME].page)
        scheduler.remove_plugin(NAME)


class _Page(Feature):
    """Feature that closes the page after the last partition has been dissolved."""

    def clean_up(self, scheduler: Any) -> None:
        close_page(scheduler)


FEATURES.append(_Page())
