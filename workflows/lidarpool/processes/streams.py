"""Output streams that tolerate closed pipes."""

from __future__ import annotations

import os
from contextlib import suppress
from typing import Any, TextIO


class TolerantStream:
    """Text stream that discards its output after the reader has closed the pipe.

    A run therefore continues, for example, after ``lidarpool run ... | head``. Each write is
    flushed.

    Parameters
    ----------
    stream
        Stream to write to.
    reader_gone
        Type of the error that indicates a closed pipe. Other errors are raised.
    """

    def __init__(self, stream: TextIO, reader_gone: type[OSError] = OSError) -> None:
        self._stream = stream
        self._reader_gone = reader_gone

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write text and flush the stream."""
        try:
            self._stream.write(text)
            self._stream.flush()
        except self._reader_gone:
            # Without the redirection, flushing the buffer would fail again when Python exits.
            with suppress(OSError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())
        return len(text)

    def flush(self) -> None:
        """Do nothing, because `write` has already flushed the stream."""
