"""The exception for errors of users."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager

from .words import printable

MAX_MISTAKES = 20
_UNFORESEEN = (IndexError, TypeError, AttributeError, ArithmeticError, AssertionError)
_MAX_REASON = 400  # letters: libraries may quote a whole file
_MAX_LETTERS = 2000  # letters of a line of a message, whose start names the file
_END_LETTERS = 500  # a line that is cut in its middle keeps so many: what was expected, and advice


_LONG_LIST = re.compile(r"(?:[^\s,]+(?: \([^)]*\))?, ){15,}\S+")
_MIN_LIST_LETTERS = 300  # letters of a list that is put on separate lines
_WIDTH = 100  # letters of these lines, as of --help
_INDENT = "  "


class LidarError(Exception):
    """An error that the user can correct, such as invalid input or a full disk.

    The message states in one or two lines what is wrong, what was expected, and what to do. The
    command line prints the message without a traceback and exits with code 2. Very long lines are
    shortened in the middle, and long lists of names are wrapped.

    If a file does not exist, the error is also a FileNotFoundError. If an argument has a wrong type
    or value, the error is also a ValueError.
    """

    def __init__(self, message: object = "") -> None:
        super().__init__("\n".join(map(_wrap_list, map(_cut, str(message).split("\n")))))


class MissingFileError(LidarError, FileNotFoundError):
    """A LidarError for a file or folder that does not exist."""


class ArgumentError(LidarError, ValueError):
    """A LidarError for an argument with a wrong type or value."""


def _cut(line: str) -> str:
    """Return a line without its middle if the line is too long to be read."""
    if len(line) <= _MAX_LETTERS:
        return line
    return f"{line[: _MAX_LETTERS - _END_LETTERS]} … {line[-_END_LETTERS:]}"


def _wrap_list(line: str) -> str:
    """Return a line with a long list, such as all columns, on separate indented lines."""
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
    """An error of a file whose end is missing: what is announced, and what is there."""


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


def reason_of(error: Exception) -> str:
    """Return why a file cannot be read, from an error of any class: a clause without a period.

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
    if isinstance(error, _UNFORESEEN):  # whose messages speak of Python, not of the file
        reason = f"its content does not match its format ({reason})"
    return reason


def as_sentence(advice: str) -> str:
    """Return advice as a sentence, with a capital letter and a period.

    Examples
    --------
    >>> as_sentence("export it again")
    'Export it again.'
    """
    return f"{advice[:1].upper()}{advice[1:].rstrip('.')}."


def unreadable(subject: object, error: Exception, advice: str = "") -> str:
    """Return a sentence on the error, of any class, of reading a file.

    Examples
    --------
    >>> unreadable("vlp16.yaml", KeyError("lasers"))
    "vlp16.yaml cannot be read: 'lasers' is missing."
    >>> unreadable("a.stl", CutShortError("line 7 is the last"), "export it again")
    'a.stl is truncated: line 7 is the last. Export it again.'
    """
    failure = "is truncated" if isinstance(error, CutShortError) else "cannot be read"
    message = f"{subject} {failure}: {reason_of(error)}."
    return f"{message} {as_sentence(advice)}" if advice else message


@contextmanager
def explained(failure: str, advice: str = "") -> Iterator[None]:
    """Turn an OSError of the body into a LidarError: the failure, the reason, and advice.

    The error is a MissingFileError if a file does not exist.
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
def converted(failure: str) -> Iterator[None]:
    """Turn an error of any class in the body into a LidarError: the failure, and the reason.

    For files that users give, whose readers and libraries raise errors of many classes. If the file
    that the failure names does not exist, the error says only that.
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
def prefixed(subject: object) -> Iterator[None]:
    """Start a LidarError of the body with its subject: «leg 3: …»."""
    try:
        yield
    except LidarError as error:
        kind = MissingFileError if isinstance(error, MissingFileError) else LidarError
        raise kind(f"{subject}: {error}") from error


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
