"""Classifies failed tasks, and names the scans of an error."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import AbstractContextManager, contextmanager

from distributed import Client, Future, KilledWorker

from lidarsim.errors import LidarError, explained
from lidarsim.io.storage import Storage
from poolpart.task_context import WorkerLeavingError

from .stage_messages import scans_in_words

ASK_S = 10.0  # wait for an error's text, which the scheduler has


class JobError(LidarError):
    """Error of a single job, after which the run goes on with the next jobs."""


class ScanError(RuntimeError):
    """Error while scans are described, cast or packed. The message names the scans."""


class DeviceLost(RuntimeError):  # noqa: N818 - reads as what happened
    """Error of a GPU after which it answers no call of the worker's process any more."""

    def __init__(self, reason: str, process: str, restarts: bool) -> None:
        super().__init__(reason, process, restarts)
        self.reason = reason
        self.process = process  # identifies the process
        self.restarts = restarts  # whether a nanny starts another process

    def __str__(self) -> str:
        return self.reason


@contextmanager
def naming_scans(first: int, stop: int) -> Iterator[None]:
    """Prefix the message of any error with the current scans.

    The error becomes a ScanError, because a ScanError can always be sent through Dask. A
    WorkerLeavingError passes unchanged, since the scans are not its cause.
    """
    try:
        yield
    except WorkerLeavingError:
        raise
    except Exception as error:
        words = scans_in_words(first, stop)
        raise ScanError(f"{words}: {type(error).__name__}: {error}") from error


def storing(storage: Storage) -> AbstractContextManager[None]:
    """Turn an OSError of the body into a LidarError with advice on storage."""
    advice = "Free space there, or choose a different location with `--scratch-dir`"
    return explained(f"The points cannot be stored in {storage.url}", advice)


def error_of(future: Future) -> BaseException | None:
    """Return the error of a failed task, or None if the task has not failed."""
    return future.exception(timeout=ASK_S) if future.status == "error" else None


def was_killed(future: Future) -> bool:
    """Return True if a task failed because its workers kept dying or its worker left."""
    return isinstance(error_of(future), (KilledWorker, WorkerLeavingError))


def raise_if_failed(future: Future, activity: str, kind: type[LidarError] = LidarError) -> None:
    """Raise `kind` if a task has failed, or LidarError if another client cancelled the task."""
    if (error := error_of(future)) is not None:
        error.__traceback__ = future.traceback(timeout=ASK_S)
        words = str(error) or type(error).__name__  # some of Dask's have no message
        raise kind(f"{activity} failed: {words}") from error
    if future.status == "cancelled":  # "lost" passes: a worker died and the task runs again
        raise LidarError(f"{activity} was cancelled by a different client.")


def memory_clause(client: Client, workers: Collection[str]) -> str:
    """Return a clause for a message if nannies ended dead workers for their memory, else ""."""
    # A nanny logs this as an event, with the address of the worker; other causes are unknown.
    events = client.get_events("worker-restart-memory")
    ended = {event.get("worker") for _, event in events} & set(workers)
    if not ended:
        return ""
    return " (terminated by their nanny because they exceeded the memory limit)"
