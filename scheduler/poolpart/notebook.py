"""Pools and partitions as notebooks show them: a table, and a link to the page of partitions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from distributed import Client
from tornado.template import Template

from .adapting import adaptive_names
from .dashboard_page import is_open, page_link
from .errors import PoolError
from .stats import PartitionStats, stats_of
from .workers import on_scheduler

# tornado escapes all that is written into a template: names come from users.
_TABLE = Template("""<table>
<caption style="text-align: left">{{ title }}</caption>
<thead><tr>{% for name in head %}<th style="text-align: left">{{ name }}</th>{% end %}</tr></thead>
<tbody>{% for row in rows %}
<tr><td style="text-align: left">{{ row[0] }}</td>\
{% for number in row[1:] %}<td style="text-align: right">{{ number }}</td>{% end %}</tr>{% end %}
</tbody>
</table>
{% if link %}<p><a href="{{ link }}" target="_blank" rel="noreferrer">Page of partitions</a></p>\
{% else %}<p>Page of partitions: <code>pool.page()</code> opens it.</p>{% end %}""")
_PLAIN = Template("<pre>{{ text }}</pre>")
_HEAD = ("partition", "workers", "slots", "busy", "waiting", "queued", "running", "done", "failed")


def table_of_partitions(client: Client, title: str, names: Sequence[str] | None = None) -> str:
    """Return the HTML of a table of partitions, and the link to the page if the page is open.

    Parameters
    ----------
    client
        Client of the cluster.
    title
        What stands above the table, and alone where the scheduler does not answer.
    names
        Partitions of the rows; by default all that workers declare, then the remainder.
    """
    try:
        stats, has_page = on_scheduler(client, _figures, names=names)
        link = page_link(client) if has_page else None
    except (PoolError, OSError):  # the client was closed, or the scheduler lacks this package
        return _PLAIN.generate(text=title).decode()
    rows = [[part.name or "remainder", *_numbers(part)] for part in stats]
    return _TABLE.generate(title=title, head=_HEAD, rows=rows, link=link).decode()


def _numbers(part: PartitionStats) -> list[int]:
    """Return the figures of a partition in the order of the columns."""
    return [getattr(part, column) for column in _HEAD[1:]]


def _figures(
    names: Sequence[str] | None, dask_scheduler: Any = None
) -> tuple[list[PartitionStats], bool]:
    """Return the statistics of partitions, and whether the page is open; runs on the scheduler."""
    if names is None:
        workers = dask_scheduler.workers.values()
        declared = {name for worker in workers for name, n in worker.resources.items() if n}
        names = [*sorted(declared | adaptive_names(dask_scheduler)), ""]
    return stats_of(names, dask_scheduler), is_open(dask_scheduler)
