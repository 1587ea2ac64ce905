"""A long drive is rebuilt submap by submap: anywhere, in any order, and on after a kill."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from distributed import Client
from tests.city_drives import write_city_drive

import poolpart.deploy
from lidarpool.cli.commands import cli
from lidarreal import twin
from lidarreal.reconstruction.alignment import Alignment
from lidarreal.reconstruction.motion import Motion, MotionStep
from lidarreal.reconstruction.submaps import AlignedSubmap, merge_alignments, split_into_submaps
from lidarsim import LidarError, Sensor

pytest.importorskip("scipy")

SWEEPS = 130


def straight(count, step_m):
    """Positions of a straight drive."""
    return np.arange(count)[:, None] * np.array([step_m, 0.0, 0.0])


def test_each_sweep_of_a_drive_is_of_one_submap_and_sees_those_around():
    positions = straight(400, 0.5)
    submaps = split_into_submaps(positions)
    assert len(submaps) == 5
    own = np.concatenate([submap.own_numbers for submap in submaps])
    np.testing.assert_array_equal(own, np.arange(400))
    middle = submaps[2]
    assert middle.own_numbers[0] - middle.numbers[0] == pytest.approx(40, abs=2)
    assert middle.numbers[-1] - middle.own_numbers[-1] == pytest.approx(40, abs=2)
    # Surfaces are of the submap whose sensor came nearest.
    poses = np.tile(np.eye(4), (400, 1, 1))
    poses[:, :3, 3] = positions
    points = positions[::7] + np.array([0.1, 15.0, 2.0])
    owners = np.array([submap.owns(points, poses) for submap in submaps])
    near = np.array([np.isin(np.arange(0, 400, 7), submap.numbers) for submap in submaps])
    assert ((owners & near).sum(axis=0) == 1).all()


def test_the_first_and_the_last_sweep_of_a_submap_own_the_points_beside_them():
    """Each sweep is in a meter of its own, so that it decides alone where its submap ends."""
    positions = straight(200, 1.5)
    poses = np.tile(np.eye(4), (200, 1, 1))
    poses[:, :3, 3] = positions
    submaps = split_into_submaps(positions)
    assert len(submaps) == 2
    for submap in submaps:
        own = submap.own_numbers
        seen = submap.numbers
        beside = positions[seen] + np.array([0.4, -9.0, 1.0])
        expected = (seen >= own[0]) & (seen <= own[-1])
        np.testing.assert_array_equal(submap.owns(beside, poses), expected)
        assert not expected.all()


def test_a_sensor_that_stands_for_long_is_one_submap_of_some_sweeps():
    random = np.random.default_rng(3)
    standing = random.normal(0, 0.02, (3000, 3))
    positions = np.concatenate([straight(50, 0.5) - [25, 0, 0], standing, straight(50, 0.5)])
    submaps = split_into_submaps(positions)
    own = np.concatenate([submap.own_numbers for submap in submaps])
    assert 150 < len(own) < 200
    assert len(submaps) <= 3
    assert (np.diff(own) > 0).all()
    assert len(split_into_submaps(standing)) == 1
    assert len(split_into_submaps(straight(4, 0.0))[0].numbers) == 4


def test_poses_go_over_from_one_submap_to_the_next():
    count = 200
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, 3] = straight(count, 0.5)
    first = Alignment(poses, 0.1 * np.arange(count), 0.1, 0.2, Motion.COMPENSATED, np.zeros((4, 3)))
    submaps = split_into_submaps(poses[:, :3, 3])
    assert len(submaps) == 2
    apart = 0.02
    aligned = []
    for index, submap in enumerate(submaps):
        own = poses[submap.numbers].copy()
        own[:, 1, 3] += index * apart
        distances = np.full(len(own), 0.01 * (index + 1))
        aligned.append(AlignedSubmap(own, np.full((4, 3), index), np.array([0.1]), distances))
    found = merge_alignments(first, submaps, aligned)
    y = found.poses[:, 1, 3]
    assert y[0] == 0 and y[-1] == pytest.approx(apart)
    assert np.abs(np.diff(y)).max() < 0.1 * apart
    assert (np.diff(y) > -1e-12).all()
    np.testing.assert_allclose(found.ring_offsets, 0.5)
    border = submaps[1].own_numbers[0]
    assert found.plane_distance_m[border - 1] == 0.01
    assert found.plane_distance_m[border] == 0.02
    # A single submap is as it was aligned, and a sweep that does not count moves with the next.
    turn = MotionStep(np.array([0, 0, 0.01]), np.array([0, 0.1, 0])).fraction(1.0)
    (whole,) = split_into_submaps(poses[:60, :3, 3])
    some = replace(whole, numbers=whole.numbers[:-1], own=slice(0, 59))
    moved = np.array([pose @ turn for pose in poses[:59]])
    offsets = AlignedSubmap(moved, np.zeros((4, 3)), np.array([0.1]), np.zeros(59))
    one = merge_alignments(first.select(np.arange(60)), [some], [offsets])
    np.testing.assert_array_equal(one.poses[:59], moved)
    expected = moved[58] @ np.linalg.inv(poses[58]) @ poses[59]
    np.testing.assert_allclose(one.poses[59], expected)


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """Return a bag of a drive of 52 m through a city, which makes two submaps."""
    path = tmp_path_factory.mktemp("drive") / "drive.mcap"
    return write_city_drive(path, Sensor.grid(320, 24, vertical_fov_deg=40), SWEEPS, -34)


def written(folder):
    """Return the files of a twin, without the pictures of the page."""
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.suffix != ".html"}


@pytest.mark.extended
def test_the_same_place_by_any_number_of_workers_and_after_a_kill(bag, tmp_path):
    folder = tmp_path / "killed"
    command = [sys.executable, "-m", "lidarpool", "twin", str(bag), "--out", str(folder)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)
    for line in process.stderr:
        if line.startswith("built 1 of 2"):
            break
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    runner = CliRunner()
    again = runner.invoke(cli, ["twin", str(bag), "--out", str(folder)])
    assert "contains an unfinished reconstruction. Continue it with `--resume`" in str(
        again.exception
    )
    other = runner.invoke(
        cli, ["twin", str(bag), "--out", str(folder), "--voxel-m", "0.2", "--resume"]
    )
    different = "an unfinished reconstruction with different inputs "
    assert f"{different}(options)" in str(other.exception)
    with pytest.raises(LidarError, match=rf"{different}\(part of the recording\)"):
        twin(bag, intensity="ring", out=folder, resume=True)
    with pytest.raises(LidarError, match=rf"{different}\(model\)"):
        twin(bag, model="velodyne/vlp16", out=folder, resume=True)
    start = time.perf_counter()
    resumed = runner.invoke(cli, ["twin", str(bag), "--out", str(folder), "--resume"])
    resumed_s = time.perf_counter() - start
    assert resumed.exit_code == 0, resumed.output
    with (
        poolpart.deploy.local_cluster({"OTHER": (1, 1)}, dashboard_port=None) as cluster,
        Client(cluster) as client,
    ):
        start = time.perf_counter()
        found = twin(bag, client=client)
        whole_s = time.perf_counter() - start
    found.save(tmp_path / "one")
    assert written(folder) == written(tmp_path / "one")
    assert resumed_s < whole_s
    figures = json.loads((folder / "twin.json").read_text())
    assert figures["submaps"] == 2
    assert figures["held_out"]["stationary"]["median_abs_difference_m"] < 0.005
    assert all(name == "drive.mcap" or name.startswith("object ") for name in found.scene.names)
    assert sorted(path.name for path in folder.iterdir()) == [
        "place.glb", "report.html", "scenario.yaml", "sensor.yaml", "trajectory.csv", "twin.json",
    ]  # fmt: skip
