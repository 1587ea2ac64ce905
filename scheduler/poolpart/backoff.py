"""Waiting between polls: short while things move, longer while they do not."""

from __future__ import annotations

import time


class Backoff:
    """Pauses that double from `least_s` to `most_s`, and start over after `reset`.

    Examples
    --------
    >>> pause = Backoff(least_s=0.001, most_s=0.004)
    >>> [pause.next() for _ in range(4)]
    [0.001, 0.002, 0.004, 0.004]
    >>> pause.reset(); pause.next()
    0.001
    """

    def __init__(self, least_s: float = 0.001, most_s: float = 0.016) -> None:
        if not 0 < least_s <= most_s:
            raise ValueError(f"Pauses must be 0 < least_s <= most_s, not {least_s} and {most_s}.")
        self.least_s, self.most_s = least_s, most_s
        self._next_s = least_s

    def next(self) -> float:
        """Seconds to pause now."""
        now, self._next_s = self._next_s, min(2 * self._next_s, self.most_s)
        return now

    def sleep(self) -> None:
        """Pause this thread."""
        time.sleep(self.next())

    def reset(self) -> None:
        """Something happened: the next pause is the shortest again."""
        self._next_s = self.least_s
