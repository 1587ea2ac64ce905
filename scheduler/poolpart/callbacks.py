"""Hearing of tasks that have ended; a leaf module."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from distributed import Future


def when_done(future: Future, function: Callable[[Future], Any]) -> None:
    """Call `function(future)` once the task has succeeded, failed or been cancelled.

    It is called in the client's event loop and must not block. `Future.add_done_callback`
    calls in a thread that all callbacks of the process share: a user's callback that waits
    there for this one would wait for ever. It also takes a task for done whose result was lost
    with its worker, while that is computed again.
    """
    future.client.loop.add_callback(_wait, future, function)


async def _wait(future: Future, function: Callable[[Future], Any]) -> None:
    while future.status in ("pending", "lost"):
        await future._state.wait()
    function(future)
