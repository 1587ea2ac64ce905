"""Clouds in other formats, read back by the libraries of those formats."""

import io
import json
import pickle
import re
import signal
import subprocess
import sys
import tarfile
import threading
import time
import tomllib
import types
from dataclasses import replace
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import laspy
import numpy as np
import pandas as pd
import pye57
import pytest
import yaml
from laspy.header import GpsTimeType
from pypcd4.pypcd4 import PointCloud
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability
from rosbags.typesys import Stores, get_typestore

from lidarfiles import read_cloud, save_cloud
from lidarfiles.clouds import multi_file_format, parquet, well_known_text
from lidarfiles.clouds.boxes import Boxes
from lidarfiles.clouds.built_in_formats import EXPORTS, FORMATS
from lidarfiles.clouds.ros.layouts import LAYOUTS
from lidarfiles.clouds.well_known_text import wkt
from lidarfiles.clouds.writing import ExportSpec
from lidarfiles.open3d_access.open3d_module import load_open3d
from lidarpool import simulate
from lidarsim import (
    Actor,
    Cloud,
    LidarError,
    Mounted,
    Pose,
    Scene,
    Sensor,
    Survey,
    Track,
    box,
    load_trajectory,
)
from lidarsim.columns.bags import point_columns
from lidarsim.columns.cloud_file import CloudFile
from lidarsim.columns.table import COLORS, TABLE
from lidarsim.io.storage import Storage
from lidarsim.io.yamlfile import load_yaml
from lidarsim.motion.rotations import matrices
from lidarsim.packets.encoders import START_NS
from lidarsim.sweeps.sweeps import Sweeps

COLUMNS = ("time", "intensity", "reflectivity", "range", "azimuth", "elevation", "class",
           "return_number", "returns", "sensor", "ray", "signal")  # fmt: skip
# pcap needs a maker's packets, and rrd a large package: see test_rrd.py.
OF_ANY_SENSOR = [
    name
    for name in EXPORTS
    if name not in ("pcap", "rrd")
    and not (name.startswith("osi") and FORMATS[name].missing_packages)
]
DISTRIBUTIONS = {"rerun": "rerun-sdk"}  # of packages with another name


@pytest.fixture(scope="module")
def survey() -> Survey:
    """Two sensors, five turns of 36 scans each, on a carrier that moves and turns."""
    half = np.sqrt(0.5)
    track = Track([0, 1], [[0, 0, 1], [10, 5, 1]], [[0, 0, 0, 1], [0, 0, half, half]])
    lidar = Sensor.grid(360, 4)
    front = Mounted(lidar, Pose((1, 0, 0.5), 30.0), "front")
    return Survey(
        sensors=[front, Mounted(lidar, name="rear")], trajectory=track, steps=180, columns=COLUMNS
    )


@pytest.fixture(scope="module")
def scene() -> Scene:
    track = Track([0, 2], [[5, 5, 0], [9, 5, 0]])
    return replace(Scene.seed(), actors=(Actor(box("Car", (4, 2, 1.5)), track),))


@pytest.fixture(scope="module")
def sweeps(survey, scene) -> Sweeps:
    return Sweeps.from_survey(survey, scene)


@pytest.fixture(scope="module")
def cloud(survey) -> Cloud:
    """Points of all sweeps but the fourth."""
    rng = np.random.default_rng(5)
    scan = np.sort(rng.integers(0, survey.scan_count, 3000))
    scan = scan[scan // 36 != 3]
    count = len(scan)
    ray = rng.integers(0, 40, count)
    ray = ray[np.lexsort((ray, scan))]
    begins = np.array([survey.begins_ns(k) for k in range(survey.scan_count)])[scan]
    columns = {
        "scan": scan,
        "channel": ray % 4,
        "object": rng.integers(0, 7, count),
        "time": begins.astype(np.int64) + rng.integers(0, 2_000_000, count),
        "intensity": rng.uniform(0, 1, count).astype(np.float32),
        "reflectivity": rng.integers(0, 256, count).astype(np.uint8),
        "signal": rng.integers(0, 65_536, count).astype(np.uint16),
        "range": rng.uniform(1, 50, count).astype(np.float32),
        "azimuth": rng.uniform(0, 360, count).astype(np.float32),
        "elevation": rng.uniform(-30, 30, count).astype(np.float32),
        "class": rng.integers(0, 300, count),
        "return_number": np.ones(count),
        "returns": np.ones(count) * 2,
        "sensor": scan // 180,
        "ray": ray,
    }
    return Cloud(np.round(rng.uniform(-60, 60, (count, 3)), 2), columns)


@pytest.fixture
def written(cloud, sweeps, tmp_path):
    """Write the cloud in a format, from its file as `lidarpool export` does."""
    save_cloud(cloud, tmp_path / "cloud.ply")

    def write(name, layout="velodyne", compensated=False):
        one = ExportSpec(name, layout, compensated)
        one.write(tmp_path / one.row.file, CloudFile(tmp_path / "cloud.ply"), sweeps)
        assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]
        return tmp_path / one.row.file

    return write


def of_sweep(cloud, sweep):
    return cloud[cloud.scan // 36 == sweep]


def test_a_sweep_is_a_turn_and_has_the_pose_of_its_first_ray(survey, sweeps):
    np.testing.assert_array_equal(sweeps.scans, np.arange(11) * 36)
    np.testing.assert_allclose(sweeps.begins_ns, np.tile(np.arange(5) * 1e8, 2))
    for sweep in (0, 3, 7):
        pose = survey.pose(36 * sweep)
        np.testing.assert_allclose(sweeps.pose.positions[sweep], pose.position, atol=1e-12)
        turn = matrices(sweeps.pose.quaternions[sweep, None])[0]
        np.testing.assert_allclose(turn, pose.rotation, atol=1e-12)
    np.testing.assert_allclose(sweeps.actor_poses.positions[0, 4], [5.8, 5, 0])


@pytest.mark.parametrize("name", ["las", "laz"])
def test_las_has_fields_of_its_own_and_the_rest_in_extra_bytes(written, cloud, name):
    las = laspy.read(written(name))
    assert (las.header.point_format.id, str(las.header.version)) == (6, "1.4")
    assert las.header.global_encoding.wkt  # without which PDAL refuses it
    told = {column.name: column.description for column in las.point_format.extra_dimensions}
    assert told["range"] == "m distance from the beam origin"  # 32 bytes at most, whole words
    np.testing.assert_allclose(las.xyz, cloud.positions, atol=1e-6)
    np.testing.assert_allclose(las.gps_time, cloud.time / 1e9, atol=1e-12)
    np.testing.assert_allclose(las.intensity / 65_535, cloud.intensity, atol=1e-5)
    np.testing.assert_array_equal(las.return_number, 1)
    np.testing.assert_array_equal(las.number_of_returns, 2)
    np.testing.assert_array_equal(las.point_source_id, cloud.sensor + 1)
    np.testing.assert_array_equal(
        las.classification, np.where(cloud["class"] < 256, cloud["class"], 0)
    )
    for column in (
        "scan", "object", "class", "range", "elevation", "sensor", "reflectivity", "signal",
        "azimuth",
    ):  # fmt: skip
        np.testing.assert_array_equal(las[column], cloud[column])
    np.testing.assert_array_equal(las["ring"], cloud.channel)
    np.testing.assert_array_equal(las["energy"], cloud.intensity)


def test_parquet_holds_every_column(written, cloud):
    frame = pd.read_parquet(written("parquet"))
    np.testing.assert_allclose(frame[["x", "y", "z"]], cloud.positions, atol=1e-5)
    for column in cloud.table:
        np.testing.assert_array_equal(frame[column.in_files], cloud[column.name])


def test_pcd_has_a_file_for_each_sweep_in_the_sensors_axes(written, cloud, sweeps):
    folder = written("pcd", compensated=True)
    assert len(list(folder.iterdir())) == 10
    read = load_open3d().t.io.read_point_cloud
    for sweep in (0, 6):
        points = of_sweep(cloud, sweep)
        found = read(str(folder / f"{sweep:06}.pcd")).point
        inside = found["positions"].numpy().astype(float)
        file = PointCloud.from_path(folder / f"{sweep:06}.pcd")
        x, y, z, *turn = file.metadata.viewpoint
        back = inside @ matrices(np.array([[*turn[1:], turn[0]]]))[0].T + (x, y, z)
        np.testing.assert_allclose(back, points.positions, atol=2e-5)
        np.testing.assert_array_equal(found["ring"].numpy()[:, 0], points.channel)
        assert "time" not in file.fields
    assert PointCloud.from_path(folder / "000003.pcd").points == 0


def test_kitti_poses_bring_the_sweeps_of_a_sensor_together(written, cloud):
    folder = written("kitti") / "sequences"
    for sensor in (0, 1):
        sequence = folder / f"{sensor:02}"
        poses = np.loadtxt(sequence / "poses.txt").reshape(-1, 3, 4)
        np.testing.assert_allclose(poses[0], np.eye(4)[:3], atol=1e-9)
        np.testing.assert_allclose(np.loadtxt(sequence / "times.txt"), np.arange(5) / 10)
        firsts = []
        back = np.loadtxt(sequence / "calib.txt", usecols=range(1, 13))[4].reshape(3, 4)[:, :3]
        for number, pose in enumerate(poses):
            points = of_sweep(cloud, 5 * sensor + number)
            rows = np.fromfile(sequence / f"velodyne/{number:06}.bin", "<f4").reshape(-1, 4)
            np.testing.assert_array_equal(rows[:, 3], points.reflectivity / np.float32(255))
            labels = np.fromfile(sequence / f"labels/{number:06}.label", "<u4")
            np.testing.assert_array_equal(labels & 0xFFFF, points["class"])
            np.testing.assert_array_equal(labels >> 16, points.object + 1)
            firsts.append(rows[:, :3] @ back.T @ pose[:, :3].T + pose[:, 3])
        # All in the axes of the first pose: distances are those in the world.
        own = cloud[cloud.sensor == sensor].positions
        placed = np.concatenate(firsts)
        apart = np.linalg.norm(placed[1:] - placed[:-1], axis=1)
        np.testing.assert_allclose(apart, np.linalg.norm(own[1:] - own[:-1], axis=1), atol=1e-4)


@pytest.mark.extended
@pytest.mark.parametrize("name", ["mcap", "rosbag2"])
def test_trajectories_of_bags_are_read_again(written, survey, name):
    path = written(name, "velodyne")
    track = load_trajectory(path, topic="/tf:base_link", offset_s=-START_NS / 1e9)
    times = track.times_s * 1e9
    for one, other in zip(track.poses(0, times), survey.trajectory.poses(0, times), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-5)
    mounted = load_trajectory(path, topic="/tf:front").pose(0)
    np.testing.assert_allclose(mounted.position, survey.pose(0).position, atol=1e-5)
    assert np.isclose(mounted.yaw_deg, 30)
    assert load_trajectory(path, topic="/tf:Car").pose(0).position[1] == 5


class Bag:
    """The messages of a bag, by their topics."""

    def __init__(self, path):
        self.path = path
        self.clouds = {}  # {(topic, time): message}
        self.frames = {}  # {(frame, time): transform}
        self.fixed = {}  # {frame: transform}
        self.boxes = []  # (time, marker)
        self.clocks = []  # times
        store = get_typestore(Stores.ROS2_HUMBLE)
        with AnyReader([path], default_typestore=store) as bag:
            for connection, when, data in bag.messages():
                self._add(connection, when, bag.deserialize(data, connection.msgtype))

    def _add(self, connection, when, message):
        if connection.topic.endswith("/points"):
            self.clouds[connection.topic, when] = message
        elif connection.topic == "/tf":
            for transform in message.transforms:
                self.frames[transform.child_frame_id, when] = transform
        elif connection.topic == "/tf_static":
            # Without it, `ros2 bag play` would offer the frames only to those who listen then.
            (offered,) = connection.ext.offered_qos_profiles
            assert offered.durability == QosDurability.TRANSIENT_LOCAL
            self.fixed |= {transform.child_frame_id: transform for transform in message.transforms}
        elif connection.topic == "/actors":
            (box,) = message.markers
            self.boxes.append((when, box))
        else:
            self.clocks.append(when)

    def check_frames(self):
        assert {frame for frame, _ in self.frames} == {"base_link", "Car"}
        parents = {(one.header.frame_id, one.child_frame_id) for one in self.frames.values()}
        assert parents == {("map", "base_link"), ("map", "Car")}
        assert {(one.header.frame_id, name) for name, one in self.fixed.items()} == {
            ("base_link", "front"), ("base_link", "rear")
        }  # fmt: skip
        mount = self.fixed["front"].transform
        assert (mount.translation.x, mount.translation.z) == (1, 0.5)
        np.testing.assert_allclose(2 * np.degrees(np.arcsin(mount.rotation.z)), 30)

    def check_boxes(self):
        # One box, however many sensors see it. The first of this time is of a sweep without points.
        assert {(box.ns, box.id) for _, box in self.boxes} == {("actors", 0)}
        box = next(box for when, box in self.boxes if when == START_NS + 300_000_000)
        assert (box.header.frame_id, box.text, box.type) == ("map", "Car", box.CUBE)
        place = box.pose.position
        np.testing.assert_allclose([place.x, place.y, place.z], [5.6, 5, 0.75], atol=1e-12)
        assert (box.scale.x, box.scale.y, box.scale.z) == (4, 2, 1.5)

    def check_profiles(self):
        """Readers of Humble take versions up to 8, whose profiles are text."""
        told = load_yaml((self.path / "metadata.yaml").read_text())
        told = told["rosbag2_bagfile_information"]
        assert told["version"] == 8
        for one in (part["topic_metadata"] for part in told["topics_with_message_count"]):
            assert bool(load_yaml(one["offered_qos_profiles"])) == (one["name"] == "/tf_static")


def rows_of(message):
    """Return the points of a message as records of its fields."""
    kinds = {2: "u1", 4: "u2", 6: "u4", 7: "f4"}
    row = np.dtype({
        "names": [field.name for field in message.fields],
        "formats": [kinds[field.datatype] for field in message.fields],
        "offsets": [field.offset for field in message.fields],
        "itemsize": message.point_step,
    })  # fmt: skip
    return message.data.view(row)


@pytest.fixture
def bag(written, name, layout):
    """Write the cloud as a bag and read its messages."""
    return Bag(written(name, layout))


@pytest.mark.parametrize("name", ["mcap", "rosbag2"])
@pytest.mark.parametrize(("layout", "step"), [("velodyne", 22), ("autoware", 32), ("ouster", 48)])
def test_bags_have_points_frames_and_a_clock(bag, cloud, survey, sweeps, name, layout, step):
    assert {topic for topic, _ in bag.clouds} == {"/front/points", "/rear/points"}
    bag.check_frames()
    assert min(bag.clocks) == START_NS
    assert len(bag.clouds) == len(bag.clocks) == len(bag.boxes) == 10
    bag.check_boxes()
    sweep = 2
    when = START_NS + 200_000_000
    message = bag.clouds["/front/points", when]
    points = of_sweep(cloud, sweep)
    assert (message.point_step, message.header.frame_id) == (step, "front")
    rows = rows_of(message)
    carrier = bag.frames["base_link", when].transform
    begin = survey.path.pose(0, 2e8)
    translation = [getattr(carrier.translation, axis) for axis in "xyz"]
    np.testing.assert_allclose(translation, begin.position, atol=1e-12)
    np.testing.assert_allclose(2 * np.degrees(np.arcsin(carrier.rotation.z)), begin.yaw_deg)
    # Points are in the sensor's axes at their own times.
    mount = bag.fixed["front"].transform
    turn = matrices(np.array([[getattr(mount.rotation, axis) for axis in "xyzw"]]))[0]
    on_carrier = np.stack([rows[axis] for axis in "xyz"], axis=1).astype(float) @ turn.T
    on_carrier += [getattr(mount.translation, axis) for axis in "xyz"]
    places, turns = survey.path.poses(0, points.time.astype(float))
    back = np.einsum("nij,nj->ni", turns, on_carrier) + places
    np.testing.assert_allclose(back, points.positions, atol=5e-5)
    channel, time = {
        "velodyne": ("ring", "time"), "autoware": ("channel", "time_stamp"), "ouster": ("ring", "t")
    }[layout]  # fmt: skip
    rings = 3 - points.channel if layout == "ouster" else points.channel
    np.testing.assert_array_equal(rows[channel], rings)
    since = points.time - sweeps.begins_ns[sweep]
    np.testing.assert_allclose(rows[time] * (1e9 if time == "time" else 1), since, atol=10)
    if name == "rosbag2":
        bag.check_profiles()
    if layout == "autoware":
        np.testing.assert_array_equal(rows["intensity"], np.round(points.intensity * 255))
    if layout == "ouster":
        np.testing.assert_array_equal(rows["range"], np.round(points.range * 1000))
        np.testing.assert_array_equal(rows["reflectivity"], points.reflectivity)
        np.testing.assert_array_equal(rows["intensity"], points.signal)


@pytest.mark.parametrize(("layout", "step"), [("velodyne", 26), ("autoware", 36), ("ouster", 48)])
def test_bags_have_colors_as_rviz_and_foxglove_read_them(cloud, sweeps, layout, step, tmp_path):
    decoder = pytest.importorskip("mcap_ros2.decoder").DecoderFactory()
    rng = np.random.default_rng(6)
    colors = {name: rng.integers(0, 256, len(cloud)).astype(np.uint8) for name in COLORS}
    colored = Cloud(cloud.positions, {**cloud.columns, **colors}, sweeps=lambda: sweeps)
    assert not {*COLORS} & {*save_cloud(colored, tmp_path / "c.mcap", layout=layout)}
    with (tmp_path / "c.mcap").open("rb") as file:
        reader = pytest.importorskip("mcap.reader").make_reader(file, decoder_factories=[decoder])
        topics = [(channel.topic, read) for _, channel, _, read in reader.iter_decoded_messages()]
    first = next(read for topic, read in topics if topic == "/front/points")
    assert first.point_step == step
    (field,) = (field for field in first.fields if field.name == "rgb")
    assert (field.datatype, field.count) == (7, 1)  # FLOAT32
    packed = np.frombuffer(first.data, np.uint8).reshape(-1, step)[:, field.offset :][:, :4]
    wanted = of_sweep(colored, 0)
    expected = [wanted[name] for name in ("blue", "green", "red")] + [np.zeros(len(wanted))]
    np.testing.assert_array_equal(packed, np.stack(expected, axis=1))
    (before,) = (field.offset for field in first.fields if field.name == "x")
    assert (before, first.width) == (0, len(wanted))


def test_e57_has_a_scan_with_its_pose_for_each_sweep(written, cloud):
    with pye57.E57(str(written("e57"))) as file:
        assert file.scan_count == 9  # of which none is empty
        found = file.read_scan(4, intensity=True, ignore_missing_fields=True)
    points = of_sweep(cloud, 5)
    placed = np.stack([found[f"cartesian{axis}"] for axis in "XYZ"], axis=1)
    np.testing.assert_allclose(placed, points.positions, atol=1e-5)
    np.testing.assert_allclose(found["intensity"], points.intensity)


@pytest.mark.parametrize(
    ("scale", "expected"),
    [(1.0, 1.0), (30.0, 32.0), (5e-5, 2.0**-14), (0.0, 1.0)],
)
def test_las_has_a_scale_of_intensities_that_suits_the_cloud(
    cloud, sweeps, tmp_path, scale, expected
):
    """Intensities from 0 to `scale`, and 0.9 % that are far brighter."""
    rng = np.random.default_rng(7)
    intensity = scale * np.linspace(0, 1, len(cloud), dtype=np.float32)
    intensity[-int(0.009 * len(cloud)) :] *= 100
    scaled = Cloud(cloud.positions, {**cloud.columns, "intensity": rng.permutation(intensity)})
    full_scale = ExportSpec("laz").write(tmp_path / "a.laz", scaled, sweeps)
    las = laspy.read(tmp_path / "a.laz")
    (record,) = [vlr for vlr in las.header.vlrs if (vlr.user_id, vlr.record_id) == ("lidarpool", 2)]
    assert json.loads(record.record_data) == {"intensity_full_scale": expected}
    assert full_scale == expected
    assert (las.intensity == 65_535).mean() <= 0.01
    np.testing.assert_allclose(
        las.intensity / 65_535, np.minimum(scaled.intensity / expected, 1), atol=0.51 / 65_535
    )
    np.testing.assert_array_equal(las["energy"], scaled.intensity)


def test_the_full_scale_is_that_at_which_one_percent_is_saturated(cloud, sweeps, tmp_path):
    def full_scale(saturated):
        intensity = np.full(len(cloud), 0.25, np.float32)
        intensity[:saturated] = 0.5
        return ExportSpec("las").write(
            tmp_path / "a.las",
            Cloud(cloud.positions, {**cloud.columns, "intensity": intensity}),
            sweeps,
            overwrite=True,
        )

    one_percent = len(cloud) // 100
    assert full_scale(one_percent) == 0.5  # at 0.25, the others would be 65,535
    assert full_scale(one_percent + 1) == 1.0


def test_the_full_scale_can_be_set(cloud, sweeps, tmp_path):
    save_cloud(cloud, tmp_path / "a.las", intensity_full_scale=2.5)
    las = laspy.read(tmp_path / "a.las")
    np.testing.assert_allclose(las.intensity / 65_535 * 2.5, cloud.intensity, atol=2e-5)
    with pytest.raises(LidarError, match="e57 does not support `intensity_full_scale`"):
        ExportSpec("e57", intensity_full_scale=1.0)
    with pytest.raises(LidarError, match="intensity_full_scale"):
        ExportSpec("las", intensity_full_scale=0.0)
    bare = Cloud(cloud.positions, {name: cloud[name] for name in ("scan", "channel", "object")})
    assert ExportSpec("las").write(tmp_path / "b.las", bare, sweeps) is None


def test_e57_states_when_each_sweep_was_scanned(cloud, sweeps, tmp_path):
    def times(start_ns):
        ExportSpec("e57").write(
            tmp_path / "cloud.e57", cloud, replace(sweeps, start_ns=start_ns), overwrite=True
        )
        with pye57.E57(str(tmp_path / "cloud.e57")) as file:
            header = file.get_header(3)  # of sweep 4, because sweep 3 has no points
            created = file.root["creationDateTime"]
            return [
                (node["dateTimeValue"].value(), node["isAtomicClockReferenced"].value())
                for node in (created, header["acquisitionStart"], header["acquisitionEnd"])
            ]

    np.testing.assert_allclose(
        times(None), [(0, 0), (sweeps.begins_ns[4] / 1e9, 0), (sweeps.ends_ns[4] / 1e9, 0)]
    )
    # 2026-11-21T10:00:00 UTC, 18 leap seconds after GPS time began
    start = datetime(2026, 11, 21, 10, tzinfo=UTC)
    gps_s = (start - datetime(1980, 1, 6, tzinfo=UTC)).total_seconds() + 18
    assert times(int(start.timestamp()) * 10**9) == [
        (gps_s, 1),
        (gps_s + sweeps.begins_ns[4] / 1e9, 1),
        (gps_s + sweeps.ends_ns[4] / 1e9, 1),
    ]


def test_e57_has_limits_of_the_cloud_and_bounds_in_the_frame_of_the_points(written, cloud):
    with pye57.E57(str(written("e57"))) as file:
        raw = file.read_scan_raw(4, ignore_unsupported_fields=True)
        header = file.get_header(4)
        assert (header.intensityMinimum, header.intensityMaximum) == (0, cloud.intensity.max())
        for axis in "XYZ":
            bounds = [getattr(header, f"{axis.lower()}{end}") for end in ("Minimum", "Maximum")]
            values = raw[f"cartesian{axis}"]
            np.testing.assert_allclose(bounds, [values.min(), values.max()], atol=1e-5)


def test_colors_are_where_readers_look_for_them(cloud, sweeps, tmp_path):
    rng = np.random.default_rng(6)
    colors = {name: rng.integers(0, 256, len(cloud)).astype(np.uint8) for name in COLORS}
    colored = Cloud(cloud.positions, {**cloud.columns, **colors})
    for name in ("las", "e57", "pcd"):
        one = ExportSpec(name, "velodyne")
        one.write(tmp_path / one.row.file, colored, sweeps)
    las = laspy.read(tmp_path / "cloud.las")
    assert las.header.point_format.id == 7
    assert not {*COLORS} & {*las.point_format.extra_dimension_names}
    with pye57.E57(str(tmp_path / "cloud.e57")) as file:
        found = file.read_scan(0, colors=True, ignore_missing_fields=True)
    first = of_sweep(colored, 0)
    rgb = np.stack([first[name] for name in COLORS], axis=1)
    path = tmp_path / "pcd" / "000000.pcd"
    pcd = PointCloud.from_path(path)
    assert pcd.fields.count("rgb") == 1 and not {*COLORS} & {*pcd.fields}
    np.testing.assert_array_equal(PointCloud.decode_rgb(pcd.pc_data["rgb"]), rgb)
    read = load_open3d().t.io.read_point_cloud(str(path)).point
    np.testing.assert_array_equal(read["colors"].numpy(), rgb)
    for name in COLORS:
        np.testing.assert_array_equal(las[name], colors[name].astype(int) * 257)
        np.testing.assert_array_equal(found[f"color{name.capitalize()}"], first[name])
    # One of them alone is a column like others.
    alone = Cloud(cloud.positions, {**cloud.columns, "red": colors["red"]})
    ExportSpec("laz", "velodyne").write(tmp_path / "red.laz", alone, sweeps)
    las = laspy.read(tmp_path / "red.laz")
    assert las.header.point_format.id == 6
    np.testing.assert_array_equal(las["red"], colors["red"])


@pytest.mark.parametrize("name", OF_ANY_SENSOR)
def test_an_empty_cloud_can_be_written(sweeps, tmp_path, name):
    columns = {
        key: np.empty(0, TABLE[key].dtype) for key in ("scan", "channel", "object", *COLUMNS)
    }
    one = ExportSpec(name)
    one.write(tmp_path / one.row.file, Cloud(np.empty((0, 3)), columns), sweeps)
    assert (tmp_path / one.row.file).exists()


def test_what_cannot_be_written_is_one_line_and_leaves_nothing(
    cloud, sweeps, tmp_path, monkeypatch
):
    bare = Cloud(cloud.positions, {name: cloud[name] for name in ("scan", "channel", "object")})
    with pytest.raises(
        LidarError,
        match=r"kitti requires the columns reflectivity and class, which.*`output: \{write: "
        r"\[kitti\]\}`, or add reflectivity and class",
    ):
        ExportSpec("kitti").write(tmp_path / "kitti", bare, sweeps)
    with pytest.raises(
        LidarError, match="mcap with the layout ouster requires the columns signal, time"
    ):
        ExportSpec("mcap", "ouster").write(tmp_path / "cloud.mcap", bare, sweeps)
    for organized in (
        ExportSpec("rosbag2", "robosense", organized=True),
        ExportSpec("mcap", organized=True),
        ExportSpec("pcd", compensated_actors=True),
    ):
        with pytest.raises(LidarError) as refused:
            organized.check_columns(bare)
        [entry] = re.findall(r"again with `output: (.*?)`, or add", str(refused.value))
        assert ExportSpec.from_entry(yaml.safe_load(entry)["write"][0]) == organized
    (tmp_path / "cloud.laz").write_text("mine")
    with pytest.raises(LidarError, match=r"exists.* `--overwrite`"):
        ExportSpec("laz").write(tmp_path / "cloud.laz", cloud, sweeps)
    assert (tmp_path / "cloud.laz").read_text() == "mine"
    ExportSpec("laz").write(tmp_path / "cloud.laz", cloud, sweeps, overwrite=True)
    assert len(laspy.read(tmp_path / "cloud.laz")) == len(cloud)
    with pytest.raises(LidarError, match=r"gone does not exist\. Create it first"):
        ExportSpec("pcd").write(tmp_path / "gone/pcd", cloud, sweeps)
    monkeypatch.setattr("lidarfiles.clouds.format_row.find_spec", lambda name: None)
    with pytest.raises(LidarError, match=r'laspy and lazrs\. Run pip install -e "\.\[las\]"'):
        ExportSpec("las").check_installed()
    assert {path.name for path in tmp_path.iterdir()} == {"cloud.laz"}


@pytest.mark.extended
@pytest.mark.skipif(sys.platform == "win32", reason="has no limits of files")
@pytest.mark.parametrize("name", OF_ANY_SENSOR)
def test_a_file_that_cannot_grow_is_one_line_and_leaves_nothing(cloud, sweeps, tmp_path, name):
    import resource

    one = ExportSpec(name)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, before[1]))  # as a full disk does
    try:
        with pytest.raises(LidarError, match="cannot be written") as told:
            one.write(tmp_path / one.row.file, cloud, sweeps)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert "\n" not in str(told.value)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("method", ["write_points", "close"])
def test_an_interrupt_waits_for_what_lazrs_writes(cloud, sweeps, tmp_path, monkeypatch, method):
    """An exception within a write of lazrs would become one of lazrs."""
    done = []
    write = getattr(laspy.LasWriter, method)

    def interrupted(writer, *points):
        if not done:
            signal.raise_signal(signal.SIGINT)
        write(writer, *points)
        done.append(method)

    monkeypatch.setattr(laspy.LasWriter, method, interrupted)
    with pytest.raises(KeyboardInterrupt):
        ExportSpec("laz").write(tmp_path / "cloud.laz", cloud, sweeps)
    assert done
    assert not list(tmp_path.iterdir())


def test_any_name_makes_a_topic_a_frame_and_a_folder(cloud, sweeps, tmp_path):
    """Also one that would lead out of the folder, and an actor called as the world's frame."""
    odd = replace(sweeps, sensors=("base_link", "../front"), actors=("map",))
    ExportSpec("nuscenes").write(tmp_path / "nuscenes", cloud, odd)
    folders = {path.name for path in (tmp_path / "nuscenes/samples").iterdir()}
    assert folders == {"LIDAR_TOP", "___front"}
    ExportSpec("mcap").write(tmp_path / "cloud.mcap", cloud, odd)
    store = get_typestore(Stores.ROS2_HUMBLE)
    frames = set()
    with AnyReader([tmp_path / "cloud.mcap"], default_typestore=store) as bag:
        assert {"/___front/points", "/base_link_2/points"} < {*bag.topics}
        for connection, _, data in bag.messages():
            if connection.topic.startswith("/tf"):
                transforms = bag.deserialize(data, connection.msgtype).transforms
                frames |= {transform.child_frame_id for transform in transforms}
    assert frames == {"base_link", "___front", "base_link_2", "map_2"}


def test_a_start_and_a_coordinate_system_are_in_files_that_hold_them(
    cloud, scene, survey, tmp_path
):
    """Also after `sweeps.npz`, of which an export reads them."""
    start = datetime(2026, 11, 21, 12, 0, tzinfo=timezone(timedelta(hours=2)))
    Sweeps.from_survey(replace(survey, start=start, epsg=25832), scene).save(tmp_path / "s.npz")
    dated = Sweeps.load(tmp_path / "s.npz")
    ExportSpec("laz").write(tmp_path / "a.laz", cloud, dated)
    las = laspy.read(tmp_path / "a.laz")
    assert str(las.header.creation_date) == "2026-11-21"
    assert las.header.global_encoding.gps_time_type == GpsTimeType.STANDARD
    # GPS time is 18 s ahead of UTC; adjusted standard GPS time is a billion seconds behind it.
    since = start - datetime(1980, 1, 6, tzinfo=UTC)
    begins = since.total_seconds() + 18 - 1e9
    np.testing.assert_allclose(las.gps_time - begins, cloud.time / 1e9, atol=1e-7)
    np.testing.assert_array_equal(las["time"], cloud.time)
    (system,) = las.header.vlrs.get("WktCoordinateSystemVlr")
    assert 'PROJCS["ETRS89 / UTM zone 32N"' in system.string and 'AUTHORITY["EPSG","25832"]]' in (
        system.string
    )
    ExportSpec("mcap").write(tmp_path / "a.mcap", cloud, dated)
    store = get_typestore(Stores.ROS2_HUMBLE)
    with AnyReader([tmp_path / "a.mcap"], default_typestore=store) as bag:
        assert bag.start_time == start.timestamp() * 1e9


@pytest.mark.parametrize(
    ("epsg", "middle", "north"), [(32601, -177, 0), (32733, 15, 10_000_000), (25838, 45, 0)]
)
def test_zones_of_utm_need_no_other_package(epsg, middle, north):
    text = wkt(epsg)
    assert f'"central_meridian",{middle}]' in text and f'"false_northing",{north}]' in text
    assert text.count("[") == text.count("]")


def test_other_coordinate_systems_come_from_rasterio(monkeypatch):
    if well_known_text.find_spec("rasterio"):
        assert wkt(2056).startswith('PROJCS["CH1903+ / LV95"')
        with pytest.raises(LidarError, match="rasterio cannot convert EPSG:1024 to WKT 1"):
            wkt(1024)
    monkeypatch.setattr(well_known_text, "find_spec", lambda name: None)
    with pytest.raises(LidarError, match=r"EPSG:2056 is not a UTM zone .*\.\[geo\]"):
        wkt(2056)


def inside_box(points, center, axes, size, tolerance_m):
    return (np.abs((points - center) @ axes) <= np.array(size) / 2 + tolerance_m).all(axis=1)


def test_boxes_are_where_actors_are_though_a_sensor_pauses(scene):
    """As one does that is carried on after a turn and a half; and one with a single sweep."""
    track = Track([0, 9], [[0, 0, 0], [90, 0, 0]])
    scene = replace(scene, actors=(Actor(box("Car", (4, 2, 1.5)), track),))
    car = len(scene.names)
    for steps, sweep, scan, start_s in ((54, 1, 45, 0.1), (54, 3, 99, 0.25), (36, 0, 9, 0.0)):
        poses = [(0, 0, 0), (5, 0, 0)][: 1 + (steps == 54)]
        survey = Survey(Sensor.grid(360, 4), poses, steps=steps)
        sweeps = Sweeps.from_survey(survey, scene)
        points = Cloud(np.zeros((1, 3)), {"scan": [scan], "object": [car]})
        boxes = Boxes.from_points(sweeps, sweep, points)
        assert boxes.points.tolist() == [1]
        np.testing.assert_allclose(boxes.centers, [[10 * start_s, 0, 0.75]], atol=1e-9)


def test_boxes_of_tilted_sensors_hold_what_was_there_when_the_sweep_began(scene, tmp_path):
    """Within 1 mm: a tilted camera, or the times of the points, are 10 cm to 1 m off."""
    turns = [[0, 0, 0, 1], [0, 0, np.sin(0.4), np.cos(0.4)]]
    track = Track([0, 1], [[-5, 8, 0], [10, 8, 0]], turns)
    away = Actor(box("Far away", (4, 2, 1.5)), Track([0, 1], [[90, 0, 0], [90, 1, 0]]))
    scene = replace(scene, actors=(Actor(box("Car 1", (4, 2, 1.5)), track), away))
    mounts = Pose((0, 1, 2), 20.0, 3.0, -2.0), Pose((0, 0, 2), -90.0, -4.0)
    sensors = [
        Mounted(Sensor.grid(360, 4), mount, name) for mount, name in zip(mounts, "ab", strict=True)
    ]
    survey = Survey(sensors=sensors, poses=[(0, 0, 0)], steps=36)
    sweeps = Sweeps.from_survey(survey, scene)
    rng = np.random.default_rng(3)
    scan = np.repeat([25, 61], 200)
    when = np.rint([survey.begins_ns(one) for one in scan])
    corners = rng.choice([-1, 1], (400, 3)) * [2, 1, 0.75] + [0, 0, 0.75]
    columns = {"scan": scan, "object": np.full(400, len(scene.names)), "class": np.ones(400)}
    columns |= {"channel": np.zeros(400), "intensity": np.ones(400)}
    columns["reflectivity"] = np.full(400, 100, np.uint8)
    columns["time"] = when
    places, axes = track.poses(0, np.zeros(400))
    placed = np.einsum("nij,nj->ni", axes, corners) + places
    cloud = Cloud(placed, columns, sweeps=lambda: sweeps)
    save_cloud(cloud, tmp_path / "kitti", format="kitti")
    for sequence in ("00", "01"):
        folder = tmp_path / "kitti/sequences" / sequence
        camera, center, turn, size = in_camera(folder, 0, len(sweeps.objects) + 1)
        assert inside_box(camera, center, turn, size, 0.001).all()
    seen = cloud[200:400]  # by the second sensor alone
    save_cloud(seen, tmp_path / "nuscenes", format="nuscenes")
    (table,) = (tmp_path / "nuscenes").glob("v1.0-*/sample_annotation.json")
    row, other = json.loads(table.read_text())
    assert (row["num_lidar_pts"], other["num_lidar_pts"]) == (200, 0)
    w, *turn = row["rotation"]
    axes = matrices(np.array([[*turn, w]]))[0]
    assert inside_box(seen.positions, row["translation"], axes, (4, 2, 1.5), 1e-6).all()


def in_camera(folder, sweep, instance):
    """Return an object's points in KITTI's camera, and the middle, axes and size of its box."""
    back = np.loadtxt(folder / "calib.txt", usecols=range(1, 13))[4].reshape(3, 4)[:, :3]
    np.testing.assert_allclose(back @ back.T, np.eye(3), atol=1e-9)
    points = np.fromfile(folder / f"velodyne/{sweep:06}.bin", "<f4").reshape(-1, 4)[:, :3]
    instances = np.fromfile(folder / f"labels/{sweep:06}.label", "<u4") >> 16
    labels = (folder / f"label_2/{sweep:06}.txt").read_text().splitlines()
    first = instances[instances > 0].min()
    height, width, length, *place, around = map(float, labels[instance - first].split()[8:])
    turn = np.array([[np.cos(around), 0, np.sin(around)], [0, 1, 0],
                     [-np.sin(around), 0, np.cos(around)]])  # fmt: skip
    center = np.array(place) - [0, height / 2, 0]
    return points[instances == instance] @ back.T, center, turn, (length, height, width)


@pytest.mark.extended
@pytest.mark.parametrize("name", ["ply", *OF_ANY_SENSOR])
def test_a_cloud_is_saved_twice_with_the_same_bytes(cloud, sweeps, tmp_path, name):
    known = replace(cloud, sweeps=lambda: sweeps)
    written = []
    for folder in (tmp_path / "a", tmp_path / "b"):
        folder.mkdir()
        save_cloud(known, folder / "it", format=name) if name != "ply" else save_cloud(
            known, folder / "it.ply"
        )
        files = sorted(path for path in folder.rglob("*") if path.is_file())
        written.append({path.relative_to(folder): path.read_bytes() for path in files})
    assert written[0] == written[1]
    if name == "las":  # which would be that of the day
        assert str(laspy.read(tmp_path / "a/it").header.creation_date) == "1980-01-06"


def test_a_cloud_is_saved_in_the_format_of_its_ending(cloud, sweeps, tmp_path):
    bare = cloud
    known = replace(cloud, sweeps=lambda: sweeps)
    (tmp_path / "a.laz").write_text("an earlier one")
    assert save_cloud(bare, tmp_path / "a.laz") == []
    las = laspy.read(tmp_path / "a.laz")
    assert len(las) == len(cloud) and las.header.scales[0] == 0.001
    save_cloud(known[:9], tmp_path / "b.las")
    assert laspy.read(tmp_path / "b.las").header.scales[0] == sweeps.precision_m
    left_out = save_cloud(known, tmp_path / "c.mcap", layout="ouster")
    assert left_out[:2] == ["scan", "object"] and "range" not in left_out
    store = get_typestore(Stores.ROS2_HUMBLE)
    with AnyReader([tmp_path / "c.mcap"], default_typestore=store) as bag:
        assert {"/front/points", "/rear/points", "/tf", "/tf_static", "/actors", "/clock"} == {
            *bag.topics
        }
    (tmp_path / "result").mkdir()
    sweeps.save(tmp_path / "result/sweeps.npz")
    save_cloud(known, tmp_path / "result/cloud.ply")
    save_cloud(read_cloud(tmp_path / "result/cloud.ply"), tmp_path / "kitti", format="kitti")
    assert len(list((tmp_path / "kitti/sequences/00/velodyne").iterdir())) == 5

    before = sorted(tmp_path.rglob("*"))
    for told, path, more in (
        (
            r"does not belong to any supported format\. Use .ply, .las, .*, or set `format`",
            "x.xyz",
            {},
        ),
        ("Unknown cloud format 'xyz'. The available names are ply, las, ", "x", {"format": "xyz"}),
        ("layout must be 'velodyne', .* but is 'sick'", "x.mcap", {"layout": "sick"}),
        (r"is a folder\. Remove it, or use another path", "kitti", {"format": "kitti"}),
        ("is a folder", "result", {"format": "laz"}),
        (
            "`precision_m` is -1; it must be a positive length in meters",
            "x.las",
            {"precision_m": -1},
        ),
    ):
        with pytest.raises(LidarError, match=told):
            save_cloud(known, tmp_path / path, **more)
    with pytest.raises(LidarError, match="mcap stores single sweeps, but"):
        save_cloud(bare, tmp_path / "x.mcap")
    with pytest.raises(
        LidarError, match="kitti requires the columns scan, object, reflectivity and class, which"
    ):
        save_cloud(
            Cloud(cloud.positions, {}, sweeps=lambda: sweeps), tmp_path / "x", format="kitti"
        )
    with pytest.raises(LidarError, match="not in scan order"):
        save_cloud(known[::-1], tmp_path / "x.e57")
    shorter = replace(sweeps, scans=sweeps.scans[:6], begins_ns=sweeps.begins_ns[:5])
    with pytest.raises(LidarError, match="or come from a different survey than the sweeps"):
        save_cloud(replace(cloud, sweeps=lambda: shorter), tmp_path / "x.mcap")
    assert sorted(tmp_path.rglob("*")) == before


def test_classes_of_formats_need_no_optional_packages():
    """Options are checked, and errors listed, also where nothing can be written."""
    packages = {package for row in FORMATS.values() for package in row.packages}
    code = (
        f"import sys; sys.modules |= dict.fromkeys({packages})\n"
        "from lidarfiles.clouds.format_table import FORMATS\n"
        "from lidarfiles.clouds.writing import ExportSpec\n"
        "assert all(ExportSpec(name).cloud_format.__name__ for name in FORMATS)\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_documentation_and_installation_follow_the_table_of_formats():
    root = Path(__file__).parents[2]
    project = tomllib.loads((root / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    for name, row in FORMATS.items():
        installed = {re.split("[<>=]", one)[0] for one in extras.get(row.extra, ())}
        assert installed == {DISTRIBUTIONS.get(package, package) for package in row.packages}, name
    text = (root / "docs/how-to/formats.md").read_text()
    cells = [
        [re.findall("`([^`]+)`", cell) for cell in line.split("|")] for line in text.split("\n")
    ]
    for name in EXPORTS:
        row = FORMATS[name]
        files, extra = next((c[2], c[4]) for c in cells if len(c) > 5 and name in c[1])
        assert row.file in [file.rstrip("/") for file in files], name
        assert extra == ([row.extra] if row.packages else []), name
    text = text.partition("## Layouts of PointCloud2\n")[2].partition("\n## ")[0]
    for name in LAYOUTS:
        (columns,) = re.findall(rf"\| `{name}` \| \d+ \|.*\| ([\w, ]+) \|\n", text)
        needs = {*ExportSpec("mcap", name).needs} - {"scan", "object", "channel"}
        assert {*columns.split(", ")} == needs, name


@pytest.mark.extended
@pytest.mark.parametrize("name", ["kitti", "nuscenes", "webdataset", "parquet", "pcd", "images"])
def test_workers_and_threads_write_the_same_files(sweeps, cloud, tmp_path, name, monkeypatch):
    """What workers do not see is written here."""
    monkeypatch.setattr(parquet, "CHUNK_POINTS", 1000)
    monkeypatch.setattr(multi_file_format, "RANGE_PIECES", 1)
    ExportSpec(name).write(tmp_path / "threads", cloud, sweeps)
    ranges = []
    sent = []

    def workers(writer, spans):
        ranges.extend(spans)
        sent.append(pickle.dumps(writer))
        made = {span: pickle.loads(sent[0])(span) for span in spans[::2]}
        assert all(made.values())
        return made

    ExportSpec(name).write(tmp_path / "workers", cloud, sweeps, workers=workers)
    assert len(ranges) == (3 if name == "parquet" else 10)
    one, two = (
        {path.relative_to(tmp_path / folder): path.read_bytes() for path in files if path.is_file()}
        for folder in ("threads", "workers")
        for files in [(tmp_path / folder).rglob("*")]
    )
    assert one == two
    assert pickle.loads(sent[0])(ranges[0]) is None  # the folder is gone


def test_an_interrupt_leaves_nothing_of_what_threads_write(sweeps, cloud, tmp_path, monkeypatch):
    write = Storage.write
    main = threading.main_thread().ident
    once = threading.Lock()

    def interrupted(storage, name, data):
        if name.endswith(".bin") and once.acquire(blocking=False):
            # Python's thread pool forgets a thread if it is interrupted while it starts that one.
            time.sleep(0.5)
            signal.pthread_kill(main, signal.SIGINT)
        write(storage, name, data)

    monkeypatch.setattr(Storage, "write", interrupted)
    with pytest.raises(KeyboardInterrupt):
        ExportSpec("kitti").write(tmp_path / "kitti", cloud, sweeps)
    assert not list(tmp_path.iterdir())


def test_a_cloud_becomes_a_dataframe_of_a_library(cloud, monkeypatch):
    assert list(cloud.to_dataframe().columns[:5]) == ["x", "y", "z", "scan", "channel"]
    made = types.SimpleNamespace(DataFrame=dict)
    monkeypatch.setitem(sys.modules, "polars", made)  # which is not installed for one test
    frame = cloud.to_dataframe("polars")
    np.testing.assert_array_equal(frame["channel"], cloud.channel)
    monkeypatch.setitem(sys.modules, "pandas", None)  # as where it is not installed
    with pytest.raises(LidarError, match=r"Dataframes require pandas. Run pip install pandas"):
        cloud.to_dataframe()


def test_formats_hold_radial_velocities(cloud, sweeps, tmp_path):
    velocity = np.random.default_rng(6).normal(0, 9, len(cloud)).astype(np.float32)
    velocity[5] = np.nan  # of a false alarm
    columns = {**cloud.columns, "radial_velocity": velocity}
    moving = Cloud(cloud.positions, columns, sweeps=lambda: sweeps)
    for name in ("c.mcap", "c.las", "c.ply"):
        assert "radial_velocity" not in save_cloud(moving, tmp_path / name)
    for found in (laspy.read(tmp_path / "c.las"), read_cloud(tmp_path / "c.ply")):
        np.testing.assert_array_equal(found["radial_velocity"], velocity)
    types = get_typestore(Stores.ROS2_HUMBLE)
    with AnyReader([tmp_path / "c.mcap"], default_typestore=types) as bag:
        to, _, data = next(m for m in bag.messages() if m[0].topic == "/front/points")
        fields = bag.deserialize(data, to.msgtype).fields
        assert "radial_velocity" in [field.name for field in fields]


SURFACE = ["normal_x", "normal_y", "normal_z", "incidence_deg", "origin_x", "origin_y", "origin_z"]


@pytest.fixture(scope="module")
def drive(cluster_client):
    """Points of a tilted sensor on a moving and turning carrier among the default objects."""
    half = np.sqrt(0.5)
    track = Track([0, 1], [[0, 0, 1], [2, 1, 1]], [[0, 0, 0, 1], [0, 0, half, half]])
    sensor = Mounted(Sensor.grid(3600, 8), Pose((1, 0, 0.5), 30.0, 10.0), "front")
    survey = Survey(
        sensors=[sensor], trajectory=track, steps=72,
        columns=["time", "range", "ray", "intensity", "class", *SURFACE], precision_m=1e-4,
    )  # fmt: skip
    return simulate(Scene.seed(), survey, client=cluster_client).cloud


@pytest.mark.extended
def test_normals_and_origins_follow_the_points_into_the_sensors_axes(drive, tmp_path):
    normals, origins = (
        np.stack([drive[f"{name}_{axis}"] for axis in "xyz"], axis=1).astype(float)
        for name in ("normal", "origin")
    )
    positions = np.asarray(drive)
    assert len(drive) > 500 and np.abs(np.linalg.norm(normals, axis=1) - 1).max() < 1e-6
    np.testing.assert_allclose(
        np.linalg.norm(positions - origins, axis=1), drive["range"], atol=2e-3
    )
    ahead = (positions - origins) / drive["range"][:, None]
    cosine = -(ahead * normals).sum(axis=1)
    assert cosine.min() > 0  # normals face the sensor
    np.testing.assert_allclose(np.cos(np.radians(drive["incidence_deg"])), cosine, atol=2e-3)

    files = {"c.ply": {}, "c.las": {}, "c.parquet": {}, "c.mcap": {"compensated": True},
             "pcd": {"format": "pcd", "compensated": True},
             "webdataset": {"format": "webdataset"}}  # fmt: skip
    for name, options in files.items():
        assert not {*save_cloud(drive, tmp_path / name, **options)} & {*SURFACE}, name
    ply = load_open3d().io.read_point_cloud(str(tmp_path / "c.ply"))
    np.testing.assert_allclose(np.asarray(ply.normals), normals, atol=1e-7)
    las = laspy.read(tmp_path / "c.las")
    frame = pd.read_parquet(tmp_path / "c.parquet")
    for column, file, table in zip(
        SURFACE,
        ["NormalX", "NormalY", "NormalZ", *SURFACE[3:]],
        ["nx", "ny", "nz", *SURFACE[3:]],
        strict=True,
    ):
        np.testing.assert_array_equal(las[file], drive[column])
        np.testing.assert_array_equal(frame[table], drive[column])

    sweeps = drive.sweeps()
    second = drive[drive["scan"] >= 36]
    turn = sweeps.pose.rotations[1]
    place = sweeps.pose.positions[1]
    pcd = PointCloud.from_path(tmp_path / "pcd/000001.pcd")
    types = get_typestore(Stores.ROS2_HUMBLE)
    with AnyReader([tmp_path / "c.mcap"], default_typestore=types) as bag:
        *_, (_, _, data) = (m for m in bag.messages() if m[0].topic == "/front/points")
    held = {
        "pcd": {name: pcd.numpy((name,))[:, 0] for name in pcd.fields},
        "bag": point_columns(bytes(data)),
    }
    with tarfile.open(next((tmp_path / "webdataset").rglob("*.tar"))) as tar:
        sample = {m.name.split(".")[1]: m for m in tar if m.name.startswith("front-000001")}
        columns = {
            name: np.load(io.BytesIO(tar.extractfile(sample[name]).read()))
            for name in ("points", *SURFACE)
        }
    held["tar"] = columns | dict(zip("xyz", columns["points"].T, strict=True))
    for name, points in held.items():
        inside, start, normal = (
            np.stack([points[f"{prefix}{axis}"] for axis in "xyz"], axis=1).astype(float)
            for prefix in ("", "origin_", "normal_")
        )
        here = drive["scan"] >= 36
        np.testing.assert_allclose(inside @ turn.T + place, np.asarray(second), atol=1e-4)
        np.testing.assert_allclose(start @ turn.T + place, origins[here], atol=1e-4, err_msg=name)
        np.testing.assert_allclose(normal @ turn.T, normals[here], atol=1e-6, err_msg=name)


@pytest.mark.extended
def test_e57_has_normals_in_the_sensors_axes(drive, tmp_path, monkeypatch):
    lost = save_cloud(drive, tmp_path / "c.e57")
    assert not {*lost} & {"normal_x", "normal_y", "normal_z"} and "origin_x" in lost
    assert "nor:normalX" not in pye57.e57.SUPPORTED_POINT_FIELDS
    for axis in "XYZ":
        monkeypatch.setitem(pye57.e57.SUPPORTED_POINT_FIELDS, f"nor:normal{axis}", "f")
    with pye57.E57(str(tmp_path / "c.e57")) as file:
        assert file.image_file.isElementNameExtended("nor:normalX")
        found = file.read_scan_raw(1, ignore_unsupported_fields=True)
        turn = file.get_header(1).rotation_matrix
    inside = np.stack([found[f"nor:normal{axis}"] for axis in "XYZ"], axis=1).astype(float)
    normals = np.stack([drive[f"normal_{axis}"] for axis in "xyz"], axis=1)
    np.testing.assert_allclose(inside @ turn.T, normals[drive["scan"] >= 36], atol=1e-6)
