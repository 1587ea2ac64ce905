"""What is said to a terminal: progress as long as there is one, and nothing that commands it."""

import os
import sys
from contextlib import suppress

import pytest

import lidarpool.cli.commands
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


def test_a_complaint_commands_no_terminal(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(lidarpool.cli.commands, "interrupt_on_signals", lambda: None)
    monkeypatch.setattr(lidarpool.cli.commands, "set_logs", lambda shown: None)
    path = tmp_path / "s.yaml"
    path.write_text('scene: {files: ["\\e]0;title\\a\\r\\u202e.ply"]}\n')
    with pytest.raises(SystemExit):
        lidarpool.cli.commands.main(["run", str(path)])
    said = capsys.readouterr().err
    assert "title" in said
    assert all(line.isprintable() for line in said.splitlines())
