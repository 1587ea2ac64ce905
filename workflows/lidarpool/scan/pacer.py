"""Describing scans no faster than a sensor would make them."""

from __future__ import annotations

import time

LOOK_EVERY_S = 0.05  # so that a pipe that fails is noticed


class Pacer:
    """Says which scans are due, so many a second from when it is made.

    Parameters
    ----------
    pace
        Scans a second.
    first
        The scan that is due at once.
    """

    def __init__(self, pace: float, first: int) -> None:
        self.pace, self.first = pace, first
        self._start = time.monotonic()

    @property
    def due(self) -> int:
        """One past the last scan that is due."""
        return self.first + 1 + int((time.monotonic() - self._start) * self.pace)

    def wait(self, scan: int) -> None:
        """Sleep until a scan is due, or for a moment."""
        at = self._start + (scan - self.first) / self.pace
        time.sleep(min(max(0.0, at - time.monotonic()), LOOK_EVERY_S))
