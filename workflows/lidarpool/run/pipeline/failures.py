"""Classifies failed tasks, and names the scans of an error."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import AbstractContextManager, contextmanager

from distributed import Client, Future, KilledWorker

from lidarsim.base.errors import LidarError, explained
from lidarsim.base.storage import Storage
from poolpart.task_context import WorkerLeft

from .messages import scans_in_words

ASK_S = 10.0  # for an error's text, which the scheduler has


class JobError(LidarError):
    """A survey cannot be made; others on the same workers can."""


class ScanError(RuntimeError):
    """Scans cannot be described, cast or packed; the message names them."""


@contextmanager
def naming_scans(first: int, stop: int) -> Iterator[None]:
    """Prefix the message of any error with the current scans.

    It becomes a ScanError, because that can always be sent through Dask; but a WorkerLeft passes,
    since the scans are not its cause.
    """
    try:
        yield
    except WorkerLeft:
        raise
    except Exception as error:
        words = scans_in_words(first, stop)
        raise ScanError(f"{words}: {type(error).__name__}: {error}") from error


def storing(storage: Storage) -> AbstractContextManager[None]:
    """Turn an OSError of the body into a LidarError that says what to do."""
    advice = "make room there, or give another place with --parts"
    return explained(f"The points cannot be kept in {storage.url}", advice)


def error_of(future: Future) -> BaseException | None:
    """Error of a task that has failed; None for any other."""
    return future.exception(timeout=ASK_S) if future.status == "error" else None


def was_killed(future: Future) -> bool:
    """Whether a task failed without being the cause: its workers kept dying, or its worker left."""
    return isinstance(error_of(future), (KilledWorker, WorkerLeft))


def raise_if_failed(future: Future, what: str, kind: type[LidarError] = LidarError) -> None:
    """Raise an error of a `kind` if a task has failed, LidarError if others cancelled it."""
    if (error := error_of(future)) is not None:
        error.__traceback__ = future.traceback(timeout=ASK_S)
        words = str(error) or type(error).__name__  # some of Dask's have no message
        raise kind(f"{what} failed: {words}") from error
    if future.status == "cancelled":  # "lost" passes: a worker died and the task runs again
        raise LidarError(f"{what} was cancelled from outside this run.")


def words_on_memory(client: Client, workers: Collection[str]) -> str:
    """Clause for a message about dead workers, if nannies ended them for their memory."""
    # A nanny logs this as an event, with the address of the worker; other causes are unknown.
    events = client.get_events("worker-restart-memory")
    ended = {event.get("worker") for _, event in events} & set(workers)
    if not ended:
        return ""
    return " (ended by their nanny for exceeding the memory limit)"
