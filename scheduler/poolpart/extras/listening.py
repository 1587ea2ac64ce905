"""A function of this process that gets the items of a pipe."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Self

from dask.utils import funcname

from ..errors import PipeClosed, PipeFailed
from .background import in_background

if TYPE_CHECKING:
    from ..pipe import Pipe

_LOOK_S = 1.0  # between looks whether the listener was stopped


class Listener:
    """Thread that calls a function for each item of a pipe, as `Pipe.listen` starts it.

    At the end of a ``with`` block it is closed. If the block raises an error, the function is not
    called again, and the block does not wait for the end of the pipe.
    """

    def __init__(self, pipe: Pipe, function: Callable[[Any], Any]) -> None:
        self._pipe = pipe
        self._function = function
        self._stopped = threading.Event()
        self._done = in_background(self._listen)

    def close(self) -> None:
        """Wait until the pipe has ended and the function has got all items.

        Raises
        ------
        PipeFailed
            If the pipe was failed or deleted.
        Exception
            What the function has raised.
        """
        self._done.result()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        if error is None:
            self.close()
        else:
            self._stopped.set()
            self._done.exception()  # waits for a call that runs

    def _listen(self) -> None:
        """Call the function until the pipe ends, or this is stopped."""
        try:
            while not self._stopped.is_set():
                try:
                    item = self._pipe.get(timeout_s=_LOOK_S)
                except PipeClosed:
                    return
                except TimeoutError:
                    continue
                self._function(item)
        except BaseException as error:
            with suppress(PipeFailed, OSError):  # the pipe or the scheduler is gone
                self._pipe.fail(f"{funcname(self._function)} has failed: {error!r}")
            raise
