"""A fence around a partition: other tasks stay out.

A Dask resource is a fence in one direction: tasks that ask for it run on workers that have
it, and all other tasks run there as well. A raised fence closes the other direction. Only
tasks that take a slot of the partition run on its workers; un-annotated ones, dask
collections, tasks submitted from inside other tasks, recomputed and stolen ones, actors and
the outputs of shuffles go to the remainder of the cluster, whoever submitted them and when.

What a fence does not concern: tasks that run already when it is raised go on; `Client.run`
reaches all workers; data that is scattered, replicated or rebalanced may be put anywhere
(give ``workers=`` to keep it out).

The fence lives on the scheduler until it is lowered, also when the client has gone. It
follows what the workers declare, so workers that join late, are restarted or move between
partitions need nothing else. Tasks that no worker outside may take wait; the scheduler logs
that, every client gets a warning, and statistics count them.
"""

from __future__ import annotations

from typing import Any

from distributed import Client

from .fence_plugin import fences_of, lower, raise_
from .remote import on_scheduler


def raise_fence(client: Client, name: str) -> None:
    """Keep tasks that do not ask for the resource `name` away from workers that declare it.

    Tasks that were given to such workers and have not started go elsewhere. Raising a fence
    that is there does nothing but that.

    Raises
    ------
    PoolError
        If the scheduler lacks this package, or what this needs of Dask.
    """
    on_scheduler(client, _raise, name=name)


def lower_fence(client: Client, name: str) -> None:
    """Let all tasks in again; those that wait are sent at once. Nothing is left behind."""
    on_scheduler(client, _lower, name=name)


def raised_fences(client: Client) -> frozenset[str]:
    """Names of the partitions that have a fence now."""
    return frozenset(on_scheduler(client, _names))


async def _raise(name: str, dask_scheduler: Any = None) -> None:
    await raise_(dask_scheduler, name)


async def _lower(name: str, dask_scheduler: Any = None) -> None:
    lower(dask_scheduler, name)


async def _names(dask_scheduler: Any = None) -> list[str]:
    return sorted(fences_of(dask_scheduler))
