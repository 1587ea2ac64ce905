"""A 2D scanner of one layer: in a run, in bags as LaserScan, and in a campaign."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from tests.clusters import thread_cluster
from tests.shapes import room

from lidarpool import LidarError, Sensor, read_cloud
from lidarscenes.writers.scene_file import write_scene

SCANNER: dict[str, Any] = {
    "scene": "room.ply",
    "sensor": {
        "rays_per_revolution": 270,
        "layers": 1,
        "vertical_fov_deg": 0,
        "horizontal_fov_deg": 270,
        "step_deg": 90,
        "rate_hz": 20,
        "min_range_m": 0.1,
        "max_range_m": 4.5,
    },
    "poses": [{"position": [0, 0, 0], "yaw_deg": 30}, [1, 0, 0]],
    "steps": 4,
    "planning": {"enabled": False},
    "pool": {"backend": "numpy", "gpu": 1},
}


@pytest.fixture(scope="module")
def slots() -> Iterator[str]:
    """Address of a cluster with the slots of a campaign."""
    with thread_cluster({"GPU": 1}, {"LIDAR": 5}) as cluster:
        yield cluster.scheduler_address


@pytest.fixture
def folder(tmp_path) -> Path:
    write_scene(tmp_path / "room.ply", room())
    return tmp_path


def messages(path: Path) -> list[tuple[str, Any]]:
    """Topics and messages of a bag."""
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as bag:
        return [
            (connection.topic, bag.deserialize(data, connection.msgtype))
            for connection, _, data in bag.messages()
        ]


def expected(angles: np.ndarray, yaw_deg: float, x: float) -> np.ndarray:
    """Distances (n,) to the sides of the room of 10 by 8 m, from (x, 0)."""
    cos = np.cos(angles + np.radians(yaw_deg))
    sin = np.sin(angles + np.radians(yaw_deg))
    with np.errstate(divide="ignore"):
        across = np.where(cos > 0, 5 - x, -5 - x) / cos
        return np.minimum(across, np.where(sin > 0, 4, -4) / sin)


@pytest.mark.extended
def test_a_run_writes_laser_scans_beside_points(folder, lidarpool, slots):
    scenario = SCANNER | {
        "cloud": {"columns": ["intensity"]},
        "output": {"write": ["mcap", "rosbag2", "las", "pcd"]},
    }
    (folder / "s.yaml").write_text(json.dumps(scenario))
    assert lidarpool("check", "s.yaml", "--strict").code == 0
    outcome = lidarpool("run", "s.yaml", "--out", "out", "--scheduler", slots, "--pictures")
    assert outcome.code == 0, outcome.err
    assert "cannot store ray" not in outcome.out
    cloud = read_cloud(folder / "out/cloud.ply")
    assert (cloud["range"] <= 4.5).all() and np.abs(cloud.positions[:, 2]).max() < 1e-3
    for bag in ("cloud.mcap", "rosbag2"):
        told = messages(folder / "out" / bag)
        scans = [message for topic, message in told if topic == "/scan"]
        clouds = [message for topic, message in told if topic == "/points"]
        assert len(scans) == len(clouds) == 2
        for scan, points, (yaw_deg, x) in zip(scans, clouds, [(30, 0), (0, 1)], strict=True):
            assert scan.__msgtype__ == "sensor_msgs/msg/LaserScan"
            assert scan.header == points.header
            angles = scan.angle_min + scan.angle_increment * np.arange(270)
            assert len(scan.ranges) == len(scan.intensities) == 270
            assert np.degrees(scan.angle_increment) == pytest.approx(1, rel=1e-5)
            assert scan.angle_max == pytest.approx(angles[-1], abs=1e-5)
            assert np.degrees(scan.angle_min) == pytest.approx(-135, abs=1)
            assert scan.scan_time == pytest.approx(0.05)
            assert scan.time_increment == pytest.approx(0.05 / 270)
            assert (scan.range_min, scan.range_max) == (np.float32(0.1), np.float32(4.5))
            true = expected(angles, yaw_deg, x)
            there = true <= 4.5
            assert np.abs(scan.ranges[there] - true[there]).max() < 2e-3
            assert np.isinf(scan.ranges[~there]).all() and (~there).any()
            assert (scan.intensities[there] > 0).all() and not scan.intensities[~there].any()
            assert points.width == there.sum()


@pytest.mark.extended
def test_a_campaign_of_bags_has_laser_scans(folder, lidarpool, slots):
    (folder / "base.yaml").write_text(json.dumps(SCANNER))
    campaign = {"base": "base.yaml", "count": 1, "vary": {}, "keep": "mcap"}
    (folder / "c.yaml").write_text(yaml.safe_dump(campaign))
    outcome = lidarpool("run", "c.yaml", "--out", "set", "--scheduler", slots, "--quiet")
    assert outcome.code == 0, outcome.err
    [bag] = (folder / "set/bags").iterdir()
    assert sum(topic == "/scan" for topic, _ in messages(bag)) == 2


def test_thinned_returns_make_no_laser_scan_and_a_note(folder, lidarpool):
    thinned = SCANNER | {"cloud": {"keep_every": 2}, "output": {"write": ["mcap"]}}
    (folder / "s.yaml").write_text(json.dumps(thinned))
    note = "note: bags contain LaserScan messages of 2D scanners only if every return is kept"
    assert note in lidarpool("check", "s.yaml").out


def test_several_layers_need_a_field_of_view():
    assert Sensor.grid(layers=1, vertical_fov_deg=0).channels == 1
    with pytest.raises(
        LidarError, match="vertical_fov_deg is 0, so all 40 layers would be identical"
    ):
        Sensor.grid(vertical_fov_deg=0)
