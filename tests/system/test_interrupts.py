"""Runs that are interrupted, killed, or lose their cluster: how they end and what they leave."""

import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.commands import RunningCommand

from lidarpool.report.result_files import FILES
from lidarsim.io import storage

pytestmark = pytest.mark.skipif(
    not Path("/proc/self/environ").exists(), reason="finds the processes of a run through /proc"
)

# Hours of work; and work of a second.
LONG = f"""
scene: seed
sensor: {{rays_per_revolution: 3600, layers: 16, step_deg: 1}}
poses: {[[0, 0, 1 + i / 100] for i in range(100)]}
steps: 3600
planning: {{start: [25, 25], target: [-30, -20], trials: 100000}}
pool: {{gpu: 1, other: 1}}
"""
PLAIN = "scene: seed\nsensor: {layers: 4}\n"
ENDS = "start: [25, 25], target: [-30, -20]"
SHORT = f"{PLAIN}planning: {{{ENDS}, trials: 2, iterations: 20}}\n"

SURVEYING = r"survey  [1-9]"
WRITING = r"writing the cloud"

# A run that is never over before whoever is to end it has its turn.
STAYS_STARTING = """
import time
import distributed
distributed.Client.register_worker_callbacks = lambda *_: time.sleep(600)
"""
STAYS_WRITING = """
import time
import lidarpool.report.result_pictures as pictures
pictures.draw_scene = lambda *_, **__: time.sleep(600)
"""


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
    """Whether the earlier result is all there is, beside what is kept of the run, if anything.

    A run that was `killed` leaves its growing cloud, which the next run in that folder removes.
    """

    def untouched(*, kept: bool = False, killed: bool = False) -> bool:
        names = {path.name for path in (tmp_path / "out").iterdir()}
        if killed:
            names = {name for name in names if not name.startswith(storage.WRITING)}
        earlier = (tmp_path / "out" / "cloud.ply").read_text() == "an earlier cloud"
        return earlier and names == ({"cloud.ply", "run"} if kept else {"cloud.ply"})

    return untouched


KEPT = r"[\d,]+ of 360,000 scans are stored in \S+/out/run\. Continue with `--resume` \(.*\)\.$"


def check_interrupted(run: Any, code: int) -> None:
    assert code == 130
    assert run.said.splitlines()[-1].startswith(
        "lidarpool: Interrupted. All processes were stopped"
    )
    assert said_besides_progress(run) == run.said.splitlines()[-1:]
    # Python's own helper process sees the end of its parent, and ends a moment after it.
    run.wait_until_alone()


def said_besides_progress(run: Any) -> list[str]:
    """What it said but for lines with a time stamp, and notes of a page and of compiling."""
    lines = [line for line in run.said.splitlines() if line.strip()]
    usual = r"\d\d:\d\d:\d\d  |note: (partitions|compiled)"
    return [line for line in lines if not re.match(usual, line)]


# Under nohup the tests ignore hangups, and what they start inherits that.
NOT_IGNORED = "import signal; signal.signal(signal.SIGHUP, signal.SIG_DFL)\n"


@pytest.mark.parametrize(
    ("number", "local"),
    [
        (signal.SIGINT, False),
        pytest.param(signal.SIGINT, True, marks=pytest.mark.extended),
        pytest.param(signal.SIGTERM, False, marks=pytest.mark.slow),
        pytest.param(signal.SIGHUP, False, marks=pytest.mark.slow),
    ],
    ids=["Ctrl-C", "Ctrl-C of a local run", "from a job manager", "the terminal is closed"],
)
def test_an_interrupted_survey_ends_cleanly(number, local, start, untouched, cluster):
    options = () if local else ("--scheduler", cluster)
    run = start(LONG, *options, prelude=NOT_IGNORED).wait_for(SURVEYING)
    check_interrupted(run, run.signal(number, group=True))
    assert re.search(rf"All processes were stopped\. {KEPT}", run.said)
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
        "armed", "lidarpool: Interrupted. All processes were stopped, and the output folder is "
        "unchanged.",
    }  # fmt: skip
    assert untouched()


@pytest.mark.slow
def test_ctrl_c_while_the_workers_start(start, untouched):
    run = start(LONG, prelude=STAYS_STARTING).wait_for("starting the workers")
    check_interrupted(run, run.signal(signal.SIGINT, group=True))
    assert untouched()


@pytest.mark.extended
def test_ctrl_c_when_the_result_is_whole(lidarpool, cluster, tmp_path, monkeypatch):
    """It is not said that nothing has happened, and there is nothing to resume."""
    replace = Path.replace

    def interrupted(path: Path, to: Path) -> Path:
        if to.absolute() == Path("out/cloud.ply").absolute():
            os.kill(os.getpid(), signal.SIGINT)
        return replace(path, to)

    (tmp_path / "s.yaml").write_text(PLAIN)
    monkeypatch.setattr(Path, "replace", interrupted)
    run = lidarpool("run", "s.yaml", "--out", "out", "--scheduler", cluster, "-q")
    assert run.code == 130
    assert run.err.strip() == (
        "lidarpool: Interrupted. All processes were stopped. The result in out is complete."
    )
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {name for name in FILES if not name.endswith(".png")}


BLOCKED = """
import re, subprocess, sys
from multiprocessing import resource_tracker
from pathlib import Path
from signal import SIGHUP, SIGINT, SIGQUIT
from lidarsim.environment.interrupts import block_child_signals

def blocked(process):
    mask = re.search(r"SigBlk:\\s+(\\w+)", Path(f"/proc/{process}/status").read_text())[1]
    return [number.name for number in (SIGINT, SIGHUP, SIGQUIT) if int(mask, 16) >> number - 1 & 1]

with block_child_signals():
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


# {what a signal comes to: a script, its exit code, and what it prints and says}
SIGNALED = {
    "a program under nohup": (
        "signal.signal(signal.SIGHUP, signal.SIG_IGN)\n"
        "for obey in (exit_on_signals, interrupt_on_signals):\n"
        "    obey()\n"
        "    signal.raise_signal(signal.SIGHUP)\n"
        "    with defer_interrupts(): signal.raise_signal(signal.SIGHUP)\n"
        "print('still here')\n",
        (0, "still here\n", ""),
    ),
    "one that was interrupted": (
        "interrupt_on_signals()\n"
        "try: signal.raise_signal(signal.SIGINT)\n"
        "except KeyboardInterrupt: pass\n"
        "signal.raise_signal(signal.SIGINT)\n"  # the first one's twin
        "time.sleep(1.1)\n"
        "with defer_interrupts():\n"
        "    signal.raise_signal(signal.SIGINT)\n"
        "    print('still here')\n",
        (130, "", "lidarpool: stopped at once"),
    ),
    "where Python drops what is raised, of a weak reference": (
        "import weakref\n"
        "class Task: pass\n"
        "def gone(): signal.raise_signal(signal.SIGINT)\n"
        "interrupt_on_signals()\n"
        "try:\n"
        "    task = Task()\n"
        "    weakref.finalize(task, gone)\n"
        "    del task\n"
        "    time.sleep(50)\n"
        "except KeyboardInterrupt: print('interrupted')\n",
        (0, "interrupted\n", ""),
    ),
    "where Python drops what is raised": (
        "class Future:\n"
        "    def __del__(self): signal.raise_signal(signal.SIGINT)\n"
        "interrupt_on_signals()\n"
        "try:\n"
        "    Future()\n"
        "    time.sleep(50)\n"
        "except KeyboardInterrupt: print('interrupted')\n",
        (0, "interrupted\n", ""),
    ),
}


@pytest.mark.parametrize("where", SIGNALED)
def test_a_signal_does_what_it_should(where):
    script, (code, out, err) = SIGNALED[where]
    script = f"import signal, time\nfrom lidarsim.environment.interrupts import *\n{script}"
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert (ended.returncode, ended.stdout, ended.stderr[: len(err)]) == (code, out, err)


@pytest.mark.slow
def test_workers_follow_a_driver_that_was_killed(start, untouched):
    run = start(LONG).wait_for(SURVEYING)
    assert len(run.processes) >= 4
    assert run.signal(signal.SIGKILL) == -signal.SIGKILL
    run.wait_until_alone()
    assert "Traceback" not in run.said
    assert untouched(kept=True, killed=True)


@pytest.mark.slow
def test_ctrl_c_while_the_result_is_written(start, untouched, cluster):
    options = ("--pictures", "--scheduler", cluster)
    run = start(SHORT, *options, prelude=STAYS_WRITING).wait_for(WRITING)
    check_interrupted(run, run.signal(signal.SIGINT, group=True))
    assert re.search(r"stopped\. 108 of 108 scans are stored in \S+/out/run", run.said)
    assert untouched(kept=True)


@pytest.mark.slow
def test_the_scheduler_of_an_outside_cluster_is_killed(start, untouched, outside):
    cluster = outside()
    cluster.add(("GPU", 1), ("LIDAR", 4), ("OTHER", 1))
    cluster.wait()
    run = start(LONG, "--scheduler", cluster.address).wait_for(SURVEYING)
    cluster.kill("scheduler")
    assert run.process.wait(300) == 2
    (message,) = said_besides_progress(run)
    assert message.startswith(f"lidarpool: The cluster at {cluster.address} is no longer reachable")
    assert re.search(KEPT, message)
    assert untouched(kept=True)
