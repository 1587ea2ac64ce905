"""Reconstructions that are interrupted, share a folder, or lose their cluster or files."""

from __future__ import annotations

import json
import os
import pickle
import signal
import subprocess
import sys
import threading
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from distributed import Client
from tests.city_drives import write_city_drive
from tests.clusters import thread_cluster

from lidarpool import LidarError, Sensor, twin
from lidarpool.cli.commands import cli
from lidarpool.clouds.folder import result_folder
from lidarpool.reconstruction.finished_steps import STEPS_FOLDER, FinishedSteps, TwinStep
from lidarpool.reconstruction.recorded_sweeps import RecordedSweeps
from lidarpool.work.lost_workers import LostWorkersError
from lidarpool.work.mapping import parallel_map

pytest.importorskip("scipy")

SWEEPS = 6


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """Return a bag of a short drive through a city."""
    path = tmp_path_factory.mktemp("drive") / "drive.mcap"
    return write_city_drive(path, Sensor.grid(240, 16, vertical_fov_deg=40), SWEEPS, -24)


@dataclass(frozen=True, eq=False)
class Squares:
    values: np.ndarray


SQUARE = TwinStep("square", (Squares,))


def run_steps(folder, calls, *, resume=True):
    """Square three numbers, adding each number that is computed to `calls`."""

    def square(number):
        calls.append(number)
        return (Squares(np.array([number**2])),)

    steps = FinishedSteps.create_or_resume(folder, "squares", resume=resume)
    return [int(one.values[0]) for (one,) in steps.each(SQUARE, map, square, [2, 3, 4])]


DAMAGES = {
    "empty": lambda content: b"",
    "cut off": lambda content: content[: len(content) // 2],
    "changed": lambda content: content.replace(np.int64(9).tobytes(), np.int64(8).tobytes()),
    "no archive": lambda content: b"no archive",
    "a damaged header": lambda content: content.replace(b"NUMPY", b"nUMPY"),
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_a_damaged_step_is_computed_again(damage, tmp_path):
    calls = []
    assert run_steps(tmp_path / "steps", calls) == [4, 9, 16]
    file = tmp_path / "steps" / "square-00001.npz"
    content = file.read_bytes()
    assert damage(content) != content
    file.write_bytes(damage(content))
    with pytest.raises(LidarError, match=r"square-00001\.npz is missing or damaged"):
        FinishedSteps(tmp_path / "steps").load(SQUARE, 1)
    assert run_steps(tmp_path / "steps", calls) == [4, 9, 16]
    assert calls == [2, 3, 4, 3]
    assert file.read_bytes() == content


def test_a_damaged_step_that_runs_once_is_computed_again(tmp_path):
    steps = FinishedSteps.create_or_resume(tmp_path / "steps", "one", resume=False)
    calls = []

    def compute():
        calls.append(None)
        return (Squares(np.array([25])),)

    for _ in range(2):
        (found,) = steps.run_once(SQUARE, compute)
        assert found.values.tolist() == [25]
    assert len(calls) == 1
    (tmp_path / "steps" / "square-00000.npz").write_bytes(b"PK")
    (found,) = steps.run_once(SQUARE, compute)
    assert found.values.tolist() == [25]
    assert len(calls) == 2


@pytest.mark.parametrize("content", [b"", b"{", b"\xff", b"[]"])
def test_steps_of_unknown_inputs_are_refused(content, tmp_path):
    run_steps(tmp_path / "steps", [])
    (tmp_path / "steps" / "of.json").write_bytes(content)
    with pytest.raises(LidarError, match=r"its files are damaged\. Start again with"):
        run_steps(tmp_path / "steps", [])


def test_a_folder_has_one_reconstruction_at_a_time(bag, tmp_path):
    out = tmp_path / "twin"
    with result_folder(out):
        refused = CliRunner().invoke(cli, ["twin", str(bag), "--out", str(out), "--overwrite"])
        assert f"Another run or export is using the folder {out}." in str(refused.exception)
    with (
        result_folder(out / STEPS_FOLDER),
        pytest.raises(LidarError, match="Another run or export is using the folder"),
    ):
        twin(bag, folder=out / STEPS_FOLDER)
    assert not out.exists()


def test_another_process_reads_the_recording_from_its_own_folder(bag, tmp_path, monkeypatch):
    monkeypatch.chdir(bag.parent)
    recorded = RecordedSweeps.open(Path(bag.name))
    assert recorded.recording.name == bag.name  # as given, for messages
    points = recorded.read(0).points
    sent = pickle.dumps(recorded)
    monkeypatch.chdir(tmp_path)
    received = pickle.loads(sent)
    assert received.source[0] == bag
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
        f"{out / STEPS_FOLDER}. Continue with `--resume`."
    ]
    done = CliRunner().invoke(cli, ["twin", str(bag), "--out", str(out), "--resume", "--json"])
    assert done.exit_code == 0, done.exception
    assert json.loads(done.output)["sweeps"] == SWEEPS
    assert not (out / STEPS_FOLDER).exists()
