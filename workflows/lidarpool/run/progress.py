"""Progress of a run, and its texts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

# Lines of progress: label, name of the count, and of the total, which is the unit.
STAGES: tuple[tuple[str, str, str], ...] = (
    ("1 generate", "generated", "scans"),
    ("2 intersect", "cast", "scans"),
    ("3 sort", "framed", "scans"),
    ("4 collect", "collected", "scans"),
    ("planning", "trials_done", "trials"),
    ("jobs", "jobs_done", "jobs"),
)

# The first items are slow, because workers warm up: the time left is shown after this share of
# items, or after this time.
SURE_SHARE, SURE_S = 0.05, 20.0


@dataclass(frozen=True)
class Progress:
    """Counts of a run at one moment."""

    seconds: float  # since the start
    scans: int = 0
    generated: int = 0  # scans that have passed stage 1, and so on to 4
    cast: int = 0
    framed: int = 0
    collected: int = 0
    points: int = 0
    trials: int = 0
    trials_done: int = 0
    replayed: int = 0  # batches that were sent or cast once more
    waits_for: str = ""  # partition whose slots the survey needs and other runs hold
    jobs: int = 0  # of a campaign, whose scans are not counted
    jobs_done: int = 0


Show = Callable[[Progress], None]


def is_sure(count: float, whole: float, seconds: float) -> bool:
    """Whether enough is done, after so many seconds, to estimate the time left."""
    return count >= SURE_SHARE * whole or seconds >= SURE_S


def in_words(rate: float) -> str:
    """Rate with two significant digits at least: 0.25, 3.1, 52, 1,234."""
    return f"{rate:,.0f}" if rate >= 10 else f"{rate:.2g}"


def time_in_words(seconds: float) -> str:
    """Time in words: 8 s, 3 min, 2 h 05 min."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60:,} h {minutes % 60:02} min"
