"""A local cluster starts whole and stops whole, whenever its user interrupts."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import psutil
import pytest

from lidarpool.run.connection import local_client

SCRIPT = """
from lidarpool import Scene, Survey, simulate

if __name__ == "__main__":
    survey = Survey(poses=[(0, 0, 1)], steps=1_000_000)
    print("starting", flush=True)
    try:
        simulate(Scene.seed(), survey, gpu_workers=1, other_workers=1)
    except KeyboardInterrupt:
        print("interrupted", flush=True)
"""


@pytest.mark.slow
def test_simulate_leaves_nothing_when_it_is_interrupted_twice(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    with subprocess.Popen(
        [sys.executable, script],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    ) as run:
        assert run.stdout
        assert "starting" in run.stdout.readline()
        for _ in range(2):
            time.sleep(0.5)
            started = psutil.Process(run.pid).children(recursive=True)
            os.killpg(run.pid, signal.SIGINT)
        out, err = run.communicate(timeout=120)
    assert "interrupted" in out or err.rstrip().endswith("KeyboardInterrupt")
    # Python's own helper process ends a moment after its parent.
    _, alive = psutil.wait_procs(started, timeout=120)
    assert alive == []


def test_workers_are_forked_from_one_process_also_in_place_of_others():
    others = set(psutil.Process().children(recursive=True))  # of the tests' own cluster
    with local_client(gpu_workers=1, collectors=2, other_workers=0) as client:
        first = client.run(os.getpid)
        for pid in first.values():
            os.kill(pid, signal.SIGKILL)
        stop = time.monotonic() + 120
        while len(now := client.run(os.getpid, on_error="ignore")) < 2 or {*now} & {*first}:
            assert time.monotonic() < stop
            time.sleep(0.1)
        (server,) = set(client.run(os.getppid).values())
        assert psutil.Process(server).ppid() == os.getpid()
        modules = client.run(lambda: {"lidarpool.scan.stages", "open3d"} & sys.modules.keys())
        assert list(modules.values()) == [{"lidarpool.scan.stages"}] * 2
    assert set(psutil.Process(server).children()) <= others
