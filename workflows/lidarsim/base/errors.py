"""The exception for errors of users."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

MISTAKES_TOLD = 20


class LidarError(Exception):
    """An error that the user can correct: bad input, a missing partition, a full disk.

    The message is one or two lines that say what was given, what was expected and what to
    do. The command prints it without a traceback and exits with code 2.
    """


def message_of(error: Exception) -> str:
    """Return the message of an error as a sentence in one line.

    Examples
    --------
    >>> message_of(KeyError("lasers"))
    "'lasers' is missing."
    """
    message = f"{error} is missing" if isinstance(error, KeyError) else str(error)
    if isinstance(error, OSError) and error.strerror:
        message = error.strerror
    return " ".join(message.split()).rstrip(".") + "."


@contextmanager
def explained(what: str, advice: str = "") -> Iterator[None]:
    """Turn an OSError of the body into a LidarError: what failed, why, and what to do."""
    try:
        yield
    except OSError as error:
        why = error.strerror or error
        told = f"{what} ({why}): {advice}." if advice else f"{what}: {why}."
        raise LidarError(told) from error


@contextmanager
def prefixed(what: object) -> Iterator[None]:
    """Begin a LidarError of the body with what it is about: «leg 3: …»."""
    try:
        yield
    except LidarError as error:
        raise LidarError(f"{what}: {error}") from error


class Mistakes:
    """Collects errors and reports them together."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    @contextmanager
    def noted(self) -> Iterator[None]:
        """Note a LidarError of the body, and go on behind it."""
        try:
            yield
        except LidarError as error:
            self.lines.append(str(error))

    def tell(self) -> None:
        """Raise LidarError with a line for each, if anything was wrong."""
        lines = list(dict.fromkeys(self.lines))
        if len(lines) > MISTAKES_TOLD:
            lines[MISTAKES_TOLD:] = [f"And {len(lines) - MISTAKES_TOLD:,} more."]
        if lines:
            raise LidarError("\n".join(lines))
