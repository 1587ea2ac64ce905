"""Progress of a run, and its display in a terminal or notebook."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TaskID, TextColumn
from rich.progress import Progress as Bars

from lidarsim.environment.notebook import cell_display
from lidarsim.io.writing_progress import WritingProgress
from lidarsim.words import plural

if TYPE_CHECKING:
    from distributed import Client

# Label, name of the count, and name of the total for each progress bar. The total is also the unit.
STAGES: tuple[tuple[str, str, str], ...] = (
    ("1 generate", "generated", "scans"),
    ("2 intersect", "cast", "scans"),
    ("3 sort", "framed", "scans"),
    ("4 collect", "collected", "scans"),
    ("planning", "trials_done", "trials"),
    ("jobs", "jobs_done", "jobs"),
)

# The first items are slow because workers are warming up, so the remaining time is shown only after
# this share of the items, or after this time.
SURE_SHARE = 0.05
SURE_S = 20.0


@dataclass(frozen=True)
class Progress:
    """Snapshot of the progress of a run."""

    seconds: float = 0.0  # time since the start
    scans: int = 0
    generated: int = 0  # scans that have passed stage 1
    cast: int = 0  # scans that have passed stage 2
    framed: int = 0  # scans that have passed stage 3
    collected: int = 0  # scans that have passed stage 4
    points: int = 0
    trials: int = 0
    trials_done: int = 0
    replayed: int = 0  # batches that were cast or sent more than once
    waits_for: str = ""  # partition whose required slots are in use by other runs
    jobs: int = 0  # number of jobs in a campaign, whose scans are not counted
    jobs_done: int = 0
    sweeps: int = 0  # revolutions or frames
    sweeps_done: int = 0  # sweeps whose scans have passed all stages

    @property
    def sweeps_text(self) -> str:
        """Number of finished sweeps, such as "12 of 100 sweeps", or "" for a campaign."""
        return f"{self.sweeps_done:,} of {plural(self.sweeps, 'sweep')}" if self.sweeps else ""


Show = Callable[[Progress], None]


def format_rate(rate: float) -> str:
    """Format a rate with at least two significant digits, such as 0.25, 3.1, 52 or 1,234."""
    return f"{rate:,.0f}" if rate >= 10 else f"{rate:.2g}"


def format_duration(seconds: float) -> str:
    """Format a duration, for example as 8 s, 3 min or 2 h 05 min."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60:,} h {minutes % 60:02} min"


class ProgressRate:
    """Rate at which a count increases, and the time that remains."""

    def __init__(self) -> None:
        self._first: tuple[float, int] | None = None

    def rate(self, seconds: float, count: int) -> float:
        """Return the rate per second, or 0 if no time has passed yet."""
        start_s, first_count = self._first = self._first or (seconds, count)
        return (count - first_count) / (seconds - start_s) if seconds > start_s else 0.0

    def time_left(self, seconds: float, count: int, total: int) -> str:
        """Format the remaining time.

        Return an empty string while no reliable estimate is possible, and at the end.
        """
        rate = self.rate(seconds, count)
        sure = rate and (count >= SURE_SHARE * total or seconds >= SURE_S) and count < total
        return format_duration((total - count) / rate) if sure else ""

    def text(self, seconds: float, count: int, total: int) -> str:
        """Format the rate and remaining time, or return an empty string if the rate is 0."""
        rate = self.rate(seconds, count)
        time_left = self.time_left(seconds, count, total)
        return f"{format_rate(rate)}/s{f'  {time_left} left' if time_left else ''}" if rate else ""


def waiting_reason(progress: Progress) -> str:
    """Return the reason why the run is waiting, or an empty string if it is not waiting."""
    slots = progress.waits_for
    return f"waiting for {slots} slots held by other runs" if slots else ""


@contextmanager
def progress_rows(console: Console) -> Iterator[Callable[..., None]]:
    """Show progress bars, and yield a function ``update(label, count, total, unit, pace="")``.

    A bar appears when the function is called with its label for the first time.
    """
    columns = (
        TextColumn("{task.description:<11}"),
        BarColumn(bar_width=None),
        MofNCompleteColumn(),
        TextColumn("{task.fields[unit]:<6}"),
        TextColumn("{task.fields[pace]}", style="progress.remaining"),
    )
    with Bars(*columns, console=console) as display:
        lines: dict[str, TaskID] = {}

        def move(label: str, count: int, total: int, unit: str, pace: str = "") -> None:
            if label not in lines:
                lines[label] = display.add_task(label, total=total, unit=unit, pace="")
            display.update(lines[label], completed=count, pace=pace)

        yield move


@contextmanager
def bars(console: Console) -> Iterator[Show]:
    """Show progress bars with rates and remaining times, and yield a function to update them."""
    paces = {label: ProgressRate() for label, _, _ in STAGES}
    with progress_rows(console) as move:

        def show(progress: Progress) -> None:
            for label, count_name, total_name in STAGES:
                count = getattr(progress, count_name)
                total = getattr(progress, total_name)
                if total:
                    pace = paces[label].text(progress.seconds, count, total)
                    if total_name == "scans" and count < total:
                        pace = waiting_reason(progress) or pace
                    if count_name == "collected":
                        pace = f"{pace}  {progress.sweeps_text}".strip()
                    move(label, count, total, total_name, pace)

        yield show


@contextmanager
def local_progress_bars() -> Iterator[Show]:
    """Show progress bars in a notebook or terminal, and yield a function to update them.

    The function has no effect if the output is neither a terminal nor a notebook.
    """
    console = Console(stderr=cell_display() is None)
    if console.is_jupyter or (console.is_terminal and not console.is_dumb_terminal):
        with bars(console) as show:
            yield show
    else:
        yield lambda progress: None


logger = logging.getLogger(__name__)


class Screen:
    """Messages and progress of a run that was started from Python.

    Messages are logged. Progress bars are shown in a terminal or notebook.

    Parameters
    ----------
    on_progress
        Function that is called with the progress instead of showing bars.

    Attributes
    ----------
    warnings
        Warnings that were reported, without duplicates.
    """

    def __init__(self, on_progress: Callable[[Progress], None] | None = None) -> None:
        self._on_progress = on_progress
        self.warnings: list[str] = []

    def report(self, words: str) -> None:
        """Log a message for the user."""
        logger.info(words)

    def warn(self, words: str) -> None:
        """Log a warning and append it to `warnings`, unless it has been reported before."""
        if words not in self.warnings:
            self.warnings.append(words)
            logger.warning(words)

    def status(self, words: str) -> AbstractContextManager[None]:
        """Return a context manager that displays the current activity."""
        return nullcontext()

    def writing(self, words: str) -> AbstractContextManager[WritingProgress]:
        """Return a context manager that displays the progress of writing.

        It yields the function that updates the progress.
        """
        return nullcontext(lambda *_: None)

    def progress(self) -> AbstractContextManager[Show]:
        """Return a context manager that displays the progress of a run.

        It yields the function that updates the progress.
        """
        return (
            local_progress_bars() if self._on_progress is None else nullcontext(self._on_progress)
        )

    def start_cluster(
        self, cluster: AbstractContextManager[Client], words: str, *, shares_terminal: bool = False
    ) -> AbstractContextManager[Client]:
        """Return a context manager that starts a cluster and displays this activity.

        `shares_terminal` is True if the workers write to the same terminal.
        """
        return cluster
