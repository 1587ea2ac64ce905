"""Signals that wait until a piece of work is done."""

import signal

from lidarsim.base.interrupts import deferred_interrupts


def test_a_signal_is_handled_after_the_work():
    handled: list[str] = []
    before = signal.signal(signal.SIGTERM, lambda *_: handled.append("signal"))
    try:
        with deferred_interrupts():
            signal.raise_signal(signal.SIGTERM)
            handled.append("work")
    finally:
        signal.signal(signal.SIGTERM, before)
    assert handled == ["work", "signal"]


def test_a_handler_that_python_does_not_know_is_left_alone(monkeypatch):
    """A program that runs Python within itself may have installed it; nobody could put it back."""
    handled: list[str] = []
    before = signal.signal(signal.SIGTERM, lambda *_: handled.append("signal"))
    try:
        with monkeypatch.context() as patch:
            patch.setattr(signal, "getsignal", lambda number: None)
            with deferred_interrupts():
                signal.raise_signal(signal.SIGTERM)
                handled.append("work")
    finally:
        signal.signal(signal.SIGTERM, before)
    assert handled == ["signal", "work"]
