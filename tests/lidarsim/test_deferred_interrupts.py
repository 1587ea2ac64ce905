"""Signals that wait until a piece of work is done."""

import signal
import subprocess
import sys

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


SWALLOWING = """
import signal
import subprocess
import sys
try:
    signal.raise_signal(signal.SIGINT)
    {more}
except BaseException:
    pass
"""
IMPORTING = """
import time
from lidarsim.environment import interrupts
interrupts._IMPATIENT_S = 0.1
interrupts.interrupt_on_signals()
try:
    import swallowing
    print("imported", flush=True)
    time.sleep(60)
except KeyboardInterrupt:
    print("interrupted")
"""


def run_import(folder, more):
    """Import a module that catches the error of a signal, which arrives meanwhile."""
    (folder / "swallowing.py").write_text(SWALLOWING.format(more=more))
    return subprocess.run(
        [sys.executable, "-c", IMPORTING], cwd=folder, capture_output=True, text=True, check=False
    )


def test_a_signal_during_an_import_is_handled_after_the_import(tmp_path):
    process = run_import(tmp_path, "")
    assert process.stdout.splitlines()[-1] == "interrupted"
    assert (process.returncode, process.stderr) == (0, "")


def test_a_second_signal_ends_an_import(tmp_path):
    more = "import time; time.sleep(0.2); signal.raise_signal(signal.SIGINT); time.sleep(60)"
    process = run_import(tmp_path, more)
    assert process.returncode == 130
    assert process.stdout == ""
    assert "stopped at once" in process.stderr
