"""A local cluster starts and stops whole, whenever its user interrupts; others are waited for."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import time

import psutil
import pytest
from tests.clusters import cluster_of

from lidarpool import LidarpoolError
from lidarpool.run import waiting
from lidarpool.run.connection import connected, local_client
from lidarpool.run.waiting import Waiting

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
        modules = client.run(lambda: {"lidarpool.pipeline.stages", "open3d"} & sys.modules.keys())
        assert list(modules.values()) == [{"lidarpool.pipeline.stages"}] * 2
    assert set(psutil.Process(server).children()) <= others


@pytest.fixture
def address():
    """An address where nobody is."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        return f"tcp://127.0.0.1:{server.getsockname()[1]}"


@pytest.fixture
def waiting_run(tmp_path, address):
    """A run that waits for its scheduler, and has said so."""
    (tmp_path / "s.yaml").write_text(
        "sensor: {layers: 2, step_deg: 90}\nsteps: 2\nplanning: {enabled: false}\n"
    )
    command = ["run", "s.yaml", "--scheduler", address, "--wait", "10m", "--only", "cloud"]
    with subprocess.Popen(
        [sys.executable, "-m", "lidarpool", *command],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    ) as run:
        try:
            assert run.stderr
            said = run.stderr.readline()
            assert re.match(rf"note: waiting for the scheduler at {address}, for another 59\d s: ",
                            said), said + run.stderr.read()  # fmt: skip
            yield run
        finally:
            run.kill()


def test_a_scheduler_that_starts_later_is_waited_for(waiting_run, address, tmp_path):
    workers = {name: {"resources": {name: slots}} for name, slots in (("GPU", 1), ("LIDAR", 4))}
    with cluster_of(workers, {"port": int(address.rpartition(":")[2])}, host="127.0.0.1"):
        _, err = waiting_run.communicate(timeout=300)
    assert waiting_run.returncode == 0, err
    assert (tmp_path / "lidarpool-out" / "cloud.ply").exists()


def test_waiting_for_a_scheduler_ends_with_an_interrupt(waiting_run, tmp_path):
    waiting_run.send_signal(signal.SIGINT)
    _, err = waiting_run.communicate(timeout=60)
    assert waiting_run.returncode == 130
    assert err.splitlines()[-1].startswith("lidarpool: interrupted"), err


def test_a_scheduler_that_never_starts_is_named_with_the_time(address, monkeypatch):
    monkeypatch.setattr(waiting, "TELL_EVERY_S", 0.0)
    told: list[str] = []
    with (
        pytest.raises(LidarpoolError, match=rf"answers at '{address}' within 1.5 s \(Connection"),
        connected(address, waiting=Waiting(1.5, told.append)),
    ):
        pytest.fail("it is connected")
    assert told[0] == f"waiting for the scheduler at {address}, for another 1 s: nobody answers"


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("foo://127.0.0.1:8786", "unknown address scheme 'foo'"),
        ("tcp://::1:x", "ipv6 needs brackets"),
        ("tcp://127.0.0.1", "has no port"),
        ("tcp://:8786", "has no host"),
        ("tcp://127.0.0.1:87860", "has the port 87860: ports are 1 to 65535"),
    ],
)
def test_waiting_does_not_mend_a_malformed_address(address, message):
    with pytest.raises(LidarpoolError, match=message), connected(address, waiting=Waiting(3600)):
        pytest.fail("it is connected")
