"""A task of a partition for each item of a pipe or an iterable, with a bounded number of tasks."""

from __future__ import annotations

import reprlib
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import CancelledError
from contextlib import suppress
from typing import Any, Protocol

from dask.utils import funcname
from distributed import Client, Future, wait

from .errors import PipeFailed, PoolError
from .membership import request_capacity
from .pipe import Pipe, take_items
from .worker_wait import WorkerWait, check_wait_s

LOOK_S = 5.0  # between looks at the number of slots
MOST_PER_SLOT = 16  # tasks in flight, without a window


class TaskSubmitter(Protocol):
    """What the tasks need of a partition."""

    name: str
    by_rule: bool  # whether workers that join come by a rule

    @property
    def client(self) -> Client:
        """The client."""

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Any:
        """Submit a task."""


class _PipeItems:
    """Items that come through a pipe, whose producers wait meanwhile."""

    def __init__(self, pipe: Pipe) -> None:
        self.name = f"pipe {pipe.name!r}"
        self.closed = False  # no item can come later than now
        self.drained = False  # all items have been read
        self._pipe = pipe
        _ = pipe.client  # a thread of a worker that runs no task would get another client

    def take(self, futures: Sequence[Future], limit: int, seconds: float) -> Sequence[Any]:
        """Return up to `limit` items, as soon as there are any or a task has ended."""
        items, self.closed, self.drained = take_items(self._pipe, futures, limit, seconds)
        return items

    def fail(self, reason: str) -> None:
        """Let the producers end."""
        with suppress(PipeFailed, OSError):  # the pipe or the scheduler is gone
            self._pipe.fail(reason)


class _IterableItems:
    """Items of an iterable, taken one by one, as a slot is free."""

    name = "the iterable"
    closed = True  # none comes by itself

    def __init__(self, iterable: Iterable[Any]) -> None:
        self.drained = False
        self._iterator = iter(iterable)

    def take(self, futures: Sequence[Future], limit: int, seconds: float) -> Sequence[Any]:
        """Return the next item, as soon as the iterable has it."""
        for item in self._iterator:
            return [item]
        self.drained = True
        return []

    def fail(self, reason: str) -> None:
        """Do nothing: nobody waits."""


def _items_of(source: object) -> _PipeItems | _IterableItems:
    if isinstance(source, Pipe):
        return _PipeItems(source)
    if isinstance(source, Iterable):
        return _IterableItems(source)
    raise PoolError(f"`for_each` expects a pipe or an iterable of items, but got {source!r}.")


class ItemTasks:
    """Tasks for the items of a pipe or an iterable, at most `window` of them under way.

    No window is two tasks a slot, so that each slot has the next item at hand. The number doubles
    if fewer tasks than slots are left of a full window by the time this process notices: then slots
    were idle. Items that have no task yet stay where they are, so that producers wait when the
    tasks are slower than they are.
    """

    def __init__(
        self,
        partition: TaskSubmitter,
        source: Pipe | Iterable[Any],
        function: Callable[..., Any],
        window: int | None,
        options: dict[str, Any],
        empty_s: float,
    ) -> None:
        check_wait_s(empty_s)
        if window is not None and (not isinstance(window, int) or window < 1):
            raise ValueError(
                f"Invalid value {window!r} for `window`. Expected an integer of at least 1."
            )
        self._count = 0  # items that have a task, or had
        self._partition = partition
        self._items = _items_of(source)
        self._function = function
        self._given_window = window
        self._options = options  # takes `Partition.submit`, and keyword arguments of the function
        # {key of a task: the task, the number of its item and the item}
        self._running: dict[str, tuple[Future, int, Any]] = {}
        self._window = window or 1
        self._slots = 0  # of the partition
        self._per_slot = 2  # tasks in flight, without a window
        self._next_look = 0.0
        self._until_next_s = LOOK_S
        self._wait = WorkerWait(partition.name, "`for_each`", empty_s)
        self._stopped = False

    def run(self) -> int:
        """Run tasks until the items and all tasks have ended, and return the number of items.

        An error of a task, or of the items, cancels the other tasks; the pipe fails with it.
        """
        try:
            while self._running or not self._items.drained:
                self._look()
                free = max(0, self._window - len(self._running))
                futures = self._futures()
                if self._items.drained or (self._items.closed and not free):
                    with suppress(TimeoutError):
                        wait(futures, timeout=self._until_next_s, return_when="FIRST_COMPLETED")
                else:
                    items = self._items.take(futures, free, self._until_next_s)
                    self._submit(items)
                full = len(self._running) >= self._window
                self._check()
                if full and len(self._running) < self._slots:
                    self._per_slot = min(2 * self._per_slot, MOST_PER_SLOT)
                    self._set_window()
        except BaseException as error:
            self._cancel()
            reason = f"Function {funcname(self._function)!r} failed: {error!r}"
            self._items.fail(str(error) if isinstance(error, PoolError) else reason)
            raise
        return self._count

    def stop(self) -> None:
        """End `run` in another thread: cancel the tasks, and fail the pipe."""
        self._stopped = True
        self._items.fail(f"`for_each` with function {funcname(self._function)!r} was canceled.")
        self._cancel()

    def _cancel(self) -> None:
        """Cancel the tasks that have not started."""
        if self._partition.client.status == "running":  # else it has cancelled them itself
            self._partition.client.cancel(self._futures())

    def _futures(self) -> list[Future]:
        return [future for future, _, _ in list(self._running.values())]

    def _look(self) -> None:
        """Read the number of slots: partitions grow, shrink, and lose workers.

        PoolError if tasks could never run, or have waited for workers too long.
        """
        if time.monotonic() <= self._next_look:
            return
        partition = self._partition
        of_partition = request_capacity(
            partition.client, partition.name, self._options["slots"], partition.by_rule
        )
        self._slots = of_partition.max_running
        self._set_window()
        if self._running:
            self._wait.check(of_partition)
        self._until_next_s = self._wait.seconds_until_check(LOOK_S)
        self._next_look = time.monotonic() + self._until_next_s

    def _set_window(self) -> None:
        if self._given_window is None:
            self._window = max(2, self._per_slot * self._slots)

    def _submit(self, items: Sequence[Any]) -> None:
        """Submit a task for each item, unless this was stopped."""
        for item in items:
            if self._stopped:
                raise CancelledError
            future = self._partition.submit(self._function, item, **self._options)
            self._running[future.key] = future, self._count, item
            self._count += 1

    def _check(self) -> None:
        """Forget tasks that have ended.

        Raises the error of a failed task, or an error that says that this has stopped.
        """
        if self._stopped:
            raise CancelledError
        ended = [key for key, (future, _, _) in self._running.items() if future.done()]
        for key in ended:
            future, number, item = self._running.pop(key)
            if future.status != "finished":
                try:
                    future.result()
                except Exception as error:
                    shown = reprlib.repr(item)
                    error.add_note(
                        f"poolpart: The error occurred for item {number} of {self._items.name}: "
                        f"{shown}"
                    )
                    raise
