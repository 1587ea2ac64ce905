"""Waiting on the scheduler for something to happen, without taking it.

Asking again and again costs a request each time, and finds late what came in between; a
request that takes an item when one comes loses it if whoever asked has died (see `Pipe`). So
the scheduler is asked to look out for a moment: its answer, early or not, says only that it
is worth a look now. One that nobody reads any more does no harm.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Collection
from typing import Any

from distributed import Client

from .remote import on_scheduler

_SOON_S = 0.02  # something that comes will come soon, mostly
_LOOK_EVERY_S = (0.002, 0.005)  # on the scheduler, first and then; some microseconds each time


def await_news(
    client: Client, seconds: float, pipes: Collection[str] = (), keys: Collection[str] = ()
) -> bool:
    """Wait until there is something in a pipe, or a task has ended, but no longer than so.

    Parameters
    ----------
    client
        A client of the cluster.
    seconds
        The longest wait.
    pipes
        Names of pipes; one that was closed, has failed or is gone ends the wait as well.
    keys
        Keys of tasks; one that the scheduler does not know ends the wait as well.

    Returns
    -------
    bool
        Whether something happened.
    """
    return bool(on_scheduler(client, _wait, seconds=seconds, pipes=list(pipes), keys=list(keys)))


async def _wait(
    seconds: float, pipes: list[str], keys: list[str], dask_scheduler: Any = None
) -> bool:
    start = time.monotonic()
    while not (_any_item(dask_scheduler, pipes) or _any_ended(dask_scheduler, keys)):
        waited = time.monotonic() - start
        if waited >= seconds:
            return False
        pause = _LOOK_EVERY_S[waited > _SOON_S]
        await asyncio.sleep(min(pause, seconds - waited))
    return True


def _any_item(scheduler: Any, pipes: list[str]) -> bool:
    queues = scheduler.extensions["queues"].queues
    variables = scheduler.extensions["variables"].variables
    for name in pipes:
        if name not in queues or name not in variables or not queues[name].empty():
            return True
        state = variables[name]["value"]
        if state["closed"] or state["failure"]:
            return True
    return False


def _any_ended(scheduler: Any, keys: list[str]) -> bool:
    tasks = (scheduler.tasks.get(key) for key in keys)
    return any(task is None or task.state in ("memory", "erred") for task in tasks)
