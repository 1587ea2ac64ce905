"""How long tasks wait for a partition that has lost all its workers."""

from __future__ import annotations

import logging
import math
import time

from .errors import PoolError
from .membership import PartitionCapacity

logger = logging.getLogger(__name__)

WAIT_S = 300.0  # a machine may be restarted, or replaced, in this time


class WorkerWait:
    """Wait of a map, or the like, for the workers of a partition.

    Parameters
    ----------
    partition
        Name of the partition.
    waiting
        What waits, as the beginning of a sentence, such as "The map".
    seconds
        Longest wait while no worker is there, and none is expected; `math.inf` for ever.
    """

    def __init__(self, partition: str, waiting: str, seconds: float) -> None:
        self._partition = partition
        self._waiting = waiting
        self._seconds = seconds
        self._since: float | None = None  # time.monotonic()

    def check(self, prospects: PartitionCapacity) -> None:
        """Note the present state of the partition, and warn at the beginning of a wait.

        Raises
        ------
        PoolError
            If the tasks could never run, or the wait has been too long.
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
        """Return after how many seconds to check again, at most `longest_s`."""
        if self._since is None:
            return longest_s
        return max(0.0, min(longest_s, self._since + self._seconds - time.monotonic()))


def check_wait_s(seconds: object) -> None:
    """Raise ValueError unless a value is a number of seconds for `WorkerWait`."""
    if isinstance(seconds, bool) or not isinstance(seconds, int | float) or not seconds >= 0:
        raise ValueError(
            f"Invalid value {seconds!r} for `empty_s`. Expected a number of seconds, for example "
            f"{WAIT_S:g}."
        )
