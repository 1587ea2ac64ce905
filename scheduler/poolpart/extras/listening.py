"""Listeners that call a function in this process for each item of a pipe."""

from __future__ import annotations

import concurrent.futures
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Protocol, Self

from dask.utils import funcname

from ..errors import PipeClosed, PipeFailed
from .background import run_in_background

_CHECK_S = 1.0  # interval at which the thread checks whether the listener was closed


class ItemSource(Protocol):
    """The part of a `Pipe` that a listener uses."""

    name: str

    def get(self, timeout_s: float | None = None) -> Any:
        """Remove and return the next item."""

    def fail(self, reason: str) -> None:
        """Make the pipe fail."""


class PipeListener:
    """Background thread, started by `Pipe.listen`, that calls a function for each item of a pipe.

    `join` waits until the pipe has ended, and `close` stops listening. At the end of a ``with``
    block, the listener is joined, or closed if the block raises an error.

    Notes
    -----
    If a task at either end of the pipe fails, the pipe fails, and `join` raises `PipeFailed`. The
    same applies after `Client.restart`. See `Pipe` for details.

    Examples
    --------
    >>> listener = hits.listen(print)                                    # doctest: +SKIP
    >>> listener.join(timeout_s=60)                                      # doctest: +SKIP
    """

    def __init__(
        self,
        pipe: ItemSource,
        function: Callable[[Any], Any],
        put_back: Callable[[Any], None],
    ) -> None:
        self._pipe = pipe
        self._put_back = put_back
        self._function = function
        self._closed = threading.Event()
        self._calling = threading.Lock()  # held while the function runs
        self._thread: threading.Thread | None = None  # not the ID, because IDs are reused
        self._done = run_in_background(self._listen)

    def join(self, timeout_s: float | None = None) -> None:
        """Wait until the pipe has ended and the function has processed all items.

        After `close`, this method returns immediately.

        Parameters
        ----------
        timeout_s
            Maximum time to wait, in seconds. By default, there is no limit.

        Raises
        ------
        PipeFailed
            If the pipe has failed or was deleted, or if the cluster was restarted.
        TimeoutError
            If the pipe has not ended within `timeout_s`. The listener keeps running.
        RuntimeError
            If the function itself calls this method.
        Exception
            The error that the function raised, if any.
        """
        if threading.current_thread() is self._thread:
            raise RuntimeError(
                f"Function {funcname(self._function)!r} waits for the end of its own listener. "
                "Call `join` in another thread, or stop listening with `close`."
            )
        concurrent.futures.wait([self._done], timeout_s)
        if not self._done.done():
            raise TimeoutError(f"Pipe {self._pipe.name!r} did not end within {timeout_s} s.")
        self._done.result()

    def close(self) -> None:
        """Stop listening without waiting for the end of the pipe.

        If the function is currently running, this method waits for it to return. The function is
        not called again, and the remaining items stay in the pipe. Errors from the function or the
        pipe are not raised here. To raise them, call `join`.
        """
        self._closed.set()
        if threading.current_thread() is self._thread:
            return
        with self._calling:
            pass
        # The thread ends at its next check unless the scheduler does not respond.
        concurrent.futures.wait([self._done], 2 * _CHECK_S)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        if error is None:
            self.join()
        else:
            self.close()

    def _listen(self) -> None:
        """Call the function for each item until the pipe ends or the listener is closed."""
        self._thread = threading.current_thread()
        try:
            while not self._closed.is_set():
                try:
                    item = self._pipe.get(timeout_s=_CHECK_S)
                except PipeClosed:
                    return
                except TimeoutError:
                    continue
                except (PipeFailed, OSError):  # the pipe or the scheduler is gone
                    if self._closed.is_set():
                        return
                    raise
                with self._calling:
                    if self._closed.is_set():
                        self._put_back(item)
                        return
                    self._function(item)
        except BaseException as error:
            with suppress(PipeFailed, OSError):  # the pipe or the scheduler is gone
                self._pipe.fail(f"Function {funcname(self._function)!r} failed: {error!r}")
            raise
