"""Several items in one task: how they run on the worker, and how many are worth a task."""

from __future__ import annotations

import reprlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any, NoReturn

from dask.sizeof import sizeof
from distributed import Reschedule
from distributed.core import clean_exception, error_message

NOTE = "poolpart: "  # how the notes that name a failed item start
MOST_ITEMS = 1024
GROWTH = 4  # from one size that was tried to the next
MOST_BYTES = 2**20

Call = tuple[Any, ...]  # the arguments of one call


@dataclass(frozen=True)
class Chunk:
    """Items that travel as one task.

    Parameters
    ----------
    first
        Index of the first of them among all items.
    calls
        Arguments of the function, item by item.
    """

    first: int
    calls: Sequence[Call]

    def __str__(self) -> str:
        last = self.first + len(self.calls) - 1
        return f"item {self.first}" if last == self.first else f"items {self.first} to {last}"


@dataclass(frozen=True)
class Failure:
    """An exception that a worker sends beside results; `reraise` raises it where it arrives."""

    exception: bytes
    traceback: bytes | None

    @classmethod
    def now(cls, error: Exception) -> Failure:
        """Of the exception that is being handled."""
        # Dask's own way of sending one: it falls back to the text of what cannot be pickled.
        message = error_message(error)
        traceback = message["traceback"]
        return cls(message["exception"].data, None if traceback is None else traceback.data)

    def reraise(self) -> NoReturn:
        """Raise the exception."""
        error: BaseException | None
        traceback: TracebackType | None
        _, error, traceback = clean_exception(self.exception, self.traceback)
        assert error is not None
        raise error.with_traceback(traceback)


@dataclass(frozen=True)
class Answer:
    """What came of a chunk.

    Parameters
    ----------
    results
        Of its first items; of all, unless one failed or the time was up.
    seconds
        Time from start to end.
    nbytes
        Estimated size of items and results.
    failure
        Of the item after the last result.
    """

    results: list[Any]
    seconds: float
    nbytes: int
    failure: Failure | None = None


def run_chunk(
    function: Callable[..., Any], patience_s: float, first: int, calls: Sequence[Call]
) -> Answer:
    """Call a function for the items of a chunk, one after the other; runs on a worker.

    It stops early when `patience_s` seconds have passed, so that items which take longer than
    those before them do not wait for each other on one worker. An error of the first item is
    the task's; a later one is sent with the results before it.
    """
    start = time.perf_counter()
    results: list[Any] = []
    failure = None
    for number, call in enumerate(calls, first):
        try:
            results.append(_call(function, call))
        except Reschedule:
            raise
        except Exception as error:
            error.add_note(f"{NOTE}this was item {number} of a map: {_shown(call)}")
            if not results:
                raise
            failure = Failure.now(error)
            break
        if time.perf_counter() - start > patience_s:
            break
    seconds = time.perf_counter() - start
    return Answer(results, seconds, sizeof(calls) + sizeof(results), failure)


def _call(function: Callable[..., Any], call: Call) -> Any:
    try:
        return function(*call)
    except StopIteration as error:
        # Out of an iterator's `__next__` it would end the map as if there were no more items.
        raise RuntimeError(f"{function} raised StopIteration") from error


def _shown(call: Call) -> str:
    return ", ".join(reprlib.repr(argument) for argument in call)


class ChunkSize:
    """How many items make a task of about `target_s` seconds, learned from those that ran.

    It starts with one, takes at most four times what was tried, and keeps a task's items and
    results to about a mebibyte.

    Examples
    --------
    >>> size = ChunkSize()
    >>> size.items(target_s=0.1)
    1
    >>> for _ in range(3):  # each item takes 10 ms
    ...     size.learn(items=size.items(0.1), seconds=0.01 * size.items(0.1), nbytes=100)
    ...     print(size.items(target_s=0.1))
    4
    10
    10
    """

    def __init__(self) -> None:
        self._tried = 0  # items in the largest chunk that has come back
        self._item_s = self._item_bytes = 0.0  # moving averages

    def learn(self, items: int, seconds: float, nbytes: int) -> None:
        """Enter a chunk that ran."""
        weight = 0.3 if self._tried else 1.0
        self._item_s += weight * (seconds / items - self._item_s)
        self._item_bytes += weight * (nbytes / items - self._item_bytes)
        self._tried = max(self._tried, items)

    def items(self, target_s: float) -> int:
        """Items to put into the next chunk."""
        by_time = target_s / max(self._item_s, 1e-9)
        by_bytes = MOST_BYTES / max(self._item_bytes, 1.0)
        return int(max(1, min(GROWTH * self._tried, by_time, by_bytes, MOST_ITEMS)))
