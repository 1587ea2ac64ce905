"""A local cluster starts and stops whole, whenever its user interrupts; others are waited for."""

import os
import signal
import socket
import sys
import time
from multiprocessing import forkserver

import dask
import psutil
import pytest
from tests.clusters import cluster_of
from tests.commands import RunningCommand

from lidarpool import LidarError
from lidarpool.run.cluster import watch
from lidarpool.run.cluster.connection import connect_client, local_client
from lidarpool.run.cluster.watch import WaitTimer


@pytest.mark.extended
def test_workers_are_forked_from_one_process_also_in_place_of_others():
    others = set(psutil.Process().children(recursive=True))  # of the tests' own cluster
    preload = forkserver._forkserver._preload_modules
    method = dask.config.get("distributed.worker.multiprocessing-method")
    with local_client({"LIDAR": 4}, gpu_workers=1) as client:
        first = client.run(os.getpid)
        for pid in first.values():
            os.kill(pid, signal.SIGKILL)
        stop = time.monotonic() + 120
        while len(now := client.run(os.getpid, on_error="ignore")) < 2 or {*now} & {*first}:
            assert time.monotonic() < stop
            time.sleep(0.1)
        (server,) = set(client.run(os.getppid).values())
        assert psutil.Process(server).ppid() == os.getpid()
        modules = client.run(
            lambda: {"lidarpool.run.pipeline.stage4_collect", "open3d"} & sys.modules.keys()
        )
        assert list(modules.values()) == [{"lidarpool.run.pipeline.stage4_collect"}] * 2
    assert set(psutil.Process(server).children()) <= others
    # Those of the user's own processes.
    assert forkserver._forkserver._preload_modules == preload
    assert dask.config.get("distributed.worker.multiprocessing-method") == method


@pytest.fixture
def address():
    """An address where nobody is."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        return f"tcp://127.0.0.1:{server.getsockname()[1]}"


@pytest.fixture
def waiting_run(tmp_path, address):
    """A run that waits for its scheduler, and has said so."""
    scenario = "scene: seed\nsensor: {layers: 2, step_deg: 90}\nsteps: 2\n"
    options = ["--scheduler", address, "--startup-timeout", "10m", "--cloud-only"]
    run = RunningCommand(tmp_path, scenario, *options)
    yield run.wait_for(rf"note: waiting for the scheduler at {address} for up to 59\d s more: ")
    run.close()


@pytest.mark.slow
def test_a_scheduler_that_starts_later_is_waited_for(waiting_run, address, tmp_path):
    workers = {name: {"resources": {name: slots}} for name, slots in (("GPU", 1), ("LIDAR", 4))}
    with cluster_of(workers, {"port": int(address.rpartition(":")[2])}, host="127.0.0.1"):
        assert waiting_run.process.wait(300) == 0, waiting_run.said
    assert (tmp_path / "out" / "cloud.ply").exists()


@pytest.mark.slow
def test_waiting_for_a_scheduler_ends_with_an_interrupt(waiting_run):
    assert waiting_run.signal(signal.SIGINT) == 130
    assert waiting_run.said.splitlines()[-1] == (
        "lidarpool: Interrupted. All processes were stopped, and the output folder is unchanged."
    )


def test_a_scheduler_that_never_starts_is_named_with_the_time(address, monkeypatch):
    monkeypatch.setattr(watch, "REPORT_EVERY_S", 0.0)
    told: list[str] = []
    with (
        pytest.raises(LidarError, match=rf"responded at '{address}' within 1.5 s \("),
        connect_client(address, waiting=WaitTimer(1.5, told.append)),
    ):
        pytest.fail("it is connected")
    assert told[0].startswith(f"waiting for the scheduler at {address} for up to ")
