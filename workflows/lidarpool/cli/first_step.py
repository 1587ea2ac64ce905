"""Print the first progress message of a command before slow imports start.

Imports take one or two seconds. In a new installation they take half a minute, because raybeam and
lidarsim compile their loops.
"""

from __future__ import annotations

import logging
import sys
import time

import click

_COMPILER = logging.getLogger("raybeam.compiled")  # the module itself may not be imported yet


class _Lines(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        _write(record.getMessage())


_LINES = _Lines()


def print_first_step(step: str, *, quiet: bool = False) -> None:
    """Print the first step of a command. If loops have to be compiled, announce this too.

    The step is only printed if stderr is not a terminal. A terminal shows a status instead. A
    `quiet` command prints neither.
    """
    _COMPILER.removeHandler(_LINES)
    if quiet or sys.stderr is None:
        return
    if not sys.stderr.isatty():
        _write(step)
    # Commands suppress the log messages of libraries. This message is an exception.
    _COMPILER.isEnabledFor = lambda level: level >= logging.INFO  # type: ignore[method-assign]
    _COMPILER.propagate = False
    _COMPILER.addHandler(_LINES)


def _write(line: str) -> None:
    click.echo(f"{time.strftime('%H:%M:%S')}  {line}", err=True)
