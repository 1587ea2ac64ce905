"""Status of a run, including its state, rate, stages and partition loads."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

from poolpart import Partition, PartitionStats

from ..run.progress import (
    STAGES,
    Progress,
    ProgressRate,
    format_duration,
    format_rate,
    waiting_reason,
)

POLL_EVERY_S = 1.0  # minimum time between polls of the partition statistics
MAX_LOADS = 6  # number of polls that are averaged


class RunStatus:
    """State of a run, with its latest progress, its rate and the remaining time."""

    def __init__(self) -> None:
        self.state = "starting"
        self.over = False
        self.progress: Progress | None = None
        self._pace = ProgressRate()
        # Formatted rate and remaining time.
        self._rate = ""
        self._time_left = ""

    def update(self, progress: Progress) -> None:
        """Record the progress, and estimate the rate and the remaining time."""
        self.progress = progress
        counts = (progress.collected, progress.scans)
        unit = ""
        if progress.jobs:
            counts = (progress.jobs_done, progress.jobs)
            unit = " jobs"
        if rate := self._pace.rate(progress.seconds, counts[0]):
            period = "s"
            if unit and rate < 1:
                period = "min"
                rate *= 60
            self._rate = f"{format_rate(rate)}{unit}/{period}"
            self._time_left = self._pace.time_left(progress.seconds, *counts)

    def finish(self, seconds: float, points: int | None) -> None:
        """Record that the run has ended, and how many points the result of a survey has."""
        if self.progress is not None:
            points = self.progress.points if points is None else points
            self.progress = replace(self.progress, seconds=seconds, points=points)
        self._time_left = ""
        self.state = "done"
        self.over = True

    def news(self, is_stopping: bool) -> dict[str, Any]:
        """Return the status as JSON-compatible objects."""
        progress = self.progress
        state = self.state
        if not self.over:
            if is_stopping:
                state = "stopping"
            elif progress is not None:
                state = waiting_reason(progress) or state
        return {
            "state": state,
            "over": self.over,
            "time": "" if progress is None else format_duration(progress.seconds),
            "seconds": None if progress is None else progress.seconds,
            "rate": self._rate,
            "left": self._time_left,
            "stages": [
                [label, getattr(progress, count), getattr(progress, total)]
                for label, count, total in STAGES
                if progress is not None and getattr(progress, total)
            ],
        }


class PartitionLoads:
    """Recent loads of the partitions of a run."""

    def __init__(self) -> None:
        self.partitions: Mapping[str, Partition] = {}
        self._loads: deque[tuple[float, dict[str, PartitionStats]]] = deque(maxlen=MAX_LOADS)
        self._poll_at = 0.0

    def poll(self) -> None:
        """Poll the partitions if the latest statistics are old."""
        time_s = time.monotonic()
        if time_s < self._poll_at:
            return
        self._poll_at = time_s + POLL_EVERY_S
        with suppress(OSError, RuntimeError):  # The run itself reports a lost cluster.
            stats = {name: part.stats() for name, part in self.partitions.items()}
            self._loads.append((time_s, stats))

    def clear(self) -> None:
        """Discard the statistics when the run has ended."""
        self._loads.clear()

    def slots(self) -> list[Any]:
        """Return the busy slots as described in `busy_slots`."""
        return busy_slots(list(self._loads))


def busy_slots(loads: Sequence[tuple[float, Mapping[str, PartitionStats]]]) -> list[Any]:
    """Return each partition's label, its fraction of busy slots, and its number of slots.

    `loads` are pairs of a time in seconds and the statistics at that time. Short tasks may end
    between two polls, and long tasks only end after all polls. The load is therefore estimated both
    from the run times of ended tasks and from the slots that were busy at each poll, and the larger
    estimate is used.
    """
    (begin, first), *_, (end, last) = [*loads, *loads] or [(0.0, {})] * 2
    shares = []
    for name, load in last.items():
        held = sum(earlier[name].busy for _, earlier in loads) / len(loads)
        took = (load.seconds - first[name].seconds) / max(end - begin, POLL_EVERY_S)
        share = min(max(held, took) / max(load.slots, 1), 1.0)
        shares.append([f"{name}, slots busy", share, load.slots])
    return shares
