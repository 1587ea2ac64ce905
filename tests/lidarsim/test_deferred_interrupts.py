"""Signals that wait until a piece of work is done."""

import signal

import pytest

from lidarsim.environment.interrupts import defer_interrupts


@pytest.fixture
def events():
    """What happens, in order; a handler of SIGTERM adds "signal"."""
    events: list[str] = []
    before = signal.signal(signal.SIGTERM, lambda *_: events.append("signal"))
    yield events
    signal.signal(signal.SIGTERM, before)


def work(events):
    with defer_interrupts():
        signal.raise_signal(signal.SIGTERM)
        events.append("work")


def test_a_signal_is_handled_after_the_work(events):
    work(events)
    assert events == ["work", "signal"]


def test_a_handler_that_python_does_not_know_is_left_alone(events, monkeypatch):
    """A program that runs Python within itself may have installed it; nobody could put it back."""
    with monkeypatch.context() as patch:
        patch.setattr(signal, "getsignal", lambda number: None)
        work(events)
    assert events == ["signal", "work"]
