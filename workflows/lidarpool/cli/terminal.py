"""Messages and progress bars that a command prints to stderr."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

import click
from rich.console import Console

from lidarsim.io.writing_progress import WritingProgress
from lidarsim.words import plural

from ..processes.logs import set_logs
from ..processes.streams import TolerantStream
from ..run.progress import Progress, ProgressRate, Screen, Show, bars, progress_rows, waiting_reason
from .shared_options import WARNED

if TYPE_CHECKING:
    from distributed import Client

# Minimum and maximum interval between progress lines in a log. Within these limits, the interval is
# a tenth of the elapsed time, so that long surveys do not fill the log.
PLAIN_EVERY_S = (2.0, 60.0)


@dataclass(frozen=True)
class Terminal(Screen):
    """Messages and progress bars of a command, which are printed to stderr."""

    quiet: bool = False
    verbose: bool = False
    as_json: bool = False
    warnings: list[str] = field(default_factory=list, init=False)  # printed warnings

    @property
    def _stream(self) -> Any:
        return None if self.quiet or sys.stderr is None else TolerantStream(sys.stderr)

    @property
    def console(self) -> Console | None:
        """Console for progress bars, or None if stderr is not a terminal that supports them."""
        console = Console(file=self._stream) if self._stream else None
        return console if console and console.is_terminal and not console.is_dumb_terminal else None

    def report(self, words: str) -> None:
        """Print a note."""
        if self._stream:
            self._stream.write(f"note: {words}\n")

    def warn(self, words: str) -> None:
        """Print a warning, even in quiet mode, unless it was printed before."""
        if words not in self.warnings:
            self.warnings.append(words)
            click.echo(f"warning: {words}", err=True)

    def exit_if_warned(self, *, strict: bool) -> None:
        """Exit the process with code 1 if `strict` is True and a warning was printed."""
        if strict and self.warnings:
            sys.exit(WARNED)

    def notes(self, notes: Iterable[str]) -> Iterator[str]:
        """Return the notes that were not printed as warnings, as lines of text."""
        return (f"note: {note}" for note in notes if note not in self.warnings)

    @contextmanager
    def status(self, words: str, *, logged: bool = True) -> Iterator[None]:
        """Show a status message while the body runs.

        Outside a terminal, the status is printed as a line of text if `logged` is True.
        """
        console = self.console
        if logged and console is None and self._stream:
            _report(self._stream, words)
        with nullcontext() if console is None else console.status(words):
            yield

    @contextmanager
    def writing(self, words: str, *, logged: bool = True) -> Iterator[WritingProgress]:
        """Show a progress bar for each file that is written, or each activity, in the body.

        Outside a terminal, occasional progress lines are printed, preceded by `words` if `logged`
        is True.
        """
        console = self.console
        if console is not None:
            with progress_rows(console) as show:
                yield show
        else:
            with self.status(words, logged=logged):
                yield WrittenLines(self._stream) if self._stream else lambda *_: None

    @contextmanager
    def progress(self) -> Iterator[Show]:
        """Show a progress bar for each stage, or lines of text if stderr is not a terminal."""
        if (console := self.console) is not None:
            with bars(console) as show:
                yield show
        else:
            yield PlainLines(self._stream) if self._stream else lambda progress: None

    @contextmanager
    def start_cluster(
        self, cluster: AbstractContextManager[Client], words: str, *, shares_terminal: bool = False
    ) -> Iterator[Client]:
        """Show a status message until the cluster has started, and yield its client.

        If `shares_terminal` is True, the workers use the log settings of this process.
        """
        with ExitStack() as stack:
            with self.status(words):
                client = stack.enter_context(cluster)
            if shares_terminal:
                set_logs(self.verbose)
                client.register_worker_callbacks(partial(set_logs, self.verbose))
            yield client


def _report(stream: Any, line: str) -> None:
    stream.write(f"{time.strftime('%H:%M:%S')}  {line}\n")


class WrittenLines:
    """Callback that prints lines of text about the progress of writing files.

    Calls have the signature of `WritingProgress`.
    """

    def __init__(self, stream: Any) -> None:
        self.stream = stream
        self._started: float | None = None  # time of the first call
        self._next = PLAIN_EVERY_S[0]  # elapsed time in seconds at which the next line is due

    def __call__(self, name: str, completed: int, total: int, unit: str) -> None:
        """Print a line if enough time has passed since the last one."""
        if self._started is None:
            self._started = time.monotonic()
        elapsed_s = time.monotonic() - self._started
        if elapsed_s >= self._next and completed < total:
            min_s, max_s = PLAIN_EVERY_S
            self._next = elapsed_s + min(max(min_s, elapsed_s / 10), max_s)
            _report(self.stream, f"{name}  {completed:,} of {total:,} {unit}")


class PlainLines:
    """Callback that prints lines of text about the progress of a run."""

    def __init__(self, stream: Any) -> None:
        self.stream = stream
        self._next = PLAIN_EVERY_S[0]  # elapsed time in seconds at which the next line is due
        self._paces = {
            "survey": ProgressRate(),
            "planning": ProgressRate(),
            "campaign": ProgressRate(),
        }
        self._completed: set[str] = set()
        self._waiting_reason = ""  # empty while the run makes progress

    def __call__(self, progress: Progress) -> None:
        """Print a line if one is due, if a stage ends, or if the run starts to wait."""
        elapsed_s = progress.seconds
        if (reason := waiting_reason(progress)) != self._waiting_reason:
            self._waiting_reason = reason
            jobs = f"{progress.jobs_done:,} jobs" if progress.jobs else ""
            ready = jobs or f"{progress.collected:,} scans"
            _report(self.stream, f"run  {reason or 'continues'}, {ready} are done")
        due = elapsed_s >= self._next
        if due:
            min_s, max_s = PLAIN_EVERY_S
            self._next = elapsed_s + min(max(min_s, elapsed_s / 10), max_s)
        scans = progress.scans
        scans_done = min(progress.collected, progress.framed)
        sweeps = f" ({progress.sweeps_text})" if progress.sweeps else ""
        all_sweeps = f" ({plural(progress.sweeps, 'sweep')})" if progress.sweeps else ""
        survey_summary = f"{scans:,} scans{all_sweeps}, {progress.points:,} points"
        survey_unit = f"scans{sweeps}, {progress.points:,} points"
        trials = progress.trials
        for stage, count, total, unit, stage_summary in (
            ("survey", scans_done, scans, survey_unit, survey_summary),
            ("planning", progress.trials_done, trials, "trials", f"{trials:,} trials"),
            ("campaign", progress.jobs_done, progress.jobs, "jobs", f"{progress.jobs:,} jobs"),
        ):
            pace = self._paces[stage].text(elapsed_s, count, total)
            if total and count == total and stage not in self._completed:
                self._completed.add(stage)
                _report(self.stream, f"{stage}  done: {stage_summary} in {elapsed_s:.1f} s")
            elif due and count < total:
                line = f"{stage}  {count:,} of {total:,} {unit}  {pace}"
                _report(self.stream, line.rstrip())
