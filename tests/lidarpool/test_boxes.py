"""Boxes of actors in exports: poses at their stamps, of one size, with the velocities of actors."""

import io
import json
import tarfile
from dataclasses import replace

import numpy as np
import pytest

import lidarpool
from lidarfiles import save_cloud
from lidarfiles.clouds.boxes import Boxes, SweepBoxes
from lidarfiles.clouds.writing import ExportSpec
from lidarfiles.datasets.dataset import DataSet
from lidarfiles.datasets.job_table import JobRow, write_table
from lidarsim import (
    Actor,
    Cloud,
    Fault,
    LidarError,
    Mounted,
    Pose,
    Scene,
    Sensor,
    Survey,
    Track,
    box,
)
from lidarsim.io.storage import Storage
from lidarsim.motion.rotations import matrices
from lidarsim.scene.animation import Animation
from lidarsim.sweeps.sweeps import Sweeps

PERIOD_NS = 100_000_000  # of a sweep
SCANS = 36  # of a sweep
LABELS = ("Bus", "Walker", "Tram", "Guest")
# Where the actors would be at time 0, m, and their velocities, m/s.
STARTS = np.array([[-8, 6, 0], [5, -4, 0.1], [3, -9, 0], [20, 8, 0]], float)
VELOCITIES = np.array([[3, 0, 0], [0.84, 1.12, 0], [-12, 5, 0.25], [-15, 0, 0]], float)
# Sizes of the boxes, m: the walker's arms and legs reach 0.6 m ahead, 0.4 m back and 0.3 m aside.
SIZES = np.array([[11, 2.5, 3], [1.0, 0.6, 1.75], [20, 2.3, 3.4], [4, 2, 1.5]])
DRIVE_START = np.array([0, 0, 1])  # of the carrier, m
GUEST_S = (0.25, 0.83)  # Guest 1 appears during its third sweep, and leaves during its ninth


def walker():
    """A mesh that is 0.2 m long while it stands, and swings 0.6 m ahead and 0.4 m back."""
    mesh = box("Walker 1", (0.2, 0.6, 1.75))
    swing = np.where(mesh.vertices[:, 2:] < 1, [[1.0, 0, 0]], 0)
    poses = mesh.vertices + np.array([0, 0.5, 0, -0.3])[:, None, None] * swing
    return replace(mesh, animation=Animation(poses, 0.25))


@pytest.fixture(scope="module")
def drive():
    """Points of a sensor of ten and one of five sweeps a second, on a carrier that turns."""
    meshes = [box("Bus 1", SIZES[0]), walker(), box("Tram 1", SIZES[2]), box("Guest 1", SIZES[3])]
    spans_s = [(-1, 2), (-1, 2), (-1, 2), GUEST_S]
    actors = [
        Actor(mesh, Track(span, start + np.outer(span, velocity), start_s=0, beyond="absent"))
        for mesh, span, start, velocity in zip(meshes, spans_s, STARTS, VELOCITIES, strict=True)
    ]
    scene = Scene.from_meshes([box("Floor", (60, 60, 0.01))]).with_actors(actors)
    half = np.sqrt(0.5)
    carrier = Track([0, 1], [[0, 0, 1], [4, 1, 1]], [[0, 0, 0, 1], [0, 0, half, half]])
    sensors = [
        Mounted(Sensor.grid(SCANS * 10, 4), Pose((1, 0, 0.5), 30.0), "roof"),
        Mounted(Sensor.grid(SCANS * 10, 4, rate_hz=5.0), Pose((-1, 0, 0.5), 200.0), "rear"),
    ]
    columns = ["time", "intensity", "reflectivity", "class"]
    return Survey(sensors=sensors, trajectory=carrier, columns=columns), scene


def cloud_of(survey, scene):
    """Return a cloud with a point of each actor in each scan in which the actor is there."""
    begins_ns = np.array([survey.begins_ns(scan) for scan in range(survey.scan_count)])
    scan = np.repeat(np.arange(survey.scan_count), len(LABELS))
    actor = np.tile(np.arange(len(LABELS)), survey.scan_count)
    time_s = begins_ns[scan] / 1e9
    kept = (actor < 3) | ((GUEST_S[0] <= time_s) & (time_s <= GUEST_S[1]))
    scan, actor, time_s = scan[kept], actor[kept], time_s[kept]
    positions = STARTS[actor] + VELOCITIES[actor] * time_s[:, None] + [0, 0, 0.5]
    columns = {
        "scan": scan, "channel": 0 * scan, "object": len(scene.names) + actor,
        "time": np.rint(1e9 * time_s), "class": 0 * scan, "intensity": np.ones(len(scan), "f4"),
        "reflectivity": np.full(len(scan), 9, np.uint8),
    }  # fmt: skip
    sweeps = Sweeps.from_survey(survey, scene)
    return Cloud(positions, columns, sweeps=lambda: sweeps)


@pytest.fixture(scope="module")
def cloud(drive):
    return cloud_of(*drive)


def poses_of(sweeps, sensor):
    """Return the matrices (n, 4, 4) of the poses of a sensor, and the times of its sweeps, s."""
    numbers = np.flatnonzero(sweeps.sensor == sensor)
    return [sweeps.pose.matrix(number) for number in numbers], sweeps.begins_ns[numbers] / 1e9


class Labels:
    """Boxes of each actor in a file: times, s, centers in the world, m, sizes, m."""

    def __init__(self):
        self.rows = {name: [] for name in LABELS}

    def add(self, name, time_s, center, size):
        self.rows[name.split()[0]].append((time_s, center, size))

    def check(self, place_m, size_m=1e-6, counts=(10, 7)):
        """Check all boxes by closed form, to an accuracy of the file."""
        for actor, name in enumerate(LABELS):
            times_s, centers, sizes = map(np.array, zip(*self.rows[name], strict=True))
            order = np.argsort(times_s, kind="stable")
            times_s, centers, sizes = times_s[order], centers[order], sizes[order]
            ahead = 0.1 if name == "Walker" else 0.0  # of the middle of the box, horizontally
            heading = np.arctan2(*VELOCITIES[actor, 1::-1])
            middle = [ahead * np.cos(heading), ahead * np.sin(heading), SIZES[actor, 2] / 2]
            expected = STARTS[actor] + middle + np.outer(times_s, VELOCITIES[actor])
            np.testing.assert_allclose(centers, expected, atol=place_m)
            np.testing.assert_allclose(sizes, np.tile(SIZES[actor], (len(sizes), 1)), atol=size_m)
            assert len(times_s) == counts[name == "Guest"]
            speeds = devkit_velocities(times_s, centers)
            assert (np.linalg.norm(speeds - VELOCITIES[actor], axis=1)
                    < 0.02 * np.linalg.norm(VELOCITIES[actor])).all()  # fmt: skip


def devkit_velocities(times_s, centers):
    """Return velocities by the rule of nuscenes-devkit: from the box before to the next."""
    last = np.minimum(np.arange(len(times_s)) + 1, len(times_s) - 1)
    first = np.maximum(np.arange(len(times_s)) - 1, 0)
    return (centers[last] - centers[first]) / (times_s[last] - times_s[first])[:, None]


def nuscenes_tables(folder):
    """Return the tables of a data set, {table: {token: row}}."""
    return {
        path.stem: {row["token"]: row for row in json.loads(path.read_text())}
        for path in folder.glob("v1.0-lidarpool/*.json")
    }


def test_nuscenes_has_boxes_at_the_times_of_samples(cloud, tmp_path):
    save_cloud(cloud, tmp_path / "nu", format="nuscenes")
    tables = nuscenes_tables(tmp_path / "nu")
    labels = Labels()
    for row in tables["sample_annotation"].values():
        instance = tables["instance"][row["instance_token"]]
        name = tables["category"][instance["category_token"]]["name"]
        time_s = tables["sample"][row["sample_token"]]["timestamp"] / 1e6
        width, length, height = row["size"]
        labels.add(name, time_s, row["translation"], (length, width, height))
        w, *vector = row["rotation"]
        forward = matrices(np.array([[*vector, w]]))[0][:, 0]
        speed = VELOCITIES[LABELS.index(name)] * [1, 1, 0]  # actors are level
        np.testing.assert_allclose(forward, speed / np.linalg.norm(speed), atol=1e-9)
    labels.check(1e-9)
    assert len(tables["sample"]) == 10
    counts = [row["num_lidar_pts"] for row in tables["sample_annotation"].values()]
    # The rear sensor's sweep that begins with a sample is its key frame.
    assert sum(counts) == len(cloud)


def test_nuscenes_interpolates_boxes_between_samples(drive, tmp_path):
    """By the rule of the devkit: sweeps between samples point to the sample that follows."""
    survey, scene = drive
    rear = Mounted(Sensor.grid(SCANS * 10, 4, rate_hz=30.0), Pose((-1, 0, 0.5), 200.0), "rear")
    cloud = cloud_of(replace(survey, sensors=[survey.mounted_sensors[0], rear]), scene)
    save_cloud(cloud, tmp_path / "nu", format="nuscenes")
    tables = nuscenes_tables(tmp_path / "nu")
    samples = tables["sample"]
    x_of_bus = {
        row["sample_token"]: row["translation"][0]
        for row in tables["sample_annotation"].values()
        if row["size"][2] == SIZES[0, 2]
    }
    interpolated = []
    last_us = max(row["timestamp"] for row in samples.values())
    for row in tables["sample_data"].values():
        sample = samples[row["sample_token"]]
        if row["is_key_frame"]:
            assert 0 <= row["timestamp"] - sample["timestamp"] < 34_000
        elif row["timestamp"] < last_us:
            before = samples[sample["prev"]]
            times_us = [before["timestamp"], sample["timestamp"]]
            assert times_us[0] < row["timestamp"] < times_us[1]
            x = np.interp(
                row["timestamp"], times_us, [x_of_bus[sample["prev"]], x_of_bus[sample["token"]]]
            )
            assert x == pytest.approx(STARTS[0, 0] + VELOCITIES[0, 0] * row["timestamp"] / 1e6)
            interpolated.append(row)
    assert len(interpolated) == 18


@pytest.mark.parametrize(("sequence", "counts"), [("00", (10, 7)), ("01", (5, 4))])
def test_kitti_has_boxes_at_the_times_of_sweeps(cloud, tmp_path, sequence, counts):
    save_cloud(cloud, tmp_path / "kitti", format="kitti")
    poses, starts_s = poses_of(cloud.sweeps(), int(sequence))
    folder = tmp_path / "kitti/sequences" / sequence
    times_s = np.loadtxt(folder / "times.txt")
    np.testing.assert_allclose(times_s, starts_s, atol=1e-9)
    camera = np.loadtxt(folder / "calib.txt", usecols=range(1, 13))[4].reshape(3, 4)[:, :3]
    labels = Labels()
    for number, (pose, time_s) in enumerate(zip(poses, times_s, strict=True)):
        for line in (folder / f"label_2/{number:06}.txt").read_text().splitlines():
            name, *words = line.split()
            height, width, length, *bottom, around = map(float, words[7:])
            # The actor turned about the camera's y, as seen from the camera; and no picture.
            alpha = around - np.arctan2(bottom[0], bottom[2])
            assert abs(float(words[2])) < np.pi + 1e-4
            assert np.exp(1j * float(words[2])) == pytest.approx(np.exp(1j * alpha), abs=3e-4)
            assert [float(word) for word in (*words[:2], *words[3:7])] == [0, 3, 0, 0, 0, 0]
            heading = camera @ pose[:3, :3].T @ np.append(VELOCITIES[LABELS.index(name), :2], 0)
            assert around == pytest.approx(np.arctan2(-heading[2], heading[0]), abs=1e-3)
            inside = camera.T @ (bottom - np.array([0, height / 2, 0]))
            labels.add(name, time_s, pose[:3, :3] @ inside + pose[:3, 3], (length, width, height))
    labels.check(2e-4, 1e-4, counts)


@pytest.mark.parametrize("sequence", ["00", "01"])
def test_kitti_has_tracks_with_the_instances_of_points(cloud, tmp_path, sequence):
    save_cloud(cloud, tmp_path / "kitti", format="kitti")
    folder = tmp_path / "kitti/sequences" / sequence
    labels = {path.stem: path.read_text().splitlines() for path in folder.glob("label_2/*.txt")}
    kinds = dict[str, str]()
    for line in (tmp_path / f"kitti/label_02/{sequence}.txt").read_text().splitlines():
        frame, track, kind, truncation, *others = line.split()
        assert truncation == "0"
        # The remaining values are those of the object's label in the sweep.
        labels[f"{int(frame):06}"].remove(" ".join([kind, "0.00", *others]))
        instances = np.fromfile(folder / f"labels/{int(frame):06}.label", "<u4") >> 16
        assert int(track) in instances
        assert kinds.setdefault(track, kind) == kind
    assert not any(labels.values())
    assert [*kinds.values()] == [*LABELS]
    first = len(cloud.sweeps().objects) + 1
    assert [*kinds] == [str(first + number) for number in range(len(LABELS))]


def test_webdataset_has_boxes_at_the_times_of_sweeps(cloud, tmp_path):
    save_cloud(cloud, tmp_path / "web", format="webdataset")
    files = {}
    for path in (tmp_path / "web").rglob("*.tar"):
        with tarfile.open(path) as tar:
            files |= {m.name: tar.extractfile(m).read() for m in tar.getmembers()}
    labels = Labels()
    for key in [name.removesuffix(".json") for name in files if name.endswith(".json")]:
        about = json.loads(files[f"{key}.json"])
        if about["sensor"] != "roof":
            continue
        boxes = np.load(io.BytesIO(files[f"{key}.boxes.npy"]))
        pose = np.load(io.BytesIO(files[f"{key}.pose.npy"]))
        centers = boxes[:, :3] @ pose[:3, :3].T + pose[:3, 3]
        for name, center, row in zip(about["box_types"], centers, boxes, strict=True):
            labels.add(name, about["time_ns"] / 1e9, center, row[3:6])
    labels.check(5e-6, 1e-6)


def test_osi_has_boxes_and_velocities_at_the_stamps_of_messages(cloud, tmp_path):
    osi = pytest.importorskip("betterosi", reason="betterosi is an extra")
    save_cloud(cloud, tmp_path / "a.osi", format="osi")
    labels = Labels()
    for message in osi.read(tmp_path / "a.osi", osi_message_type="SensorData"):
        if message.sensor_id.value:
            continue
        truth = message.sensor_view[0].global_ground_truth
        time_s = truth.timestamp.seconds + truth.timestamp.nanos / 1e9
        for thing in truth.moving_object[1:]:
            base = thing.base
            size = (base.dimension.length, base.dimension.width, base.dimension.height)
            labels.add(thing.model_reference, time_s, vector_of(base.position), size)
            speed = VELOCITIES[LABELS.index(thing.model_reference.split()[0])]
            np.testing.assert_allclose(vector_of(base.velocity), speed, atol=1e-9)
    labels.check(1e-9)


def vector_of(message):
    return np.array([message.x, message.y, message.z])


def test_bags_have_boxes_at_their_stamps(cloud, tmp_path):
    rosbags = pytest.importorskip("rosbags.highlevel", reason="rosbags is an extra")
    from rosbags.typesys import Stores, get_typestore

    save_cloud(cloud, tmp_path / "a.mcap")
    labels = Labels()
    seen_ns = set()
    store = get_typestore(Stores.ROS2_HUMBLE)
    with rosbags.AnyReader([tmp_path / "a.mcap"], default_typestore=store) as bag:
        connections = [one for one in bag.connections if one.topic == "/actors"]
        for connection, when_ns, data in bag.messages(connections):
            for marker in bag.deserialize(data, connection.msgtype).markers:
                stamp_ns = marker.header.stamp.sec * 10**9 + marker.header.stamp.nanosec
                assert stamp_ns == when_ns
                since_ns = stamp_ns - bag.start_time
                if marker.action or (since_ns, marker.text) in seen_ns:
                    continue  # of the other sensor
                seen_ns.add((since_ns, marker.text))
                size = (marker.scale.x, marker.scale.y, marker.scale.z)
                labels.add(
                    marker.text.split("_")[0], since_ns / 1e9, vector_of(marker.pose.position), size
                )
    labels.check(1e-9)


def frames_of(path):
    """Return the frames in a bag's /tf: {frame: (times, s; positions; quaternions)}, and mounts."""
    rosbags = pytest.importorskip("rosbags.highlevel", reason="rosbags is an extra")
    from rosbags.typesys import Stores, get_typestore

    frames = {}
    with rosbags.AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as bag:
        connections = [one for one in bag.connections if one.topic in ("/tf", "/tf_static")]
        start_ns = bag.start_time
        for connection, _, data in bag.messages(connections):
            for stamped in bag.deserialize(data, connection.msgtype).transforms:
                stamp = stamped.header.stamp
                time_s = (stamp.sec * 10**9 + stamp.nanosec - start_ns) / 1e9
                turned = stamped.transform.rotation
                quaternion = (turned.x, turned.y, turned.z, turned.w)
                row = (time_s, vector_of(stamped.transform.translation), quaternion)
                frames.setdefault(stamped.child_frame_id, []).append(row)
    for name, rows in frames.items():
        times_s, positions, quaternions = map(np.array, zip(*sorted(rows, key=first), strict=True))
        frames[name] = times_s, positions, quaternions
    return frames


def first(row):
    return row[0]


def poses_in(frame, times_s):
    """Interpolate the poses of a frame, which must have poses before and after all times."""
    frame_s, positions, quaternions = frame
    assert frame_s[0] <= times_s.min() and times_s.max() <= frame_s[-1]
    before = np.clip(np.searchsorted(frame_s, times_s, "right") - 1, 0, len(frame_s) - 2)
    share = ((times_s - frame_s[before]) / (frame_s[before + 1] - frame_s[before]))[:, None]
    positions = positions[before] * (1 - share) + positions[before + 1] * share
    # Between frames 0.1 s apart, the drive turns by 9 degrees.
    first_q, second_q = quaternions[before], quaternions[before + 1]
    angle = np.arccos(np.clip((first_q * second_q).sum(axis=1), -1, 1))[:, None] + 1e-12
    mixed = np.sin(angle * (1 - share)) * first_q + np.sin(angle * share) * second_q
    return positions, matrices(mixed / np.sin(angle))


def points_in_map(path, frames, sensor):
    """Return the points of a sensor in a bag in `map`, each moved by the frames at its time."""
    rosbags = pytest.importorskip("rosbags.highlevel", reason="rosbags is an extra")
    from rosbags.typesys import Stores, get_typestore

    _, (mount,), (quaternion,) = frames[sensor]
    in_map = []
    with rosbags.AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as bag:
        connections = [one for one in bag.connections if one.topic == f"/{sensor}/points"]
        for connection, when_ns, data in bag.messages(connections):
            message = bag.deserialize(data, connection.msgtype)
            kind = [("xyz", "<f4", 3), ("intensity", "<f4"), ("ring", "<u2"), ("time", "<f4")]
            rows = message.data.view(kind)
            times_s = (when_ns - bag.start_time) / 1e9 + rows["time"].astype(float)
            positions, rotations = poses_in(frames["base_link"], times_s)
            on_carrier = rows["xyz"] @ matrices(np.array([quaternion]))[0].T + mount
            in_map.append(np.einsum("nij,nj->ni", rotations, on_carrier) + positions)
    return in_map


@pytest.mark.parametrize("format", ["mcap", "rosbag2"])
def test_all_sweeps_of_a_bag_can_be_deskewed_by_its_frames(cloud, tmp_path, format):  # noqa: A002
    path = tmp_path / ("a.mcap" if format == "mcap" else "a")
    save_cloud(cloud, path, format=format)
    frames = frames_of(path)
    sweeps = cloud.sweeps()
    by_sensor = {"roof": [], "rear": []}
    for number, points in enumerate(sweeps.points(cloud)):
        by_sensor[sweeps.sensors[sweeps.sensor[number]]].append(points.positions)
    for sensor, expected in by_sensor.items():
        in_map = points_in_map(path, frames, sensor)
        np.testing.assert_allclose(np.concatenate(in_map), np.concatenate(expected), atol=2e-5)
    # Besides the starts of the sweeps there are frames at the ends of the last of each sensor.
    times_s = frames["base_link"][0]
    ends_s = 1.000001 - np.array([0.1, 0.2]) / 360  # a microsecond after the last firing
    assert set(np.round(times_s, 9)) == {*np.round(np.arange(10) / 10, 9), *np.round(ends_s, 9)}


def test_a_bag_has_poses_at_a_rate(cloud, tmp_path):
    save_cloud(cloud, tmp_path / "a.mcap", pose_rate_hz=40)
    frames = frames_of(tmp_path / "a.mcap")
    times_s, positions, quaternions = frames["base_link"]
    assert {*np.round(np.arange(40) / 40, 9)} <= {*np.round(times_s, 9)}
    np.testing.assert_allclose(positions, DRIVE_START + np.outer(times_s, [4, 1, 0]), atol=1e-5)
    turned = np.stack([np.sin(np.pi / 4 * times_s), np.cos(np.pi / 4 * times_s)], axis=1)
    np.testing.assert_allclose(quaternions[:, 2:], turned, atol=1e-6)
    for name, start, velocity in zip(LABELS, STARTS, VELOCITIES, strict=True):
        actor_s, positions, _ = frames[f"{name}_1"]
        np.testing.assert_allclose(positions, start + np.outer(actor_s, velocity), atol=1e-6)
        if name == "Guest":
            assert actor_s.min() >= GUEST_S[0] and actor_s.max() <= GUEST_S[1]
        else:
            assert len(actor_s) == len(times_s)


def test_frames_of_a_bag_stay_at_a_station_until_its_last_sweep_ends(tmp_path):
    lidar = Sensor.grid(SCANS * 10, 4)
    scene = Scene.from_meshes([box("Floor", (60, 60, 0.01))])
    survey = Survey(lidar, [(0, 0, 1), (7, 0, 1)], steps=2 * SCANS, columns=["time", "intensity"])
    scan = np.arange(survey.scan_count)
    times_ns = np.array([survey.begins_ns(number) for number in scan])
    columns = {"scan": scan, "channel": 0 * scan, "object": 0 * scan, "time": np.rint(times_ns)}
    columns["intensity"] = np.ones(len(scan), "f4")
    sweeps = Sweeps.from_survey(survey, scene)
    cloud = Cloud(np.zeros((len(scan), 3)), columns, sweeps=lambda: sweeps)
    save_cloud(cloud, tmp_path / "a.mcap")
    positions, _ = poses_in(frames_of(tmp_path / "a.mcap")["base_link"], times_ns / 1e9)
    expected = np.where(scan < 2 * SCANS, 0, 7)
    np.testing.assert_allclose(positions[:, 0], expected, atol=1e-9)


def moving_corners(coordinates="world"):
    """Return a cloud of the corners of two boxes in each scan, and their sweeps."""
    trailer = box("Trailer 1", (8, 2, 3))
    trailer = replace(trailer, vertices=trailer.vertices - [4, 0, 0])
    angles = np.linspace(0, 1.5, 601)  # about the hitch, at 0.5 rad/s
    quaternions = np.stack([0 * angles, 0 * angles, np.sin(angles / 2), np.cos(angles / 2)], axis=1)
    turning = Track(2 * angles, np.tile([9.0, 0, 0], (601, 1)), quaternions)
    driving = Track([0, 3], [[-30, 5, 0], [60, 5, 0]])  # 30 m/s
    parked = Track([0, 3], [[0, -5, 0], [0, -5, 0]])
    cars = box("Car 1", (4, 2, 1.5)), box("Car 2", (4, 2, 1.5))
    actors = Actor(cars[0], driving), Actor(trailer, turning), Actor(cars[1], parked)
    scene = Scene.from_meshes([box("Floor", (60, 60, 0.01))]).with_actors(actors)
    carrier = Track([0, 1], [[0, 0, 1], [4, 1, 1]])
    columns = ["time", "intensity", "reflectivity", "normal_x", "normal_y", "normal_z"]
    survey = Survey(Sensor.grid(SCANS * 10, 4), trajectory=carrier, columns=[*columns, "class"],
                    coordinates=coordinates)  # fmt: skip
    positions, normals, scan, number, stamps = [], [], [], [], []
    for step in range(survey.scan_count):
        time_ns = survey.begins_ns(step)
        for actor, moving in enumerate(actors):
            vertices = moving.mesh_at(time_ns).vertices
            _, rotations = moving.trajectory.poses(0, np.array([time_ns]))
            forward = [1, 0, 0] if rotations is None else rotations[0][:, 0]
            if coordinates == "sensor":
                pose = survey.pose(step)
                vertices = (vertices - pose.position) @ pose.rotation
                forward = forward @ pose.rotation
            positions.append(vertices)
            normals.append(np.tile(forward, (len(vertices), 1)))
            scan.append(np.full(len(vertices), step))
            number.append(np.full(len(vertices), len(scene.names) + actor))
            stamps.append(np.full(len(vertices), round(time_ns)))
    scan, number, stamps = map(np.concatenate, (scan, number, stamps))
    x, y, z = np.concatenate(normals).T
    columns = {
        "scan": scan, "object": number, "time": stamps, "channel": 0 * scan, "class": 0 * scan,
        "intensity": np.ones(len(scan), "f4"), "reflectivity": np.full(len(scan), 9, np.uint8),
        "normal_x": x, "normal_y": y, "normal_z": z,
    }  # fmt: skip
    sweeps = Sweeps.from_survey(survey, scene)
    return Cloud(np.concatenate(positions), columns, sweeps=lambda: sweeps), sweeps


def outside(boxes, objects, points):
    """Return the distances (n,) of points to the boxes of their actors, m."""
    rotations = matrices(boxes.quaternions)
    index = np.searchsorted(boxes.objects, objects)
    inside = np.einsum("nji,nj->ni", rotations[index], points - boxes.centers[index])
    return np.linalg.norm(np.maximum(np.abs(inside) - boxes.sizes[index] / 2, 0), axis=1)


@pytest.mark.extended(keep=("kitti",))
@pytest.mark.parametrize("name", ["kitti", "nuscenes", "webdataset", "mcap"])
def test_points_of_actors_lie_in_their_boxes_at_the_start_of_the_sweep(tmp_path, name):
    cloud, sweeps = moving_corners()
    objects = [points["object"] for points in sweeps.points(cloud)]
    for compensated, expected in ((False, 3.0), (True, 0.0)):
        data = DataSet(
            Storage.at(tmp_path / str(compensated)), name, compensated_actors=compensated
        )
        rows = [JobRow(0, "00")]
        data.write_job(rows[0], cloud, sweeps)
        write_table(data.storage, [], lambda rows=rows: rows)
        data.finish(rows)
        found = lidarpool.sweeps(tmp_path / str(compensated))
        distances = [
            outside(sweep.boxes, numbers, sweep.points)
            for sweep, numbers in zip(found, objects, strict=True)
        ]
        assert np.max(distances) == pytest.approx(expected, abs=0.1 if expected else 2e-4)


@pytest.mark.parametrize("coordinates", ["world", "sensor"])
def test_actors_are_compensated_in_both_coordinates(coordinates):
    cloud, sweeps = moving_corners(coordinates)
    boxes_by_sweep = []
    for number, points in enumerate(sweeps.points(cloud)):
        boxes = Boxes.from_points(sweeps, number, points).to_sensor_frame(sweeps.pose, number)
        boxes_by_sweep.append(SweepBoxes.select(sweeps, boxes))
    moved = replace(sweeps, actors_at_start=True)
    for number, points in enumerate(moved.points(cloud)):
        boxes = boxes_by_sweep[number]
        at_start = moved.compensate_motion(number, points)
        assert outside(boxes, points["object"], at_start).max() < 2e-4
        columns = moved.columns_compensated(number, points)
        normals = np.stack([columns[f"normal_{axis}"] for axis in "xyz"], axis=1)
        forward = matrices(boxes.quaternions)[:, :, 0]
        expected = forward[np.searchsorted(boxes.objects, points["object"])]
        np.testing.assert_allclose(normals, expected, atol=2e-6)


def test_formats_without_sweeps_refuse_to_move_the_points_of_actors():
    for name in ("laz", "parquet", "pcap"):
        with pytest.raises(LidarError, match=f"{name} does not support `compensated_actors"):
            ExportSpec(name, compensated_actors=True)
    with pytest.raises(LidarError, match="kitti does not support `pose_rate_hz`"):
        ExportSpec("kitti", pose_rate_hz=10)
    assert "time" in ExportSpec("kitti", compensated_actors=True).needs


def test_an_actor_whose_box_is_beside_its_origin_has_the_velocity_of_the_box(tmp_path):
    """A trailer that turns about its hitch, 4 m from the middle of its box, at 0.5 rad/s."""
    mesh = box("Trailer 1", (8, 2, 3))
    mesh = replace(mesh, vertices=mesh.vertices - [4, 0, 0])
    angles = np.linspace(0, 1, 401)
    quaternions = np.stack([0 * angles, 0 * angles, np.sin(angles / 2), np.cos(angles / 2)], axis=1)
    track = Track(2 * angles, np.tile([9.0, 0, 0], (401, 1)), quaternions)
    scene = Scene.from_meshes([box("Floor", (60, 60, 0.01))]).with_actors([Actor(mesh, track)])
    sweeps = Sweeps.from_survey(Survey(Sensor.grid(360, 4), [(0, 0, 1)], steps=180), scene)
    turned = 0.5 * sweeps.begins_ns / 1e9
    expected = 2 * np.stack([np.sin(turned), -np.cos(turned), 0 * turned], axis=1)
    np.testing.assert_allclose(sweeps.actor_velocities[0], expected, atol=1e-9)


def test_sweeps_of_one_firing_have_velocities(drive):
    """Beginning and end of such a sweep are the same time."""
    _, scene = drive
    flash = Survey(Sensor.grid(1, 4, step_deg=360), [(0, 0, 1)], steps=5)
    sweeps = Sweeps.from_survey(flash, scene)
    assert (sweeps.ends_ns == sweeps.begins_ns).all()
    np.testing.assert_allclose(sweeps.actor_velocities[:3, 2], VELOCITIES[:3], atol=1e-9)


def test_repeated_points_of_an_actor_that_has_left_have_no_box(drive):
    survey, scene = drive
    survey = replace(survey, sensors=survey.mounted_sensors[:1], faults=[Fault("frozen", 0.75)])
    sweeps = Sweeps.from_survey(survey, scene)
    guest = len(scene.names) + 3
    points = Cloud(np.zeros((1, 3)), {"scan": [SCANS * 9], "object": [guest]})
    boxes = Boxes.from_points(sweeps, 9, points)
    assert boxes.points.tolist() == [0, 0, 0, 1]
    assert boxes.present.tolist() == [True, True, True, False]


def test_the_first_sensor_of_nuscenes_is_lidar_top_and_a_note_says_so(drive, tmp_path):
    survey, scene = drive
    for names, channels, words in (
        (("roof", "rear"), {"LIDAR_TOP", "rear"}, "so 'roof' is renamed to 'LIDAR_TOP'"),
        (("LIDAR_TOP", "rear"), {"LIDAR_TOP", "rear"}, ""),
        (
            ("rear", "LIDAR_TOP"),
            {"LIDAR_TOP", "LIDAR_TOP_2"},
            "and 'LIDAR_TOP' to 'LIDAR_TOP_2'",
        ),
    ):
        sensors = [
            replace(carried, name=name)
            for carried, name in zip(survey.mounted_sensors, names, strict=True)
        ]
        cloud = cloud_of(replace(survey, sensors=sensors), scene)
        folder = tmp_path / "-".join(names)
        save_cloud(cloud, folder, format="nuscenes")
        tables = nuscenes_tables(folder)
        assert {row["channel"] for row in tables["sensor"].values()} == channels
        assert {path.name for path in (folder / "samples").iterdir()} == channels
        # As the devkit looks for it: the key frame of each sample with the time of the sample.
        of_channel = {row["token"]: row["channel"] for row in tables["sensor"].values()}
        top = [
            row for row in tables["sample_data"].values()
            if row["is_key_frame"] and of_channel[
                tables["calibrated_sensor"][row["calibrated_sensor_token"]]["sensor_token"]
            ] == "LIDAR_TOP"
        ]  # fmt: skip
        times = {row["token"]: row["timestamp"] for row in tables["sample"].values()}
        assert {row["sample_token"]: row["timestamp"] for row in top} == times
        notes = ExportSpec("nuscenes").notes(cloud, cloud.sweeps())
        assert [words in note for note in notes if "LIDAR_TOP" in note] == [True] * bool(words)
        assert not any(
            "LIDAR_TOP" in note for note in ExportSpec("kitti").notes(cloud, cloud.sweeps())
        )
