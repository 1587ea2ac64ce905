"""Timeline of a command, which records when each step ends.

Steps are always recorded, even if the timeline is not shown, because `record_step` takes only about
one microsecond.
"""

from __future__ import annotations

import atexit
import os
import sys
import time
from html import escape
from pathlib import Path
from typing import NamedTuple

import psutil

# Names of the steps, which the documentation explains.
COMMAND = "command imported"
SCENE = "scene read"
WORKERS = "workers started"
CHECKED = "cluster checked"
FIRST_BATCH = "first batch offered"
FIRST_RECEIPT = "first receipt"
LAST_RECEIPT = "last receipt"
PLANNED = "paths planned"
STOPPED = "workers stopped"
CLOUD_WRITTEN = "cloud written"
REPORT_WRITTEN = "report written"
IN_PLACE = "result in place"
SUMMARY = "summary printed"
EXIT = "exit"

_PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Timeline of a run</title><style>
body {{ font: 15px/1.4 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem;
  color: #1c2733; background: #fff }}
table {{ border-collapse: collapse; width: 100% }}
td, th {{ padding: .2rem .6rem; text-align: right; white-space: nowrap }}
td:first-child, th:first-child {{ text-align: left }}
td:last-child {{ width: 60% }}
code {{ overflow-wrap: anywhere }}
svg {{ display: block; width: 100%; height: 1rem }}
rect {{ fill: #2a6fb0 }}
@media (prefers-color-scheme: dark) {{ body {{ color: #dde5ee; background: #10161d }}
  rect {{ fill: #6fb0ee }} }}
@media (max-width: 600px) {{ thead, tbody {{ display: block }}
  tr {{ display: grid; grid-template-columns: 1fr 5rem 6rem }}
  td, th {{ padding: .2rem 0 }} td:last-child {{ grid-column: 1 / -1; width: auto }} }}
</style></head><body><h1>Timeline of a run</h1><p><code>{command}</code>, started {begun}</p>
<table><thead><tr><th>step</th><th>duration (s)</th><th>end (s)</th><th></th></tr></thead><tbody>
{rows}
</tbody></table></body></html>
"""
_ROW = (
    '<tr><td>{name}</td><td>{takes:.2f}</td><td>{end:.2f}</td><td><svg viewBox="0 0 1000 16" '
    'preserveAspectRatio="none"><rect x="{x:.1f}" width="{width:.1f}" height="16"/></svg></td></tr>'
)


class TimelineStep(NamedTuple):
    """Step of a command, which starts at the end of the previous step."""

    name: str
    end_s: float  # seconds since the start of the process


def _age_s() -> float:
    """Return the age of this process in seconds."""
    if not hasattr(time, "CLOCK_BOOTTIME"):  # a system other than Linux
        return time.time() - psutil.Process().create_time()
    # psutil derives the start from the boot time, which was off by a second on machines whose clock
    # had been adjusted after booting.
    stat = Path("/proc/self/stat").read_text("ascii", errors="replace")
    start_ticks = int(stat.rpartition(")")[2].split()[19])
    return time.clock_gettime(time.CLOCK_BOOTTIME) - start_ticks / os.sysconf("SC_CLK_TCK")


class Timeline:
    """Steps of this process, in the order in which they ended."""

    def __init__(self) -> None:
        # Start of the process in seconds since 1970, with a resolution of 10 ms.
        self._started = time.time() - _age_s()
        self.steps: list[TimelineStep] = []

    def record_step(self, name: str) -> None:
        """Record that a step ends now, unless a step with the same name was recorded before."""
        if all(step.name != name for step in self.steps):
            self.steps.append(TimelineStep(name, time.time() - self._started))

    def table(self) -> str:
        """Return a text table with the name, duration and end of each step, in seconds."""
        lines = [f"{'step':<22}{'duration':>9}{'end':>9}"]
        start_s = 0.0
        for step in self.steps:
            lines.append(f"{step.name:<22}{step.end_s - start_s:>7.2f} s{step.end_s:>7.2f} s")
            start_s = step.end_s
        return "\n".join(lines) + "\n"

    def page(self, command: str) -> str:
        """Return an HTML page with a bar chart of the steps."""
        total_s = max(self.steps[-1].end_s, 1e-9) if self.steps else 1.0
        rows = []
        start_s = 0.0
        for step in self.steps:
            takes_s = step.end_s - start_s
            scale = 1000 / total_s
            rows.append(
                _ROW.format(
                    name=escape(step.name),
                    takes=takes_s,
                    end=step.end_s,
                    x=start_s * scale,
                    width=max(1.0, takes_s * scale),
                )
            )
            start_s = step.end_s
        begun = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(self._started))
        return _PAGE.format(command=escape(command), begun=begun, rows="\n".join(rows))

    def show_at_exit(self, path: Path) -> None:
        """When the process exits, write the page to a file and print the table to stderr.

        Call this before other functions are registered with `atexit`, so that their time is
        included. Functions that are registered later are called earlier.

        Raises
        ------
        OSError
            If the file cannot be written.
        """
        command = " ".join(["lidarpool", *sys.argv[1:]])
        path.touch()

        def show() -> None:
            self.record_step(EXIT)
            path.write_text(self.page(command), encoding="utf-8")
            if sys.stderr is not None:
                sys.stderr.write(self.table())

        atexit.register(show)


timeline = Timeline()
record_step = timeline.record_step
