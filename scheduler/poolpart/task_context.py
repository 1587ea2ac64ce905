"""Access the client of the current task's worker, and detect that this worker is leaving."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from distributed import Client, Status, default_client, get_client, get_worker

from .internals.partition_client import whole_client

_TRIES = 5
_CLOSE_S = 5.0

_one_at_a_time = threading.Lock()


def own_client() -> Client:
    """Return the client of the current task's worker, or the current client outside tasks.

    This function works around two problems of `distributed.get_client`, which creates the worker's
    client when it is first called. If the scheduler sends a message to all clients while it
    registers the new client, for example because a worker has died, the creation fails with an
    AssertionError without a message, and later tasks receive the unconnected client. If several
    tasks call it at the same time, each of them may create a client.

    In an event loop, `get_client` is called directly. A coroutine in the worker's event loop must
    not wait for a thread that creates the client, because the thread needs the event loop, which
    would be a deadlock.
    """
    if is_in_event_loop():
        return whole_client(get_client())
    with _one_at_a_time:
        for _ in range(_TRIES - 1):
            try:
                return whole_client(get_client())
            except AssertionError:
                with suppress(ValueError):  # no client was created
                    if (client := default_client()).status != "running":
                        client.close(timeout=_CLOSE_S)
        return whole_client(get_client())


def is_in_event_loop() -> bool:
    """Return whether the caller runs in an event loop and therefore must not block."""
    try:
        asyncio.get_running_loop()
    except RuntimeError:
        return False
    return True


_LEAVING = (Status.closing, Status.closed, Status.failed)


class WorkerLeavingError(RuntimeError):
    """Raised if a task has failed because its worker is leaving. Submit the task again."""


@contextmanager
def translate_leaving_errors() -> Iterator[None]:
    """Raise `WorkerLeavingError` instead of any other error if the worker is leaving.

    Use it as a decorator of a task, or as a context manager around its body. A worker that is
    retired or restarted closes its client while tasks are still running. These tasks fail with
    various errors, such as CommClosedError, CancelledError or an AttributeError inside Dask, and
    sometimes early enough for the scheduler to attribute the error to the task.

    Raises
    ------
    WorkerLeavingError
        If an error occurs while the worker is leaving. In all other cases, including code outside
        of workers, errors are not changed.
    """
    try:
        yield
    except (Exception, asyncio.CancelledError) as error:
        with suppress(ValueError):  # not in a task
            if get_worker().status in _LEAVING:
                # The cause is omitted because it may not be picklable.
                message = f"The worker has left the cluster ({type(error).__name__}: {error})"
                raise WorkerLeavingError(message) from None
        raise
