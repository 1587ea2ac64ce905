"""The exception for errors of users."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

MAX_MISTAKES = 20


class LidarError(Exception):
    """An error that the user can correct: bad input, a missing partition, a full disk.

    The message says in one or two lines what was given, what was expected and what to do. The
    command prints the message without a traceback and exits with code 2.
    """


def message_of(error: Exception) -> str:
    """Return the message of an error as a sentence in a line.

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
def explained(failure: str, advice: str = "") -> Iterator[None]:
    """Turn an OSError of the body into a LidarError: the failure, the reason, and advice."""
    try:
        yield
    except OSError as error:
        why = error.strerror or error
        message = f"{failure} ({why}): {advice}." if advice else f"{failure}: {why}."
        raise LidarError(message) from error


@contextmanager
def prefixed(subject: object) -> Iterator[None]:
    """Start a LidarError of the body with its subject: «leg 3: …»."""
    try:
        yield
    except LidarError as error:
        raise LidarError(f"{subject}: {error}") from error


class Mistakes:
    """Collector of errors, which reports all errors together."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    @contextmanager
    def noted(self) -> Iterator[None]:
        """Note a LidarError of the body, and continue after the body."""
        try:
            yield
        except LidarError as error:
            self.lines.append(str(error))

    def tell(self) -> None:
        """Raise LidarError with a line for each error, if there are errors."""
        lines = list(dict.fromkeys(self.lines))
        if len(lines) > MAX_MISTAKES:
            lines[MAX_MISTAKES:] = [f"And {len(lines) - MAX_MISTAKES:,} more."]
        if lines:
            raise LidarError("\n".join(lines))
