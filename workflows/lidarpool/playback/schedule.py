"""When what is played leaves: deadlines by a clock that all processes share, and casting ahead."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable, Iterator
from queue import Empty, Full, Queue
from typing import Generic, Self, TypeVar

from lidarsim.base.arrays import Ints

Item = TypeVar("Item")
_CHECK_S = 0.1
# How late a sweep may be before the user reads that casting falls behind, seconds.
BEHIND_S = 0.005
BEHIND = (
    "casting falls behind: sweeps leave late. Use fewer rays, sub-rays or actors, or play slower "
    "(--rate)."
)


class Schedule:
    """Times of a survey as times of `time.monotonic_ns`, which is the same in all processes.

    `rate` is the speed of the survey: 2 plays two seconds of it in one.
    """

    def __init__(self, rate: float = 1.0) -> None:
        self.rate = rate
        self._origin_ns: float | None = None  # time by the clock at the survey's time 0

    @property
    def started(self) -> bool:
        """Whether the schedule has been started."""
        return self._origin_ns is not None

    def start(self, time_ns: float, delay_ns: float = 0.0) -> None:
        """Let a time of the survey be now, or `delay_ns` later."""
        self._origin_ns = time.monotonic_ns() + delay_ns - time_ns / self.rate

    def deadline_ns(self, time_ns: float) -> float:
        """Return a time of the survey by the clock, nanoseconds; the schedule has started."""
        assert self._origin_ns is not None
        return self._origin_ns + time_ns / self.rate

    def deadlines_ns(self, times_ns: Ints) -> Ints:
        """Return times of the survey (n,) by the clock, nanoseconds: (n,)."""
        return (self.deadline_ns(0.0) + times_ns / self.rate).astype("<i8")

    def late_s(self, time_ns: float) -> float:
        """Return by how much a time of the survey is over, seconds; negative before that time."""
        return (time.monotonic_ns() - self.deadline_ns(time_ns)) / 1e9

    def wait_until(self, time_ns: float) -> None:
        """Sleep until a time of the survey, if that is not over."""
        time.sleep(max(0.0, -self.late_s(time_ns)))


class MadeAhead(Generic[Item]):
    """Iterates over items that a thread takes from `items`, up to `count` ahead: a context manager.

    An error of `items` is raised in the place of the item. The thread ends with the context.
    """

    def __init__(self, items: Iterable[Item], count: int) -> None:
        self._items = items
        # An item, an error in the place of an item, or None after the last item.
        self._queue: Queue[tuple[Item] | BaseException | None] = Queue(count)
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._make, name="made ahead", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._stopped.set()
        self._thread.join()

    def __iter__(self) -> Iterator[Item]:
        while True:
            try:
                entry = self._queue.get(timeout=_CHECK_S)  # Ctrl-C may not end an unlimited wait
            except Empty:
                continue
            if entry is None:
                return
            if isinstance(entry, BaseException):
                raise entry
            yield entry[0]

    def _make(self) -> None:
        """Put all items into the queue, until the context ends."""
        try:
            for item in self._items:
                self._put((item,))
                if self._stopped.is_set():
                    return
            self._put(None)
        except BaseException as error:
            self._put(error)

    def _put(self, entry: tuple[Item] | BaseException | None) -> None:
        """Put an entry into the queue when the queue has room, unless the context has ended."""
        while not self._stopped.is_set():
            try:
                self._queue.put(entry, timeout=_CHECK_S)
            except Full:
                continue
            return
