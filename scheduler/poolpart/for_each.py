"""A task of a partition for each item of a pipe, with a bounded number of tasks."""

from __future__ import annotations

import reprlib
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from dask.utils import funcname
from distributed import Future, wait

from .errors import PipeFailed, PoolError
from .membership import prospects
from .pipe import Pipe
from .worker_wait import WorkerWait, check_wait

if TYPE_CHECKING:
    from .partition import Partition

LOOK_S = 5.0  # between looks at the number of slots


class ItemTasks:
    """Tasks for the items of a pipe, of which at most `window` are under way.

    No window is two tasks a slot, so that each slot has the next item at hand. Items that have no
    task yet stay in the pipe, so that producers wait when the tasks are slower than they are.
    """

    def __init__(
        self,
        partition: Partition,
        pipe: Pipe,
        function: Callable[..., Any],
        window: int | None,
        options: dict[str, Any],
        empty_s: float,
    ) -> None:
        check_wait(empty_s)
        if window is not None and (not isinstance(window, int) or window < 1):
            raise ValueError(f"window is {window!r}; give a whole number, 1 or more.")
        self.count = 0  # items that have a task, or had
        self._partition = partition
        self._pipe = pipe
        self._function = function
        self._given_window = window
        self._options = options  # of `Partition.submit`, and keyword arguments of the function
        # {key of a task: the task, the number of its item and the item}
        self._running: dict[str, tuple[Future, int, Any]] = {}
        self._window = window or 1
        self._next_look = 0.0
        self._wait = WorkerWait(partition.name, "for_each", empty_s)

    def run(self) -> None:
        """Run tasks until the pipe is closed and all tasks have ended.

        An error of a task, or of the pipe, cancels the other tasks; the pipe fails with it.
        """
        closed = drained = False
        try:
            while self._running or not drained:
                self._look()
                free = max(0, self._window - len(self._running))
                futures = [future for future, _, _ in self._running.values()]
                if drained or (closed and not free):
                    with suppress(TimeoutError):
                        wait(futures, timeout=LOOK_S, return_when="FIRST_COMPLETED")
                else:
                    items, closed = self._pipe.take_beside(futures, free, LOOK_S)
                    drained = closed and not self._pipe.buffered and len(items) < free
                    self._submit(items)
                self._check()
        except BaseException as error:
            self._partition.client.cancel([future for future, _, _ in self._running.values()])
            if not isinstance(error, PipeFailed):
                reason = f"{funcname(self._function)} has failed: {error!r}"
                with suppress(PipeFailed, OSError):  # the pipe or the scheduler is gone
                    self._pipe.fail(str(error) if isinstance(error, PoolError) else reason)
            raise

    def _look(self) -> None:
        """Read the number of slots: partitions grow, shrink, and lose workers.

        PoolError if tasks could never run, or have waited for workers too long.
        """
        if time.monotonic() <= self._next_look:
            return
        partition = self._partition
        of_partition = prospects(
            partition.client, partition.name, self._options["slots"], partition.by_rule
        )
        if self._given_window is None:
            self._window = max(2, 2 * of_partition.running)
        if self._running:
            self._wait.check(of_partition)
        self._next_look = time.monotonic() + LOOK_S

    def _submit(self, items: Sequence[Any]) -> None:
        """Submit a task for each item."""
        for item in items:
            future = self._partition.submit(self._function, item, **self._options)
            self._running[future.key] = future, self.count, item
            self.count += 1

    def _check(self) -> None:
        """Forget tasks that have ended; raise the error of a failed task."""
        ended = [key for key, (future, _, _) in self._running.items() if future.done()]
        for key in ended:
            future, number, item = self._running.pop(key)
            if future.status != "finished":
                try:
                    future.result()
                except Exception as error:
                    shown = reprlib.repr(item)
                    error.add_note(
                        f"poolpart: this was item {number} of pipe {self._pipe.name!r}: {shown}"
                    )
                    raise
