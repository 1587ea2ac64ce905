"""Recognize the items that a task sends to a pipe again because Dask runs the task again.

The items of a task are numbered in the order in which the task sends them. If a later run of the
task sends an item with the same number and the same content, the pipe has already accepted it.

Numbers alone would not be safe. A producer that resumes where its previous run stopped, or that
reads from a live source, sends different items in its next run, and dropping them would lose data.
Such a run is recognized by its first different item, and all of its further items are accepted.
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence

# Contents are compared up to this number of items per task and pipe, which limits the memory to
# 4 MiB. A run that has repeated that many items in the same order is trusted to repeat the rest.
COMPARED = 2**20
_DIFFERENT = -1  # position of a run that has sent different items


class AcceptedItems:
    """Items that a pipe has accepted from the runs of a task.

    A run is identified by the time when it started. An earlier run may still be sending, for
    example if its worker has only lost the connection to the scheduler. Runs that send the same
    items can alternate.
    """

    __slots__ = ("_digests", "_positions", "count", "is_forgotten", "may_still_run")

    def __init__(self) -> None:
        self.count = 0  # number of items
        # Whether the task was taken from a worker while it was running. Dask does not stop running
        # functions, so it may send further items, even after the scheduler has forgotten the task.
        self.may_still_run = False
        self.is_forgotten = False  # whether the scheduler has forgotten the task
        self._digests = array("I")  # of the first `COMPARED` items
        self._positions: dict[float, int] = {}  # {run: number of its items, or _DIFFERENT}

    def starts(self, run: float) -> bool:
        """Return whether a run has not sent any items yet."""
        return run not in self._positions

    def accept_all(self, run: float) -> None:
        """From now on, accept all items of a run without remembering them."""
        self._positions[run] = _DIFFERENT

    def count_repeats(self, run: float, items: Sequence[bytes]) -> int:
        """Return how many of a run's next items repeat accepted items.

        Only items that precede the first new or different item are counted.
        """
        position = self._positions.get(run, 0)
        if position in (_DIFFERENT, self.count):  # the usual case
            return 0
        known = self._digests[position : position + len(items)]
        for number, (digest, item) in enumerate(zip(known, items, strict=False)):
            if digest != _digest(item):
                return number
        return min(len(items), self.count - position)

    def skip_repeats(self, run: float, items: Sequence[bytes]) -> int:
        """Advance a run by its repeated items, and return their number."""
        number = self.count_repeats(run, items)
        if number:
            self._positions[run] = self._positions.get(run, 0) + number
        return number

    def append(self, run: float, items: Sequence[bytes]) -> bool:
        """Add items that follow the repeated items of a run.

        Returns
        -------
        bool
            False if these are the first items of the run that differ from the accepted items. From
            now on, all items of the run are accepted, and they are not added.
        """
        position = self._positions.get(run, 0)
        if position == _DIFFERENT:
            return True
        if position != self.count:
            self.accept_all(run)
            return False
        self._digests.extend(map(_digest, items[: COMPARED - len(self._digests)]))
        self.count += len(items)
        self._positions[run] = self.count
        return True


def _digest(item: bytes) -> int:
    return hash(item) & 0xFFFFFFFF
