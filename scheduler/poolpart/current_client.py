"""The client that a task uses, asked for by several at once."""

from __future__ import annotations

import threading

from distributed import Client, get_client

_one_at_a_time = threading.Lock()


def own_client() -> Client:
    """Client of this task's worker; elsewhere the current one.

    `distributed.get_client` makes the worker's client when a task asks for it first. Of
    several tasks that ask at the same moment, in threads of one worker, each may make one,
    get another's that is still connecting, or fail with an AssertionError that has no words.
    """
    with _one_at_a_time:
        return get_client()
