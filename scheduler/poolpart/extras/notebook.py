"""HTML representations of pools, partitions, and pipes in notebooks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from distributed import Client
from tornado.template import Template

from ..adapting import adaptive_names
from ..errors import PoolError
from ..html_table import html_paragraph, html_table
from ..membership import has_rule, partition_names
from ..partition_stats import COUNTS, NO_PARTITION, PartitionStats
from ..pipe_states import pipes_of
from ..stats import stats_of
from ..workers import run_on_scheduler
from .dashboard_page import is_page_open, page_link

_LINK = Template("""\
{% if link %}<p><a href="{{ link }}" target="_blank" rel="noreferrer">Partitions page</a></p>\
{% else %}<p>To open the partitions page, call <code>{{ opener }}</code>.</p>{% end %}""")
_PLAIN = Template("<pre>{{ text }}</pre>")
_HEAD = ("partition", "workers", "slots", "busy", *COUNTS)
_HEAD_OF_A_PIPE = ("pipe", "depth", "capacity", "state")
# Used for partitions and pipes, because there may be no variable named `pool`.
_OPENER = "Pool.from_client(client).page()"


def table_of_partitions(client: Client, title: str) -> str:
    """Return a table of all partitions as HTML, including workers and tasks without one.

    If the page is open, the table is followed by a link to it. If the scheduler is unavailable,
    only the title is returned.
    """
    try:
        rows, link = _request(client, _all_partitions)
    except (PoolError, OSError):  # the client was closed, or the scheduler lacks this package
        return _plain(title)
    return html_table(title, _HEAD, rows) + _link(link, "pool.page()")


def table_of_partition(get_client: Callable[[], Client], title: str, name: str) -> str:
    """Return a partition's statistics as HTML, or state that the partition does not exist."""
    gone = "No worker declares this partition. It was dissolved, or its workers have left."
    return _table_of_one(get_client, _one_partition, name, (title, _HEAD, gone))


def table_of_pipe(get_client: Callable[[], Client], title: str, name: str) -> str:
    """Return a pipe's state as HTML, or state that the pipe does not exist."""
    gone = "The pipe does not exist. It was deleted or never created."
    return _table_of_one(get_client, _one_pipe, name, (title, _HEAD_OF_A_PIPE, gone))


def _table_of_one(
    get_client: Callable[[], Client],
    look: Callable[..., Any],
    name: str,
    words: tuple[str, Sequence[str], str],
) -> str:
    """Return an HTML table whose only row is the result of a function on the scheduler.

    `words` contains the title, the column names, and the sentence that is shown if there is no row.
    If the scheduler is unavailable, only the title is returned.
    """
    title, head, gone = words
    try:
        row, link = _request(get_client(), look, name=name)
    except (PoolError, OSError, ValueError):  # ValueError: this process has no client
        return _plain(title)
    if row is None:
        return _plain(title) + html_paragraph(gone)
    return html_table(title, head, [row]) + _link(link, _OPENER)


def _plain(text: str) -> str:
    return _PLAIN.generate(text=text).decode()


def _link(link: str | None, opener: str) -> str:
    """Return a link to the page as HTML, or the call that opens the page."""
    return _LINK.generate(link=link, opener=opener).decode()


def _request(client: Client, look: Callable[..., Any], **arguments: Any) -> tuple[Any, str | None]:
    """Call a function on the scheduler, and return its result and the URL of an open page."""
    found, has_page = run_on_scheduler(client, look, **arguments)
    return found, page_link(client) if has_page else None


def _row(stats: PartitionStats) -> list[object]:
    return [stats.name or NO_PARTITION, *(getattr(stats, column) for column in _HEAD[1:])]


def _all_partitions(dask_scheduler: Any = None) -> tuple[list[Sequence[object]], bool]:
    """Return the rows of all partitions, and whether the page is open. Runs on the scheduler."""
    names = [*partition_names(dask_scheduler), ""]
    return [_row(stats) for stats in stats_of(names, dask_scheduler)], is_page_open(dask_scheduler)


def _one_partition(name: str, dask_scheduler: Any = None) -> tuple[Sequence[object] | None, bool]:
    """Return a partition's row (None if it does not exist), and whether the page is open.

    Partitions of a divided pool and adaptive partitions exist even without workers. Runs on the
    scheduler.
    """
    [stats] = stats_of([name], dask_scheduler)
    is_expected = has_rule(dask_scheduler, name) or name in adaptive_names(dask_scheduler)
    exists = bool(stats.workers) or is_expected
    return _row(stats) if exists else None, is_page_open(dask_scheduler)


def _one_pipe(name: str, dask_scheduler: Any = None) -> tuple[Sequence[object] | None, bool]:
    """Return a pipe's row (None if it does not exist), and whether the page is open."""
    pipe = pipes_of(dask_scheduler).get(name)
    row = None if pipe is None else [name, *pipe.summary]
    return row, is_page_open(dask_scheduler)
