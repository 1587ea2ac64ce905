"""Runs that are interrupted, killed, or lose their cluster: how they end and what they leave."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from lidarpool.report.output import FILES

pytestmark = pytest.mark.skipif(
    not Path("/proc/self/environ").exists(), reason="finds the processes of a run through /proc"
)

# Hours of work; and work of a second.
LONG = f"""
sensor: {{rays_per_revolution: 3600, layers: 16, step_deg: 1}}
poses: {[[0, 0, 1 + i / 100] for i in range(100)]}
steps: 3600
planning: {{trials: 100000}}
pool: {{gpu: 1, other: 1}}
"""
SHORT = "sensor: {layers: 4}\nplanning: {trials: 2, iterations: 20}\n"

SURVEYING = r"survey  [1-9]"
WRITING = r"writing the cloud"

# A run that is never over before whoever is to end it has its turn.
STAYS_STARTING = """
import time
import lidarpool.cli.run_command
lidarpool.cli.run_command.WorkerLogs = lambda shown: time.sleep(600)
"""
STAYS_WRITING = """
import time
import lidarpool.report.pictures as pictures
pictures.draw_scene = lambda *_, **__: time.sleep(600)
"""


ENDS_WITHIN_S = 300  # on a busy machine; a second or two on an idle one


class RunningCommand:
    """The command in a process group of its own, as a shell starts it."""

    def __init__(self, folder: Path, scenario: str, *options: str, prelude: str = "") -> None:
        (folder / "s.yaml").write_text(scenario)
        self.tag = uuid.uuid4().hex
        self.log = folder / f"{self.tag}.log"
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(
                [
                    sys.executable,
                    "-c",
                    prelude + "from lidarpool.__main__ import main; main()",
                    "run",
                    "s.yaml",
                    "--out",
                    "out",
                    "--overwrite",
                    *options,
                ],
                cwd=folder,
                stdout=log,
                stderr=log,
                start_new_session=True,
                env={
                    **os.environ,
                    "PYTHONPATH": os.pathsep.join(sys.path),
                    "TEST_RUN_TAG": self.tag,
                },
            )

    def wait_for(self, pattern: str) -> RunningCommand:
        """Wait until the run says something."""
        stop = time.monotonic() + ENDS_WITHIN_S
        while not re.search(pattern, self.said):
            assert self.process.poll() is None, self.said
            assert time.monotonic() < stop, self.said
            time.sleep(0.02)
        return self

    @property
    def said(self) -> str:
        """What it has written so far, its workers included."""
        return self.log.read_text()

    def signal(self, number: int, *, group: bool = False) -> int:
        """Send a signal, wait for the end, return the exit code."""
        (os.killpg if group else os.kill)(self.process.pid, number)
        return self.process.wait(ENDS_WITHIN_S)

    @property
    def processes(self) -> set[int]:
        """Processes of this run that are alive, workers included."""
        found = set()
        for entry in Path("/proc").iterdir():
            if entry.name.isdigit():
                try:
                    if self.tag.encode() in (entry / "environ").read_bytes():
                        found.add(int(entry.name))
                except (OSError, ProcessLookupError):
                    continue  # it has ended, or is another user's
        return found

    def wait_until_alone(self, seconds: float = ENDS_WITHIN_S) -> None:
        """Wait until no process is left."""
        stop = time.monotonic() + seconds
        while self.processes:
            assert time.monotonic() < stop, self.processes
            time.sleep(0.1)

    def close(self) -> None:
        for process in self.processes:
            os.kill(process, signal.SIGKILL)
        self.process.wait(300)


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., RunningCommand]]:
    """Start runs of a scenario, its text given, into a folder with an earlier result.

    All that is left of them is killed in the end. `prelude` is Python that comes first.
    """
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "cloud.ply").write_text("an earlier cloud")
    runs: list[RunningCommand] = []

    def start(*arguments: str, prelude: str = "") -> RunningCommand:
        runs.append(RunningCommand(tmp_path, *arguments, prelude=prelude))
        return runs[-1]

    yield start
    for run in runs:
        run.close()


@pytest.fixture
def untouched(tmp_path: Path) -> Callable[[], bool]:
    """Whether the earlier result is all there is, beside what is kept of the run, if anything."""

    def untouched(*, kept: bool = False) -> bool:
        names = {path.name for path in (tmp_path / "out").iterdir()}
        earlier = (tmp_path / "out" / "cloud.ply").read_text() == "an earlier cloud"
        return earlier and names == ({"cloud.ply", "run"} if kept else {"cloud.ply"})

    return untouched


KEPT = r"[\d,]+ of 360,000 scans are kept in out/run: continue with --resume \(.*\)\.$"


def check_interrupted(run: Any, code: int) -> None:
    assert code == 130
    assert run.said.splitlines()[-1].startswith("lidarpool: interrupted; everything was stopped")
    assert said_besides_progress(run) == run.said.splitlines()[-1:]
    # Python's own helper process sees the end of its parent, and ends a moment after it.
    run.wait_until_alone()


def said_besides_progress(run: Any) -> list[str]:
    """What it said but for lines with a time stamp, and where there is a page."""
    lines = [line for line in run.said.splitlines() if line.strip()]
    return [line for line in lines if not re.match(r"\d\d:\d\d:\d\d  |note: partitions", line)]


# Under nohup the tests ignore hangups, and what they start inherits that.
NOT_IGNORED = "import signal; signal.signal(signal.SIGHUP, signal.SIG_DFL)\n"


@pytest.mark.parametrize(
    ("number", "local"),
    [
        (signal.SIGINT, True),
        pytest.param(signal.SIGTERM, False, marks=pytest.mark.slow),
        pytest.param(signal.SIGHUP, False, marks=pytest.mark.slow),
    ],
    ids=["Ctrl-C", "from a job manager", "the terminal is closed"],
)
def test_an_interrupted_survey_ends_cleanly(number, local, start, untouched, cluster):
    options = () if local else ("--scheduler", cluster)
    run = start(LONG, *options, prelude=NOT_IGNORED).wait_for(SURVEYING)
    check_interrupted(run, run.signal(number, group=True))
    assert re.search(rf"everything was stopped\. {KEPT}", run.said)
    assert untouched(kept=True)


ANNOUNCE = """
import signal, sys
arm = signal.signal
def announce(*what):
    arm(*what)
    print("armed", flush=True)
signal.signal = announce
"""


def test_ctrl_c_while_python_imports(start, untouched):
    run = start(LONG, prelude=ANNOUNCE).wait_for("armed\narmed")
    assert run.signal(signal.SIGINT, group=True) == 130
    assert {line for line in run.said.splitlines() if line} == {  # click ends the line of a ^C
        "armed", "lidarpool: interrupted; everything was stopped, and the output folder is as "
        "it was.",
    }  # fmt: skip
    assert untouched()


@pytest.mark.slow
def test_ctrl_c_while_the_workers_start(start, untouched):
    run = start(LONG, prelude=STAYS_STARTING).wait_for("starting the workers")
    check_interrupted(run, run.signal(signal.SIGINT, group=True))
    assert untouched()


@pytest.mark.parametrize("when", ["end_on_signals", "interrupt_on_signals"])
def test_nohup_is_obeyed(when):
    script = (
        "import signal\n"
        f"from lidarpool.base.interrupts import {when}, deferred_interrupts\n"
        "signal.signal(signal.SIGHUP, signal.SIG_IGN)\n"
        f"{when}()\n"
        "signal.raise_signal(signal.SIGHUP)\n"
        "with deferred_interrupts(): signal.raise_signal(signal.SIGHUP)\n"
        "print('still here')\n"
    )
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, check=False)
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, b"still here\n", b"")


def test_ctrl_c_when_the_result_is_whole(lidarpool, cluster, tmp_path, monkeypatch, no_pictures):
    """It is not said that nothing has happened, and there is nothing to resume."""
    replace = Path.replace

    def interrupted(path: Path, to: Path) -> Path:
        if to == Path("out/cloud.ply"):
            os.kill(os.getpid(), signal.SIGINT)
        return replace(path, to)

    (tmp_path / "s.yaml").write_text(SHORT)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Path, "replace", interrupted)
    run = lidarpool("run", "s.yaml", "--out", "out", "--scheduler", cluster, "-q", "--no-plan")
    assert run.code == 130
    assert run.err.strip() == (
        "lidarpool: interrupted; everything was stopped. The result in out is complete."
    )
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {*FILES} - {"path.png"}


BLOCKED = """
import re, subprocess, sys
from multiprocessing import resource_tracker
from pathlib import Path
from signal import SIGHUP, SIGINT, SIGQUIT
from lidarpool.base.interrupts import children_spared

def blocked(process):
    mask = re.search(r"SigBlk:\\s+(\\w+)", Path(f"/proc/{process}/status").read_text())[1]
    return [number.name for number in (SIGINT, SIGHUP, SIGQUIT) if int(mask, 16) >> number - 1 & 1]

with children_spared():
    worker = subprocess.Popen(["cat"], stdin=subprocess.PIPE)
    print(*blocked(worker.pid))
    worker.communicate()
print(*blocked(resource_tracker._resource_tracker._pid)[-2:])
print(*blocked("self"))
"""


def test_a_terminal_spares_workers_and_what_clears_up_behind_them():
    ended = subprocess.run([sys.executable, "-c", BLOCKED], capture_output=True, check=True)
    assert ended.stdout.decode().split("\n") == [
        "SIGINT SIGHUP SIGQUIT", "SIGHUP SIGQUIT", "", "",
    ]  # fmt: skip


def test_a_second_ctrl_c_ends_it_at_once():
    script = (
        "import signal, time\n"
        "from lidarpool.base.interrupts import deferred_interrupts, interrupt_on_signals\n"
        "interrupt_on_signals()\n"
        "try: signal.raise_signal(signal.SIGINT)\n"
        "except KeyboardInterrupt: pass\n"
        "signal.raise_signal(signal.SIGINT)\n"  # the first one's twin
        "time.sleep(1.1)\n"
        "with deferred_interrupts():\n"
        "    signal.raise_signal(signal.SIGINT)\n"
        "    print('still here')\n"
    )
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, check=False)
    assert (ended.returncode, ended.stdout) == (130, b"")
    assert ended.stderr.startswith(b"lidarpool: stopped at once")


def test_a_ctrl_c_where_python_drops_what_is_raised_comes_again():
    script = (
        "import signal, time\n"
        "from lidarpool.base.interrupts import interrupt_on_signals\n"
        "class Future:\n"
        "    def __del__(self): signal.raise_signal(signal.SIGINT)\n"
        "interrupt_on_signals()\n"
        "try:\n"
        "    Future()\n"
        "    time.sleep(50)\n"
        "except KeyboardInterrupt: print('interrupted')\n"
    )
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, check=False)
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, b"interrupted\n", b"")


def test_workers_follow_a_driver_that_was_killed(start, untouched):
    run = start(LONG).wait_for(SURVEYING)
    assert len(run.processes) >= 4
    assert run.signal(signal.SIGKILL) == -signal.SIGKILL
    run.wait_until_alone()
    assert "Traceback" not in run.said
    assert untouched(kept=True)


@pytest.mark.slow
def test_ctrl_c_while_the_result_is_written(start, untouched, cluster):
    run = start(SHORT, "--scheduler", cluster, prelude=STAYS_WRITING).wait_for(WRITING)
    check_interrupted(run, run.signal(signal.SIGINT, group=True))
    assert "stopped. 108 of 108 scans are kept in out/run" in run.said
    assert untouched(kept=True)


def test_the_scheduler_of_an_outside_cluster_is_killed(start, untouched, outside):
    cluster = outside()
    cluster.add(("GPU", 1), ("LIDAR", 4), ("OTHER", 1))
    cluster.wait()
    run = start(LONG, "--scheduler", cluster.address).wait_for(SURVEYING)
    cluster.kill("scheduler")
    assert run.process.wait(300) == 2
    (message,) = said_besides_progress(run)
    assert message.startswith(
        f"lidarpool: The cluster at {cluster.address} cannot be reached any more"
    )
    assert re.search(KEPT, message)
    assert untouched(kept=True)
