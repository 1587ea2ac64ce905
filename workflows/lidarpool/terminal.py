"""Progress of a run at the terminal."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)
from rich.progress import Progress as Bars
from rich.progress import Task as Bar
from rich.text import Text

from .progress import Progress

PLAIN_EVERY_S = 2.0

# Label, the count so far and the total of each line.
_LINES: tuple[tuple[str, str, str], ...] = (
    ("1 generate", "generated", "scans"),
    ("2 intersect", "cast", "scans"),
    ("3 sort frames", "framed", "scans"),
    ("4 collect", "collected", "scans"),
    ("plan path", "trials_done", "trials"),
)


class _Rate(TextColumn):
    """Items a second, which rich has only for bytes."""

    def __init__(self) -> None:
        super().__init__("")

    def render(self, task: Bar) -> Text:
        speed = task.finished_speed or task.speed
        return Text(f"{speed:,.0f}/s" if speed else "", style="progress.data.speed")


@contextmanager
def shown_progress(quiet: bool = False) -> Iterator[Callable[[Progress], None]]:
    """Show progress on stderr while the body runs; gives the function to call with it.

    Bars by stage with rates and time left on a terminal, else a line every two seconds.
    """
    if quiet:
        yield lambda progress: None
    elif sys.stderr.isatty():
        with _bars() as show:
            yield show
    else:
        yield _plain_lines()


@contextmanager
def _bars() -> Iterator[Callable[[Progress], None]]:
    columns = (
        TextColumn("{task.description:<14}"),
        BarColumn(bar_width=None),
        MofNCompleteColumn(),
        TextColumn("{task.fields[unit]:<6}"),
        _Rate(),
        TimeRemainingColumn(elapsed_when_finished=True),
    )
    with Bars(*columns, console=Console(stderr=True)) as bars:
        lines: dict[str, TaskID] = {}

        def show(progress: Progress) -> None:
            for label, done, total in _LINES:
                whole = getattr(progress, total)
                if whole and label not in lines:
                    lines[label] = bars.add_task(label, total=whole, unit=total)
                if label in lines:
                    bars.update(lines[label], completed=getattr(progress, done))

        yield show


def _plain_lines() -> Callable[[Progress], None]:
    told = float("-inf")
    finished = False

    def show(progress: Progress) -> None:
        nonlocal told, finished
        now = time.monotonic()
        over = progress.collected == progress.scans and progress.trials_done == progress.trials
        if finished or (not over and now - told < PLAIN_EVERY_S):
            return
        told, finished = now, over
        rate = progress.collected / progress.seconds if progress.seconds else 0.0
        left = (progress.scans - progress.collected) / rate if rate else float("nan")
        parts = [
            time.strftime("%H:%M:%S"),
            f"scans generated {progress.generated}, cast {progress.cast}, "
            f"sorted {progress.framed}, collected {progress.collected} of {progress.scans}",
            f"{progress.points:,} points",
            f"{rate:,.0f} scans/s",
        ]
        if progress.trials:
            parts.append(f"trials {progress.trials_done} of {progress.trials}")
        if rate and not over:
            parts.append(f"{left:.0f} s left for the survey")
        sys.stderr.write("  ".join(parts) + "\n")
        sys.stderr.flush()

    return show
