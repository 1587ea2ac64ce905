"""Handling of SIGINT (Ctrl-C), SIGTERM and SIGHUP.

The first signal shuts the program down cleanly. The second ends the process immediately, without
waiting for its workers.
"""

from __future__ import annotations

import _thread
import os
import signal
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import NoReturn

INTERRUPTED = 130  # exit code that shells report for a program ended by Ctrl-C
STOPPED = "Interrupted. All processes were stopped"
UNTOUCHED = f"{STOPPED}, and the output folder is unchanged."

# These signals are sent by the keyboard, by job managers, and when a terminal is closed.
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_IMPATIENT_S = 1.0  # a second signal within this time is considered part of the first
_RETRY_S = 0.01
# Files that define weak reference callbacks, and the import system.
_SILENT = {
    weakref.__file__,
    weakref.WeakSet.add.__code__.co_filename,
    "<frozen importlib._bootstrap>",
    "<frozen importlib._bootstrap_external>",
}


class _Interrupt:
    """Signal handler that first raises KeyboardInterrupt, and then ends the process."""

    def __init__(self) -> None:
        self.first_at: float | None = None
        self._postponed_at: float | None = None  # time of a signal that is waiting to be handled
        self._is_resent = False  # whether the next signal is sent by `_resend`

    def __call__(self, number: int, frame: FrameType | None) -> None:
        now = time.monotonic()
        is_resent = self._is_resent
        self._is_resent = False
        if self.first_at is None:
            if not _drops_errors(frame):
                self.first_at = now
                raise KeyboardInterrupt
            if self._postponed_at is None:
                self._postponed_at = now
            if is_resent or now - self._postponed_at <= _IMPATIENT_S:
                # threading.Timer takes a lock that the interrupted code may hold.
                _thread.start_new_thread(self._resend, (number,))
                return
            self.first_at = self._postponed_at
        if now - self.first_at > _IMPATIENT_S:
            _exit_at_once(
                b"lidarpool: stopped at once; workers of this machine end by themselves.\n"
            )

    def _resend(self, number: int) -> None:
        time.sleep(_RETRY_S)
        self._is_resent = True
        # A signal sent to the thread itself also interrupts a wait for a lock.
        signal.pthread_kill(threading.main_thread().ident or 0, number)


def _drops_errors(frame: FrameType | None) -> bool:
    """Return whether a finalizer, a weak reference callback or an import is running.

    Python ignores exceptions that are raised in the first two. Imports may also discard them: some
    packages catch all exceptions while they are imported, and extension modules ignore them. An
    import that was interrupted cannot be repeated either.
    """
    while frame is not None:
        code = frame.f_code
        if code.co_name == "__del__" or code.co_filename in _SILENT:
            return True
        frame = frame.f_back
    return False


def exit_on_signals() -> None:
    """End the process immediately on a signal.

    Use this function before any work has started.
    """
    _on_signals(lambda number, frame: _exit_at_once(f"lidarpool: {UNTOUCHED}\n".encode()))


def interrupt_on_signals() -> None:
    """Raise KeyboardInterrupt on the first signal, and end the process on the second."""
    _on_signals(_Interrupt())


def _on_signals(handler: Callable[[int, FrameType | None], object]) -> None:
    """Install a handler for all signals except those that `nohup` ignores."""
    for number in _SIGNALS:
        # Under `nohup`, a run must survive when its terminal is closed.
        if signal.getsignal(number) is not signal.SIG_IGN or number == signal.SIGINT:
            signal.signal(number, handler)


def _exit_at_once(message: bytes) -> NoReturn:
    with suppress(OSError):  # the terminal may already be closed
        os.write(2, message)
    os._exit(INTERRUPTED)


@contextmanager
def defer_interrupts() -> Iterator[None]:
    """Defer signals until the context exits, and then handle the first one.

    Use this context for operations that must not be interrupted, such as starting and stopping
    processes or moving a result to its folder. It has no effect outside the main thread, because
    only the main thread receives signals. A second signal to a program that has already been
    interrupted is not deferred.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    signals: list[int] = []
    handlers = {n: signal.getsignal(n) for n in _SIGNALS}
    # A handler that has already received a signal no longer raises exceptions, and must end the
    # process without delay. A handler that was not installed from Python (None) cannot be restored.
    deferred = [
        number
        for number, handler in handlers.items()
        if handler not in (None, signal.SIG_IGN) and getattr(handler, "first_at", None) is None
    ]
    for number in deferred:
        signal.signal(number, lambda number, _: signals.append(number))
    try:
        yield
    finally:
        for number in deferred:
            signal.signal(number, handlers[number])
        if signals:
            signal.raise_signal(signals[0])


@contextmanager
def block_child_signals() -> Iterator[None]:
    """Block Ctrl-C in processes and threads that are started in the context.

    A terminal sends SIGINT and SIGQUIT to the entire process group, as well as SIGHUP when it is
    closed. Without protection, every worker and nanny would exit with a traceback before it could
    be stopped cleanly. Threads and processes inherit blocked signals, which includes workers that a
    nanny restarts.
    """
    from multiprocessing import resource_tracker  # imported late, because --help needs no processes

    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGHUP, signal.SIGQUIT})
    try:
        # Starting the tracker unblocks SIGINT, so it must not start later with the first process.
        resource_tracker.ensure_running()
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
