"""The exception for errors of users."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

MISTAKES_TOLD = 20


class LidarpoolError(Exception):
    """An error that the user can correct: bad input, a missing partition, a full disk.

    The message is one or two lines that say what was given, what was expected and what to
    do. The command prints it without a traceback and exits with code 2.
    """


class Mistakes:
    """Collects errors and reports them together."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    @contextmanager
    def noted(self) -> Iterator[None]:
        """Note a LidarpoolError of the body, and go on behind it."""
        try:
            yield
        except LidarpoolError as error:
            self.lines.append(str(error))

    def tell(self) -> None:
        """Raise LidarpoolError with a line for each, if anything was wrong."""
        lines = list(dict.fromkeys(self.lines))
        if len(lines) > MISTAKES_TOLD:
            lines[MISTAKES_TOLD:] = [f"There are {len(lines) - MISTAKES_TOLD:,} more."]
        if lines:
            raise LidarpoolError("\n".join(lines))
