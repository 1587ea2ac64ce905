"""When what is played leaves: deadlines by a clock that all processes share, and casting ahead."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from itertools import islice
from typing import Generic, Self, TypeVar

from lidarsim.numerics.arrays import Ints

from ..processes.processors import processor_count

Item = TypeVar("Item")
_CHECK_S = 0.1
# How late a sweep may be before the user reads that casting falls behind, seconds.
BEHIND_S = 0.005
_MAX_THREADS = 8  # sweeps in memory are bounded as well
BEHIND = (
    "The simulation is slower than the sensor, so sweeps are sent late. Use fewer rays, "
    "sub-rays or actors, or reduce the rate (`--rate`)."
)


def casting_threads() -> int:
    """Return how many sweeps are cast at the same time: one on each core of this process, up to 8.

    The threads of a single cast share only its rays; steps on their hits, a half of the time, would
    use one core.
    """
    return min(processor_count(), _MAX_THREADS)


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
        """Return a time of the survey by the clock, nanoseconds, once the schedule has started."""
        assert self._origin_ns is not None
        return self._origin_ns + time_ns / self.rate

    def deadlines_ns(self, times_ns: Ints) -> Ints:
        """Return times of the survey (n,) by the clock, nanoseconds: (n,)."""
        return (self.deadline_ns(0.0) + times_ns / self.rate).astype("<i8")

    def late_s(self, time_ns: float) -> float:
        """Return by how much a time of the survey is over, seconds, negative before that time."""
        return (time.monotonic_ns() - self.deadline_ns(time_ns)) / 1e9

    def wait_until(self, time_ns: float) -> None:
        """Sleep until a time of the survey, if that is not over."""
        time.sleep(max(0.0, -self.late_s(time_ns)))


class MadeAhead(Generic[Item]):
    """Iterates over the results of tasks that threads run, up to `count` ahead: a context manager.

    An error of a task is raised in the place of its result. Leaving the context waits for the tasks
    under way, and drops the others.

    Parameters
    ----------
    tasks
        Functions without arguments; `threads` of them run at the same time.
    count
        Largest number of tasks that are ahead of the results taken, at least `threads`.
    threads
        Number of threads.

    Examples
    --------
    >>> with MadeAhead((str, int), count=2) as results:
    ...     list(results)
    ['', 0]
    """

    def __init__(self, tasks: Iterable[Callable[[], Item]], count: int, threads: int = 1) -> None:
        self._tasks = iter(tasks)
        self._count = max(count, threads)
        self._futures: deque[Future[Item]] = deque()
        self._pool = ThreadPoolExecutor(threads, "made ahead")

    def __enter__(self) -> Self:
        self._start_tasks()
        return self

    def __exit__(self, *error: object) -> None:
        self._pool.shutdown(cancel_futures=True)

    def __iter__(self) -> Iterator[Item]:
        while self._futures:
            first = self._futures.popleft()
            while not first.done():  # Ctrl-C may not end an unlimited wait
                wait([first], _CHECK_S)
            self._start_tasks()
            yield first.result()

    def _start_tasks(self) -> None:
        """Start tasks until `count` are ahead, or none is left."""
        for task in islice(self._tasks, self._count - len(self._futures)):
            self._futures.append(self._pool.submit(task))
