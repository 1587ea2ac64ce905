"""Output that nobody reads any more."""

from __future__ import annotations

import os
from contextlib import suppress
from typing import Any, TextIO


class Unheard:
    """A stream whose writes do not fail once its reader has `gone`: a run goes on without.

    Each write is flushed; other errors are raised.
    """

    def __init__(self, stream: TextIO, gone: type[OSError] = OSError) -> None:
        self._stream = stream
        self._gone = gone

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write and flush."""
        try:
            self._stream.write(text)
            self._stream.flush()
        except self._gone:  # its buffer would fail again when Python exits
            with suppress(OSError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())
        return len(text)

    def flush(self) -> None:
        """Do nothing: `write` flushes."""
