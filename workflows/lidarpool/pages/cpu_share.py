"""Limit the CPU time of a background activity during a run."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager


class CpuShare:
    """Limiter of an activity to a fraction of a CPU core.

    Only CPU time counts, not time spent waiting.
    """

    def __init__(self, share: float) -> None:
        self._share = share
        self._due_at = 0.0

    @property
    def is_due(self) -> bool:
        """Whether the activity may run now."""
        return self.wait_s <= 0

    @property
    def wait_s(self) -> float:
        """Seconds until the activity may run again, which is 0 or negative if it may run now."""
        return self._due_at - time.monotonic()

    @contextmanager
    def use(self, pause_s: float = 0.0) -> Iterator[None]:
        """Measure the CPU time of the body to determine when the activity may run again.

        The delay is the CPU time divided by the share, plus `pause_s`.
        """
        started = time.thread_time()
        try:
            yield
        finally:
            self._due_at = max(self._due_at, time.monotonic() + pause_s)
            self._due_at += (time.thread_time() - started) / self._share
