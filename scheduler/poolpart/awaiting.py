"""Waiting: between polls (`Backoff`), and on the scheduler until something happens.

Polling over the network costs a request each time, and finds news late. A request that takes
an item as soon as one comes loses the item if the client that asked has died (see `Pipe`). So
`await_news` and `await_room` ask the scheduler to wait and take nothing: their answer, early or
not, says only that it is worth looking now. An answer that nobody reads does no harm.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Collection
from typing import Any

from distributed import Client

from .remote import on_scheduler


class Backoff:
    """Pauses that double from `least_s` to `most_s`, and start over after `reset`.

    Examples
    --------
    >>> pause = Backoff(least_s=0.001, most_s=0.004)
    >>> [pause.next() for _ in range(4)]
    [0.001, 0.002, 0.004, 0.004]
    >>> pause.reset(); pause.next()
    0.001
    """

    def __init__(self, least_s: float = 0.001, most_s: float = 0.016) -> None:
        if not 0 < least_s <= most_s:
            raise ValueError(f"Pauses must be 0 < least_s <= most_s, not {least_s} and {most_s}.")
        self.least_s, self.most_s = least_s, most_s
        self._next_s = least_s

    def next(self) -> float:
        """Seconds to pause now."""
        now, self._next_s = self._next_s, min(2 * self._next_s, self.most_s)
        return now

    def sleep(self) -> None:
        """Pause this thread."""
        time.sleep(self.next())

    def reset(self) -> None:
        """Something happened: the next pause is the shortest again."""
        self._next_s = self.least_s


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


def await_room(client: Client, seconds: float, pipe: str, capacity: int) -> bool:
    """Wait until a pipe holds fewer items than so, or is closed, has failed or is gone.

    Returns
    -------
    bool
        Whether that is so; False where the wait was over before.
    """
    return bool(on_scheduler(client, _wait_for_room, seconds=seconds, pipe=pipe, most=capacity))


def take_news(
    client: Client, seconds: float, pipes: Collection[str], keys: Collection[str] = ()
) -> dict[str, list[Any]]:
    """Wait as `await_news` does, and take what is in the pipes, all in one request.

    What is taken is lost if the client that asked dies meanwhile. So it is for one whose death
    ends what it asks for anyway. Items must be plain data, not futures.

    Returns
    -------
    dict
        Items by pipe, of those that had some.
    """
    found: dict[str, list[Any]] = on_scheduler(
        client, _take, seconds=seconds, pipes=list(pipes), keys=list(keys)
    )
    return found


async def _take(
    seconds: float, pipes: list[str], keys: list[str], dask_scheduler: Any = None
) -> dict[str, list[Any]]:
    await _wait(seconds, pipes, keys, dask_scheduler)
    extension = dask_scheduler.extensions["queues"]
    found = {}
    for name in pipes:
        if name in extension.queues and not extension.queues[name].empty():
            records = await extension.get(name=name, client=None, batch=True)
            found[name] = [record["value"] for record in records]
    return found


async def _wait_for_room(seconds: float, pipe: str, most: int, dask_scheduler: Any = None) -> bool:
    queues = dask_scheduler.extensions["queues"].queues
    start = time.monotonic()
    while not _has_ended(dask_scheduler, pipe) and queues[pipe].qsize() >= most:
        waited = time.monotonic() - start
        if waited >= seconds:
            return False
        await asyncio.sleep(min(_LOOK_EVERY_S[waited > _SOON_S], seconds - waited))
    return True


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
    return any(_has_ended(scheduler, name) or not queues[name].empty() for name in pipes)


def _has_ended(scheduler: Any, name: str) -> bool:
    """Whether a pipe was closed, has failed or is gone."""
    variables = scheduler.extensions["variables"].variables
    if name not in scheduler.extensions["queues"].queues or name not in variables:
        return True
    state = variables[name]["value"]
    return bool(state["closed"] or state["failure"])


def _any_ended(scheduler: Any, keys: list[str]) -> bool:
    tasks = (scheduler.tasks.get(key) for key in keys)
    return any(task is None or task.state in ("memory", "erred") for task in tasks)
