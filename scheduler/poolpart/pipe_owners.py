"""Pipes end with the client that made them, also where it was killed: a scheduler's plugin.

Otherwise tasks at both ends would wait for it for ever, and keep their slots from whoever
comes after; Dask does not stop the thread of a task whose client has left.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from typing import Any

from distributed.diagnostics.plugin import SchedulerPlugin

NAME = "poolpart-pipe-owners"


class PipeOwners(SchedulerPlugin):
    """Knows whose each pipe is; there as long as there are pipes.

    Parameters
    ----------
    forget
        Forgets pipes by their names.
    """

    def __init__(self, forget: Callable[..., Awaitable[None]]) -> None:
        self.owners: dict[str, str] = {}  # {pipe: id of the client that made it}
        self._forget = forget
        self._under_way: set[asyncio.Future[None]] = set()  # else they might be collected

    def remove_client(self, scheduler: Any, client: str) -> None:
        """Forget the pipes of a client that has left."""
        names = [name for name, owner in self.owners.items() if owner == client]
        if names:
            work = asyncio.ensure_future(self._forget(names, dask_scheduler=scheduler))
            self._under_way.add(work)
            work.add_done_callback(self._under_way.discard)


def note_owner(
    scheduler: Any, name: str, client: str, forget: Callable[..., Awaitable[None]]
) -> None:
    """Note that a client has made a pipe."""
    if NAME not in scheduler.plugins:
        scheduler.add_plugin(PipeOwners(forget), name=NAME)
    scheduler.plugins[NAME].owners[name] = client


def drop_owners(scheduler: Any, names: Sequence[str]) -> None:
    """Note that pipes are gone; the plugin goes with the last."""
    if NAME in scheduler.plugins:
        owners = scheduler.plugins[NAME].owners
        for name in names:
            owners.pop(name, None)
        if not owners:
            scheduler.remove_plugin(NAME)
