"""A limit to the tasks that one user of a partition has under way."""

from __future__ import annotations

import threading
from typing import Any

from distributed import Future

from .callbacks import when_done


class Quota:
    """At most so many tasks under way at a time, counted where they are submitted.

    Dask places tasks by a worker's total resources and knows no users. So whoever submits
    holds back: one place for each task, given back when the task is done.
    """

    def __init__(self, slots: int) -> None:
        if not isinstance(slots, int) or slots < 1:
            raise ValueError(f"A quota of {slots!r} slots; give a whole number, 1 or more.")
        self.slots = slots
        self._free = threading.Semaphore(slots)

    def take(self, most: int, wait: bool) -> int:
        """Take up to so many places.

        Parameters
        ----------
        most
            Places wanted, 1 or more.
        wait
            Whether to wait until there is one; else this may be none.

        Returns
        -------
        int
            Places taken.
        """
        taken = int(self._free.acquire(blocking=wait))
        while 0 < taken < most and self._free.acquire(blocking=False):
            taken += 1
        return taken

    def watch(self, future: Future) -> None:
        """Give the task's place back when it is done, failed or cancelled."""
        when_done(future, self._done)

    def give_back(self, places: int) -> None:
        """Give places back for which no task was submitted after all."""
        self._free.release(places)

    def _done(self, _: Any) -> None:
        self._free.release()
