"""What a command prints before the modules that do its work are imported, and while they compile.

Imports take a second or two, in a new installation half a minute, as raybeam and lidarsim compile
their loops.
"""

from __future__ import annotations

import logging
import sys
import time

import click

_COMPILER = logging.getLogger("raybeam.compiled")  # logger of a module that is not imported yet


class _Lines(logging.Handler):
    """Writes messages as the lines of a command's progress."""

    def emit(self, record: logging.LogRecord) -> None:
        """Write a message."""
        _write(record.getMessage())


_LINES = _Lines()


def begin(step: str, *, quiet: bool = False) -> None:
    """Print the first step of a command that is not at a terminal, where a status follows.

    Unless the command is quiet, it also prints that loops are compiled, if they are.
    """
    _COMPILER.removeHandler(_LINES)
    if quiet or sys.stderr is None:
        return
    if not sys.stderr.isatty():
        _write(step)
    # A command drops the logs of libraries: this message is the command's own.
    _COMPILER.isEnabledFor = lambda level: level >= logging.INFO  # type: ignore[method-assign]
    _COMPILER.propagate = False
    _COMPILER.addHandler(_LINES)


def _write(line: str) -> None:
    """Write a line with the time of day to stderr."""
    click.echo(f"{time.strftime('%H:%M:%S')}  {line}", err=True)
