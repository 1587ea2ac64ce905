"""Output whose reader may have gone."""

from __future__ import annotations

import os
from contextlib import suppress
from typing import Any, TextIO


class TolerantStream:
    """A stream whose writes succeed after its reader has gone, so that a run goes on.

    `reader_gone` is the kind of error of such writes. Each write is flushed; other errors are
    raised.
    """

    def __init__(self, stream: TextIO, reader_gone: type[OSError] = OSError) -> None:
        self._stream = stream
        self._reader_gone = reader_gone

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write and flush."""
        try:
            self._stream.write(text)
            self._stream.flush()
        except self._reader_gone:  # the stream's buffer would fail again when Python exits
            with suppress(OSError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())
        return len(text)

    def flush(self) -> None:
        """Skip flushing, since `write` flushes."""
