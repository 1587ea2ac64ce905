"""The client that a task uses: made by one at a time, and made again where that failed."""

from __future__ import annotations

import asyncio
import threading

from distributed import Client, default_client, get_client

_TRIES = 5
_CLOSE_S = 5.0

_one_at_a_time = threading.Lock()


def own_client() -> Client:
    """Client of this task's worker; elsewhere the current one.

    `distributed.get_client` makes the worker's client when a task asks for it first, and that
    fails, with an AssertionError that has no words, when the scheduler has something to tell
    all clients in the moment in which it greets the new one: that a worker has died, say. What
    was made by then stays the default, connected to nothing, and every later task gets it.
    Besides, of several tasks that ask at the same moment each may make one.

    A coroutine, which runs in the worker's event loop, does not wait for a thread that is making
    the client, since that needs the loop: both would wait for ever.
    """
    if in_event_loop():
        return get_client()
    with _one_at_a_time:
        for _ in range(_TRIES - 1):
            try:
                return get_client()
            except AssertionError:
                _close_half_made()
        return get_client()


def in_event_loop() -> bool:
    """Whether this runs in an event loop, which must not be held up, and not in a thread."""
    try:
        asyncio.get_running_loop()
    except RuntimeError:
        return False
    return True


def _close_half_made() -> None:
    try:
        client = default_client()
    except ValueError:  # it was not made at all
        return
    if client.status != "running":
        client.close(timeout=_CLOSE_S)
