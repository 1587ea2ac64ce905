"""The sensor service, called as simulators call it. Tests skip without grpcio.

The expected points come from closed forms, or from a `Scanner` with the same options."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from lidarpool.cli.commands import cli
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarsim import LidarError, Material, Mounted, Noise, Pose, Scanner, Track, load_sensor
from lidarsim.motion.rotations import quaternions_of

grpc = pytest.importorskip("grpc")
descriptor_pb2 = pytest.importorskip("google.protobuf.descriptor_pb2")

from lidarlive.serving import service as service_module  # noqa: E402
from lidarlive.serving.conversion import sweep_request  # noqa: E402
from lidarlive.serving.messages import METHODS, SERVICE, message_class, proto_text  # noqa: E402
from lidarlive.serving.served_scene import load_served_scene  # noqa: E402
from lidarlive.serving.server import Endpoint, SensorServer  # noqa: E402
from lidarlive.serving.service import SensorService  # noqa: E402

WALL = "v 10 -50 -5\nv 10 50 -5\nv 10 50 5\nv 10 -50 5\nf 1 2 3\nf 1 3 4\n"
SENSOR = """
name: Line
firings_per_turn: 360
rate_hz: 10
range_m: [0.1, 200]
beams: {elevation_deg: [0]}
"""
YARD = """
scene: {files: [{file: wall.obj, up_axis: z, unit: m}]}
sensor: velodyne/vlp16
trajectory: {points: [{time_s: 0, position: [-2, 0, 0]}, {time_s: 1, position: [3, 0, 0]}]}
actors:
  - name: car
    box: [2, 2, 2]
    trajectory: {points: [{time_s: 0, position: [5, 0, 0]}, {time_s: 1, position: [8, 0, 0]}]}
  - {name: post, box: [0.5, 0.5, 4], at: [0, -6, -2]}
materials: [{objects: wall, reflectance: 0.51}, {objects: "*", reflectance: 0.2}]
cloud: {precision_m: 0.0001}
"""
NOISE = "noise: {range_m: 0.02, seed: 5}\n"
STILL = ((0, 0, 0), 0.0)
PANDAR128, AT128 = 0, 1


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("yard")
    texts = {
        "wall.obj": WALL,
        "line.yaml": SENSOR,
        "yard.yaml": YARD,
        "noisy.yaml": YARD + NOISE,
    }
    for name, text in texts.items():
        (path / name).write_text(text)
    return path


@contextmanager
def serving(path: Path, models: dict[int, str], **options: Any) -> Iterator[Client]:
    """Serve a scenario, and yield a client of the server."""
    settings = {name: options.pop(name) for name in ("listen", "token_file") if name in options}
    notes: list[str] = []
    scene = load_served_scene(path, models, notes.append)
    service = SensorService(scene, notes.append, **options)
    endpoint = Endpoint.choose(**{"listen": "127.0.0.1:0", **settings})
    server = SensorServer(service, endpoint)
    with server, Client(server.address.port) as client:
        client.notes = notes
        client.service = service
        yield client


class Client:
    """A client with a method for each method of the service."""

    notes: list[str]
    service: SensorService

    def __init__(self, port: int, token: str = "") -> None:
        limit = [("grpc.max_receive_message_length", 1 << 26)]
        self.address = f"127.0.0.1:{port}"
        self._channel = grpc.insecure_channel(self.address, limit)
        self._metadata = [("authorization", f"Bearer {token}")] if token else []

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *error: object) -> None:
        self._channel.close()

    def raw(self, method: str, data: bytes) -> Any:
        call = self._channel.unary_unary(f"/{SERVICE}/{method}")
        return call(data, metadata=self._metadata, timeout=60)

    def __getattr__(self, method: str) -> Any:
        names = METHODS[method]
        return lambda **fields: message_class(names[1]).FromString(
            self.raw(method, message_class(names[0])(**fields).SerializeToString())
        )

    def refusal(self, method: str, **fields: Any) -> tuple[str, str]:
        """Return the status and the message with which a request is refused."""
        with pytest.raises(grpc.RpcError) as caught:
            getattr(self, method)(**fields)
        return caught.value.code().name, caught.value.details()


@pytest.fixture(scope="module")
def client(folder) -> Iterator[Client]:
    with serving(folder / "yard.yaml", {PANDAR128: str(folder / "line.yaml")}) as client:
        yield client


def pose(position: Any, yaw_deg: float = 0.0) -> dict[str, Any]:
    half = np.radians(yaw_deg) / 2
    x, y, z = position
    return {"vec": {"x": x, "y": y, "z": z}, "quat": {"w": np.cos(half), "z": np.sin(half)}}


def pair(start: Any, end: Any) -> dict[str, Any]:
    return {"start_pose": pose(*start), "end_pose": pose(*end)}


def request(start: Any = STILL, end: Any = STILL, **changes: Any) -> dict[str, Any]:
    return {
        "scene_id": "yard",
        "frame_start_us": 1_000_000,
        "frame_end_us": 1_100_000,
        "sensor_pose": pair(start, end),
    } | changes


def moving(name: str, start: Any, end: Any) -> dict[str, Any]:
    return {"track_id": name, "pose_pair": pair((start,), (end,))}


def xyz(reply: Any) -> np.ndarray:
    """Points of a reply, whose lists and buffers must agree."""
    assert reply.point_xyzs == reply.point_xyzs_buffer
    assert reply.point_intensities == reply.point_intensities_buffer
    points = np.frombuffer(reply.point_xyzs, "<f4").reshape(-1, 3)
    assert len(points) == reply.num_points == len(reply.point_intensities) // 4
    return points


def test_points_of_a_moving_sensor_are_in_its_frame_at_the_end_of_the_sweep(client):
    above = moving("post", (0, 0, 100), (0, 0, 100))  # out of the way
    fields = request(((0, 0, 0), 0), ((2, 1, 0), 30), dynamic_objects=[above])
    reply = client.render_lidar(**fields)
    share = np.arange(360) / 360  # of the sweep, when each ray is fired
    azimuth = 2 * np.pi * share + np.radians(30) * share
    x, y = 2 * share, share  # of the sensor
    with np.errstate(divide="ignore"):
        range_m = (10 - x) / np.cos(azimuth)
    meets = (range_m > 0) & (np.abs(y + range_m * np.sin(azimuth)) < 50)
    world = np.column_stack([x + range_m * np.cos(azimuth), y + range_m * np.sin(azimuth)])[meets]
    cos, sin = np.cos(np.radians(30)), np.sin(np.radians(30))
    expected = (world - [2, 1]) @ [[cos, -sin], [sin, cos]]
    points = xyz(reply)
    assert len(points) == meets.sum() > 150
    assert np.abs(points[:, :2] - expected).max() < 2e-4
    assert np.abs(points[:, 2]).max() < 1e-6


def test_intensities_are_on_the_scale_of_the_manufacturer(client):
    reply = client.render_lidar(**request())
    intensities = np.frombuffer(reply.point_intensities, "<f4")
    assert np.allclose(intensities[0], 51 / 255)  # at normal incidence, 100 is white


def test_an_object_moves_during_the_sweep(client):
    # The pose is that of the center. The rear face moves from 2 to 5 m, and then away.
    car = moving("car", (3, 0, 0), (6, 0, 0))
    points = xyz(client.render_lidar(**request(dynamic_objects=[car])))
    # The first and the last ray of the sweep point forward.
    assert points[0, 0] == pytest.approx(2, abs=2e-4)
    assert points[-1, 0] == pytest.approx(2 + 3 * 359 / 360, abs=2e-4)


def test_an_object_that_is_turned_and_raised_is_placed_by_its_center(client):
    entry = {"track_id": "car", "pose_pair": pair(((4, 0, 0.9), 45), ((4, 0, 0.9), 45))}
    points = xyz(client.render_lidar(**request(dynamic_objects=[entry])))
    assert points[0, 0] == pytest.approx(4 - np.sqrt(2), abs=2e-4)  # an edge of the box
    entry = {"track_id": "car", "pose_pair": pair(((4, 0, 1.1), 45), ((4, 0, 1.1), 45))}
    points = xyz(client.render_lidar(**request(dynamic_objects=[entry])))
    assert points[0, 0] == pytest.approx(10, abs=2e-4)  # the ray passes below


def test_actors_that_move_are_absent_unless_requested(client):
    seen = xyz(
        client.render_lidar(**request(dynamic_objects=[moving("car", (3, 0, 0), (3, 0, 0))]))
    )
    assert seen[0, 0] == pytest.approx(2, abs=2e-4)
    alone = xyz(client.render_lidar(**request()))
    assert alone[0, 0] == pytest.approx(10, abs=2e-4)
    post = alone[np.abs(alone[:, 0]) < 0.5]  # stationary actors stay
    assert post[:, 1].max() == pytest.approx(-5.75, abs=2e-4)
    away = moving("post", (0, 8, 0), (0, 8, 0))
    moved = xyz(client.render_lidar(**request(dynamic_objects=[away])))
    assert moved[np.abs(moved[:, 0]) < 0.5][:, 1].min() == pytest.approx(7.75, abs=2e-4)
    assert np.array_equal(xyz(client.render_lidar(**request())), alone)


def test_the_bytes_are_those_of_a_scanner(folder):
    fields = request(
        ((1, 2, 0.5), 20),
        ((2.5, 2, 0.5), 35),
        scene_id="noisy",
        dynamic_objects=[moving("car", (6, 3, 0), (6.5, 3, 0))],
    )
    with serving(folder / "noisy.yaml", {AT128: "velodyne/vlp16"}) as client:
        reply = client.render_lidar(**fields, lidar_config={"lidar_type": AT128})
    scenario = prepare(Scenario.load(folder / "noisy.yaml"))
    scanner = Scanner(
        scenario.scene,
        Mounted(load_sensor("velodyne/vlp16")),
        columns=["reflectivity"],
        materials=[Material("wall", reflectance=0.51), Material("*", reflectance=0.2)],
        noise=Noise(range_m=0.02, seed=5),
        precision_m=0.0001,
    )
    matrices = np.tile(np.eye(4), (2, 1, 1))
    matrices[:, :3, 3] = (6, 3, -1), (6.5, 3, -1)  # of the underside
    scanner.move("car", matrices, times_s=[0, 0.1])
    half = np.radians(np.array([20, 35])) / 2
    quaternions = np.array([np.zeros(2), np.zeros(2), np.sin(half), np.cos(half)], np.float32).T
    track = Track([0, 0.1], [[1, 2, 0.5], [2.5, 2, 0.5]], quaternions.astype(np.float64))
    cloud = scanner.sweep(track, number=10, start_s=0.0)
    z, w = track.quaternions[1, 2:]
    cos, sin = 1 - 2 * (z * z), 2 * (z * w)
    x, y, up = np.asarray(cloud.positions, np.float64).T - np.array([[2.5], [2], [0.5]])
    expected = np.stack([x * cos + y * sin, y * cos - x * sin, up], axis=1).astype("<f4")
    assert len(expected) > 5_000
    assert reply.point_xyzs == expected.tobytes()
    bytes_of = (cloud["reflectivity"].astype("<f4") / np.float32(255)).tobytes()
    assert reply.point_intensities == bytes_of


# A box of 3 x 1 x 2 m with a corner at the origin
BOX = """
v 0 0 0\nv 3 0 0\nv 3 1 0\nv 0 1 0\nv 0 0 2\nv 3 0 2\nv 3 1 2\nv 0 1 2
f 1 4 3 2\nf 5 6 7 8\nf 1 2 6 5\nf 2 3 7 6\nf 3 4 8 7\nf 4 1 5 8
"""
FAR = """
scene: {files: [{file: wall.obj, up_axis: z, unit: m}]}
sensor: velodyne/vlp16
world: {origin: [500000, 4000000, 300]}
trajectory:
  points:
    - {time_s: 3.0, position: [-2, 0, 1], yaw_deg: 0}
    - {time_s: 3.5, position: [3, 1, 1], yaw_deg: 90}
    - {time_s: 4.2, position: [3, 9, 4], yaw_deg: 180}
  duration_s: 1
actors:
  - name: box
    file: {file: box.obj, up_axis: z, unit: m}
    trajectory: {points: [{time_s: 3, position: [5, 0, 0]}, {time_s: 5, position: [8, 0, 0]}]}
cloud: {precision_m: 0.0001}
"""


def tilted(position: Any, yaw_deg: float, pitch_deg: float, roll_deg: float) -> dict[str, Any]:
    """A pose with all three angles."""
    matrix = Pose((0, 0, 0), yaw_deg=yaw_deg, pitch_deg=pitch_deg, roll_deg=roll_deg)
    ((qx, qy, qz, qw),) = quaternions_of(matrix.rotation_matrix[None])
    x, y, z = map(float, position)
    quat = {"x": float(qx), "y": float(qy), "z": float(qz), "w": float(qw)}
    return {"vec": {"x": x, "y": y, "z": z}, "quat": quat}


def test_poses_are_in_world_coordinates_and_boxes_are_turned_about_their_centers(folder):
    """The world is far from the scene, the sensor is tilted, and the box is off its origin."""
    (folder / "box.obj").write_text(BOX)
    (folder / "far.yaml").write_text(FAR)
    origin = np.array([500_000.0, 4_000_000, 300])  # single precision can store them
    sensor_pose = tilted(origin + np.array([1, 2, 0]), 20, 10, -30)
    center = np.array([6.0, 2.5, 0.5])
    entry = {"track_id": "box", "pose_pair": dict.fromkeys(("start_pose", "end_pose"))}
    for name in entry["pose_pair"]:
        entry["pose_pair"][name] = pose(origin + center, 90)
    fields = request(
        scene_id="far",
        sensor_pose={"start_pose": sensor_pose, "end_pose": sensor_pose},
        dynamic_objects=[entry],
    )
    with serving(folder / "far.yaml", {PANDAR128: "velodyne/vlp16"}) as client:
        points = xyz(client.render_lidar(**fields)).astype(np.float64)
        reply = client.get_available_trajectories(scene_id="far")
    rotation = Pose((0, 0, 0), yaw_deg=20, pitch_deg=10, roll_deg=-30).rotation_matrix
    local = points @ rotation.T + [1, 2, 0]
    # The box is 3 m long, 1 m wide and 2 m high, and turned by 90 degrees.
    sides = np.abs(local - center) - [0.5, 1.5, 1.0]
    on_box = (sides < 0.005).all(axis=1)
    assert on_box.sum() > 200 and np.abs(sides[on_box].max(axis=1)).max() < 0.003
    on_wall = np.abs(local[:, 0] - 10) < 0.003
    assert on_wall.sum() > 200 and (on_box | on_wall).all()
    (trajectory,) = reply.available_trajectories
    rows = trajectory.trajectory.poses
    assert [row.timestamp_us for row in rows] == [0, 500_000]  # those during the survey
    places = [[row.pose.vec.x, row.pose.vec.y, row.pose.vec.z] for row in rows]
    assert np.allclose(places, origin + np.array([[-2, 0, 1], [3, 1, 1]]), atol=0.3)
    assert np.allclose([row.pose.quat.z for row in rows], [0, np.sqrt(0.5)], atol=1e-6)


@pytest.mark.parametrize(
    ("length_ms", "fits"), [(89, False), (91, True), (109, True), (111, False)]
)
def test_frames_may_be_a_tenth_shorter_or_longer_than_a_sweep(client, length_ms, fits):
    fields = request(frame_end_us=1_000_000 + 1000 * length_ms)
    if fits:
        assert xyz(client.render_lidar(**fields))[0, 0] == pytest.approx(10, abs=2e-4)
    else:
        _, message = client.refusal("render_lidar", **fields)
        assert f"The frame lasts {length_ms} ms, but a sweep of Line lasts 100 ms" in message


def test_each_device_has_its_own_sensor_and_sweeps_are_counted(folder):
    models = {PANDAR128: str(folder / "line.yaml"), AT128: "velodyne/vlp16"}
    with serving(folder / "yard.yaml", models) as client:
        few = client.render_lidar(**request())
        many = client.render_lidar(**request(lidar_config={"lidar_type": AT128}))
        assert 100 < few.num_points < 360 and many.num_points > 2000
        assert xyz(many)[:, 2].min() < -1 < xyz(few)[:, 2].min()
        client.render_aggregated(lidar_requests=[request(), request()])
        client.refusal("render_lidar", **request(scene_id="x"))
        points = 3 * few.num_points + many.num_points
        assert client.service.summary == (
            f"4 sweeps with {points:,} points simulated. 1 request refused."
        )


def test_all_sweeps_of_an_aggregated_request_share_the_limit(client, monkeypatch):
    count = client.render_lidar(**request()).num_points
    monkeypatch.setattr(service_module, "MAX_POINTS", 2 * count)
    reply = client.render_aggregated(lidar_requests=[request()] * 2)
    assert [one.num_points for one in reply.lidar_returns] == [count] * 2
    monkeypatch.setattr(service_module, "MAX_POINTS", 2 * count - 1)
    code, message = client.refusal("render_aggregated", lidar_requests=[request()] * 2)
    assert code == "RESOURCE_EXHAUSTED"
    assert f"has {count:,} points, but the reply can only hold {count - 1:,}" in message


def test_equal_requests_have_equal_replies_and_random_numbers_depend_on_the_time(folder):
    with serving(folder / "noisy.yaml", {PANDAR128: str(folder / "line.yaml")}) as client:
        fields = request(scene_id="noisy")
        first = client.render_lidar(**fields)
        later = fields | {"frame_start_us": 1_100_000, "frame_end_us": 1_200_000}
        assert client.render_lidar(**later) != first
        assert client.render_lidar(**fields) == first


def beside_a_car(y: float) -> dict[str, Any]:
    car = moving("car", (4 + y, y, 0), (4 + y, y, 0))
    return request(((0, y, 0), 0), STILL, dynamic_objects=[car])


def test_a_sweep_waits_until_the_one_before_has_ended(folder):
    path, models = folder / "yard.yaml", {PANDAR128: str(folder / "line.yaml")}
    sensor = load_served_scene(path, models, lambda note: None).sensors[PANDAR128]
    first, second = (
        sweep_request(message_class("LidarRenderRequest")(**beside_a_car(y))) for y in (0.0, 1.0)
    )
    expected = [sensor.simulate(one).positions for one in (first, second)]
    with ThreadPoolExecutor(1) as pool:
        later = []

        def is_alone() -> bool:
            later.append(pool.submit(sensor.simulate, second))
            return not wait(later, timeout=0.3).done

        points = sensor.simulate(first, is_alone)
        assert points is not None, "the other sweep was simulated meanwhile"
        assert np.array_equal(points.positions, expected[0])
        assert np.array_equal(later[0].result().positions, expected[1])
    assert sensor.simulate(first, lambda: False) is None


def test_several_clients_are_served_at_the_same_time(client):
    def points(y: float) -> np.ndarray:
        with Client(int(client.address.rpartition(":")[2])) as other:
            return xyz(other.render_lidar(**beside_a_car(y)))

    with ThreadPoolExecutor(8) as pool:
        for y, found in zip(range(8), pool.map(points, range(8)), strict=True):
            assert np.array_equal(found, xyz(client.render_lidar(**beside_a_car(y))))


def test_an_aggregated_request_has_a_reply_for_each_sweep(client):
    requests = [request(), request(((1, 0, 0), 0), ((1, 0, 0), 0))]
    reply = client.render_aggregated(lidar_requests=requests)
    assert [xyz(one)[0, 0] for one in reply.lidar_returns] == pytest.approx([10, 9], abs=2e-4)
    code, message = client.refusal("render_aggregated", lidar_requests=requests, rgb_requests=[b""])
    assert code == "UNIMPLEMENTED" and "no cameras" in message
    code, message = client.refusal("render_aggregated", lidar_requests=[request()] * 17)
    assert code == "INVALID_ARGUMENT" and "The limit is 16" in message


def test_a_client_can_ask_what_is_served(client):
    assert client.get_version().version_id.startswith("lidarpool ")
    assert client.get_version().grpc_api_version.minor == 54
    assert list(client.get_available_scenes().scene_ids) == ["yard"]
    assert [s.loaded_instance_count for s in client.get_loaded_scenes().scenes] == [1]
    assert client.get_available_cameras(scene_id="yard").ByteSize() == 0
    assert client.get_available_ego_masks().ByteSize() == 0
    reply = client.get_available_trajectories(scene_id="yard")
    poses = reply.available_trajectories[0].trajectory.poses
    assert [(one.timestamp_us, one.pose.vec.x, one.pose.quat.w) for one in poses] == [
        (0, -2, 1),
        (1_000_000, 3, 1),
    ]


@pytest.mark.parametrize("method", ["render_rgb", "batch_render_rgb"])
def test_cameras_are_refused(client, method):
    with pytest.raises(grpc.RpcError) as caught:
        client.raw(method, b"\x0a\x01x")
    assert caught.value.code() is grpc.StatusCode.UNIMPLEMENTED
    assert "no cameras" in caught.value.details()


def broken(field: str, value: float) -> dict[str, Any]:
    """A pose pair with an invalid number."""
    poses = pair(STILL, STILL)
    kind, name = field.split(".")
    poses["end_pose"][kind][name] = value
    return poses


@pytest.mark.parametrize(
    ("changes", "code", "message"),
    [
        ({"scene_id": "field"}, "NOT_FOUND", "The available scene is 'yard'"),
        ({"lidar_config": {"lidar_type": 7}}, "INVALID_ARGUMENT", "lidar_type 7 is unknown"),
        ({"frame_end_us": 1_000_000}, "INVALID_ARGUMENT", "must be greater than frame_start_us"),
        ({"frame_end_us": 1_050_000}, "INVALID_ARGUMENT", "50 ms, but a sweep of Line lasts 100"),
        ({"frame_start_us": 1 << 63}, "INVALID_ARGUMENT", "but they are 1100000 and 92233720368"),
        ({"frame_end_us": (1 << 64) - 1}, "INVALID_ARGUMENT", "but a sweep of Line lasts 100 ms"),
        ({"sensor_pose": None}, "INVALID_ARGUMENT", "sensor_pose of the sensor is missing"),
        ({"sensor_pose": {}}, "INVALID_ARGUMENT", "start_pose.quat of the sensor has the norm 0"),
        ({"sensor_pose": broken("vec.y", np.nan)}, "INVALID_ARGUMENT", "end_pose.vec .* finite"),
        ({"sensor_pose": broken("quat.x", 1)}, "INVALID_ARGUMENT", "norm 1.41421"),
        ({"sensor_pose": broken("quat.x", np.inf)}, "INVALID_ARGUMENT", "norm inf"),
        ({"sensor_pose": broken("vec.y", 1e30)}, "INVALID_ARGUMENT", "more than 100 km from"),
        (
            {"dynamic_objects": [moving("cars", (0, 0, 0), (0, 0, 0))]},
            "INVALID_ARGUMENT",
            "no actor 'cars'. Did you mean 'car'",
        ),
        ({"dynamic_objects": [{"track_id": "car"}]}, "INVALID_ARGUMENT", "object 'car' is missing"),
        (
            {"dynamic_objects": [moving("car", (0, 0, 0), (0, 0, 0))] * 2},
            "INVALID_ARGUMENT",
            "contains 'car' twice",
        ),
        (
            {"dynamic_objects": [moving("car", (0, 0, 0), (0, 1e9, 0))]},
            "INVALID_ARGUMENT",
            "object 'car' is more than 100 km",
        ),
        ({"dynamic_objects": [{"track_id": "x" * 300}]}, "INVALID_ARGUMENT", "256 characters"),
        ({"dynamic_objects": [{}] * 10_001}, "INVALID_ARGUMENT", "10,001 entries"),
    ],
)
def test_bad_requests_are_refused_in_a_sentence(client, capfd, changes, code, message):
    fields = {name: value for name, value in request(**changes).items() if value is not None}
    found, details = client.refusal("render_lidar", **fields)
    assert found == code
    assert details == details.strip() and "\n" not in details
    assert re.search(message, details), details
    output = "".join(capfd.readouterr())
    assert "Traceback" not in output
    assert xyz(client.render_lidar(**request()))[0, 0] == pytest.approx(10, abs=2e-4)


def test_bytes_that_are_no_message_are_refused(client, capfd):
    for data in (b"\xff" * 40, os.urandom(1000)):
        with pytest.raises(grpc.RpcError) as caught:
            client.raw("render_lidar", b"\x0a\xff" + data)
        assert caught.value.code() is grpc.StatusCode.INVALID_ARGUMENT
    assert "Traceback" not in "".join(capfd.readouterr())


def test_large_requests_and_replies_are_refused(client, monkeypatch):
    code, _ = client.refusal("render_lidar", **request(scene_id="x" * (5 << 20)))
    assert code == "RESOURCE_EXHAUSTED"
    monkeypatch.setattr(service_module, "MAX_POINTS", 20)
    code, message = client.refusal("render_lidar", **request())
    assert code == "RESOURCE_EXHAUSTED" and "can only hold 20" in message


def test_unknown_objects_can_be_ignored(folder):
    models = {PANDAR128: str(folder / "line.yaml")}
    with serving(folder / "yard.yaml", models, ignores_unknown=True) as client:
        objects = [moving("van 7", (3, 0, 0), (3, 0, 0)), moving("car", (3, 0, 0), (3, 0, 0))]
        for _ in range(2):
            points = xyz(client.render_lidar(**request(dynamic_objects=objects)))
            assert points[0, 0] == pytest.approx(2, abs=2e-4)
        assert [note for note in client.notes if "van" in note] == [
            "The scene has no actor 'van 7', so it is ignored."
        ]
        objects = [moving(f"bus {k:02}", (3, 0, 0), (3, 0, 0)) for k in range(30)]
        assert xyz(client.render_lidar(**request(dynamic_objects=objects)))[0, 0] > 9
        assert client.notes[1:] == [
            f"The scene has no actor 'bus {k:02}', so it is ignored." for k in range(19)
        ]


def test_fields_that_have_no_effect_are_reported(folder):
    fields = "faults: [{kind: dirt, transmission: 0.3}]\n"
    text = YARD.replace("precision_m: 0.0001", "precision_m: 0.0001, keep_every: 3")
    (folder / "thinned.yaml").write_text(text + fields)
    notes: list[str] = []
    load_served_scene(folder / "thinned.yaml", {PANDAR128: str(folder / "line.yaml")}, notes.append)
    assert [note.partition(": ")[2] for note in notes] == [
        "These fields are not used: faults, cloud.keep_every."
    ]


def test_the_rate_of_the_sensor_can_be_set(folder):
    models = {PANDAR128: "velodyne/vlp16"}
    scene = load_served_scene(folder / "yard.yaml", models, lambda note: None, rate_hz=20)
    fields = request(frame_end_us=1_050_000)
    one = sweep_request(message_class("LidarRenderRequest")(**fields))
    points = scene.sensors[PANDAR128].simulate(one)
    scanner = Scanner(
        prepare(Scenario.load(folder / "yard.yaml")).scene,
        load_sensor("velodyne/vlp16", rate_hz=20),
        precision_m=0.0001,
    )
    scanner.move("car", (0, 0, 500))
    expected = scanner.sweep((0, 0, 0), number=20, start_s=0.0)
    assert np.array_equal(points.positions, expected.positions.astype(np.float32))


def test_a_token_is_required_for_other_machines(folder, tmp_path):
    token = tmp_path / "token.txt"
    token.write_text("0123456789abcdef\n")
    path = folder / "yard.yaml"
    models = {PANDAR128: str(folder / "line.yaml")}
    with serving(path, models, token_file=token) as client:
        for wrong in ("", "0123456789abcdeg"):
            with Client(int(client.address.rpartition(":")[2]), wrong) as other:
                code, message = other.refusal("get_version")
            assert code == "UNAUTHENTICATED" and "Bearer TOKEN" in message
        with Client(int(client.address.rpartition(":")[2]), "0123456789abcdef") as right:
            assert right.get_version().version_id
    with pytest.raises(LidarError, match=r"Other machines can connect to 0\.0\.0\.0:0"):
        Endpoint.choose("0.0.0.0:0")
    token.write_text("short")
    with pytest.raises(LidarError, match="at least 16 ASCII characters"):
        Endpoint.choose("127.0.0.1:0", token)


def test_a_second_server_does_not_share_the_port(client):
    with pytest.raises(LidarError, match="cannot be used"):
        Endpoint.choose(client.address)
    endpoint = Endpoint.choose("127.0.0.1:0")
    port = int(client.address.rpartition(":")[2])
    with pytest.raises(LidarError, match="cannot listen on"):
        SensorServer(
            client.service, endpoint._replace(address=endpoint.address._replace(port=port))
        )


def test_a_request_that_is_canceled_does_not_disturb_others(client):
    data = message_class("LidarRenderRequest")(**request()).SerializeToString()
    channel = client._channel
    calls = [channel.unary_unary(f"/{SERVICE}/render_lidar").future(data) for _ in range(20)]
    for call in calls[::2]:
        call.cancel()
    assert all(call.result() for call in calls[1::2])
    assert "sweep" in client.service.summary


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "Missing argument 'SCENE'"),
        (["none.yaml"], "none.yaml"),
        (["."], "contains no scenario.yaml"),
        (["yard.yaml", "--sensor", "VLP16=velodyne/vlp16"], "unknown device 'VLP16'"),
        (["yard.yaml", "--sensor", "vlp16", "--sensor", "AT128=vlp16"], "two models for AT128"),
        (["yard.yaml", "--sensor", "nothing"], "Unknown sensor model 'nothing'"),
    ],
)
def test_wrong_arguments_are_explained(folder, monkeypatch, arguments, message):
    monkeypatch.chdir(folder)
    result = CliRunner().invoke(cli, ["serve", *arguments])
    assert message in f"{result.exception}{result.output}"


def test_a_device_without_a_model_keeps_its_default(folder, monkeypatch):
    monkeypatch.chdir(folder)
    monkeypatch.setattr(SensorServer, "wait", lambda server: None)
    served = {
        "PANDAR128": "PANDAR128 is Line, AT128 is Hesai AT128",
        "AT128": "PANDAR128 is Hesai Pandar128, AT128 is Line",
    }
    for device, line in served.items():
        arguments = ["serve", "yard.yaml", "--sensor", f"{device}=line.yaml"]
        result = CliRunner().invoke(cli, [*arguments, "--listen", "127.0.0.1:0"])
        assert f", {line}. Press" in result.output


def test_times_of_a_frame_have_no_limit(client):
    last = (1 << 64) - 1
    late = request(frame_start_us=last - 100_000, frame_end_us=last)
    assert xyz(client.render_lidar(**late))[0, 0] == pytest.approx(10, abs=2e-4)


def test_the_box_of_a_recorded_actor_is_that_of_the_twin(folder, tmp_path):
    """The mesh of a twin contains only the sides that were observed, here the rear."""
    (tmp_path / "actors").mkdir()
    (tmp_path / "actors" / "car-1.obj").write_text(
        "v -2 -1 0.2\nv -2 1 0.2\nv -2 1 1.4\nv -2 -1 1.4\nf 1 2 3\nf 1 3 4\n"
    )
    (tmp_path / "wall.obj").write_text(WALL)
    (tmp_path / "twin.json").write_text('{"actors": [{"name": "Car 1", "size_m": [4, 2, 1.5]}]}')
    (tmp_path / "scenario.yaml").write_text(
        """
scene: {files: [{file: wall.obj, up_axis: z, unit: m}]}
sensor: velodyne/vlp16
poses: [[0, 0, 0]]
actors:
- name: Car 1
  file: {file: actors/car-1.obj, up_axis: z, unit: m}
  trajectory: {points: [{time_s: 0, position: [6, 0, 0]}, {time_s: 9, position: [7, 0, 0]}]}
"""
    )
    with serving(tmp_path, {PANDAR128: str(folder / "line.yaml")}) as client:
        assert list(client.get_available_scenes().scene_ids) == [tmp_path.name]
        car = moving("Car 1", (6, 0, 0), (6, 0, 0))
        reply = client.render_lidar(**request(scene_id=tmp_path.name, dynamic_objects=[car]))
        assert not client.get_available_trajectories(scene_id=tmp_path.name).ByteSize()
    assert xyz(reply)[0, 0] == pytest.approx(4, abs=2e-3)


def compiled(folder: Path, file: str) -> dict[str, Any]:
    """Descriptors of all messages of a .proto file and those it imports, by full name."""
    protoc = pytest.importorskip("grpc_tools.protoc")
    out = folder / "descriptors.bin"
    arguments = ["protoc", f"-I{folder}", "--include_imports", f"--descriptor_set_out={out}", file]
    assert protoc.main(arguments) == 0
    files = descriptor_pb2.FileDescriptorSet.FromString(out.read_bytes())
    found = {}
    for one in files.file:
        prefix = f".{one.package}"
        for message in one.message_type:
            found[f"{prefix}.{message.name}"] = message
            for inner in message.nested_type:
                found[f"{prefix}.{message.name}.{inner.name}"] = inner
        for service in one.service:
            found[f"{prefix}.{service.name}"] = service
    return found


def check_same_wire(ours: dict[str, Any], name: str, theirs: dict[str, Any], other: str) -> None:
    """Check that each field of a message of ours has the same number and type in theirs."""
    fields = {field.number: field for field in theirs[other].field}
    for field in ours[name].field:
        if field.name == "rgb_requests":
            continue  # only counted; any message is encoded as bytes
        match = fields[field.number]
        assert (match.name, match.type, match.label) == (field.name, field.type, field.label)
        if field.type == field.TYPE_MESSAGE:
            check_same_wire(ours, field.type_name, theirs, match.type_name)


def published_protocol() -> Path:
    """Folder that contains alpasim_grpc; tests skip without it."""
    spec = find_spec("alpasim_grpc")
    places = [
        os.environ.get("ALPASIM_GRPC", ""),
        "" if spec is None else Path(spec.origin).parents[1],
    ]
    for place in filter(None, places):
        if (Path(place) / "alpasim_grpc/v0/sensorsim.proto").is_file():
            return Path(place)
    pytest.skip("needs alpasim_grpc, installed or in the folder ALPASIM_GRPC")


def test_the_protocol_that_is_written_is_the_one_that_is_served(tmp_path):
    file = tmp_path / "sensorsim.proto"
    assert CliRunner().invoke(cli, ["serve", "--proto", str(file)]).exit_code == 0
    assert file.read_text() == proto_text()
    result = CliRunner().invoke(cli, ["serve", "--proto", str(file)])
    assert "already exists" in str(result.exception)
    printed = compiled(tmp_path, "sensorsim.proto")
    service = printed[f".{SERVICE}"]
    assert [method.name for method in service.method] == [*METHODS]
    for name in {name for names in METHODS.values() for name in names}:
        descriptor = message_class(name).DESCRIPTOR
        served = {field.number: field.name for field in descriptor.fields}
        fields = printed[f".{descriptor.full_name}"].field
        assert {field.number: field.name for field in fields} == served


def test_the_messages_are_those_of_the_published_protocol(tmp_path, client):
    source = published_protocol()
    theirs = compiled_copy(source, tmp_path / "theirs")
    (tmp_path / "sensorsim.proto").write_text(proto_text())
    ours = compiled(tmp_path, "sensorsim.proto")
    methods = {method.name: method for method in theirs[f".{SERVICE}"].method}
    for method in ours[f".{SERVICE}"].method:
        match = methods.pop(method.name)
        for name, other in (
            (method.input_type, match.input_type),
            (method.output_type, match.output_type),
        ):
            check_same_wire(ours, name, theirs, other)
    assert sorted(methods) == ["batch_render_rgb", "render_rgb"]


def compiled_copy(source: Path, folder: Path) -> dict[str, Any]:
    """Compile a copy of the published protocol, whose folder may be read-only."""
    target = folder / "alpasim_grpc" / "v0"
    target.mkdir(parents=True)
    for file in (source / "alpasim_grpc" / "v0").glob("*.proto"):
        (target / file.name).write_bytes(file.read_bytes())
    return compiled(folder, "alpasim_grpc/v0/sensorsim.proto")


CLIENT = """
import sys
import grpc, numpy as np
from {module} import sensorsim_pb2 as messages, sensorsim_pb2_grpc as services
{common}
with grpc.insecure_channel(sys.argv[1]) as channel:
    service = services.SensorsimServiceStub(channel)
    pose = {prefix}Pose(vec={prefix}Vec3(x=1), quat={prefix}Quat(w=1))
    pair = messages.PosePair(start_pose=pose, end_pose=pose)
    reply = service.render_lidar(messages.LidarRenderRequest(
        scene_id=service.get_available_scenes({prefix}Empty()).scene_ids[0],
        lidar_config=messages.LidarSpec(lidar_type=messages.PANDAR128),
        frame_start_us=0, frame_end_us=100_000, sensor_pose=pair))
    points = np.array(reply.point_xyzs, np.float32).reshape(-1, 3)
    assert np.array_equal(points.ravel(), np.frombuffer(reply.point_xyzs_buffer, "<f4"))
    assert len(reply.point_intensities) == reply.num_points == len(points)
    print(points[0].tolist())
"""


def run_generated_client(folder: Path, files: list[str], text: str, address: str) -> str:
    """Generate stubs in a folder, and run a client that uses them."""
    pytest.importorskip("grpc_tools")
    command = [sys.executable, "-m", "grpc_tools.protoc", "-I.", "--python_out=.", *files]
    subprocess.run([*command, "--grpc_python_out=."], cwd=folder, check=True)
    (folder / "client.py").write_text(textwrap.dedent(text))
    environment = os.environ | {"PYTHONPATH": f"{folder}:{os.environ['PYTHONPATH']}"}
    done = subprocess.run(
        [sys.executable, "client.py", address],
        cwd=folder, env=environment, check=True, capture_output=True, text=True,
    )  # fmt: skip
    return done.stdout


@pytest.mark.extended
def test_generated_clients_understand_the_replies(client, tmp_path):
    (tmp_path / "sensorsim.proto").write_text(proto_text())
    text = CLIENT.format(module="__main__", common="", prefix="messages.")
    text = text.replace("from __main__ import", "import").replace("services\n\n", "services\n")
    output = run_generated_client(tmp_path, ["sensorsim.proto"], text, client.address)
    assert eval(output) == pytest.approx([9, 0, 0], abs=2e-4)


@pytest.mark.extended
def test_published_clients_understand_the_replies(client, tmp_path):
    source = published_protocol()
    compiled_copy(source, tmp_path)
    text = CLIENT.format(
        module="alpasim_grpc.v0",
        common="from alpasim_grpc.v0 import common_pb2 as common",
        prefix="common.",
    )
    files = ["alpasim_grpc/v0/common.proto", "alpasim_grpc/v0/sensorsim.proto"]
    output = run_generated_client(tmp_path, files, text, client.address)
    assert eval(output) == pytest.approx([9, 0, 0], abs=2e-4)


@pytest.mark.extended
def test_the_command_serves_until_ctrl_c_while_clients_are_killed(folder, tmp_path):
    command = [sys.executable, "-m", "lidarpool", "serve", str(folder / "yard.yaml")]
    command += ["--sensor", str(folder / "line.yaml"), "--listen", "127.0.0.1:0"]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        line = server.stdout.readline()
        assert line.startswith("ready: scene yard on 127.0.0.1:"), server.communicate()
        address = line.split()[4].rstrip(",")
        loop = (
            "import sys; sys.path.insert(0, sys.argv[2])\n"
            "from tests.lidarpool.test_sensor_service import Client, request\n"
            "client = Client(int(sys.argv[1]))\n"
            "print(client.render_lidar(**request()).num_points, flush=True)\n"
            "while True: client.render_lidar(**request())\n"
        )
        port = address.rpartition(":")[2]
        root = Path(__file__).parents[2]
        killed = subprocess.Popen(
            [sys.executable, "-c", loop, port, root], stdout=subprocess.PIPE, text=True, cwd=root
        )
        assert int(killed.stdout.readline()) > 150
        killed.kill()
        killed.communicate()
        with Client(int(port)) as client:
            assert client.render_lidar(**request()).num_points > 150
        server.send_signal(signal.SIGINT)
        _, errors = server.communicate(timeout=60)
    finally:
        server.kill()
    assert "Traceback" not in errors
    assert "sweeps with" in errors
    assert server.returncode == 130


@pytest.mark.extended
def test_the_example_of_the_documentation_runs(tmp_path, monkeypatch):
    page = (Path(__file__).parents[2] / "docs/how-to/sensor-service.md").read_text("utf-8")
    blocks = dict(re.findall(r'^```\w+ title="(.*?)"\n(.*?)^```$', page, re.M | re.S))
    (tmp_path / "crossing.yaml").write_text(blocks["crossing.yaml"])
    (tmp_path / "sensorsim.proto").write_text(proto_text())
    monkeypatch.chdir(tmp_path)
    assert CliRunner().invoke(cli, ["scene", "city", "city.glb"]).exit_code == 0
    with serving(tmp_path / "crossing.yaml", {PANDAR128: "hesai/pandar128"}) as client:
        text = blocks["client.py"].replace("127.0.0.1:50051", client.address)
        lines = run_generated_client(tmp_path, ["sensorsim.proto"], text, client.address)
    counts = [int(line.split()[2]) for line in lines.splitlines()[1:]]
    assert len(counts) == 5 and counts == sorted(counts) and counts[0] > 300
