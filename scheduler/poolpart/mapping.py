"""Apply a function to many items, with several items per task and few tasks in flight.

A map over the results of another map is a single map with two stages. Each task of the first stage
is followed by a task of the second stage, which fetches the result of the first directly from its
worker.
"""

from __future__ import annotations

import heapq
import logging
import math
import queue
import reprlib
import time
import uuid
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence, Sized
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice, repeat
from typing import Any, NoReturn

import dask
from dask.sizeof import sizeof
from dask.utils import funcname
from distributed import CancelledError, Client, Future, KilledWorker, Reschedule
from distributed.protocol.pickle import dumps, loads

from .errors import PoolError, TaskTimeoutError
from .internals.client import call_when_done, gather, lend_slots
from .map_lead import LeadTime
from .membership import PartitionCapacity, request_capacity
from .setups import SETUP_COUNTS, StageSetup
from .worker_wait import WAIT_S, WorkerWait, check_wait_s

logger = logging.getLogger(__name__)

NOTE = "poolpart: "  # beginning of the notes that name a failed item
MOST_ITEMS = 1024  # maximum number of items in a chunk
MOST_TASKS = 512  # maximum number of tasks in flight, unless two per slot are more
GROWTH = 4  # maximum number of items in a chunk, relative to the number of items processed so far
MOST_BYTES = 2**20  # maximum size of the items and results of a chunk
MOST_BYTES_IN_FLIGHT = 64 * 2**20  # maximum size of all chunks, unless two per slot are more
SEND_S = 0.05  # maximum time to collect items of a slow iterable before they are sent
LOOK_S = 0.1  # minimum interval between requests for idle slots
CHECK_S = 5.0  # interval between requests for the number of slots
CHUNK_S = 0.1  # target duration of a task
CHUNK_S_PER_SLOT = 0.005  # minimum target per slot, so that the scheduler keeps up with many slots
PATIENCE = 4  # a task ends early after this multiple of the target, and its other items are resent

Call = tuple[Any, ...]  # positional arguments of a call, without the result of the previous stage
Row = tuple[Call, ...]  # calls of an item by stage


@dataclass(frozen=True)
class Chunk:
    """Items of a task, with the index of the first item and the calls in each stage."""

    first: int
    rows: Sequence[Row]


@dataclass(frozen=True)
class ChunkResult:
    """Results of a chunk, and the time spent in each stage."""

    results: list[Any]  # at least one, but not all if an item failed or the time limit was reached
    seconds: tuple[float, ...]  # duration by stage
    nbytes: int  # estimated size of the items and results of the last stage

    def __sizeof__(self) -> int:
        """Return the size of the results in bytes, which Dask uses for its memory limits."""
        return int(sizeof(self.results))


def run_chunk(
    function: Callable[..., Any],
    first: int,
    calls: Sequence[Call],
    keywords: dict[str, Any],
    previous: ChunkResult | None = None,
    *,
    patience_s: float,
    result_position: int,
    return_exceptions: bool,
    setup: StageSetup | None = None,
) -> ChunkResult:
    """Call a function for each item of a chunk. Runs on a worker.

    If the function fails for the first item of the chunk, the task fails. If the function fails for
    a later item, the task ends before that item, and the error occurs when the remaining items are
    sent again.

    Parameters
    ----------
    function, keywords
        Function and its keyword arguments.
    first
        Index of the first item of the chunk in the map.
    calls
        Positional arguments of each call, without the result of the previous stage.
    previous
        Results of the previous stage, if there is one.
    patience_s
        Time in seconds after which the task ends early. Otherwise, if items take longer than
        earlier items, they would all wait for each other on one worker.
    result_position
        Position of the previous result among the arguments.
    return_exceptions
        Whether to return the error of an item as its result.
    setup
        Setup of the stage, whose value is passed to the function before all other arguments. An
        error of the setup function makes the task fail, because no item is the cause.
    """
    if setup is not None:
        with setup.value() as value:
            return run_chunk(
                partial(function, value),
                first,
                calls,
                keywords,
                previous,
                patience_s=patience_s,
                result_position=result_position,
                return_exceptions=return_exceptions,
            )
    start = time.perf_counter()
    results: list[Any] = []
    if previous is not None:
        calls = [
            (*call[:result_position], result, *call[result_position:])
            for call, result in zip(calls, previous.results, strict=False)
        ]
    for number, call in enumerate(calls, first):
        try:
            results.append(_call(function, call, keywords))
        except Reschedule:
            raise
        except Exception as error:
            if results and not return_exceptions:
                break
            shown = ", ".join(reprlib.repr(argument) for argument in call)
            error.add_note(f"{NOTE}The error occurred for item {number} of a map: {shown}")
            if not return_exceptions:
                raise
            results.append(_sendable(error))
        if time.perf_counter() - start > patience_s:
            break
    before = () if previous is None else previous.seconds
    seconds = (*before, time.perf_counter() - start)
    return ChunkResult(results, seconds, sizeof(calls) + sizeof(results))


def _call(function: Callable[..., Any], call: Call, keywords: dict[str, Any]) -> Any:
    try:
        return function(*call, **keywords)
    except StopIteration as error:
        # A StopIteration that is raised in an iterator's `__next__` would end the map silently.
        raise RuntimeError(f"{function} raised StopIteration") from error


def _sendable(error: Exception) -> Exception:
    """Return a copy of an error without its traceback, or a substitute that can be pickled."""
    try:
        copy: Exception = loads(dumps(error))
    except Exception:
        copy = Exception(repr(error))
        copy.__notes__ = error.__notes__
    return copy


class ChunkSize:
    """Number of items that take about `target_s` seconds, learned from previous chunks.

    The first chunk has one item. Later chunks have at most four times as many items as have been
    processed so far, and their items and results are limited to about 1 MiB.

    Examples
    --------
    >>> size = ChunkSize()
    >>> size.items(target_s=0.1)
    1
    >>> for _ in range(3):  # each item takes 10 ms
    ...     size.update(items=size.items(0.1), seconds=0.01 * size.items(0.1), nbytes=100)
    ...     print(size.items(target_s=0.1))
    4
    10
    10
    """

    def __init__(self) -> None:
        self._tried = 0  # number of items processed so far
        self._item_s = self._item_bytes = 0.0  # moving averages

    def update(self, items: int, seconds: float, nbytes: int) -> None:
        """Update the averages with the measurements of a processed chunk."""
        weight = 0.3 if self._tried else 1.0
        self._item_s += weight * (seconds / items - self._item_s)
        self._item_bytes += weight * (nbytes / items - self._item_bytes)
        self._tried += items

    def items(self, target_s: float) -> int:
        """Return the number of items for the next chunk."""
        by_time = target_s / max(self._item_s, 1e-9)
        by_bytes = MOST_BYTES / max(self._item_bytes, 1.0)
        return round(max(1, min(GROWTH * self._tried, by_time, by_bytes, MOST_ITEMS)))

    def chunks(self, items: int, seconds: float, nbytes: int) -> int:
        """Return how many chunks of `items` items take `seconds` or contain `nbytes` bytes.

        The smaller of both numbers is returned, or 0 if no item has been processed yet.
        """
        if not self._tried:
            return 0
        by_time = seconds / max(items * self._item_s, 1e-9)
        by_bytes = nbytes / max(items * self._item_bytes, 1.0)
        return int(min(by_time, by_bytes))

    def will_grow(self, items: int) -> bool:
        """Return whether chunks may grow beyond `items` once more items are processed."""
        return items >= GROWTH * self._tried


@dataclass(frozen=True)
class Stage:
    """Stage of a map, which calls one function in one partition."""

    client: Client
    partition: str
    function: Callable[..., Any]
    ordered: bool = True
    window: int | None = None
    chunk: int | None = None
    priority: int = 0
    retries: int = 0
    slots: int = 1
    return_exceptions: bool = False
    keywords: dict[str, Any] = field(default_factory=dict)
    result_position: int = 0  # position of the argument that is the result of the previous stage
    by_rule: str = ""  # see `Partition`
    empty_s: float = WAIT_S  # maximum time to wait without workers
    annotations: dict[str, Any] = field(default_factory=dict)  # of the tasks
    setup: StageSetup | None = None

    def __post_init__(self) -> None:
        for name, minimum in (("window", 1), ("chunk", 1), ("retries", 0)):
            value = getattr(self, name)
            if value is not None and (not isinstance(value, int) or value < minimum):
                raise ValueError(
                    f"Invalid value {value!r} for `{name}`. Expected an integer of at least "
                    f"{minimum}."
                )
        check_wait_s(self.empty_s)

    def request_capacity(self) -> PartitionCapacity:
        """Ask the scheduler how many tasks of this stage the partition can run, if any."""
        return request_capacity(self.client, self.partition, self.slots, self.by_rule)

    def _keys(self, firsts: Sequence[int], calls: Sequence[Sequence[Call]]) -> list[str]:
        """Return a unique key for each chunk, which names its items."""
        # Dask derives the prefix from the first word and further words of letters only.
        prefix = f"{funcname(self.function)}-map-{uuid.uuid4()}"
        return [
            f"{prefix}-item-{first}"
            if len(chunk) == 1
            else f"{prefix}-items-{first}-to-{first + len(chunk) - 1}"
            for first, chunk in zip(firsts, calls, strict=True)
        ]

    def send(
        self,
        patience_s: float,
        firsts: Sequence[int],
        calls: Sequence[Sequence[Call]],
        previous_tasks: Sequence[Future] | None = None,
    ) -> list[Future]:
        """Submit a task for each chunk, to run after the chunk's task in the previous stage."""
        # Dask only retries tasks that fail, so errors must not become results if `retries` is set.
        keep_errors = self.return_exceptions and not self.retries
        # A single message for all tasks is cheaper for the scheduler than one message per task.
        with dask.annotate(**self.annotations) if self.annotations else nullcontext():
            futures: list[Future] = self.client.map(
                partial(
                    run_chunk,
                    self.function,
                    patience_s=patience_s,
                    result_position=self.result_position,
                    return_exceptions=keep_errors,
                    setup=self.setup,
                ),
                firsts,
                calls,
                # Keyword arguments are passed as a positional argument, so that futures among them
                # are replaced by their results. Dask's own keyword arguments share a key if they
                # are large.
                [self.keywords] * len(firsts),
                *([previous_tasks] if previous_tasks else []),
                key=self._keys(firsts, calls),
                pure=False,
                priority=self.priority,
                retries=self.retries or None,
                resources={self.partition: self.slots},
            )
        return futures


class Results(Iterator[Any]):
    """Iterator over a function's results for many items, as returned by `Partition.map`.

    The first tasks start immediately. While results are read, further items are submitted and their
    results are fetched. Close or delete the iterator to stop early. It has a length if all
    iterables have a length. `done` is the number of results that have been read.

    Examples
    --------
    >>> with contextlib.closing(io.map(load, paths)) as results:         # doctest: +SKIP
    ...     first = next(results)
    """

    def __init__(self, stage: Stage, iterables: Sequence[Iterable[Any]]) -> None:
        self.done = 0
        self._stages: tuple[Stage, ...] = (stage,)
        lengths = [_length(iterable) for iterable in iterables]
        self._length = math.inf if math.inf in lengths else min(lengths, default=0)
        self._closed = False
        self._begun = False  # whether a result was requested
        self._items_read = 0  # number of items read from the source
        # Heap of items to send again: (index of the first item, items, maximum number per chunk).
        self._unfinished: list[tuple[int, Sequence[Row], int]] = []
        self._size = ChunkSize()
        self._lead = LeadTime()
        self._next_look = 0.0  # earliest time to look for idle slots again
        self._running: dict[Future, Chunk] = {}
        self._ended: queue.SimpleQueue[Future] = queue.SimpleQueue()  # tasks that have ended
        # {index of the first item: (finished chunk, its result or the failed task)}
        self._undelivered: dict[int, tuple[Chunk, ChunkResult | Future]] = {}
        self._next_item = 0  # index of the next item to deliver if the map is ordered
        self._ready: deque[Any] = deque()  # results to deliver
        self._failed: tuple[Chunk, Future] | None = None  # raised after the results in `_ready`
        if stage.setup is not None:
            stage.setup.begin(stage.client)
        maps = [n for n, i in enumerate(iterables) if isinstance(i, Results) and not i._begun]
        # A second map is an ordinary iterable, because its chunks have different items.
        previous = iterables[maps[0]] if maps else None
        if isinstance(previous, Results):
            other_iterables = [i for i in iterables if i is not previous]
            self._continue_map(previous, replace(stage, result_position=maps[0]), other_iterables)
        else:
            self._source: Iterator[Row] = ((call,) for call in zip(*iterables, strict=False))
            self._waits = [_worker_wait(stage)]
            self._update_slots()
        self._reviewed = self._capacities
        self._reviewed_at = time.monotonic()
        self._submit()

    def _continue_map(
        self, previous: Results, stage: Stage, iterables: Sequence[Iterable[Any]]
    ) -> None:
        """Add a stage to an unread map, and take over its source and its running tasks."""
        calls: Iterator[Call] = zip(*iterables, strict=False) if iterables else repeat(())
        self._stages = (*previous._stages, stage)
        self._waits = [*previous._waits, _worker_wait(stage)]
        self._source = ((*row, call) for call, row in zip(calls, previous._source, strict=False))
        self._items_read = previous._items_read
        self._update_slots()
        sent: dict[Future, Chunk] = {}
        for future, chunk in previous._running.items():
            if rows := [(*row, call) for row, call in zip(chunk.rows, calls, strict=False)]:
                sent[future] = Chunk(chunk.first, rows)
        self._run([*sent.values()], [*sent])
        previous._begun = previous._closed = True
        previous._running.clear()

    # -- iteration ---------------------------------------------------------------------

    def __next__(self) -> Any:
        self._begun = True
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
        self.done += 1
        return self._ready.popleft()

    def __len__(self) -> int:
        if self._length == math.inf:
            raise TypeError(
                "The length of a map is unknown, because one of its iterables has no length."
            )
        return int(self._length)

    def __bool__(self) -> bool:
        # Dask's `as_completed` evaluates this before it would interpret the results as futures.
        raise TypeError(
            "`Partition.map` returns an iterator of results, not futures. Iterate over it, with "
            "`ordered=False` to receive results as they complete. To obtain futures for "
            "`as_completed`, use `Partition.submit`."
        )

    def __repr__(self) -> str:
        state = "closed" if self._closed else f"{len(self._running)} tasks in flight"
        last = self._stages[-1]
        return (
            f"<Results of {funcname(last.function)} on {last.partition!r}: "
            f"{self._items_read} items taken, {state}>"
        )

    def close(self) -> None:
        """Cancel pending tasks, and discard unread results."""
        setups = [] if self._closed else [stage.setup for stage in self._stages if stage.setup]
        self._closed = True
        self._failed = None
        for held in (self._ready, self._undelivered, self._unfinished):
            held.clear()
        # Futures are released explicitly, because their callbacks hold references as well.
        for future in self._running:
            future.release()
        self._running.clear()
        for setup in setups:
            setup.end(self._stages[-1].client)

    def __del__(self) -> None:
        if not getattr(self, "_closed", True):
            self.close()

    # -- steps -------------------------------------------------------------------------

    def _step(self) -> None:
        """Wait for tasks, fetch their results, and submit further tasks."""
        if not self._running:
            self._submit()
        if self._running:
            self._grow_if_idle()
            self._collect_results(self._wait())
            self._deliver()
            self._submit()
        else:
            self.close()

    def _grow_if_idle(self) -> None:
        """Increase the lead time if the client is about to wait while some slots are idle.

        This happens in an ordered map if later tasks have finished before a slow one.
        """
        in_flight = len(self._running) - self._ended.qsize()
        if not self._ended.empty() or in_flight >= max(self._slots):
            return
        if time.monotonic() < self._next_look:
            return
        self._next_look = time.monotonic() + LOOK_S
        # The other slots may be busy with other tasks.
        self._update_slots()
        if any(capacity.free for capacity in self._capacities):
            self._lead.grow()
            self._submit()

    def _update_slots(self) -> None:
        """Update the number of slots, which changes when partitions grow, shrink, or lose workers.

        Raises
        ------
        PoolError
            If tasks of a stage could never run, or have waited too long for workers.
        """
        self._capacities = [stage.request_capacity() for stage in self._stages]
        self._slots = [of_stage.max_running for of_stage in self._capacities]
        for wait, of_stage in zip(self._waits, self._capacities, strict=True):
            wait.check(of_stage)
        until_next = min(wait.seconds_until_check(CHECK_S) for wait in self._waits)
        self._next_check = time.monotonic() + until_next

    def _submit(self) -> None:
        """Submit chunks until the window is full, in as few messages as possible."""
        size, window = self._sizes()
        free = window - len(self._running)
        # Several chunks are sent in one message, since the tasks in flight keep the slots busy.
        if self._running and free < window // 4:
            return
        # Undelivered results limit the number of new items, but not items to send again.
        fresh = free - len(self._undelivered)
        started = time.monotonic()
        chunks: list[Chunk] = []
        for number in range(free):
            chunk = self._next_chunk(size, number < fresh)
            if chunk is None:
                break
            chunks.append(chunk)
            if time.monotonic() - started > SEND_S:
                self._run(chunks)
                if self._ready or not self._ended.empty():
                    return  # deliver results before reading more of a slow iterable
                chunks = []
                started = time.monotonic()
        self._run(chunks)

    def _sizes(self) -> tuple[int, int]:
        """Return the number of items per chunk, and the maximum number of tasks in flight."""
        learned = self._size.items(self._target_s())
        given = next((stage.chunk for stage in self._stages[::-1] if stage.chunk), None)
        size = given or learned
        slots = zip(self._stages, self._slots, strict=True)
        window = sum(stage.window or max(2, 2 * number) for stage, number in slots)
        # The window only grows with the final chunk size, so that not all items of fast functions
        # are sent in the small chunks at the beginning.
        if not any(stage.window for stage in self._stages) and (
            given or not self._size.will_grow(size)
        ):
            slot_count = max(1, sum(self._slots))
            grown = self._size.chunks(size, slot_count * self._lead.seconds, MOST_BYTES_IN_FLIGHT)
            window = max(window, min(grown, MOST_TASKS // len(self._stages)))
        return size, window

    def _run(self, chunks: Sequence[Chunk], previous_tasks: list[Future] | None = None) -> None:
        """Submit chunks to all stages, or only to the last one if `previous_tasks` are given."""
        if not chunks:
            return
        firsts = [chunk.first for chunk in chunks]
        stages = list(enumerate(self._stages))
        futures = previous_tasks
        for number, stage in stages if previous_tasks is None else stages[-1:]:
            patience_s = math.inf if stage.chunk else PATIENCE * self._target_s()
            calls = [[row[number] for row in chunk.rows] for chunk in chunks]
            # Only the task of the next stage keeps the result of this stage in memory.
            futures = stage.send(patience_s, firsts, calls, futures)
        for future, chunk in zip(futures or [], chunks, strict=True):
            self._running[future] = chunk
            call_when_done(future, self._ended.put)

    def _next_chunk(self, size: int, fresh: bool) -> Chunk | None:
        """Return the next chunk, or None if no items are left.

        Items that have to be sent again come first. New items are only read if `fresh` is true.
        """
        if self._unfinished:
            first, rows, most = heapq.heappop(self._unfinished)
            size = min(size, most)
            if len(rows) > size:
                heapq.heappush(self._unfinished, (first + size, rows[size:], most))
            return Chunk(first, rows[:size])
        if not fresh:
            return None
        longest_s = math.inf if any(stage.chunk for stage in self._stages) else SEND_S
        taken: list[Row] = []
        started = time.monotonic()
        for row in islice(self._source, size):
            taken.append(row)
            if time.monotonic() - started > longest_s:
                break
        first = self._items_read
        self._items_read += len(taken)
        return Chunk(first, taken) if taken else None

    def _target_s(self) -> float:
        return max(CHUNK_S, CHUNK_S_PER_SLOT * max(self._slots))

    def _wait(self) -> list[Future]:
        """Wait until at least one task has ended. Meanwhile, the calling task lends its slots."""
        ended: list[Future] = []
        started = time.monotonic()
        with lend_slots(self._ended.empty()):
            while not ended:
                self._check_while_waiting()
                with suppress(queue.Empty):
                    ended.append(self._ended.get(timeout=1))
        self._lead.count_wait(time.monotonic() - started)
        while not self._ended.empty():
            ended.append(self._ended.get())
        return ended

    def _check_while_waiting(self) -> None:
        """Update the number of slots at intervals, and raise an error if the client was closed."""
        if self._stages[-1].client.status in ("closing", "closed"):
            raise CancelledError(
                f"The client that partition {self._stages[-1].partition!r} uses was closed."
            )
        # If the partition was dissolved, the results of finished tasks are delivered first.
        if self._ended.empty() and time.monotonic() > self._next_check:
            self._update_slots()

    def _collect_results(self, ended: list[Future]) -> None:
        """Fetch the results of all ended tasks in a single request."""
        finished = []
        for future in ended:
            if future.status == "finished":
                finished.append(future)
            elif future.status in ("pending", "lost"):  # lost with its worker, and runs again
                call_when_done(future, self._ended.put)
            else:
                chunk = self._running.pop(future)
                self._undelivered[chunk.first] = chunk, future
        answers = gather(self._stages[-1].client, finished) if finished else ()
        for future, answer in zip(finished, answers, strict=True):
            chunk = self._running.pop(future)
            self._undelivered[chunk.first] = chunk, answer
            self._size.update(max(1, len(answer.results)), sum(answer.seconds), answer.nbytes)
            self._lead.count_task(self._busy_s(answer.seconds))
        if self._lead.is_short(self._sizes()[1]):
            self._lead.review(self._idle_fraction())

    def _idle_fraction(self) -> float:
        """Return for which fraction of the slot time slots had no task since the last call."""
        earlier, since = self._reviewed, self._reviewed_at
        self._update_slots()
        self._reviewed, self._reviewed_at = self._capacities, time.monotonic()
        elapsed_s = max(self._reviewed_at - since, 1e-9)
        # In a chain of maps, the partition with the most work limits the rate.
        return min(
            (now.idle_s - before.idle_s) / (max(1, now.slots) * elapsed_s)
            for before, now in zip(earlier, self._capacities, strict=True)
        )

    def _busy_s(self, seconds: Sequence[float]) -> dict[str, float]:
        """Return the time spent in each partition, divided by the number of slots."""
        busy_s: dict[str, float] = {}
        for stage, stage_s, slots in zip(self._stages, seconds, self._slots, strict=True):
            busy_s[stage.partition] = busy_s.get(stage.partition, 0.0) + stage_s / max(1, slots)
        return busy_s

    def _deliver(self) -> None:
        """Move results to the queue of ready results when it is their turn."""
        while self._undelivered and self._failed is None:
            first = self._next_item if self._stages[-1].ordered else next(iter(self._undelivered))
            if first not in self._undelivered:
                return
            chunk, answer = self._undelivered.pop(first)
            if isinstance(answer, Future):
                error = None if answer.cancelled() else answer.exception()
                if isinstance(error, KilledWorker) and len(chunk.rows) > 1:
                    heapq.heappush(self._unfinished, (first, chunk.rows, 1))  # to find the item
                    continue
                if isinstance(error, KilledWorker | TaskTimeoutError):
                    _add_note(error, chunk, self._stages)
                if not (self._stages[-1].return_exceptions and _is_item_error(error)):
                    self._failed = chunk, answer
                    return
                answer = ChunkResult([error], (), 0)
            count = len(answer.results)
            self._ready.extend(answer.results)
            self._next_item += count
            if count < len(chunk.rows):
                heapq.heappush(self._unfinished, (first + count, chunk.rows[count:], MOST_ITEMS))

    def _raise(self, chunk: Chunk, future: Future) -> NoReturn:
        """Close the map, and raise a task's error with a note that names the items."""
        self.close()
        try:
            future.result()
        except Exception as error:
            if not (_is_item_error(error) or future.cancelled() or isinstance(error, PoolError)):
                last = chunk.first + len(chunk.rows) - 1
                error.add_note(f"{NOTE}The task processed items {chunk.first} to {last} of a map.")
            raise
        raise AssertionError("the task has not failed")


def _add_note(
    error: KilledWorker | TaskTimeoutError, chunk: Chunk, stages: Sequence[Stage]
) -> None:
    """Name the only item of a task whose workers have died, or that took too long."""
    shown = ", ".join(reprlib.repr(argument) for call in chunk.rows[0] for argument in call)
    note = f"The error occurred for item {chunk.first} of a map: {shown}"
    if isinstance(error, KilledWorker):
        note = (
            f"Workers died while they processed item {chunk.first} of a map: {shown}. If workers "
            "run several tasks at a time, another task may be the cause."
        )
    elif any(stage.setup for stage in stages):
        note = f"{note}. {SETUP_COUNTS}"
    error.add_note(NOTE + note)


def _worker_wait(stage: Stage) -> WorkerWait:
    return WorkerWait(stage.partition, "The map", stage.empty_s)


def _is_item_error(error: BaseException | None) -> bool:
    """Return whether a single item is known to be the cause of an error."""
    return any(note.startswith(NOTE) for note in getattr(error, "__notes__", ()))


def _length(iterable: Iterable[Any]) -> float:
    """Return the number of remaining items, or infinity if the iterable has no length."""
    if isinstance(iterable, Results):
        return iterable._length - iterable.done
    return len(iterable) if isinstance(iterable, Sized) else math.inf
