"""Errors of jobs and scans, and classification of failed tasks."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import TYPE_CHECKING

from lidarsim.errors import LidarError, explain_os_errors
from lidarsim.io.storage import Storage

from .stage_messages import format_scans

if TYPE_CHECKING:
    from distributed import Client, Future

ASK_S = 10.0  # time limit for fetching an error from the scheduler


class JobError(LidarError):
    """Error that affects a single job, so that the run can continue with the other jobs."""


class ScanError(RuntimeError):
    """Error while scans are described, cast or packed, with a message that names the scans."""


class DeviceLost(RuntimeError):  # noqa: N818 - the name states what happened
    """Error after which the GPU no longer responds to the worker process."""

    def __init__(self, reason: str, process: str, restarts: bool) -> None:
        super().__init__(reason, process, restarts)
        self.reason = reason
        self.process = process  # identifies the process
        self.restarts = restarts  # whether a nanny restarts the process

    def __str__(self) -> str:
        return self.reason


@contextmanager
def naming_scans(first: int, stop: int) -> Iterator[None]:
    """Convert errors in the body to a ScanError that names the scans.

    In contrast to arbitrary errors, a ScanError can always be pickled. A WorkerLeavingError is not
    converted, because it is not caused by the scans.
    """
    from poolpart.task_context import WorkerLeavingError  # imported late, as in `was_killed`

    try:
        yield
    except WorkerLeavingError:
        raise
    except Exception as error:
        words = format_scans(first, stop)
        raise ScanError(f"{words}: {type(error).__name__}: {error}") from error


def convert_storage_errors(storage: Storage) -> AbstractContextManager[None]:
    """Convert OSErrors in the body to a LidarError that suggests how to make space available."""
    advice = "Free space there, or choose a different location with `--scratch-dir`"
    return explain_os_errors(f"The points cannot be stored in {storage.url}", advice)


def error_of(future: Future) -> BaseException | None:
    """Return the error of a failed task, or None if the task has not failed."""
    return future.exception(timeout=ASK_S) if future.status == "error" else None


def was_killed(future: Future) -> bool:
    """Return True if a task failed because its worker left or its workers kept dying."""
    # These modules are imported late, because commands that run no tasks do not need Dask.
    from distributed import KilledWorker

    from poolpart.task_context import WorkerLeavingError

    return isinstance(error_of(future), (KilledWorker, WorkerLeavingError))


def raise_if_failed(future: Future, activity: str, kind: type[LidarError] = LidarError) -> None:
    """Raise an error if a task has failed.

    Parameters
    ----------
    future
        Future of the task.
    activity
        Name of the activity for the message.
    kind
        Type of the error.

    Raises
    ------
    LidarError
        If the task has failed (of type `kind`), or if a different client has cancelled it.
    """
    if (error := error_of(future)) is not None:
        error.__traceback__ = future.traceback(timeout=ASK_S)
        words = str(error) or type(error).__name__  # some of Dask's errors have no message
        raise kind(f"{activity} failed: {words}") from error
    if future.status == "cancelled":  # a "lost" task runs again
        raise LidarError(f"{activity} was cancelled by a different client.")


def memory_clause(client: Client, workers: Collection[str]) -> str:
    """Return a clause for messages if any of the workers exceeded its memory limit.

    Return an empty string if the cause of death is unknown.
    """
    # A nanny that terminates a worker because of its memory logs an event with the address.
    events = client.get_events("worker-restart-memory")
    ended = {event.get("worker") for _, event in events} & set(workers)
    if not ended:
        return ""
    return " (terminated by their nanny because they exceeded the memory limit)"
