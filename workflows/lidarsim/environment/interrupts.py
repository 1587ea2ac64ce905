"""Ctrl-C, SIGTERM, SIGHUP: the first stops cleanly, the second at once, without workers."""

from __future__ import annotations

import os
import signal
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from types import FrameType
from typing import NoReturn

INTERRUPTED = 130  # exit code of shells for a program ended by Ctrl-C
STOPPED = "Interrupted. All processes were stopped"
UNTOUCHED = f"{STOPPED}, and the output folder is unchanged."

# From the keyboard, from a job manager, and from a terminal that is closed.
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_IMPATIENT_S = 1.0  # a second signal sooner than this counts as the first
_RETRY_S = 0.01
# Files with the callbacks of weak references.
_WEAK = {weakref.__file__, weakref.WeakSet.add.__code__.co_filename}


class _Interrupt:
    """A signal handler: KeyboardInterrupt the first time, the end of the process the next."""

    def __init__(self) -> None:
        self.first_at: float | None = None

    def __call__(self, number: int, frame: FrameType | None) -> None:
        if self.first_at is None:
            if _drops_errors(frame):  # send the signal again, a little later, from a thread
                main = threading.main_thread().ident
                # A signal to the thread also interrupts its waiting for a lock.
                threading.Timer(_RETRY_S, signal.pthread_kill, (main, signal.SIGINT)).start()
                return
            self.first_at = time.monotonic()
            raise KeyboardInterrupt
        if time.monotonic() - self.first_at > _IMPATIENT_S:
            _exit_at_once(
                b"lidarpool: stopped at once; workers of this machine end by themselves.\n"
            )


def _drops_errors(frame: FrameType | None) -> bool:
    """Return True if an object may be being finalized: Python drops errors raised there."""
    while frame is not None:
        code = frame.f_code
        if code.co_name == "__del__" or code.co_filename in _WEAK:
            return True
        frame = frame.f_back
    return False


def end_on_signals() -> None:
    """Let the signals end the process at once, as long as no work has started."""
    _on_signals(lambda number, frame: _exit_at_once(f"lidarpool: {UNTOUCHED}\n".encode()))


def interrupt_on_signals() -> None:
    """Turn the first signal into KeyboardInterrupt, and end the process at once at the second."""
    _on_signals(_Interrupt())


def _on_signals(handler: Callable[[int, FrameType | None], object]) -> None:
    """Handle the signals by a handler, except signals that `nohup` ignores."""
    for number in _SIGNALS:
        # With `nohup` a run survives the closing of its terminal.
        if signal.getsignal(number) is not signal.SIG_IGN or number == signal.SIGINT:
            signal.signal(number, handler)


def _exit_at_once(message: bytes) -> NoReturn:
    """End the process at once, with a message on stderr."""
    with suppress(OSError):  # the terminal may be gone
        os.write(2, message)
    os._exit(INTERRUPTED)


@contextmanager
def deferred_interrupts() -> Iterator[None]:
    """Defer signals while the body runs, then raise KeyboardInterrupt for the first signal.

    For indivisible actions: starting and stopping processes, moving a result to its folder. Only
    the main thread of a program gets signals; in other threads, the body just runs. A second signal
    to an interrupted program is not deferred.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    signals: list[int] = []
    handlers = {n: signal.getsignal(n) for n in _SIGNALS}
    # A handler that has seen a first signal raises no errors, and the user is impatient. A handler
    # from outside of Python (None) could not be restored.
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
def children_spared() -> Iterator[None]:
    """Protect processes and threads started in the body from Ctrl-C.

    A terminal sends SIGINT and SIGQUIT to the whole process group, and SIGHUP when it is closed.
    Workers would die with a traceback each before they can be stopped cleanly, and so would their
    nannies. A blocked signal stays blocked in later threads and processes, including a worker that
    a nanny restarts.
    """
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGHUP, signal.SIGQUIT})
    try:
        # The tracker would start with the first process, and starting it unblocks SIGINT.
        resource_tracker.ensure_running()
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
