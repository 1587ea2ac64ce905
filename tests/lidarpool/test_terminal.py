"""Progress goes to a terminal as long as there is one; a run does not depend on it."""

import os
import sys
from contextlib import suppress

import pytest

from lidarpool.cli.terminal import shown_progress, shown_status
from lidarpool.run.progress import Progress

pty = pytest.importorskip("pty", reason="there are no pseudo-terminals here", exc_type=ImportError)


def progress(done):
    return Progress(
        scans=9, generated=done, cast=done, framed=done, collected=done, points=done,
        trials=3, trials_done=done // 3, seconds=60.0 * done,
    )  # fmt: skip


@pytest.mark.parametrize("kind", ["xterm", "dumb"])
def test_a_terminal_that_is_closed_ends_nothing(kind, monkeypatch):
    master, slave = pty.openpty()
    monkeypatch.setenv("TERM", kind)
    stream = os.fdopen(slave, "w")
    monkeypatch.setattr(sys, "stderr", stream)
    with shown_progress() as show:
        show(progress(3))
        said = os.read(master, 1 << 16)
        os.close(master)
        with pytest.raises(OSError, match="Input/output error"):
            os.write(slave, b"x")
        show(progress(6))
        show(progress(9))
    with shown_status("writing"):
        pass
    assert said
    with suppress(OSError):  # what it could not write it tries to write once more
        stream.close()
