"""A cluster on this machine with its client, which ends with a pool or when nobody uses it."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Mapping
from contextlib import ExitStack
from typing import Any

from distributed import Client

from ..errors import PoolError
from ..extras.background import run_in_background
from ..internals.scheduler import count_transitions
from ..pipe_states import names_of_pipes
from ..stats import statistics_of
from ..workers import run_on_scheduler
from .local import local_cluster

logger = logging.getLogger(__name__)

LOOK_EVERY_S = 1.0  # between looks whether the cluster is used


class LocalPool:
    """Cluster of `local_cluster` with a client, as `Pool.local` starts them."""

    def __init__(
        self, partitions: Mapping[str, tuple[int, int]], idle_s: float, options: dict[str, Any]
    ) -> None:
        if isinstance(idle_s, bool) or not isinstance(idle_s, int | float) or not idle_s > 0:
            raise PoolError(
                f"Invalid value {idle_s!r} for `idle_s`. Expected a positive number of seconds, "
                "for example 1800."
            )
        with ExitStack() as stack:
            cluster = stack.enter_context(local_cluster(partitions, **options))
            self.client = stack.enter_context(Client(cluster))
            run_on_scheduler(self.client, _begin_to_count)
            self._stack = stack.pop_all()
        self._closing = threading.Lock()
        self._closed = threading.Event()
        if idle_s < math.inf:
            run_in_background(lambda: self._close_when_idle(idle_s))

    def close(self) -> None:
        """Close the client and the cluster, unless they are closed."""
        self._closed.set()
        with self._closing:  # so that this also waits for the end in another thread
            self._stack.close()

    def _close_when_idle(self, idle_s: float) -> None:
        """Close everything once the cluster was not used for `idle_s` seconds."""
        last_transitions = -1
        used_at = time.monotonic()
        while not self._closed.wait(min(LOOK_EVERY_S, idle_s)):
            in_use, transitions = run_on_scheduler(self.client, _use)
            if in_use or transitions != last_transitions:  # or it was used between two looks
                last_transitions = transitions
                used_at = time.monotonic()
            elif time.monotonic() - used_at >= idle_s:
                logger.warning("The local pool was closed because it was idle for %g s.", idle_s)
                self.close()


def _begin_to_count(dask_scheduler: Any = None) -> None:
    """Count the tasks of the cluster from now on, for `Partition.stats` and `Partition.tasks`."""
    statistics_of(dask_scheduler)


def _use(dask_scheduler: Any = None) -> tuple[bool, int]:
    """Return whether a cluster has tasks, results or pipes, and a number that tasks change."""
    in_use = bool(dask_scheduler.tasks or names_of_pipes(dask_scheduler))
    return in_use, count_transitions(dask_scheduler)
