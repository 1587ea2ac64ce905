"""A place for one thing at a time, in which a newer one takes the older one's place."""

from __future__ import annotations

import threading
from typing import Generic, TypeVar

T = TypeVar("T")


class Latest(Generic[T]):
    """Hands the newest of many things from one thread to another, which need not keep up.

    Examples
    --------
    >>> frames = Latest()
    >>> for frame in range(3):
    ...     frames.put(frame)
    >>> frames.take(), frames.take(), frames.dropped
    (2, None, 2)
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._newest: T | None = None
        self.taken = 0  # things that were taken
        self.dropped = 0  # things that made way for a newer one

    def put(self, thing: T) -> None:
        """Leave something; never waits for whoever takes it."""
        with self._lock:
            self.dropped += self._newest is not None
            self._newest = thing

    def take(self) -> T | None:
        """Take what was left last; None if that was taken already."""
        with self._lock:
            newest, self._newest = self._newest, None
            self.taken += newest is not None
            return newest
