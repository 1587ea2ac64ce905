"""Implementation of `Partition.for_each`, which runs a task for each item of a pipe or iterable."""

from __future__ import annotations

import reprlib
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import CancelledError
from contextlib import suppress
from typing import Any, Protocol

from dask.utils import funcname
from distributed import Client, Future, wait

from .errors import PipeFailed, PoolError, TaskTimeoutError
from .membership import request_capacity
from .pipe import Pipe, take_items
from .setups import SETUP_COUNTS, FunctionWithSetup, StageSetup
from .worker_wait import WorkerWait, check_wait_s

CHECK_S = 5.0  # interval between requests for the number of slots
MOST_PER_SLOT = 16  # maximum number of tasks in flight per slot if no window is given


class TaskSubmitter(Protocol):
    """The part of a `Partition` that this module uses."""

    name: str
    by_rule: str  # see `Partition`

    @property
    def client(self) -> Client:
        """Client of the cluster."""

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Any:
        """Submit a task."""


class _PipeItems:
    """Items from a pipe, whose producers wait until the items are taken."""

    def __init__(self, pipe: Pipe, partition: str) -> None:
        self.name = f"pipe {pipe.name!r}"
        self._partition = partition
        self.closed = False  # whether no further items can be put into the pipe
        self.drained = False  # whether all items have been taken
        self._pipe = pipe
        _ = pipe.client  # on a worker, a thread without a task would create another client

    def next_items(self, futures: Sequence[Future], limit: int, seconds: float) -> Sequence[Any]:
        """Return up to `limit` items, after waiting for an item or the end of a task."""
        items, self.closed, self.drained = take_items(
            self._pipe, futures, limit, seconds, self._partition
        )
        return items

    def fail(self, reason: str) -> None:
        with suppress(PipeFailed, OSError):  # the pipe or the scheduler is gone
            self._pipe.fail(reason)


class _IterableItems:
    """Items from an iterable, each of which is only read when a slot is free."""

    name = "the iterable"
    closed = True  # items never arrive on their own

    def __init__(self, iterable: Iterable[Any]) -> None:
        self.drained = False
        self._iterator = iter(iterable)

    def next_items(self, futures: Sequence[Future], limit: int, seconds: float) -> Sequence[Any]:
        """Return the next item, or no items at the end of the iterable."""
        for item in self._iterator:
            return [item]
        self.drained = True
        return []

    def fail(self, reason: str) -> None:
        """Do nothing, because there are no producers."""


def _items_of(source: object, partition: str) -> _PipeItems | _IterableItems:
    if isinstance(source, Pipe):
        return _PipeItems(source, partition)
    if isinstance(source, Iterable):
        return _IterableItems(source)
    raise PoolError(f"`for_each` expects a pipe or an iterable of items, but got {source!r}.")


class ItemTasks:
    """Tasks that process the items of a pipe or iterable, at most `window` at a time.

    By default, the window is two tasks per slot, so that the next item is available when a task
    ends. It doubles if this process finds that a full window has shrunk to fewer tasks than slots,
    because this means that slots were idle. Items without a task remain in the pipe, so that
    producers wait if they are faster than the tasks.
    """

    def __init__(
        self,
        partition: TaskSubmitter,
        source: Pipe | Iterable[Any],
        function: Callable[..., Any],
        window: int | None,
        options: dict[str, Any],
        empty_s: float,
        setup: StageSetup | None = None,
    ) -> None:
        check_wait_s(empty_s)
        if window is not None and (not isinstance(window, int) or window < 1):
            raise ValueError(
                f"Invalid value {window!r} for `window`. Expected an integer of at least 1."
            )
        self._count = 0  # number of items for which a task was submitted
        self._partition = partition
        self._items = _items_of(source, partition.name)
        self._function = function if setup is None else FunctionWithSetup(function, setup)
        self._setup = setup
        self._given_window = window
        self._options = options  # for `Partition.submit`, including arguments of the function
        # {task key: (future, index of the item, item)}
        self._running: dict[str, tuple[Future, int, Any]] = {}
        self._window = window or 1
        self._slots = 0  # number of slots in the partition
        self._per_slot = 2  # number of tasks in flight per slot if no window is given
        self._next_check = 0.0
        self._until_next_s = CHECK_S
        self._wait = WorkerWait(partition.name, "`for_each`", empty_s)
        self._stopped = False

    def run(self) -> int:
        """Run tasks until all items are processed, and return the number of items.

        If a task or the source of the items raises an error, the other tasks are canceled, the pipe
        fails with the error, and the error is raised.
        """
        try:
            if self._setup is not None:
                self._setup.begin(self._partition.client)
            while self._running or not self._items.drained:
                self._update_slots()
                free = max(0, self._window - len(self._running))
                futures = self._futures()
                if self._items.drained or (self._items.closed and not free):
                    with suppress(TimeoutError):
                        wait(futures, timeout=self._until_next_s, return_when="FIRST_COMPLETED")
                else:
                    items = self._items.next_items(futures, free, self._until_next_s)
                    self._submit(items)
                full = len(self._running) >= self._window
                self._check_tasks()
                if full and len(self._running) < self._slots:
                    self._per_slot = min(2 * self._per_slot, MOST_PER_SLOT)
                    self._set_window()
        except BaseException as error:
            self._cancel()
            reason = f"Function {funcname(self._function)!r} failed: {error!r}"
            self._items.fail(str(error) if isinstance(error, PoolError) else reason)
            raise
        finally:
            if self._setup is not None:
                self._setup.end(self._partition.client)
        return self._count

    def stop(self) -> None:
        """End `run` from another thread, cancel the tasks, and make the pipe fail."""
        self._stopped = True
        self._items.fail(f"`for_each` with function {funcname(self._function)!r} was canceled.")
        self._cancel()

    def _cancel(self) -> None:
        """Cancel tasks that have not started yet."""
        if self._partition.client.status == "running":  # a closed client has canceled them itself
            self._partition.client.cancel(self._futures())

    def _futures(self) -> list[Future]:
        return [future for future, _, _ in list(self._running.values())]

    def _update_slots(self) -> None:
        """Update the number of slots, which changes when partitions grow, shrink, or lose workers.

        Raises
        ------
        PoolError
            If the tasks could never run, or have waited too long for workers.
        """
        if time.monotonic() <= self._next_check:
            return
        partition = self._partition
        of_partition = request_capacity(
            partition.client, partition.name, self._options["slots"], partition.by_rule
        )
        self._slots = of_partition.max_running
        self._set_window()
        if self._running:
            self._wait.check(of_partition)
        self._until_next_s = self._wait.seconds_until_check(CHECK_S)
        self._next_check = time.monotonic() + self._until_next_s

    def _set_window(self) -> None:
        if self._given_window is None:
            self._window = max(2, self._per_slot * self._slots)

    def _submit(self, items: Sequence[Any]) -> None:
        """Submit a task for each item unless `stop` was called."""
        for item in items:
            if self._stopped:
                raise CancelledError
            future = self._partition.submit(self._function, item, **self._options)
            self._running[future.key] = future, self._count, item
            self._count += 1

    def _check_tasks(self) -> None:
        """Remove tasks that have ended, and raise the error of a failed task.

        Raises
        ------
        CancelledError
            If `stop` was called.
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
                    if self._setup is not None and isinstance(error, TaskTimeoutError):
                        error.add_note(f"poolpart: {SETUP_COUNTS}")
                    raise
