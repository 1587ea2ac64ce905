"""Ctrl-C and SIGTERM: once stops cleanly, twice stops now, and neither hits a worker."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker
from types import FrameType

INTERRUPTED = 130  # exit code, as shells give it to whatever Ctrl-C ended

_SIGNALS = (signal.SIGINT, signal.SIGTERM)  # from the keyboard, and from a job manager
_IMPATIENT_S = 1.0  # a second signal sooner than this is the first one's twin


def interrupt_on_signals() -> None:
    """Turn SIGINT and SIGTERM into KeyboardInterrupt; a second one ends the process at once."""
    first: list[float] = []

    def interrupt(number: int, frame: FrameType | None) -> None:
        if not first:
            first.append(time.monotonic())
            raise KeyboardInterrupt
        if time.monotonic() - first[0] > _IMPATIENT_S:
            os.write(2, b"lidarpool: stopped at once; workers of this machine end by themselves.\n")
            os._exit(INTERRUPTED)

    for number in _SIGNALS:
        signal.signal(number, interrupt)


@contextmanager
def deferred_interrupts() -> Iterator[None]:
    """Hold signals back while the body runs, then raise KeyboardInterrupt if there was one.

    For what must be done whole or not at all: starting processes, moving a result into place.
    Only the main thread of a program gets signals; elsewhere this does nothing.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    seen: list[int] = []
    before = {n: signal.signal(n, lambda number, _: seen.append(number)) for n in _SIGNALS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if seen:
            signal.raise_signal(seen[0])


@contextmanager
def children_spared() -> Iterator[None]:
    """Start processes in the body, and threads that start some later, which Ctrl-C spares.

    A terminal sends SIGINT to the whole process group. Workers that it hits die with a
    traceback each, before whoever started them can stop them in good order. A blocked signal
    stays blocked in threads and processes that come after, also in a worker that a nanny
    starts again.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    # It is started with the first process, and whoever starts it has SIGINT unblocked after.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
