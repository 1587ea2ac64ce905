"""Progress of a run at the terminal."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TextIO, cast

from rich.console import Console

from ..base.streams import Unheard
from ..run.bars import Pace, bars, standing_still
from ..run.progress import STAGES, Progress, Show

# Plain lines come after another tenth of the elapsed time, within these bounds, so that a survey
# of hours does not fill a log.
PLAIN_EVERY_S = (2.0, 60.0)


@contextmanager
def shown_progress(quiet: bool = False) -> Iterator[Show]:
    """Show progress on stderr while the body runs; yields the function that shows it.

    On a terminal, bars by stage with rates and time left; elsewhere occasional lines for survey
    and planning.
    """
    if quiet or sys.stderr is None:
        yield lambda progress: None
    elif (console := _terminal()) is not None:
        with bars(console) as show:
            yield show
    else:
        yield PlainLines(Unheard(sys.stderr))


@contextmanager
def shown_status(text: str, quiet: bool = False, logged: bool = True) -> Iterator[None]:
    """Show a status on stderr while the body runs; in a log, too, if it is `logged`."""
    if quiet or sys.stderr is None:
        yield
    elif (console := _terminal()) is not None:
        with console.status(text):
            yield
    else:
        if logged:
            _tell(Unheard(sys.stderr), text)
        yield


def tell(words: str) -> None:
    """Print a line on stderr; ignore a closed stream."""
    if sys.stderr is not None:
        Unheard(sys.stderr).write(f"{words}\n")


def _terminal() -> Console | None:
    """Console of a terminal that can move its cursor; None without one."""
    console = Console(file=cast(TextIO, Unheard(sys.stderr)))
    return console if console.is_terminal and not console.is_dumb_terminal else None


def _tell(stream: Any, line: str) -> None:
    stream.write(f"{time.strftime('%H:%M:%S')}  {line}\n")


class PlainLines:
    """Progress as lines of text in a stream; call it with each `Progress`."""

    def __init__(self, stream: Any) -> None:
        self.stream = stream
        self._next = PLAIN_EVERY_S[0]  # seconds since the start of the next line
        self._paces = {"survey": Pace(), "planning": Pace(), "campaign": Pace()}
        self._done: set[str] = set()
        self._standing = ""  # the last line about it

    def __call__(self, progress: Progress) -> None:
        """Write a line, if it is time or something has been completed."""
        now = progress.seconds
        if (standing := standing_still(progress)) != self._standing:
            self._standing = standing
            jobs = f"{progress.jobs_done:,} jobs" if progress.jobs else ""
            ready = jobs or f"{progress.collected:,} scans"
            _tell(self.stream, f"run  {standing or 'goes on'}, {ready} are done")
        due = now >= self._next
        if due:
            least, most = PLAIN_EVERY_S
            self._next = now + min(max(least, now / 10), most)
        stages = ", ".join(
            f"{label} {getattr(progress, count):,}"
            for label, count, unit in STAGES
            if unit == "scans"
        )
        scans, done = progress.scans, min(progress.collected, progress.framed)
        whole, trials = f"{scans:,} scans, {progress.points:,} points", progress.trials
        for what, count, total, unit, all_ in (
            ("survey", done, scans, f"scans ({stages})", whole),
            ("planning", progress.trials_done, trials, "trials", f"{trials:,} trials"),
            ("campaign", progress.jobs_done, progress.jobs, "jobs", f"{progress.jobs:,} jobs"),
        ):
            pace = self._paces[what].told(now, count, total)
            if total and count == total and what not in self._done:
                self._done.add(what)
                _tell(self.stream, f"{what}  done: {all_} in {now:.1f} s")
            elif due and count < total:
                line = f"{what}  {count:,} of {total:,} {unit}  {pace}"
                _tell(self.stream, line.rstrip())
