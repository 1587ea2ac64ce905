"""How far a run is, in words and numbers: its state, rate and stages, and its busy partitions."""

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

ASK_EVERY_S = 1.0  # how busy the partitions are
MAX_LOADS = 6  # answers to that, over which it is averaged


class RunStatus:
    """State of a run, its last progress, its rate, and the remaining time."""

    def __init__(self) -> None:
        self.state = "starting"
        self.over = False
        self.progress: Progress | None = None
        self._pace = ProgressRate()
        # The rate, and the remaining time, in words.
        self._rate = ""
        self._time_left = ""

    def update(self, progress: Progress) -> None:
        """Take a progress, and derive rate and remaining time."""
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
        """Record the end of the run, and the points of the result of a survey."""
        if self.progress is not None:
            points = self.progress.points if points is None else points
            self.progress = replace(self.progress, seconds=seconds, points=points)
        self._time_left = ""
        self.state = "done"
        self.over = True

    def news(self, is_stopping: bool) -> dict[str, Any]:
        """Return the state in words and numbers, for JSON."""
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
    """How busy the partitions of a run are: their statistics at the last moments."""

    def __init__(self) -> None:
        self.partitions: Mapping[str, Partition] = {}
        self._loads: deque[tuple[float, dict[str, PartitionStats]]] = deque(maxlen=MAX_LOADS)
        self._ask_at = 0.0

    def ask(self) -> None:
        """Ask the partitions, if the last answer is old."""
        time_s = time.monotonic()
        if time_s < self._ask_at:
            return
        self._ask_at = time_s + ASK_EVERY_S
        with suppress(OSError, RuntimeError):  # the run itself reports a lost cluster
            stats = {name: part.stats() for name, part in self.partitions.items()}
            self._loads.append((time_s, stats))

    def clear(self) -> None:
        """Forget the statistics of a run that is over."""
        self._loads.clear()

    def slots(self) -> list[Any]:
        """Return the busy slots (`busy_slots`)."""
        return busy_slots(list(self._loads))


def busy_slots(loads: Sequence[tuple[float, Mapping[str, PartitionStats]]]) -> list[Any]:
    """Return [label, share of busy slots, slots] of each partition, over moments.

    `loads` are (seconds, statistics) of the moments. Short tasks end between two moments, long
    tasks after all: the larger counts, of the slots of ended tasks and the slots held at moments.
    """
    (begin, first), *_, (end, last) = [*loads, *loads] or [(0.0, {})] * 2
    shares = []
    for name, load in last.items():
        held = sum(earlier[name].busy for _, earlier in loads) / len(loads)
        took = (load.seconds - first[name].seconds) / max(end - begin, ASK_EVERY_S)
        share = min(max(held, took) / max(load.slots, 1), 1.0)
        shares.append([f"{name}, slots busy", share, load.slots])
    return shares
