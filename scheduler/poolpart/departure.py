"""Telling the errors of a long task from those that the leaving of its worker makes."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager

from distributed import Status, get_worker

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
