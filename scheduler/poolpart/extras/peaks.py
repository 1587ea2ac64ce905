"""Measure the peak memory of each stage of a partition on its workers.

Ten times a second, and when a task ends, the memory of the worker process (its resident set size)
is recorded for the stage of each running task. It includes everything else in the process, such as
libraries, stored results, and tasks that run at the same time. New maxima are sent to the scheduler
as events, and `stats.TaskStatistics` keeps them. A shorter peak within a task may be missed.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import Any

from dask.utils import key_split
from tornado.ioloop import PeriodicCallback

from ..internals.worker import resources_of
from ..stats import PEAKS

SAMPLE_S = 0.1  # interval between samples
MIN_INTERVAL_S = 0.02  # minimum time between the last sample and one at the end of a task
GROWTH = 1.02  # a maximum is sent if it exceeds the one that was sent before by this factor


class PeakMemory:
    """Highest memory of a worker process for each stage of a partition."""

    def __init__(self, worker: Any, name: str) -> None:
        self._worker = worker
        self._name = name
        self._sent: dict[str, int] = {}  # {stage: memory in bytes}
        self._sampled_at = 0.0  # time.monotonic()
        self._timer = PeriodicCallback(self._sample, 1000 * SAMPLE_S)
        self._timer.start()

    def stop(self) -> None:
        """Stop the measurement."""
        self._timer.stop()

    def transition(self, key: Any, start: str) -> None:
        """Record the memory at the end of a task."""
        if start in ("executing", "long-running"):
            if time.monotonic() - self._sampled_at < MIN_INTERVAL_S:
                return
            task = self._worker.state.tasks.get(key)
            if task is not None:
                self._record([task])

    def _sample(self) -> None:
        self._record(self._worker.state.all_running_tasks)

    def _record(self, tasks: Iterable[Any]) -> None:
        stages = {key_split(task.key) for task in tasks if self._name in resources_of(task)}
        if not stages:
            return
        self._sampled_at = time.monotonic()
        memory = self._worker.monitor.get_process_memory()
        for stage in stages:
            if memory > GROWTH * self._sent.get(stage, 0):
                self._sent[stage] = memory
                message = {"partition": self._name, "stage": stage, "bytes": memory}
                self._worker.log_event(PEAKS, message)
