"""Schedules for playback on a clock that all processes share, and prefetching of sweeps."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from itertools import islice
from typing import Generic, Self, TypeVar

from lidarfiles.processes.processors import processor_count
from lidarsim.numerics.arrays import Ints

Item = TypeVar("Item")
_CHECK_S = 0.1
# Maximum delay of a sweep in seconds before the user is warned.
BEHIND_S = 0.005
_MAX_THREADS = 8  # also limits the number of sweeps in memory
BEHIND = (
    "The simulation is slower than the sensor, so sweeps are sent late. Use fewer rays, "
    "sub-rays or actors, or reduce the rate (`--rate`)."
)


def casting_threads() -> int:
    """Return the number of sweeps that are simulated in parallel.

    This is the number of cores available to this process, up to 8. Multithreading within a sweep
    would be slower, because only ray casting would be parallel. The steps on the hits, which take
    half of the time, would use a single core.
    """
    return min(processor_count(), _MAX_THREADS)


class Schedule:
    """Schedule that converts survey times to `time.monotonic_ns`, which all processes share.

    `rate` is the playback speed. At a rate of 2, two seconds of the survey take one second.
    """

    def __init__(self, rate: float = 1.0) -> None:
        self.rate = rate
        self._origin_ns: float | None = None  # clock time at survey time 0

    @property
    def is_started(self) -> bool:
        """Whether the schedule has started."""
        return self._origin_ns is not None

    def start(self, time_ns: float, delay_ns: float = 0.0) -> None:
        """Start the schedule such that the survey time `time_ns` is reached after `delay_ns`."""
        self._origin_ns = time.monotonic_ns() + delay_ns - time_ns / self.rate

    def deadline_ns(self, time_ns: float) -> float:
        """Convert a survey time to a clock time in nanoseconds.

        The schedule must have been started.
        """
        assert self._origin_ns is not None
        return self._origin_ns + time_ns / self.rate

    def deadlines_ns(self, times_ns: Ints) -> Ints:
        """Convert an array of survey times to clock times in nanoseconds."""
        return (self.deadline_ns(0.0) + times_ns / self.rate).astype("<i8")

    def late_s(self, time_ns: float) -> float:
        """Return the time since a survey time in seconds. Before that time, it is negative."""
        return (time.monotonic_ns() - self.deadline_ns(time_ns)) / 1e9

    def wait_until(self, time_ns: float) -> None:
        """Sleep until a survey time is reached."""
        time.sleep(max(0.0, -self.late_s(time_ns)))


class Prefetcher(Generic[Item]):
    """Iterator over the results of tasks that threads execute in advance.

    If a task fails, its exception is raised in place of its result. Leaving the context waits for
    running tasks, and cancels the others.

    Parameters
    ----------
    tasks
        Functions without arguments.
    count
        Maximum number of tasks in advance of the consumed results. It is increased to `threads` if
        it is smaller.
    threads
        Number of tasks that run in parallel.

    Examples
    --------
    >>> with Prefetcher((str, int), count=2) as results:
    ...     list(results)
    ['', 0]
    """

    def __init__(self, tasks: Iterable[Callable[[], Item]], count: int, threads: int = 1) -> None:
        self._tasks = iter(tasks)
        self._count = max(count, threads)
        self._futures: deque[Future[Item]] = deque()
        self._pool = ThreadPoolExecutor(threads, "prefetch")

    def __enter__(self) -> Self:
        self._start_tasks()
        return self

    def __exit__(self, *error: object) -> None:
        self._pool.shutdown(cancel_futures=True)

    def __iter__(self) -> Iterator[Item]:
        while self._futures:
            first = self._futures.popleft()
            while not first.done():  # An unlimited wait might not be interrupted by Ctrl-C.
                wait([first], _CHECK_S)
            self._start_tasks()
            yield first.result()

    def _start_tasks(self) -> None:
        for task in islice(self._tasks, self._count - len(self._futures)):
            self._futures.append(self._pool.submit(task))
