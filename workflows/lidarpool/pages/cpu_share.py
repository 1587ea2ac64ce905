"""Limits the processor time of an activity beside a run."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager


class CpuShare:
    """A share of a core for an activity.

    Processor time, since waiting does not count.
    """

    def __init__(self, share: float) -> None:
        self._share = share
        self._due_at = 0.0

    @property
    def due(self) -> bool:
        """True if the activity may run again."""
        return self.wait_s <= 0

    @property
    def wait_s(self) -> float:
        """Seconds until the activity may run again, or 0 or less if it may now."""
        return self._due_at - time.monotonic()

    @contextmanager
    def use(self, pause_s: float = 0.0) -> Iterator[None]:
        """Delay the next run by the processor time of the body over the share, and by a pause."""
        started = time.thread_time()
        try:
            yield
        finally:
            self._due_at = max(self._due_at, time.monotonic() + pause_s)
            self._due_at += (time.thread_time() - started) / self._share
