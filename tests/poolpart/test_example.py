"""The example of another workflow, as a user would run it, and with workers that die."""

import os
import runpy
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from distributed import Client, LocalCluster
from tests.clusters import import_jobqueue

from poolpart import Partition
from poolpart.pipe_states import pipes_of

EXAMPLES = Path(__file__).parents[2] / "examples"
EXAMPLE = EXAMPLES / "thumbnails.py"


def thumbnails(count):
    """Bytes of the file."""
    pictures = [
        np.random.default_rng(number).integers(0, 256, (240, 320, 3), np.uint8)
        for number in range(count)
    ]
    blocks = np.reshape(pictures, (count, 30, 8, 40, 8, 3))
    return blocks.mean(axis=(2, 4)).astype(np.uint8).tobytes()


@pytest.mark.slow
def test_whichever_worker_is_killed_the_file_is_the_same(tmp_path, wait_until):
    path = tmp_path / "out.bin"
    total = 100
    run = runpy.run_path(str(EXAMPLE))["run"]
    all_killed = threading.Event()

    def pause(seconds):
        time.sleep(seconds)
        if path.exists() and path.stat().st_size > 3600 * 60:  # let it not be too late to kill
            all_killed.wait(120)

    run.__globals__["time"] = SimpleNamespace(sleep=pause)
    with (
        LocalCluster(
            n_workers=4,
            threads_per_worker=1,
            dashboard_address="127.0.0.1:0",
            silence_logs=50,
        ) as cluster,
        Client(cluster) as client,
    ):
        driver = threading.Thread(target=run, args=(client, path, total))
        driver.start()
        for number, name in enumerate(["WRITER", "GPU", "CPU"]):
            wait_until(lambda n=number: path.exists() and path.stat().st_size > 3600 * 10 * (n + 1))
            worker = Partition(name, client).workers[0]
            killed = client.run(os.getpid, workers=[worker.address])[worker.address]
            assert path.stat().st_size < 3600 * total  # it is not too late
            os.kill(killed, signal.SIGKILL)
        all_killed.set()
        driver.join(120)
        assert not driver.is_alive()
        assert path.read_bytes() == thumbnails(total)
        assert not pipes_of(cluster.scheduler)


def test_a_writer_goes_on_where_one_has_died(start, tmp_path):
    client = start({name: {} for name in "abc"})
    path = tmp_path / "out.bin"
    path.write_bytes(thumbnails(5) + b"half")
    runpy.run_path(str(EXAMPLE))["run"](client, path, 9)
    assert path.read_bytes() == thumbnails(9)


@pytest.mark.slow
def test_partitions_that_grow_with_their_work():
    import_jobqueue()
    command = [sys.executable, EXAMPLES / "adaptive.py"]
    ran = subprocess.run(command, check=True, capture_output=True, text=True, timeout=300)
    said = ["workers: 0 0", "200 tasks of GPU ran on GPU", "workers of IO: 0"]
    assert ran.stdout.splitlines() == said
