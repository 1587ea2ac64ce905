"""Exceptions for errors that the user can correct, and helpers that format their messages."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager

from .words import printable

MAX_MISTAKES = 20
_UNFORESEEN = (IndexError, TypeError, AttributeError, ArithmeticError, AssertionError)
_MAX_REASON = 400  # characters; libraries may quote an entire file
_MAX_LETTERS = 2000  # characters per line of a message; longer lines are cut in the middle
# The start of a line names the file. Its end, which states what was expected and what to do, keeps
# this many characters.
_END_LETTERS = 500


_LONG_LIST = re.compile(r"(?:[^\s,]+(?: \([^)]*\))?, ){15,}\S+")
_MIN_LIST_LETTERS = 300  # characters; longer lists are moved to separate lines
_WIDTH = 100  # characters per line of a wrapped list, as in the output of --help
_INDENT = "  "


class LidarError(Exception):
    """An error that the user can correct, such as invalid input or a full disk.

    The message states in one or two lines what is wrong, what was expected, and what to do. The
    command line prints the message without a traceback and exits with code 2. Very long lines are
    shortened in the middle, and long lists of names are wrapped.

    MissingFileError is also a FileNotFoundError, and ArgumentError is also a ValueError.
    """

    def __init__(self, message: object = "") -> None:
        super().__init__("\n".join(map(_wrap_list, map(_cut, str(message).split("\n")))))


class MissingFileError(LidarError, FileNotFoundError):
    """A LidarError for a file or folder that does not exist."""


class ArgumentError(LidarError, ValueError):
    """A LidarError for an argument with an invalid type or value."""


def _cut(line: str) -> str:
    """Shorten a long line by removing its middle."""
    if len(line) <= _MAX_LETTERS:
        return line
    return f"{line[: _MAX_LETTERS - _END_LETTERS]} … {line[-_END_LETTERS:]}"


def _wrap_list(line: str) -> str:
    """Wrap a long list, such as the names of all columns, into separate indented lines."""
    names = _LONG_LIST.search(line)
    if names is None or len(names[0]) < _MIN_LIST_LETTERS or line.startswith(_INDENT):
        return line
    wrapped = textwrap.fill(
        line[names.start() :],
        _WIDTH,
        initial_indent=_INDENT,
        subsequent_indent=_INDENT,
        break_long_words=False,
        break_on_hyphens=False,
    )
    return f"{line[: names.start()].rstrip()}\n{wrapped}"


class CutShortError(ValueError):
    """An error for a truncated file.

    The message states how much data was expected and how much the file contains.
    """


def message_of(error: Exception) -> str:
    """Format an error message as a single-line sentence.

    Examples
    --------
    >>> message_of(KeyError("lasers"))
    "'lasers' is missing."
    """
    message = f"{error} is missing" if isinstance(error, KeyError) else str(error)
    if isinstance(error, OSError) and error.strerror:
        message = error.strerror
    return " ".join(message.split()).rstrip(".") + "."


def reason_of(error: Exception) -> str:
    """Describe in a clause without a period why a file cannot be read.

    `error` may be an exception of any class.

    Examples
    --------
    >>> reason_of(TypeError("'NoneType' object is not iterable"))
    "its content does not match its format ('NoneType' object is not iterable)"
    >>> reason_of(RecursionError("maximum recursion depth exceeded"))
    'its content is nested too deeply'
    """
    if isinstance(error, RecursionError):
        return "its content is nested too deeply"
    reason = type(error).__name__
    if str(error):
        reason = printable(message_of(error), _MAX_REASON).rstrip(".")
    if isinstance(error, _UNFORESEEN):  # messages that describe Python objects, not the file
        reason = f"its content does not match its format ({reason})"
    return reason


def as_sentence(advice: str) -> str:
    """Capitalize a piece of advice and end it with a period.

    Examples
    --------
    >>> as_sentence("export it again")
    'Export it again.'
    """
    return f"{advice[:1].upper()}{advice[1:].rstrip('.')}."


def unreadable_message(subject: object, error: Exception, advice: str = "") -> str:
    """Return an error message for a file that cannot be read.

    `error` may be an exception of any class. The advice, if any, follows as a second sentence.

    Examples
    --------
    >>> unreadable_message("vlp16.yaml", KeyError("lasers"))
    "vlp16.yaml cannot be read: 'lasers' is missing."
    >>> unreadable_message("a.stl", CutShortError("line 7 is the last"), "export it again")
    'a.stl is truncated: line 7 is the last. Export it again.'
    """
    failure = "is truncated" if isinstance(error, CutShortError) else "cannot be read"
    message = f"{subject} {failure}: {reason_of(error)}."
    return f"{message} {as_sentence(advice)}" if advice else message


@contextmanager
def explain_os_errors(failure: str, advice: str = "") -> Iterator[None]:
    """Convert an OSError raised in the context into a LidarError.

    The message consists of the failure, the reason and the advice. If a file does not exist, the
    error is a MissingFileError.
    """
    try:
        yield
    except LidarError:
        raise
    except OSError as error:
        why = message_of(error).rstrip(".")
        message = f"{failure}: {why}."
        message = f"{message} {as_sentence(advice)}" if advice else message
        kind = MissingFileError if isinstance(error, FileNotFoundError) else LidarError
        raise kind(message) from error


@contextmanager
def convert_errors(failure: str) -> Iterator[None]:
    """Convert any exception raised in the context into a LidarError.

    Use this context for input files, whose readers and libraries raise exceptions of many classes.
    The message consists of the failure and the reason. If the file named in `failure` does not
    exist, the message only states that.
    """
    try:
        yield
    except Exception as error:
        missing = str(error.filename) if isinstance(error, FileNotFoundError) else ""
        if missing and missing in failure:
            raise MissingFileError(f"{missing} does not exist.") from error
        reason = (
            message_of(error).rstrip(".") if isinstance(error, LidarError) else reason_of(error)
        )
        kind = MissingFileError if isinstance(error, FileNotFoundError) else LidarError
        raise kind(f"{failure}: {reason}.") from error


@contextmanager
def prefix_errors(subject: object) -> Iterator[None]:
    """Add a prefix such as "leg 3: " to the message of a LidarError raised in the context."""
    try:
        yield
    except LidarError as error:
        kind = MissingFileError if isinstance(error, MissingFileError) else LidarError
        raise kind(f"{subject}: {error}") from error


class Mistakes:
    """Collector that combines several errors into a single one."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    @contextmanager
    def collect(self) -> Iterator[None]:
        """Collect a LidarError raised in the context instead of propagating it."""
        try:
            yield
        except LidarError as error:
            self.lines.append(str(error))

    def raise_if_any(self) -> None:
        """Raise a LidarError with one line per distinct error, if any errors were collected."""
        lines = list(dict.fromkeys(self.lines))
        if len(lines) > MAX_MISTAKES:
            lines[MAX_MISTAKES:] = [f"And {len(lines) - MAX_MISTAKES:,} more."]
        if lines:
            raise LidarError("\n".join(lines))
