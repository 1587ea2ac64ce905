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

import pytest

pytestmark = pytest.mark.skipif(
    not Path("/proc/self/environ").exists(), reason="finds the processes of a run through /proc"
)

# Hours of work; and work of a second.
LONG = f"""
sensor: {{rays_per_revolution: 3600, layers: 16, step_deg: 1}}
poses: {[[0, 0, 1 + i / 100] for i in range(100)]}
steps: 3600
planning: {{trials: 100000}}
"""
SHORT = "sensor: {layers: 4}\nplanning: {trials: 2}\n"

COMMAND = "from lidarpool.cli import main; main()"
ENDS_WITHIN_S = 20  # on a busy machine; a second or two on an idle one
SURVEYING = r"survey  [1-9]"
WRITING = r"writing the cloud"


class Run:
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
                    prelude + COMMAND,
                    "run",
                    "s.yaml",
                    "--out",
                    "out",
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

    def wait_for(self, pattern: str) -> Run:
        """Wait until the run says something."""
        stop = time.monotonic() + 90
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
        self.process.wait(10)


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., Run]]:
    """Start runs whose result goes to a folder with an earlier one."""
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "cloud.ply").write_text("an earlier cloud")
    runs: list[Run] = []

    def start(*arguments: str, prelude: str = "") -> Run:
        runs.append(Run(tmp_path, *arguments, prelude=prelude))
        return runs[-1]

    yield start
    for run in runs:
        run.close()


@pytest.fixture
def untouched(tmp_path: Path) -> Callable[[], bool]:
    def untouched() -> bool:
        files = list((tmp_path / "out").iterdir())
        return files == [tmp_path / "out" / "cloud.ply"] and (
            files[0].read_text() == "an earlier cloud"
        )

    return untouched


def check_interrupted(run: Run, code: int) -> None:
    assert code == 130
    assert run.said.splitlines()[-1].startswith("lidarpool: interrupted; everything was stopped")
    assert said_besides_progress(run) == run.said.splitlines()[-1:]
    # Python's own helper process sees the end of its parent, and ends a moment after it.
    run.wait_until_alone(seconds=3)


def said_besides_progress(run: Run) -> list[str]:
    """What it said but for lines with a time stamp."""
    lines = [line for line in run.said.splitlines() if line.strip()]
    return [line for line in lines if not re.match(r"\d\d:\d\d:\d\d  ", line)]


@pytest.mark.parametrize(
    ("number", "group"),
    [(signal.SIGINT, False), (signal.SIGINT, True), (signal.SIGTERM, True)],
    ids=["INT", "Ctrl-C", "TERM"],
)
def test_an_interrupted_survey_ends_cleanly(number, group, start, untouched):
    run = start(LONG).wait_for(SURVEYING)
    check_interrupted(run, run.signal(number, group=group))
    assert untouched()


def test_ctrl_c_while_the_workers_start(start, untouched):
    run = start(LONG).wait_for("starting the workers")
    time.sleep(0.5)  # their Python has started, lidarpool is not yet imported
    check_interrupted(run, run.signal(signal.SIGINT, group=True))
    assert untouched()


def test_ctrl_c_while_pictures_are_written(start, untouched):
    run = start(SHORT).wait_for(WRITING)
    check_interrupted(run, run.signal(signal.SIGINT, group=True))
    assert untouched()


def test_a_second_ctrl_c_ends_it_at_once():
    script = (
        "import signal, time\n"
        "from lidarpool.interrupts import interrupt_on_signals\n"
        "interrupt_on_signals()\n"
        "try: signal.raise_signal(signal.SIGINT)\n"
        "except KeyboardInterrupt: pass\n"
        "signal.raise_signal(signal.SIGINT)\n"  # the first one's twin
        "time.sleep(1.1)\n"
        "signal.raise_signal(signal.SIGINT)\n"
        "print('still here')\n"
    )
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, check=False)
    assert (ended.returncode, ended.stdout) == (130, b"")
    assert ended.stderr.startswith(b"lidarpool: stopped at once")


def test_workers_follow_a_driver_that_was_killed(start, untouched):
    run = start(LONG).wait_for(SURVEYING)
    assert len(run.processes) >= 4
    assert run.signal(signal.SIGKILL) == -signal.SIGKILL
    run.wait_until_alone()
    assert "Traceback" not in run.said
    assert untouched()


def test_the_run_after_one_that_was_killed_while_writing(start, untouched, tmp_path):
    killed = start(SHORT).wait_for(WRITING)
    killed.signal(signal.SIGKILL)
    killed.wait_until_alone()
    assert (tmp_path / "out" / "cloud.ply").read_text() == "an earlier cloud"
    run = start(SHORT)
    assert run.process.wait(90) == 0, run.said
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {
        "cloud.ply", "scene.png", "intensity.png", "cloud.png", "path.png", "report.json",
    }  # fmt: skip


def test_the_scheduler_of_an_outside_cluster_is_killed(start, untouched, outside):
    cluster = outside()
    for name, slots in (("GPU", 1), ("LIDAR", 4), ("OTHER", 1)):
        cluster.add(name, slots=slots)
    cluster.wait()
    run = start(LONG, "--scheduler", cluster.address).wait_for(SURVEYING)
    cluster.kill("scheduler")
    assert run.process.wait(60) == 2
    (message,) = said_besides_progress(run)
    assert message.startswith(
        f"lidarpool: The cluster at {cluster.address} cannot be reached any more"
    )
    assert untouched()


def test_the_last_worker_of_a_partition_is_killed(start, untouched, outside):
    cluster = outside()
    for name, slots in (("GPU", 1), ("LIDAR", 4), ("OTHER", 1)):
        cluster.add(name, slots=slots)
    cluster.wait()
    patience = "import lidarpool.watch; lidarpool.watch.PATIENCE_S = 2\n"
    run = start(LONG, "--scheduler", cluster.address, prelude=patience).wait_for(SURVEYING)
    cluster.kill(next(name for name in cluster.processes if name.startswith("GPU")))
    assert run.process.wait(60) == 2
    (message,) = said_besides_progress(run)
    assert "Partition 'GPU' has had no workers for 2 s" in message
    assert '--resources "GPU=1"' in message
    assert untouched()
    assert "Traceback" not in cluster.log()
