"""What a command tells at the terminal while it works."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import click
from distributed import Client
from rich.console import Console

from lidarsim.base.writing_progress import WritingProgress

from ..base.streams import TolerantStream
from ..run.progress import Pace, Progress, Screen, Show, bars, progress_rows, waiting_reason
from .shared_options import WARNED, set_logs

# Plain lines come after another tenth of the elapsed time, within these bounds, so that a survey
# of hours does not fill a log.
PLAIN_EVERY_S = (2.0, 60.0)


@dataclass(frozen=True)
class Terminal(Screen):
    """Tells the user of a command, on stderr."""

    quiet: bool = False
    verbose: bool = False
    as_json: bool = False
    warnings: list[str] = field(default_factory=list, init=False)  # those that were printed

    @property
    def _stream(self) -> Any:
        """Stream for what is told; None to tell nothing."""
        return None if self.quiet or sys.stderr is None else TolerantStream(sys.stderr)

    @property
    def _console(self) -> Console | None:
        """Console of a terminal that can move its cursor; None without one."""
        console = Console(file=self._stream) if self._stream else None
        return console if console and console.is_terminal and not console.is_dumb_terminal else None

    def tell(self, words: str) -> None:
        """Print a note."""
        if self._stream:
            self._stream.write(f"note: {words}\n")

    def warn(self, words: str) -> None:
        """Print a warning once, also in a quiet command; `warnings` lists it."""
        if words not in self.warnings:
            self.warnings.append(words)
            click.echo(f"warning: {words}", err=True)

    def end(self, *, strict: bool) -> None:
        """End the process with exit code 1 if it is `strict` and a warning was printed."""
        if strict and self.warnings:
            sys.exit(WARNED)

    def notes(self, notes: Iterable[str]) -> Iterator[str]:
        """Return lines of notes, without those that were printed as warnings."""
        return (f"note: {note}" for note in notes if note not in self.warnings)

    @contextmanager
    def status(self, words: str, *, logged: bool = True) -> Iterator[None]:
        """Show what is going on while the body runs; in a log, too, if it is `logged`."""
        console = self._console
        if logged and console is None and self._stream:
            _tell(self._stream, words)
        with nullcontext() if console is None else console.status(words):
            yield

    @contextmanager
    def writing(self, words: str) -> Iterator[WritingProgress]:
        """Show a bar for each output while the body writes them; in a log, `words` and lines."""
        console = self._console
        if console is not None:
            with progress_rows(console) as show:
                yield show
        else:
            with self.status(words):
                yield WrittenLines(self._stream) if self._stream else lambda *_: None

    @contextmanager
    def progress(self) -> Iterator[Show]:
        """Show bars by stage with rates and time left; elsewhere than on a terminal, some lines."""
        if (console := self._console) is not None:
            with bars(console) as show:
                yield show
        else:
            yield PlainLines(self._stream) if self._stream else lambda progress: None

    @contextmanager
    def starting(
        self, cluster: AbstractContextManager[Client], words: str, *, shares_terminal: bool = False
    ) -> Iterator[Client]:
        """Show a status until the cluster has started; its workers log as this process does."""
        with ExitStack() as stack:
            with self.status(words):
                client = stack.enter_context(cluster)
            if shares_terminal:
                set_logs(self.verbose)
                client.register_worker_callbacks(partial(set_logs, self.verbose))
            yield client


def _tell(stream: Any, line: str) -> None:
    stream.write(f"{time.strftime('%H:%M:%S')}  {line}\n")


class WrittenLines:
    """Progress of what is written as lines of text in a stream; call it as `WritingProgress`."""

    def __init__(self, stream: Any) -> None:
        self.stream = stream
        self._started = time.monotonic()
        self._next = PLAIN_EVERY_S[0]  # seconds since the start of the next line

    def __call__(self, name: str, done: int, total: int, unit: str) -> None:
        """Write a line, if it is time."""
        now = time.monotonic() - self._started
        if now >= self._next and done < total:
            least, most = PLAIN_EVERY_S
            self._next = now + min(max(least, now / 10), most)
            _tell(self.stream, f"{name}  {done:,} of {total:,} {unit}")


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
        if (standing := waiting_reason(progress)) != self._standing:
            self._standing = standing
            jobs = f"{progress.jobs_done:,} jobs" if progress.jobs else ""
            ready = jobs or f"{progress.collected:,} scans"
            _tell(self.stream, f"run  {standing or 'continues'}, {ready} are done")
        due = now >= self._next
        if due:
            least, most = PLAIN_EVERY_S
            self._next = now + min(max(least, now / 10), most)
        scans = progress.scans
        done = min(progress.collected, progress.framed)
        whole = f"{scans:,} scans, {progress.points:,} points"
        trials = progress.trials
        for what, count, total, unit, all_ in (
            ("survey", done, scans, f"scans, {progress.points:,} points", whole),
            ("planning", progress.trials_done, trials, "trials", f"{trials:,} trials"),
            ("campaign", progress.jobs_done, progress.jobs, "jobs", f"{progress.jobs:,} jobs"),
        ):
            pace = self._paces[what].text(now, count, total)
            if total and count == total and what not in self._done:
                self._done.add(what)
                _tell(self.stream, f"{what}  done: {all_} in {now:.1f} s")
            elif due and count < total:
                line = f"{what}  {count:,} of {total:,} {unit}  {pace}"
                _tell(self.stream, line.rstrip())
