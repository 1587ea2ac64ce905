"""What is said of a run: bars as long as there is a terminal, or else lines that come seldom."""

import os
import re
import sys
from contextlib import suppress
from dataclasses import replace
from io import StringIO

import pytest
from rich.console import Console

import lidarpool.cli.commands
from lidarpool.cli.terminal import PlainLines, Terminal, WrittenLines
from lidarpool.run.progress import Progress, bars, local_progress_bars


def progress(seconds: float, scans: int, trials: int = 0) -> Progress:
    return Progress(seconds, 100, scans, scans, scans, scans, 7 * scans, 10, trials)


@pytest.mark.parametrize("kind", ["xterm", "dumb"])
def test_a_terminal_that_is_closed_ends_nothing(kind, monkeypatch):
    try:
        master, slave = os.openpty()
    except OSError as error:
        pytest.skip(f"there are no pseudo-terminals here: {error}")
    monkeypatch.setenv("TERM", kind)
    stream = os.fdopen(slave, "w")
    monkeypatch.setattr(sys, "stderr", stream)
    with Terminal().progress() as show:
        show(progress(60.0 * 3, 3))
        said = os.read(master, 1 << 16)
        os.close(master)
        with pytest.raises(OSError, match="Input/output error"):
            os.write(slave, b"x")
        show(progress(60.0 * 6, 6))
        show(progress(60.0 * 9, 9))
    with Terminal().status("writing"):
        pass
    assert said
    with suppress(OSError):  # what it could not write it tries to write once more
        stream.close()


def test_a_terminal_shows_what_is_written_and_how_far(monkeypatch):
    console = Console(file=StringIO(), force_terminal=True, width=90)
    monkeypatch.setattr(Terminal, "console", console)
    with Terminal().writing("writing the cloud") as show:
        show("cloud.ply", 6000, 8000, "points")
        show("cloud.ply", 8000, 8000, "points")
        show("pictures", 1, 4, "pictures")
    plain = re.sub(r"\x1b\[[^a-zA-Z]*[a-zA-Z]|[━╸╺]", "", console.file.getvalue())
    told = [" ".join(line.split()) for line in plain.splitlines()]
    assert {"cloud.ply 8000/8000 points", "pictures 1/4 pictures"} <= {*told}


def test_progress_counts_sweeps_beside_scans(capsys):
    told = Progress(8.0, 100, 60, 60, 50, 50, 350, sweeps=3, sweeps_done=1)
    lines = PlainLines(sys.stderr)
    lines(told)
    lines(Progress(9.0, 100, 100, 100, 100, 100, 700, sweeps=3, sweeps_done=3))
    written = [line.partition("  ")[2] for line in capsys.readouterr().err.splitlines()]
    assert written[0] == "survey  50 of 100 scans (1 of 3 sweeps), 350 points"
    assert written[1] == "survey  done: 100 scans (3 sweeps), 700 points in 9.0 s"
    console = Console(file=StringIO(), force_terminal=True, width=120)
    with bars(console) as show:
        show(told)
    plain = re.sub(r"\x1b\[[^a-zA-Z]*[a-zA-Z]|[━╸╺]", "", console.file.getvalue())
    collected = [line for line in plain.splitlines() if "4 collect" in line]
    assert collected[-1].rstrip().endswith("1 of 3 sweeps")


def test_a_log_has_a_line_on_what_is_written(capsys):
    with Terminal().writing("writing the cloud") as show:
        show("cloud.ply", 1, 8000, "points")
    assert [line[10:] for line in capsys.readouterr().err.splitlines()] == ["writing the cloud"]


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


def lines_of(stream: StringIO) -> list[str]:
    """Lines without their times."""
    return [line[10:] for line in stream.getvalue().splitlines()]


def test_plain_lines_come_seldom_and_tell_rate_and_time_left():
    stream = StringIO()
    show = PlainLines(stream)
    for tenth in range(0, 51):
        show(progress(tenth / 10, 2 * tenth))
    assert lines_of(stream) == [
        "survey  40 of 100 scans, 280 points  20/s  3 s left",
        "planning  0 of 10 trials",
        "survey  80 of 100 scans, 560 points  20/s  1 s left",
        "planning  0 of 10 trials",
        "survey  done: 100 scans, 700 points in 5.0 s",
    ]


def test_plain_lines_tell_why_nothing_goes_on():
    stream = StringIO()
    show = PlainLines(stream)
    show(progress(1.0, 10))
    for second in range(2, 4):
        show(replace(progress(float(second), 20), waits_for="LIDAR"))
    show(progress(4.1, 40))
    run = [line for line in lines_of(stream) if line.startswith("run")]
    words = "waiting for LIDAR slots held by other runs"
    assert run == [f"run  {words}, 20 scans are done", "run  continues, 40 scans are done"]
    assert len(lines_of(stream)) - len(run) == 4


def test_lines_of_what_is_written_come_seldom(monkeypatch):
    now = 100.0
    monkeypatch.setattr("lidarpool.cli.terminal.time.monotonic", lambda: now)
    stream = StringIO()
    show = WrittenLines(stream)
    for frame in range(1, 41):
        now += 0.25
        show("film", frame, 40, "frames")
    assert lines_of(stream) == [f"film  {done} of 40 frames" for done in (9, 17, 25, 33)]


@pytest.mark.parametrize("terminal", [True, False])
def test_a_script_has_bars_at_a_terminal_and_nothing_elsewhere(terminal, monkeypatch):
    stream = StringIO()
    stream.isatty = lambda: terminal
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setenv("TERM", "xterm")
    with local_progress_bars() as show:
        show(progress(1.0, 50))
    assert ("2 intersect" in stream.getvalue()) == terminal
