"""Determine how much work a map keeps in flight so that workers do not wait for the client."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping

LEAD_S = 1.0  # initial lead time
MOST_LEAD_S = 3600.0
IDLE = 0.1  # the lead time is too short if both sides are idle for more than this fraction


class LeadTime:
    """Amount of work in flight per slot of a map, in seconds.

    A client that computes between results, or that runs on a busy machine, sends the next tasks
    late. The lead time covers this delay. It doubles if both the slots and the client were idle for
    more than 10 % of the time over a whole window of tasks. If the client never waits, it is slower
    than the workers, and more tasks in flight would not help. The same applies if the slots were
    busy with tasks of others, which only the scheduler knows.

    Examples
    --------
    >>> lead = LeadTime()
    >>> lead.seconds
    1.0
    >>> lead.grow()
    >>> lead.seconds
    2.0
    """

    def __init__(self) -> None:
        self.seconds = LEAD_S
        self._start_period()

    def _start_period(self) -> None:
        self._since = time.monotonic()
        self._tasks = 0
        self._waited_s = 0.0
        self._busy_s: Counter[str] = Counter()  # {partition: time for which all slots were busy}

    def count_task(self, busy_s: Mapping[str, float]) -> None:
        """Record that a task has finished.

        Parameters
        ----------
        busy_s
            Time in seconds for which the task occupied a slot, divided by the number of slots, by
            partition.
        """
        self._tasks += 1
        self._busy_s.update(busy_s)

    def count_wait(self, seconds: float) -> None:
        """Record for how many seconds the client has waited for tasks."""
        self._waited_s += seconds

    def is_short(self, window: int) -> bool:
        """Return whether the lead time may be too short, after each `window` tasks.

        This is the case if the client was idle, and the slots had too few tasks of this map.
        """
        if self._tasks < window:
            return False
        elapsed_s = time.monotonic() - self._since
        # In a chain of maps, the partition with the most work limits the rate.
        idle_s = elapsed_s - max(self._busy_s.values())
        if min(idle_s, self._waited_s) > IDLE * elapsed_s:
            return True
        self._start_period()
        return False

    def review(self, idle: float) -> None:
        """Double the lead time if the slots were idle, and start the next period.

        `idle` is the fraction of the slot time for which slots had no task of any client.
        """
        if idle > IDLE:
            self.grow()
        self._start_period()

    def grow(self) -> None:
        """Double the lead time, up to `MOST_LEAD_S`."""
        self.seconds = min(2 * self.seconds, MOST_LEAD_S)
