"""What the command prints, where whoever reads it may have gone.

A terminal may be closed while a run goes on, and ``| head`` has seen enough: neither is a
failure of the run, whose result is in files. It is told from a disk that is full below a
``> file``, where somebody wanted what is lost.
"""

from __future__ import annotations

import errno
import io
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TextIO

from ..base.errors import LidarpoolError

_GONE = frozenset({errno.EPIPE, errno.EIO})  # the other end of a pipe, or a terminal


class _Listener(io.RawIOBase):
    """The end of a stream, a file descriptor, on which writing may come to nothing.

    At the lowest level, because click and rich write to whatever is beneath `sys.stdout`.

    Parameters
    ----------
    descriptor
        The file descriptor.
    wanted
        Whether what cannot be written, though there may be somebody to read it, is an error.
    """

    def __init__(self, descriptor: int, wanted: bool) -> None:
        super().__init__()
        self._descriptor, self._wanted = descriptor, wanted
        self._gone = False

    def fileno(self) -> int:
        return self._descriptor

    def isatty(self) -> bool:
        return os.isatty(self._descriptor)

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int | None:  # anything with a buffer
        """Write bytes, or drop them once nobody takes any; returns how many were taken."""
        size = memoryview(data).nbytes
        if self._gone:
            return size
        try:
            return os.write(self._descriptor, data)
        except BlockingIOError:
            return None  # as a raw stream says that it takes nothing now
        except OSError as error:
            self._gone = True  # also for what is still in the buffers above
            if self._wanted and error.errno not in _GONE:
                raise LidarpoolError(
                    f"What the command prints cannot be written: {error.strerror}."
                ) from error
            return size


@contextmanager
def leaving_listeners() -> Iterator[None]:
    """Let those who read standard output and standard error leave while the body runs."""
    before = sys.stdout, sys.stderr
    sys.stdout = _listened_to(sys.stdout, wanted=True)
    sys.stderr = _listened_to(sys.stderr, wanted=False)
    try:
        yield
    finally:
        for stream in (sys.stdout, sys.stderr):
            if stream is not None:
                stream.flush()
        sys.stdout, sys.stderr = before


def _listened_to(stream: TextIO, wanted: bool) -> TextIO:
    """Stream to the same place; the same one where that is no file descriptor."""
    if sys.platform == "win32":  # its console takes no bytes
        return stream
    try:
        descriptor = stream.fileno()
    except (AttributeError, io.UnsupportedOperation):  # closed from the start; not a real one
        return stream
    return io.TextIOWrapper(
        io.BufferedWriter(_Listener(descriptor, wanted)),
        encoding=stream.encoding,
        errors=stream.errors,
        line_buffering=True,
    )
