"""What a task needs of the worker that runs it: a client, and whether the worker is leaving."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from distributed import Client, Status, default_client, get_client, get_worker

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


_LEAVING = (Status.closing, Status.closed, Status.failed)


class WorkerLeft(RuntimeError):  # noqa: N818 - reads as what happened
    """A long task has ended because its worker is leaving; start it again on another."""


@contextmanager
def telling_departure() -> Iterator[None]:
    """Raise `WorkerLeft` in place of whatever is raised while the worker is leaving.

    A worker that is retired, or started again by its nanny, closes its client under the tasks
    that still run. What they get then is anything: CommClosedError, CancelledError, an
    AttributeError from within Dask. Some get it soon enough for the scheduler to hear of it,
    and to take it for an error of theirs.

    Use it as a decorator of the task, or around its body.

    Raises
    ------
    WorkerLeft
        If the worker is leaving; errors pass through unchanged if not, and where there is no
        worker.
    """
    try:
        yield
    except (Exception, asyncio.CancelledError) as error:
        if not _is_leaving():
            raise
        # Without the cause: it travels to the client, and not everything can.
        raise WorkerLeft(f"the worker has left ({type(error).__name__}: {error})") from None


def _is_leaving() -> bool:
    try:
        return get_worker().status in _LEAVING
    except ValueError:  # not in a task
        return False
