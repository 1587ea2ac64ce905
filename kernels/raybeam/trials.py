"""Choosing the fastest of several options for the same work, by trials during the work."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

import numpy as np

Option = TypeVar("Option")

TRIALS = 5  # of each option, before one is chosen
# Ratio of the times of the chosen option and of the fastest that clearly contradicts a choice: a
# single trial of a millisecond is off by a tenth on a busy machine.
_CLEAR = 1.3
# Work between two later trials, as a multiple of the work of a trial: doubles from the first to the
# last value, so that a choice by untypical work is found soon, and later trials cost little.
_FIRST_INTERVAL = 8
_LAST_INTERVAL = 256
_SLOWER_EVERY = 64  # calls, of which one uses the slower option


def clock() -> float:
    """Return the processor time of this thread, seconds.

    Elapsed time would also count other threads and programs that use the processor meanwhile. But
    on Windows the processor time of a thread advances in steps of 16 ms, longer than a trial.
    """
    return time.perf_counter() if sys.platform == "win32" else time.thread_time()


class Trials(Generic[Option]):
    """Options for the same work, of which the fastest is chosen.

    In a trial, every option does the same piece of work. After `TRIALS` trials the option with the
    smallest median is chosen. Later trials check the choice, at growing intervals: if the chosen
    option was clearly slower, the choice is made anew.

    Parameters
    ----------
    options
        At least one. The first is `current` until one is chosen.

    Attributes
    ----------
    options
        All options.
    current
        The option that does the work.

    Examples
    --------
    >>> trials = Trials(["slow", "fast"])
    >>> for seconds in [(2, 1)] * TRIALS:
    ...     trials.add(seconds)
    >>> trials.current, trials.due
    ('fast', 0)
    """

    def __init__(self, options: Sequence[Option]) -> None:
        self.options = tuple(options)
        self.current = self.options[0]
        self._ratios: list[list[float]] = []  # times of the options over the shortest, by trial
        self._chosen = len(self.options) == 1
        self._interval = float(_FIRST_INTERVAL)
        self._work_left = 0.0  # until the next trial that checks the choice

    @property
    def due(self) -> int:
        """Number of trials that are due until a choice; 1 to check a choice, 0 for none."""
        if not self._chosen:
            return TRIALS - len(self._ratios)
        return int(len(self.options) > 1 and self._work_left <= 0)

    def try_all(self, work: Callable[[Option], object], size: float) -> None:
        """Do a piece of work by every option, in this thread, and compare the times.

        `size` is the size of the piece, in the units of `worked`.
        """
        seconds = []
        for option in self.options:
            start = clock()
            work(option)
            seconds.append(clock() - start)
        self.add(seconds, size)

    def add(self, seconds: Sequence[float], size: float = 1.0) -> None:
        """Add a trial: the times of the options, and the size of the piece of work."""
        ratios = [duration / max(min(seconds), 1e-9) for duration in seconds]
        if self._chosen:
            self._work_left = self._interval * size * len(self.options)
            self._interval = min(2 * self._interval, _LAST_INTERVAL)
            if ratios[self.options.index(self.current)] <= _CLEAR:
                return
            self._chosen = False
            self._ratios = []
        self._ratios.append(ratios)
        if len(self._ratios) >= TRIALS:
            self.current = self.options[int(np.median(self._ratios, axis=0).argmin())]
            self._chosen = True
            self._work_left = self._interval * size * len(self.options)

    def worked(self, size: float) -> None:
        """Count work that was done by the current option."""
        self._work_left -= size


class Alternation:
    """Two options, of which each call uses the faster by the latest times.

    From time to time a call uses the slower option, whose times may have changed.

    Examples
    --------
    >>> alternation = Alternation()
    >>> for _ in range(2 * TRIALS):
    ...     option = alternation.next()
    ...     alternation.add(option, (2.0, 1.0)[option])
    >>> alternation.next()
    1
    """

    def __init__(self) -> None:
        # Latest times of each option. Threads replace the tuples, since they may read them.
        self._times: list[tuple[float, ...]] = [(), ()]
        self._calls = 0

    def next(self) -> int:
        """Return the number of the option for the next call: 0 or 1."""
        first, second = self._times
        if min(len(first), len(second)) < TRIALS:
            return int(len(second) < len(first))
        faster = int(sorted(second)[TRIALS // 2] < sorted(first)[TRIALS // 2])
        self._calls += 1
        return 1 - faster if self._calls % _SLOWER_EVERY == 0 else faster

    def add(self, option: int, seconds: float) -> None:
        """Add the time of a unit of work by an option."""
        self._times[option] = (*self._times[option], seconds)[-TRIALS:]
