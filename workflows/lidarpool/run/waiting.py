"""Waits at the start of a run, for a scheduler and its workers."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import cached_property

TELL_EVERY_S = 5.0  # and less often in a long wait


class Waiting:
    """Time that a start may take, and lines that say what it waits for.

    Parameters
    ----------
    seconds
        How long to wait, from the first time that it is asked or told.
    tell
        Called every few seconds with such a line.
    """

    def __init__(self, seconds: float = 0.0, tell: Callable[[str], None] = lambda words: None):
        self.seconds, self._tell = seconds, tell
        self._told = float("-inf")

    @cached_property
    def _began(self) -> float:
        return time.monotonic()

    def left(self, now: float | None = None) -> float:
        """Seconds that are left; 0 when it is over."""
        now = time.monotonic() if now is None else now
        return max(0.0, self._began + self.seconds - now)

    def tell(self, what: str, why: str) -> None:
        """Say what is waited for, if it is time to."""
        now = time.monotonic()
        if now - max(self._told, self._began) >= max(TELL_EVERY_S, (now - self._began) / 10):
            self._told = now
            self._tell(f"waiting for {what}, for another {self.left(now):.0f} s: {why}")
