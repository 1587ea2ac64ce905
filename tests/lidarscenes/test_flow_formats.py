"""Scene flow in files: vectors of all formats, and pairs of points in the layout of HPLFlowNet."""

from __future__ import annotations

import io
import tarfile
from dataclasses import replace
from functools import cache

import laspy
import numpy as np
import pandas as pd
import pytest
from pypcd4 import PointCloud
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from tests.lidarscenes.test_scene_flow import SENSOR, cloud_of, straight, turning, vectors
from tests.shapes import block

from lidarfiles import read_cloud, save_cloud
from lidarfiles.clouds.kitti import flow_arrays
from lidarsim import Actor, Mounted, Pose, Scene, Survey
from lidarsim import box as car_box
from lidarsim.columns.table import FLOW, FLOW_EGO
from lidarsim.motion.rotations import rotations_of


@cache
def drive():
    """A cloud of three sweeps: a sensor that turns, and a car that passes."""
    car = Actor(car_box("Car", (4.5, 2.0, 1.5)), straight((4, -3, -1), (0, 8, 0)))
    scene = Scene.from_meshes([block("Room", (40, 40, 12))]).with_actors([car])
    survey = Survey(
        sensors=[Mounted(SENSOR, Pose((0.5, 0.2, 0.3), 30.0, 8.0), "lidar")],
        trajectory=turning(9.0, 1.5), steps=12, precision_m=1e-6,
        columns=("time", "ray", "range", "intensity", "reflectivity", "class", *FLOW, *FLOW_EGO),
    )  # fmt: skip
    return cloud_of(scene, survey)


def test_kitti_has_pairs_of_points_in_the_layout_of_hplflownet(tmp_path):
    cloud = drive()
    lost = save_cloud(cloud, tmp_path / "kitti", format="kitti")
    assert not {*lost} & {*FLOW} and {*FLOW_EGO} <= {*lost}
    sequence = tmp_path / "kitti/sequences/00"
    sweeps = cloud.sweeps()
    calibration = (sequence / "calib.txt").read_text().splitlines()[-1]
    camera = np.array(calibration.split()[1:], float).reshape(3, 4)[:, :3]
    poses = np.loadtxt(sequence / "poses.txt").reshape(-1, 3, 4)
    for number, points in enumerate(sweeps.points(cloud)):
        first, second = (np.load(sequence / f"flow/{number:06}/pc{k}.npy") for k in (1, 2))
        assert first.dtype == second.dtype == np.float32
        if number == 2:
            assert first.shape == second.shape == (0, 3)
            continue
        rows = np.fromfile(sequence / f"velodyne/{number:06}.bin", np.float32).reshape(-1, 4)
        in_camera = rows[:, :3] @ camera.T  # right, down, forward
        np.testing.assert_allclose(first * [-1, -1, 1], in_camera, atol=1e-5)
        # By the poses of the files, static points of both sweeps are at the same place.
        static = points["object"] == 0
        before, after = (
            (pair * [-1, -1, 1]) @ poses[number + k, :, :3].T + poses[number + k, :, 3]
            for k, pair in enumerate((first, second))
        )
        np.testing.assert_allclose(after[static], before[static], atol=1e-4)
        moved = np.linalg.norm(after - before, axis=1)[~static]
        np.testing.assert_allclose(moved, 0.8, atol=1e-4)


def test_a_tilted_sensor_has_level_pairs():
    tilt = rotations_of(np.array([0.0, 20.0, 0.0]))
    level = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    points = np.array([[5.0, 0, 0], [0, 3, 0]], np.float32)
    flow = np.array([[1.0, 0, 0], [np.nan, 0, 0]], np.float32)
    arrays = flow_arrays(points, flow, level @ tilt)
    expected = (level @ tilt @ points[0]) * [-1, -1, 1]
    np.testing.assert_allclose(arrays["pc1"], expected[None], atol=1e-6)
    np.testing.assert_allclose(arrays["pc2"], 1.2 * expected[None], atol=1e-6)


@pytest.mark.extended
def test_all_formats_of_columns_hold_flow(tmp_path):
    cloud = drive()
    sweeps = cloud.sweeps()
    names = (*FLOW, *FLOW_EGO)
    files = {"c.ply": {}, "c.las": {}, "c.parquet": {}, "c.mcap": {"compensated": True},
             "pcd": {"format": "pcd"}, "webdataset": {"format": "webdataset"}}  # fmt: skip
    for name, options in files.items():
        assert not {*save_cloud(cloud, tmp_path / name, **options)} & {*names}, name
    las = laspy.read(tmp_path / "c.las")
    frame = pd.read_parquet(tmp_path / "c.parquet")
    ply = read_cloud(tmp_path / "c.ply")
    for name in names:
        for stored in (las[name], frame[name], ply[name]):
            np.testing.assert_array_equal(stored, cloud[name])
    first = next(iter(sweeps.points(cloud)))
    fired = vectors(sweeps.columns_as_fired(0, first), names)
    compensated = vectors(sweeps.columns_compensated(0, first), names)
    assert np.abs(fired - compensated).max() > 0.05
    pcd = PointCloud.from_path(tmp_path / "pcd/000000.pcd")
    np.testing.assert_allclose(pcd.numpy(names), fired, atol=1e-6)
    with AnyReader(
        [tmp_path / "c.mcap"], default_typestore=get_typestore(Stores.ROS2_HUMBLE)
    ) as bag:
        _, _, data = next(m for m in bag.messages() if m[0].topic == "/lidar/points")
        message = bag.deserialize(data, "sensor_msgs/msg/PointCloud2")
    offsets = {field.name: field.offset for field in message.fields}
    dtype = np.dtype(
        {"names": names, "formats": ["<f4"] * 6, "offsets": [offsets[name] for name in names],
         "itemsize": message.point_step}
    )  # fmt: skip
    rows = message.data.view(dtype)
    np.testing.assert_allclose(vectors(rows, names), compensated, atol=1e-6)
    with tarfile.open(next((tmp_path / "webdataset").rglob("*.tar"))) as tar:
        members = {m.name.split(".", 1)[1]: m for m in tar if m.name.startswith("lidar-000000")}
        arrays = {
            name: np.load(io.BytesIO(tar.extractfile(members[f"{name}.npy"]).read()))
            for name in names
        }
    np.testing.assert_allclose(vectors(arrays, names), compensated, atol=1e-6)


@pytest.mark.extended
def test_compensated_actors_have_the_flow_of_their_boxes(tmp_path):
    cloud = drive()
    save_cloud(cloud, tmp_path / "kitti", format="kitti", compensated_actors=True)
    first, second = (
        np.load(tmp_path / f"kitti/sequences/00/flow/000000/pc{k}.npy") for k in (1, 2)
    )
    sweeps = replace(cloud.sweeps(), actors_at_start=True)
    points = next(iter(sweeps.points(cloud)))
    on_car = points["object"] == 1
    boxes = sweeps.actor_poses.positions[0, :2]
    in_car = points.positions - boxes[0]
    assert np.abs(in_car[on_car][:, 0]).max() < 2.26
    camera = np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]])  # not level: only for lengths
    ends = sweeps.pose.to_body_frame(1, (in_car + boxes[1])[on_car])
    np.testing.assert_allclose(
        np.linalg.norm(ends @ camera.T, axis=1), np.linalg.norm(second[on_car], axis=1), atol=1e-4
    )
    assert len(first) == len(points)
