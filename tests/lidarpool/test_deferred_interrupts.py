"""Signals that are held back while something is done whole."""

from __future__ import annotations

import signal

import pytest

from lidarpool.base.interrupts import deferred_interrupts


def raise_within(number):
    """Names of what was reached when a signal came within the body."""
    reached = []
    with deferred_interrupts():
        signal.raise_signal(number)
        reached.append("body")
    return reached


@pytest.fixture
def own_handler():
    """A handler that notes what comes."""
    seen, before = [], signal.signal(signal.SIGTERM, lambda number, _: seen.append(number))
    yield seen
    signal.signal(signal.SIGTERM, before)


def test_a_signal_comes_when_the_body_is_done(own_handler):
    with deferred_interrupts():
        signal.raise_signal(signal.SIGTERM)
        assert own_handler == []
    assert own_handler == [signal.SIGTERM]


def test_what_is_ignored_stays_ignored():
    before = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    try:
        assert raise_within(signal.SIGTERM) == ["body"]
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGTERM, before)


def test_a_handler_that_python_does_not_know_is_left_alone(monkeypatch, own_handler):
    """One that a program installed which runs Python within itself."""
    monkeypatch.setattr(signal, "getsignal", lambda number: None)
    assert raise_within(signal.SIGTERM) == ["body"]
    assert own_handler == [signal.SIGTERM]
