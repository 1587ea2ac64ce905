"""A local cluster and its client, which are closed together with their pool or when idle."""

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

CHECK_EVERY_S = 1.0  # interval between checks whether the cluster is in use


class LocalPool:
    """The local cluster and the client that `Pool.local` starts."""

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
        """Close the client and the cluster unless this has already been done."""
        self._closed.set()
        with self._closing:  # waits if another thread is closing the cluster
            self._stack.close()

    def _close_when_idle(self, idle_s: float) -> None:
        """Close the client and the cluster after they have not been used for `idle_s` seconds."""
        last_transitions = -1
        used_at = time.monotonic()
        while not self._closed.wait(min(CHECK_EVERY_S, idle_s)):
            in_use, transitions = run_on_scheduler(self.client, _usage)
            if in_use or transitions != last_transitions:  # used now or since the last check
                last_transitions = transitions
                used_at = time.monotonic()
            elif time.monotonic() - used_at >= idle_s:
                logger.warning("The local pool was closed because it was idle for %g s.", idle_s)
                self.close()


def _begin_to_count(dask_scheduler: Any = None) -> None:
    """Start counting tasks, so that `Partition.stats` and `Partition.tasks` are complete."""
    statistics_of(dask_scheduler)


def _usage(dask_scheduler: Any = None) -> tuple[bool, int]:
    """Return whether a cluster is in use, and its number of task transitions."""
    in_use = bool(dask_scheduler.tasks or names_of_pipes(dask_scheduler))
    return in_use, count_transitions(dask_scheduler)
