"""Results of one function for many items, several items in a task, with bounded work under way."""

from __future__ import annotations

import heapq
import logging
import math
import queue
import reprlib
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from itertools import islice
from types import TracebackType
from typing import Any, NoReturn

from dask.sizeof import sizeof
from dask.utils import funcname
from distributed import CancelledError, Future, Reschedule
from distributed.core import clean_exception, error_message

from .sender import Sender, when_done

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


logger = logging.getLogger(__name__)

LOOK_S = 5.0  # between looks at how many slots there are
CHUNK_S = 0.1  # a task is to take so long …
CHUNK_S_PER_SLOT = 0.005  # … or, with many slots, so long that the scheduler keeps up
PATIENCE = 4  # a task ends after so many times that; the rest of its items are sent again


@dataclass(frozen=True)
class MapOptions:
    """How to map; see `Partition.map`."""

    ordered: bool = True
    window: int | None = None
    chunk: int | None = None
    priority: int = 0
    retries: int = 0

    def __post_init__(self) -> None:
        if not isinstance(self.retries, int) or self.retries < 0:
            raise ValueError(f"retries is {self.retries!r}; give a whole number, 0 or more.")
        for name in ("window", "chunk"):
            value = getattr(self, name)
            if value is not None and (not isinstance(value, int) or value < 1):
                raise ValueError(f"{name} is {value!r}; give a whole number, 1 or more.")


class Results(Iterator[Any]):
    """Results of a function for many items, as `Partition.map` gives them.

    The first tasks start at once; further items are taken, sent and fetched while results
    are asked for. Close it, or let go of it, to stop early.
    """

    def __init__(
        self,
        sender: Sender,
        slots: Callable[[], int],
        function: Callable[..., Any],
        calls: Iterator[Call],
        total: int | None,
        options: MapOptions,
    ) -> None:
        self._closed = False
        self._sender, self._count_slots = sender, slots
        self._function, self._options = function, options
        self._source, self._total = calls, total
        self._taken = 0  # items taken from the source
        self._again: list[tuple[int, Sequence[Call]]] = []  # heap of items to be sent once more
        self._size = ChunkSize()
        self._running: dict[Future, Chunk] = {}
        self._done: queue.SimpleQueue[Future] = queue.SimpleQueue()
        # {index of its first item: a chunk that came back and was not delivered yet}
        self._back: dict[int, tuple[Chunk, Answer | Future]] = {}
        self._next_item = 0  # the one to be delivered next, if in order
        self._ready: deque[Any] = deque()  # results to be delivered
        self._failed: tuple[Chunk, Answer | Future] | None = None  # to be raised after these
        self._look()
        self._submit(wait=False)

    # -- for the user ------------------------------------------------------------------

    def __next__(self) -> Any:
        while not self._ready:
            if self._failed is not None:
                self._raise(*self._failed)
            if self._closed:
                raise StopIteration
            try:
                self._step()
            except BaseException:
                self.close()
                raise
        return self._ready.popleft()

    def __enter__(self) -> Results:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: Any, traceback: TracebackType | None
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        state = "closed" if self._closed else f"{len(self._running)} tasks under way"
        name = funcname(self._function)
        return (
            f"<Results of {name} on {self._sender.resource!r}: {self._taken} items taken, {state}>"
        )

    def close(self) -> None:
        """Stop: tasks that have not started never do, results that were not taken are dropped."""
        self._closed, self._failed = True, None
        for held in (self._ready, self._back, self._again):
            held.clear()
        # Each is released by itself: the callback that waits for it holds a reference as well.
        for future in self._running:
            future.release()
        self._running.clear()

    def __del__(self) -> None:
        if not getattr(self, "_closed", True):
            self.close()

    # -- steps -------------------------------------------------------------------------

    def _step(self) -> None:
        """Wait for tasks, take back what is done, send more."""
        if not self._running:
            self._submit(wait=True)
        if self._running:
            self._take_back(self._wait())
            self._deliver()
            self._submit(wait=False)
        else:
            self.close()

    def _look(self) -> None:
        """See how many slots there are: partitions grow, shrink, and lose workers."""
        self._slots = self._count_slots()
        self._next_look = time.monotonic() + LOOK_S
        if not self._slots:
            logger.warning("Partition %r has no workers: a map on it waits.", self._sender.resource)

    def _submit(self, wait: bool) -> None:
        """Send chunks, several in one message, up to the window."""
        window = self._options.window or max(2, 2 * self._slots)
        window = min(window, 2 * self._sender.most)  # of its quota's tasks, some are done
        free = window - len(self._running)
        # One at a time would be many messages; the rest keeps the slots busy meanwhile.
        if self._running and free < window // 4:
            return
        chunks: list[Chunk] = []
        # What came back out of turn takes room as well, but not from the items it waits for.
        fresh = free - len(self._back)
        while len(chunks) < free and (chunk := self._next_chunk(fresh=len(chunks) < fresh)):
            chunks.append(chunk)
        if not chunks:
            return
        patience_s = math.inf if self._options.chunk else PATIENCE * self._target_s()
        futures = self._sender.send_many(
            partial(run_chunk, self._function, patience_s),
            [chunk.first for chunk in chunks],
            [chunk.calls for chunk in chunks],
            key=f"map-{funcname(self._function)}",
            priority=self._options.priority,
            retries=self._options.retries,
            wait=wait,
        )
        for future, chunk in zip(futures, chunks, strict=False):
            self._running[future] = chunk
            when_done(future, self._done.put)
        for chunk in chunks[len(futures) :]:  # beyond the quota of the sender
            heapq.heappush(self._again, (chunk.first, chunk.calls))

    def _next_chunk(self, fresh: bool) -> Chunk | None:
        """Take items: first those to be sent once more, then, if `fresh`, from the source."""
        if self._again:
            first, calls = heapq.heappop(self._again)
            size = self._chunk_size(len(calls))
            if len(calls) > size:
                heapq.heappush(self._again, (first + size, calls[size:]))
            return Chunk(first, calls[:size])
        if not fresh:
            return None
        left = None if self._total is None else max(0, self._total - self._taken)
        calls = list(islice(self._source, self._chunk_size(left)))
        first, self._taken = self._taken, self._taken + len(calls)
        return Chunk(first, calls) if calls else None

    def _chunk_size(self, left: int | None) -> int:
        if self._options.chunk is not None:
            return self._options.chunk
        size = self._size.items(self._target_s())
        if left is not None:
            # Smaller towards the end, so that all slots come to it together.
            size = min(size, -(-left // (2 * max(1, self._slots))))
        return max(1, size)

    def _target_s(self) -> float:
        return max(CHUNK_S, CHUNK_S_PER_SLOT * self._slots)

    def _wait(self) -> list[Future]:
        """Wait until tasks are done."""
        done: list[Future] = []
        while not done:
            if self._sender.client.status in ("closing", "closed"):
                raise CancelledError(
                    f"The client of partition {self._sender.resource!r} was closed."
                )
            if time.monotonic() > self._next_look:
                self._look()
            with suppress(queue.Empty):
                done.append(self._done.get(timeout=1))
        while not self._done.empty():
            done.append(self._done.get())
        return done

    def _take_back(self, done: list[Future]) -> None:
        """Fetch the answers of finished tasks, all in one go."""
        finished = []
        for future in done:
            if future.status == "finished":
                finished.append(future)
            elif future.status in ("pending", "lost"):  # so was its worker: it runs once more
                when_done(future, self._done.put)
            else:
                chunk = self._running.pop(future)
                self._back[chunk.first] = chunk, future
        answers = self._sender.client.gather(finished) if finished else ()
        for future, answer in zip(finished, answers, strict=True):
            chunk = self._running.pop(future)
            self._back[chunk.first] = chunk, answer
            self._size.learn(max(1, len(answer.results)), answer.seconds, answer.nbytes)

    def _deliver(self) -> None:
        """Make results ready whose turn it is."""
        while self._back and self._failed is None:
            first = self._next_item if self._options.ordered else next(iter(self._back))
            if first not in self._back:
                return
            chunk, answer = self._back.pop(first)
            if isinstance(answer, Future):
                self._failed = chunk, answer
                return
            count = len(answer.results)
            self._ready.extend(answer.results)
            self._next_item += count
            # The item that failed is the first of a task then, which Dask runs again itself.
            if answer.failure is not None and not self._options.retries:
                self._failed = chunk, answer
            elif count < len(chunk.calls):
                heapq.heappush(self._again, (first + count, chunk.calls[count:]))

    def _raise(self, chunk: Chunk, answer: Answer | Future) -> NoReturn:
        """Stop, and raise what a task raised; a note says at which item."""
        self.close()
        try:
            if isinstance(answer, Future):
                answer.result()
            elif answer.failure is not None:
                answer.failure.reraise()
        except Exception as error:
            # Without a note of its own it comes from Dask, not from an item.
            if not any(note.startswith(NOTE) for note in getattr(error, "__notes__", ())):
                error.add_note(f"{NOTE}the task was for {chunk} of a map")
            raise
        raise AssertionError(f"the task for {chunk} has not failed")
