"""Progress as lines of text, where there is no terminal: seldom, with rate and time left."""

from dataclasses import replace
from io import StringIO

from lidarpool.cli.terminal import PlainLines
from lidarpool.run.progress import Progress


def progress(seconds: float, scans: int, trials: int = 0) -> Progress:
    return Progress(100, scans, scans, scans, scans, 7 * scans, 10, trials, seconds)


def said(stream: StringIO) -> list[str]:
    """Lines without their times."""
    return [line[10:] for line in stream.getvalue().splitlines()]


def test_plain_lines_come_seldom_and_tell_rate_and_time_left():
    stream = StringIO()
    show = PlainLines(stream)
    for tenth in range(0, 51):
        show(progress(tenth / 10, 2 * tenth))
    stages = "(1 generate {0}, 2 intersect {0}, 3 sort {0}, 4 collect {0})"
    assert said(stream) == [
        f"survey  40 of 100 scans {stages.format(40)}  20/s  3 s left",
        "planning  0 of 10 trials",
        f"survey  80 of 100 scans {stages.format(80)}  20/s  1 s left",
        "planning  0 of 10 trials",
        "survey  done: 100 scans, 700 points in 5.0 s",
    ]


def test_plain_lines_say_once_that_something_is_done():
    stream = StringIO()
    show = PlainLines(stream)
    for second in range(600):
        show(progress(float(second), 100, min(10, second // 60)))
    text = stream.getvalue()
    assert text.count("survey") == text.count("survey  done") == 1
    assert text.count("planning  done") == 0 and 20 < text.count("planning") < 60
    show(progress(600.0, 100, 10))
    show(progress(601.0, 100, 10))
    assert stream.getvalue().count("planning  done: 10 trials in 600.0 s") == 1


def test_plain_lines_tell_why_nothing_goes_on():
    stream = StringIO()
    show = PlainLines(stream)
    show(progress(1.0, 10))
    for second in range(2, 4):
        show(replace(progress(float(second), 20), waits_for="LIDAR"))
    show(progress(4.1, 40))
    run = [line for line in said(stream) if line.startswith("run")]
    words = "waits for slots of LIDAR, which other runs hold"
    assert run == [f"run  {words}, 20 scans are done", "run  goes on, 40 scans are done"]
    assert len(said(stream)) - len(run) == 4
