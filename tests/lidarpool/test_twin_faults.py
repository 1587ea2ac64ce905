"""Reconstructions that are interrupted, share a folder, or lose their cluster or files."""

from __future__ import annotations

import json
import os
import pickle
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from distributed import Client
from tests.city_drives import write_city_drive
from tests.clusters import thread_cluster

from lidarfiles.clouds.folder import result_folder
from lidarfiles.work.lost_workers import LostWorkersError
from lidarfiles.work.mapping import parallel_map
from lidarfiles.work.work import FOLDER
from lidarpool.cli.commands import cli
from lidarreal import twin
from lidarreal.reconstruction.recorded_sweeps import RecordedSweeps
from lidarsim import LidarError, Sensor

pytest.importorskip("scipy")

SWEEPS = 6


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """Return a bag of a short drive through a city."""
    path = tmp_path_factory.mktemp("drive") / "drive.mcap"
    return write_city_drive(path, Sensor.grid(240, 16, vertical_fov_deg=40), SWEEPS, -24)


def test_a_folder_has_one_reconstruction_at_a_time(bag, tmp_path):
    out = tmp_path / "twin"
    with result_folder(out):
        refused = CliRunner().invoke(cli, ["twin", str(bag), "--out", str(out), "--overwrite"])
        assert f"Another run or export is using the folder {out}." in str(refused.exception)
        with pytest.raises(LidarError, match="Another run or export is using the folder"):
            twin(bag, out=out)
    assert not out.exists()


def test_another_process_reads_the_recording_from_its_own_folder(bag, tmp_path, monkeypatch):
    monkeypatch.chdir(bag.parent)
    recorded = RecordedSweeps.open(Path(bag.name))
    assert recorded.recording.info.name == bag.name  # as given, for messages
    points = recorded.read(0).points
    sent = pickle.dumps(recorded)
    monkeypatch.chdir(tmp_path)
    received = pickle.loads(sent)
    assert received.recording.info.name == bag.name
    assert received.ref.located.path == bag
    np.testing.assert_array_equal(received.read(0).points, points)


IS_LOST = threading.Event()


def wait_for_loss(number):
    if number:
        IS_LOST.wait(60)
    return number


@pytest.mark.extended
def test_a_lost_scheduler_is_one_sentence():
    with thread_cluster({"OTHER": 1}) as cluster, Client(cluster, set_as_default=False) as client:
        address = cluster.scheduler_address
        with parallel_map(client, 3, 1) as run:
            results = iter(run(wait_for_loss, [0, 1, 2]))
            assert next(results) == 0
            cluster.sync(cluster.scheduler.close)
            with pytest.raises(LostWorkersError, match=f"The cluster at {address} is no longer"):
                next(results)
        IS_LOST.set()


def fail(number):
    raise OSError(number, "no such file")


def test_an_error_of_a_worker_is_no_lost_cluster():
    with (
        thread_cluster({"OTHER": 1}) as cluster,
        Client(cluster, set_as_default=False) as client,
        parallel_map(client, 1, 1) as run,
        pytest.raises(OSError, match="no such file"),
    ):
        list(run(fail, [2]))


@pytest.mark.extended
def test_an_interrupted_reconstruction_can_be_continued(bag, tmp_path):
    out = tmp_path / "twin"
    command = [sys.executable, "-m", "lidarpool", "twin", str(bag), "--out", str(out)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)
    for line in process.stderr:
        if line.startswith("aligning the sweeps"):
            os.killpg(process.pid, signal.SIGINT)
            break
    rest = process.stderr.read().strip().splitlines()
    assert process.wait() == 130
    assert rest == [
        "lidarpool: Interrupted. All processes were stopped. The finished steps are stored in "
        f"{out}. Continue with `--resume`."
    ]
    done = CliRunner().invoke(cli, ["twin", str(bag), "--out", str(out), "--resume", "--json"])
    assert done.exit_code == 0, done.exception
    assert json.loads(done.output)["sweeps"] == SWEEPS
    assert not (out / FOLDER).exists()
