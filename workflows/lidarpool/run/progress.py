"""Progress of a run, its texts, and what is shown of it at a terminal or in a notebook."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass

from distributed import Client
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TaskID, TextColumn
from rich.progress import Progress as Bars

from lidarsim.base.notebook import cell_display
from lidarsim.base.writing_progress import WritingProgress

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
SURE_SHARE = 0.05
SURE_S = 20.0


@dataclass(frozen=True)
class Progress:
    """Counts of a run at one moment."""

    seconds: float = 0.0  # since the start
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


def in_words(rate: float) -> str:
    """Rate with two significant digits at least: 0.25, 3.1, 52, 1,234."""
    return f"{rate:,.0f}" if rate >= 10 else f"{rate:.2g}"


def time_in_words(seconds: float) -> str:
    """Time in words: 8 s, 3 min, 2 h 05 min."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60:,} h {minutes % 60:02} min"


class Pace:
    """Rate of a count since it was first seen, and the time left."""

    def __init__(self) -> None:
        self._first: tuple[float, int] | None = None

    def rate(self, seconds: float, count: int) -> float:
        """Rate, 1/s; 0 until something has been counted."""
        begin, before = self._first = self._first or (seconds, count)
        return (count - before) / (seconds - begin) if seconds > begin else 0.0

    def left(self, seconds: float, count: int, whole: int) -> str:
        """Time that is left; empty until enough has been counted, and at the end."""
        rate = self.rate(seconds, count)
        sure = rate and (count >= SURE_SHARE * whole or seconds >= SURE_S) and count < whole
        return time_in_words((whole - count) / rate) if sure else ""

    def told(self, seconds: float, count: int, whole: int) -> str:
        """Rate and time left; empty until something has been counted."""
        rate = self.rate(seconds, count)
        left = self.left(seconds, count, whole)
        return f"{in_words(rate)}/s{f'  {left} left' if left else ''}" if rate else ""


def standing_still(progress: Progress) -> str:
    """Why the run waits; empty if it does not."""
    slots = progress.waits_for
    return f"waits for slots of {slots}, which other runs hold" if slots else ""


@contextmanager
def rows(console: Console) -> Iterator[Callable[..., None]]:
    """Bars that appear when they are first moved; yields the function that moves one."""
    columns = (
        TextColumn("{task.description:<11}"),
        BarColumn(bar_width=None),
        MofNCompleteColumn(),
        TextColumn("{task.fields[unit]:<6}"),
        TextColumn("{task.fields[pace]}", style="progress.remaining"),
    )
    with Bars(*columns, console=console) as shown:
        lines: dict[str, TaskID] = {}

        def move(label: str, done: int, total: int, unit: str, pace: str = "") -> None:
            if label not in lines:
                lines[label] = shown.add_task(label, total=total, unit=unit, pace="")
            shown.update(lines[label], completed=done, pace=pace)

        yield move


@contextmanager
def bars(console: Console) -> Iterator[Show]:
    """Bars by stage with rates and time left; yields the function that moves them."""
    paces = {label: Pace() for label, _, _ in STAGES}
    with rows(console) as move:

        def show(progress: Progress) -> None:
            for label, count, unit in STAGES:
                done = getattr(progress, count)
                total = getattr(progress, unit)
                if total:
                    pace = paces[label].told(progress.seconds, done, total)
                    if unit == "scans" and done < total:
                        pace = standing_still(progress) or pace
                    move(label, done, total, unit, pace)

        yield show


@contextmanager
def bars_here() -> Iterator[Show]:
    """Bars in the cell of a notebook or at the terminal of a script; elsewhere nothing is shown."""
    console = Console(stderr=cell_display() is None)
    if console.is_jupyter or (console.is_terminal and not console.is_dumb_terminal):
        with bars(console) as show:
            yield show
    else:
        yield lambda progress: None


logger = logging.getLogger(__name__)


class Screen:
    """Tells a caller of Python: notes go to the log, and bars are where they can be seen.

    `on_progress` is called in place of bars.
    """

    def __init__(self, on_progress: Callable[[Progress], None] | None = None) -> None:
        self._on_progress = on_progress

    def tell(self, words: str) -> None:
        """Tell something that the user should know."""
        logger.info(words)

    def warn(self, words: str) -> None:
        """Tell something that is probably a mistake."""
        logger.warning(words)

    def status(self, words: str) -> AbstractContextManager[None]:
        """Show what is going on while the body runs."""
        return nullcontext()

    def writing(self, words: str) -> AbstractContextManager[WritingProgress]:
        """Show what is being written while the body runs; give the function to call."""
        return nullcontext(lambda *_: None)

    def progress(self) -> AbstractContextManager[Show]:
        """Show the progress while the body runs; gives the function that does."""
        return bars_here() if self._on_progress is None else nullcontext(self._on_progress)

    def starting(
        self, cluster: AbstractContextManager[Client], words: str, *, own: bool = False
    ) -> AbstractContextManager[Client]:
        """Show that a cluster is being started; `own` if its workers share the terminal."""
        return cluster
