"""A page in Dask's dashboard: partitions, their workers and tasks, and pipes."""

from __future__ import annotations

from typing import Any

from distributed import Client

from .errors import PoolError
from .page_server import PATH, close_page, is_open, open_page
from .remote import on_scheduler
from .stats_plugin import TOTALS_TOPIC


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
