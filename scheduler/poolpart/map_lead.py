"""How much work a map keeps in flight, so that workers do not wait for the client."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping

LEAD_S = 1.0  # at first
MOST_LEAD_S = 3600.0
IDLE = 0.1  # share of the time for which both sides wait, that shows a lead which is too short


class LeadTime:
    """Work in flight for each slot of a map, in seconds.

    A client that computes between results, or a machine that is short of processor time, sends the
    next tasks late. The lead covers this delay. It doubles if, over a whole window of tasks, both
    the slots and the client were idle for a tenth of the time. If the client never waits, it is
    slower than the workers, and more tasks in flight would not help.

    Examples
    --------
    >>> lead = Lead()
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
        self._busy_s: Counter[str] = Counter()  # {partition: seconds for which all slots were busy}

    def count_task(self, busy_s: Mapping[str, float]) -> None:
        """Count a task that has come back.

        Parameters
        ----------
        busy_s
            {partition: seconds for which the task kept a slot, divided by the number of slots}
        """
        self._tasks += 1
        self._busy_s.update(busy_s)

    def count_wait(self, seconds: float) -> None:
        """Count the time for which the client waited for tasks."""
        self._waited_s += seconds

    def review(self, window: int) -> None:
        """Grow after a window of tasks during which slots and client were idle."""
        if self._tasks < window:
            return
        elapsed_s = time.monotonic() - self._since
        # Of a map of a map, the partition with the most work limits the rate.
        idle_s = elapsed_s - max(self._busy_s.values())
        if min(idle_s, self._waited_s) > IDLE * elapsed_s:
            self.grow()
        self._start_period()

    def grow(self) -> None:
        """Double the lead."""
        self.seconds = min(2 * self.seconds, MOST_LEAD_S)
