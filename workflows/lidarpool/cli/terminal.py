"""Progress of a run at the terminal."""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO, cast

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    TaskID,
    TextColumn,
)
from rich.progress import Progress as Bars
from rich.progress import Task as Bar
from rich.text import Text

from ..run.progress import STAGES, Progress, Show, in_words, is_sure, time_in_words

# Plain lines come as a tenth of the time has passed again, within these bounds: a survey of
# hours should not fill a log.
PLAIN_EVERY_S = (2.0, 60.0)
WINDOW_S = 10.0  # that rates are taken over


@contextmanager
def shown_progress(quiet: bool = False) -> Iterator[Show]:
    """Show progress on stderr while the body runs; gives the function to call with it.

    Bars by stage with rates and time left on a terminal, else now and then a line for the
    survey and one for the planning.
    """
    if quiet or sys.stderr is None:
        yield lambda progress: None
    elif (console := _terminal(sys.stderr)) is not None:
        with _bars(console) as show:
            yield show
    else:
        yield PlainLines(sys.stderr)


@contextmanager
def shown_status(text: str, quiet: bool = False) -> Iterator[None]:
    """Say on stderr what is going on while the body runs."""
    if quiet or sys.stderr is None:
        yield
    elif (console := _terminal(sys.stderr)) is not None:
        with console.status(text):
            yield
    else:
        _tell(sys.stderr, text)
        yield


def _terminal(stream: TextIO) -> Console | None:
    """Console of a terminal that can move its cursor; None where lines are all there is."""
    console = Console(file=cast(TextIO, _Unheard(stream)))
    return console if console.is_terminal and not console.is_dumb_terminal else None


class _Unheard:
    """A stream on which writing does not fail: a terminal may be closed while a run goes on."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        with suppress(OSError):
            return self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        with suppress(OSError):
            self._stream.flush()


class PlainLines:
    """Progress as lines of text; call it with each `Progress`.

    Parameters
    ----------
    stream
        Where to write.
    """

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream
        self._next = PLAIN_EVERY_S[0]  # seconds since the start at which to tell again
        self._survey, self._planning = _Pace(), _Pace()
        self._done: set[str] = set()
        self._standing = ""  # what was said of it

    def __call__(self, progress: Progress) -> None:
        """Write what is new, if it is time or something has been completed."""
        now = progress.seconds
        self._survey.add(now, progress.collected)
        self._planning.add(now, progress.trials_done)
        self._tell_standing(progress)
        due = now >= self._next and not progress.paused
        if due:
            least, most = PLAIN_EVERY_S
            self._next = now + min(max(least, now / 10), most)
        self._line(
            "survey",
            due,
            f"{progress.scans:,} scans, {progress.points:,} points in {now:.1f} s",
            f"{progress.collected:,} of {progress.scans:,} scans (generated "
            f"{progress.generated:,}, cast {progress.cast:,}, sorted {progress.framed:,})",
            self._survey.told(progress.scans),
            progress.collected == progress.framed == progress.scans,
        )
        if progress.trials:
            self._line(
                "plan",
                due,
                f"{progress.trials:,} trials in {now:.1f} s",
                f"{progress.trials_done:,} of {progress.trials:,} trials",
                self._planning.told(progress.trials),
                progress.trials_done == progress.trials,
            )

    def _tell_standing(self, progress: Progress) -> None:
        standing = ""
        if progress.paused:
            standing = "paused from the live page"
        elif progress.waits_for:
            standing = f"waits for slots of {progress.waits_for}, which other runs hold"
        if standing != self._standing:
            self._standing = standing
            words = standing or "goes on"
            _tell(self.stream, f"run     {words}, {progress.collected:,} scans are done")

    def _line(self, what: str, due: bool, whole: str, part: str, pace: str, done: bool) -> None:
        if what in self._done or not (due or done):
            return
        if done:
            self._done.add(what)
        text = f"done: {whole}" if done else part + pace
        _tell(self.stream, f"{what:<6}  {text}")


class _Pace:
    """Rate of a count over the last seconds, and the time that the rest of it takes."""

    def __init__(self) -> None:
        self._seen: deque[tuple[float, int]] = deque()

    def add(self, seconds: float, count: int) -> None:
        self._seen.append((seconds, count))
        while len(self._seen) > 2 and self._seen[1][0] <= seconds - WINDOW_S:
            self._seen.popleft()

    @property
    def rate(self) -> float:
        """Items a second, 0 where nothing is known."""
        (start, before), (stop, after) = self._seen[0], self._seen[-1]
        return (after - before) / (stop - start) if stop > start else 0.0

    def told(self, whole: int) -> str:
        """Rate and time left as the end of a line; empty as long as nothing has come."""
        if not self.rate:
            return ""
        seconds, count = self._seen[-1]
        left = f"  {time_in_words((whole - count) / self.rate)} left"
        return f"  {in_words(self.rate)}/s{left if is_sure(count, whole, seconds) else ''}"


def _tell(stream: TextIO, line: str) -> None:
    with suppress(OSError):  # that nobody reads along any more is no reason to end a run
        stream.write(f"{time.strftime('%H:%M:%S')}  {line}\n")
        stream.flush()


class _Rate(TextColumn):
    """Items a second, which rich has only for bytes."""

    def __init__(self) -> None:
        super().__init__("")

    def render(self, task: Bar) -> Text:
        """Write it for a bar; empty as long as nothing is known."""
        speed = task.finished_speed or task.speed
        return Text(f"{in_words(speed)}/s" if speed else "", style="progress.data.speed")


class _Left(TextColumn):
    """Time left, or the time it took."""

    def __init__(self) -> None:
        super().__init__("")

    def render(self, task: Bar) -> Text:
        """Write it for a bar, or why the bar stands still."""
        if task.fields["standing"] and not task.finished:
            return Text(task.fields["standing"], style="bold yellow")
        if task.finished:
            return Text(f"in {task.finished_time or 0:.1f} s", style="progress.elapsed")
        left = task.time_remaining
        if left is None or not is_sure(task.completed, task.total or 0, task.elapsed or 0):
            return Text("")
        return Text(f"{time_in_words(left)} left", style="progress.remaining")


def _standing(progress: Progress, what: str) -> str:
    """Why no more scans or trials come, in few words; empty where they do."""
    if progress.paused:
        return "paused"
    return f"waits for {progress.waits_for}" if progress.waits_for and what == "scans" else ""


@contextmanager
def _bars(console: Console) -> Iterator[Show]:
    columns = (
        TextColumn("{task.description:<13}"),
        BarColumn(bar_width=None),
        MofNCompleteColumn(),
        TextColumn("{task.fields[unit]:<6}"),
        _Rate(),
        _Left(),
    )
    with Bars(*columns, console=console) as bars:
        lines: dict[str, TaskID] = {}

        def show(progress: Progress) -> None:
            """Move the bars; one appears when its total is known."""
            for label, done, total in STAGES:
                whole = getattr(progress, total)
                if whole and label not in lines:
                    lines[label] = bars.add_task(label, total=whole, unit=total, standing="")
                if label in lines:
                    done_now, standing = getattr(progress, done), _standing(progress, total)
                    bars.update(lines[label], completed=done_now, standing=standing)

        yield show
