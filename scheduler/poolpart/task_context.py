"""The context of a task: its worker's client, and whether the worker is leaving."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from distributed import Client, Status, default_client, get_client, get_worker

_TRIES = 5
_CLOSE_S = 5.0

_one_at_a_time = threading.Lock()


def own_client() -> Client:
    """Return the client of this task's worker or, outside tasks, the current client.

    `distributed.get_client` makes the worker's client on first use. That fails, with an
    AssertionError without a message, if the scheduler broadcasts to all clients while it registers
    the new one, for example that a worker has died. The unconnected client stays the default, and
    every later task gets it. Besides, several tasks that ask at once may make a client each.

    A coroutine in the worker's event loop must not wait for a thread that makes the client, which
    needs the loop: both would wait for ever.
    """
    if in_event_loop():
        return get_client()
    with _one_at_a_time:
        for _ in range(_TRIES - 1):
            try:
                return get_client()
            except AssertionError:
                with suppress(ValueError):  # it was not made at all
                    if (client := default_client()).status != "running":
                        client.close(timeout=_CLOSE_S)
        return get_client()


def in_event_loop() -> bool:
    """Whether this runs in an event loop, which must not block, and not in a thread."""
    try:
        asyncio.get_running_loop()
    except RuntimeError:
        return False
    return True


_LEAVING = (Status.closing, Status.closed, Status.failed)


class WorkerLeavingError(RuntimeError):
    """A long task has ended because its worker is leaving.

    Submit the task again.
    """


@contextmanager
def translate_leaving_errors() -> Iterator[None]:
    """Raise `WorkerLeavingError` instead of any error while the worker is leaving.

    A worker that is retired or restarted closes its client under the tasks that still run. They
    fail with CommClosedError, CancelledError, an AttributeError from within Dask and others,
    sometimes early enough for the scheduler to record the error as theirs.

    Use it as a decorator of the task, or around its body.

    Raises
    ------
    WorkerLeavingError
        If the worker is leaving; otherwise, and outside of a worker, errors pass unchanged.
    """
    try:
        yield
    except (Exception, asyncio.CancelledError) as error:
        with suppress(ValueError):  # not in a task
            if get_worker().status in _LEAVING:
                # Without the cause, which may not be picklable.
                message = f"The worker has left the cluster ({type(error).__name__}: {error})"
                raise WorkerLeavingError(message) from None
        raise
