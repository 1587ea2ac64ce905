"""Limit how long tasks wait after their partition has lost all of its workers."""

from __future__ import annotations

import logging
import math
import time

from .errors import PoolError
from .membership import PartitionCapacity

logger = logging.getLogger(__name__)

WAIT_S = 300.0  # long enough to restart or replace a machine


class WorkerWait:
    """Timer for a map or a `for_each` call in a partition without workers.

    Parameters
    ----------
    partition
        Name of the partition.
    waiting
        Subject of the messages, for example "The map".
    seconds
        Maximum time to wait while the partition has no workers and none are expected. `math.inf`
        means no limit.
    """

    def __init__(self, partition: str, waiting: str, seconds: float) -> None:
        self._partition = partition
        self._waiting = waiting
        self._seconds = seconds
        self._since: float | None = None  # time.monotonic()

    def check(self, prospects: PartitionCapacity) -> None:
        """Update the timer from the partition's current state, and warn when a wait begins.

        Raises
        ------
        PoolError
            If the tasks can never run, or if the wait has exceeded its limit.
        """
        if prospects.rejection:
            raise PoolError(prospects.rejection)
        if prospects.has_workers:
            self._since = None
            return
        if self._since is None:
            self._since = time.monotonic()
            limit = "" if math.isinf(self._seconds) else f" at most {self._seconds:g} s"
            logger.warning(
                "Partition %r has no workers. %s waits%s for a worker.",
                self._partition,
                self._waiting,
                limit,
            )
        if time.monotonic() - self._since >= self._seconds:
            raise PoolError(
                f"Partition {self._partition!r} has no workers. {self._waiting} waited "
                f"{self._seconds:g} s, and no worker is starting. Start workers with "
                f'`--resources "{self._partition}=1"`, move workers with `Partition.grow`, or pass '
                "a longer `empty_s`."
            )

    def seconds_until_check(self, longest_s: float) -> float:
        """Return the number of seconds until the next check, at most `longest_s`."""
        if self._since is None:
            return longest_s
        return max(0.0, min(longest_s, self._since + self._seconds - time.monotonic()))


def check_wait_s(seconds: object) -> None:
    """Raise ValueError if the value of `empty_s` is not a nonnegative number."""
    if isinstance(seconds, bool) or not isinstance(seconds, int | float) or not seconds >= 0:
        raise ValueError(
            f"Invalid value {seconds!r} for `empty_s`. Expected a number of seconds, for example "
            f"{WAIT_S:g}."
        )
