"""What viewers are sent, read back by a client of Foxglove's protocol of its own."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import time

import numpy as np
import pytest
from click.testing import CliRunner
from distributed import Client
from tests.clusters import thread_cluster
from tests.foxglove_client import FoxgloveClient, numbers, records, stamp_ns

from lidarfiles.clouds.boxes import Boxes
from lidarfiles.clouds.shown_sweeps import ShownSweep, Surroundings
from lidarlive import Foxglove, Rerun
from lidarlive.playback.bridge import BridgeOptions, bridge_class
from lidarlive.playback.schedule import Schedule
from lidarlive.playback.sources import open_source
from lidarlive.viewers import attached_child
from lidarlive.viewers.viewer import Address, Viewer, open_viewer
from lidarpool import simulate
from lidarpool.cli.commands import cli
from lidarscenario import Planning
from lidarsim import (
    Actor,
    LidarError,
    Mounted,
    Pose,
    Scanner,
    Scene,
    Sensor,
    Survey,
    Track,
    box,
    load_sensor,
)
from lidarsim.motion.rotations import matrices
from lidarsim.packets.encoders import START_NS

SCENARIO = """
sensors:
  roof: {model: velodyne/vlp16, rate_hz: 20, mount: {position: [0.5, 0, 0.4], yaw_deg: 30}}
  rear: {layers: 2, rays_per_revolution: 90, mount: {position: [-1, 0, 0], yaw_deg: 180}}
scene: room.obj
trajectory:
  points: [{time_s: 0, position: [-1, 0, 1]}, {time_s: 1, position: [1, 0.5, 1]}]
  duration_s: 0.15
actors:
  - name: Car 1
    box: [4.5, 1.8, 1.5]
    trajectory: {points: [{time_s: 0, position: [5, -5, 0]}, {time_s: 1, position: [5, 5, 0]}]}
cloud: {keep_every: 1, columns: [intensity, time, range]}
planning: {enabled: false}
"""
# A floor and a wall.
ROOM = "v -9 -9 0\nv 9 -9 0\nv 9 9 0\nv -9 9 0\nv 9 -9 4\nv 9 9 4\nf 1 2 3 4\nf 2 3 6 5\n"
needs_foxglove = pytest.mark.skipif(
    "not __import__('importlib.util').util.find_spec('foxglove')", reason="needs foxglove-sdk"
)


def write_scenario(folder):
    (folder / "room.obj").write_text(ROOM)
    scenario = folder / "s.yaml"
    scenario.write_text(SCENARIO)
    return scenario


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    path = tmp_path_factory.mktemp("room") / "room.obj"
    path.write_text(ROOM)
    return Scene.load(path)


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    scenario = write_scenario(tmp_path_factory.mktemp("scenario"))
    with open_source(scenario) as source:
        yield source.sweeps, list(source), source.content()


@pytest.fixture
def bridge(played):
    sweeps, _, content = played
    options = BridgeOptions(("127.0.0.1:0",))
    with bridge_class("foxglove")(sweeps, Schedule(), options, print) as opened:
        opened.show_content(lambda: content)
        yield opened


def port_of(description):
    return int(re.search(r"ws://127\.0\.0\.1:(\d+)", description)[1])


def poses_in_world(frames):
    """Return {frame: (position, rotation)} in the world from a message of transforms."""
    poses = {"map": (np.zeros(3), np.eye(3))}
    for transform in frames["transforms"]:
        position = numbers(transform["translation"], "xyz")
        rotation = matrices(numbers(transform["rotation"], "xyzw")[None])[0]
        parent_position, parent_rotation = poses[transform["parent_frame_id"]]
        poses[transform["child_frame_id"]] = (
            parent_position + parent_rotation @ position,
            parent_rotation @ rotation,
        )
    return poses


def in_world(cloud, frames):
    rows = records(cloud)
    position, rotation = poses_in_world(frames)[cloud["frame_id"]]
    return np.stack([rows[axis] for axis in "xyz"], axis=1) @ rotation.T + position


@needs_foxglove
def test_sweeps_arrive_with_all_columns_where_they_were_measured(bridge, played):
    sweeps, scanned, content = played
    with FoxgloveClient(port_of(bridge.description)) as client:
        client.receive(lambda client: client.of("/trajectories") and client.of("/scene"))
        client.settle()
        for sweep, points in scanned:
            bridge.send(sweep, points, 0)
        client.receive(
            lambda client: len(client.of("/actors")) == len(client.times_ns) == len(scanned)
        )
    assert client.topics == {
        "/roof/points", "/rear/points", "/tf", "/actors", "/scene", "/trajectories",
    }  # fmt: skip
    frames = iter(client.of("/tf"))
    clouds = {name: iter(client.of(f"/{name}/points")) for name in sweeps.sensors}
    for (sweep, points), actors, clock_ns in zip(
        scanned, client.of("/actors"), client.times_ns, strict=True
    ):
        cloud = next(clouds[sweeps.sensors[sweeps.sensor[sweep]]])
        begin_ns = START_NS + round(sweeps.begins_ns[sweep])
        assert stamp_ns(cloud["timestamp"]) == clock_ns == begin_ns
        transforms = next(frames)
        assert {stamp_ns(frame["timestamp"]) for frame in transforms["transforms"]} == {begin_ns}
        assert np.abs(in_world(cloud, transforms) - points.positions).max() < 1e-5
        rows = records(cloud)
        assert rows.dtype.names == ("x", "y", "z", *points.columns)
        for name, values in points.columns.items():
            assert np.array_equal(rows[name], values), name
        boxes = Boxes.from_points(sweeps, sweep, points)
        (car,) = actors["entities"]
        (cube,) = car["cubes"]
        assert car["id"] == car["texts"][0]["text"] == "Car 1"
        assert {entry["key"]: entry["value"] for entry in car["metadata"]} == {
            "type": "Car",
            "points": str(boxes.points[0]),
        }
        assert np.allclose(numbers(cube["pose"]["position"], "xyz"), boxes.centers[0])
        assert np.allclose(numbers(cube["pose"]["orientation"], "xyzw"), boxes.quaternions[0])
        assert np.allclose(numbers(cube["size"], "xyz"), boxes.sizes[0])
    (scene,) = client.of("/scene")[0]["entities"]
    corners = [numbers(p, "xyz") for part in scene["triangles"] for p in part["points"]]
    assert np.allclose([np.min(corners, 0), np.max(corners, 0)], content.scene.bounds, atol=0.02)
    assert sum(len(part["indices"]) for part in scene["triangles"]) == 3 * len(content.scene.faces)
    roof = next(e for e in client.of("/trajectories")[0]["entities"] if e["id"] == "roof")
    (line,) = roof["lines"]
    start = numbers(line["pose"]["position"], "xyz")
    track = start + [numbers(point, "xyz") for point in line["points"]]
    assert np.allclose(track, sweeps.pose.positions[sweeps.sensor == 0])


@needs_foxglove
def test_who_comes_late_gets_the_last_message_of_each_topic(bridge, played):
    sweeps, scanned, _ = played
    for sweep, points in scanned:
        bridge.send(sweep, points, 250_000_000)
    with FoxgloveClient(port_of(bridge.description)) as client:
        client.receive(lambda client: len({topic for topic, *_ in client.messages}) == 6)
    for name in ("roof", "rear"):
        (cloud,) = client.of(f"/{name}/points")
        own = sweeps.sensor == sweeps.sensors.index(name)
        *_, expected = (points for sweep, points in scanned if own[sweep])
        assert np.array_equal(records(cloud)["scan"], expected["scan"])
        assert poses_in_world(client.of("/tf")[0]).keys() >= {cloud["frame_id"], "Car_1"}
    last_ns = max(time_ns for topic, time_ns, _ in client.messages if topic == "/tf")
    assert last_ns == START_NS + 250_000_000 + round(max(played[0].begins_ns))


@needs_foxglove
def test_another_scene_replaces_all_that_was_shown(bridge, played):
    _, scanned, _ = played
    bridge.send(*scanned[0], 0)
    bridge.show_content(lambda: None)  # no scene
    with FoxgloveClient(port_of(bridge.description)) as client:
        client.receive(lambda client: client.of("/scene") and client.of("/actors"))
    everything = {"deletions": [{"type": 1}]}
    assert client.of("/scene") == client.of("/actors") == [everything]


@pytest.mark.extended
@needs_foxglove
def test_slow_and_malformed_clients_do_not_matter(bridge, played, capfd):
    port = port_of(bridge.description)
    sweep, points = next(entry for entry in played[1] if len(entry[1]) > 5_000)
    with (
        socket.create_connection(("127.0.0.1", port)) as garbage,
        socket.create_connection(("127.0.0.1", port)) as _silent,
        FoxgloveClient(port) as confused,
        FoxgloveClient(port) as slow,
    ):
        garbage.sendall(os.urandom(10_000))
        for message in ("{", "[]", '{"op": "subscribe"}', '{"op": 3}', os.urandom(300)):
            confused.socket.send(message)
        slow.receive(lambda client: "/scene" in client.topics)  # and reads nothing from now on
        start = time.monotonic()
        for number in range(300):
            bridge.send(sweep, points, 50_000_000 * number)
        assert time.monotonic() - start < 10
        confused.receive(lambda client: len(client.statuses) >= 4)
        with FoxgloveClient(port) as client:
            client.receive(lambda client: client.of("/roof/points"))
        assert len(records(client.of("/roof/points")[0])) == len(points)
    assert capfd.readouterr().err == ""


@pytest.mark.slow
@needs_foxglove
def test_ctrl_c_ends_a_loop_with_its_server(tmp_path):
    write_scenario(tmp_path)
    command = ["play", "s.yaml", "--as", "foxglove", "--loop", "--to", ":0"]
    process = subprocess.Popen(
        [sys.executable, "-m", "lidarpool", *command],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    ready = process.stdout.readline()
    assert ready.startswith(
        "ready: Foxglove is available at https://app.foxglove.dev/?ds=foxglove-websocket"
    )
    with FoxgloveClient(port_of(ready)) as client:
        count = len({0.0})
        client.receive(lambda client: len(client.of("/tf")) > 8 * count)
    times_ns = [time_ns for topic, time_ns, _ in client.messages if topic == "/tf"]
    assert times_ns == sorted(times_ns)  # those of the second round go on
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "Traceback" not in said
    with pytest.raises(OSError):
        FoxgloveClient(port_of(ready))


@needs_foxglove
def test_a_port_in_use_is_refused_and_by_default_another_is_taken(played):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(LidarError, match=rf"127\.0\.0\.1:{port} cannot be used: Address al"):
            open_viewer("foxglove", f"127.0.0.1:{port}")
        chosen = Address.choose(None, port)
        assert chosen.host == "127.0.0.1"
        assert port < chosen.port < port + 20
    with pytest.raises(LidarError, match=r"203\.0\.113\.1:8765 cannot be used: Cannot assign"):
        open_viewer("foxglove", "203.0.113.1")
    options = BridgeOptions(("127.0.0.1:0", "127.0.0.1:1"))
    with pytest.raises(
        LidarError, match="`--to` was passed 2 times, but foxglove listens on a single address"
    ):
        bridge_class("foxglove")(played[0], Schedule(), options, print)


@needs_foxglove
@pytest.mark.parametrize("to", ["0.0.0.0:0", "[::]:0"])
def test_foxglove_is_served_to_this_machine_only(to):
    with pytest.raises(LidarError, match="can only listen on this machine") as raised:
        open_viewer("foxglove", to)
    assert "ssh -L" in str(raised.value)


@pytest.mark.parametrize(
    ("text", "address"),
    [("localhost", "localhost:8765"), (":90", "127.0.0.1:90"), ("[::1]", "[::1]:8765")],
)
def test_addresses_have_defaults(text, address, monkeypatch):
    monkeypatch.setattr(Address, "_check_free", lambda *_: None)
    assert str(Address.choose(text, 8765)) == address


@pytest.mark.parametrize("text", ["127.0.0.1:http", "127.0.0.1:99999", "a:-1", "a:\u0661"])
def test_what_is_no_address_is_refused(text):
    with pytest.raises(LidarError, match=f"'{text}' is not a valid address. Expected ADDRESS:PORT"):
        Address.choose(text, 8765)


def test_a_port_alone_is_not_an_address():
    with pytest.raises(LidarError, match=r"'50051' is not a valid .* write 127\.0\.0\.1:50051\."):
        Address.choose("50051", 8765)


def test_a_port_of_thousands_of_digits_is_refused_in_a_line():
    with pytest.raises(
        LidarError, match=r"is not a valid address\. Expected ADDRESS:PORT"
    ) as raised:
        Address.choose(f"127.0.0.1:{'9' * 5000}", 8765)
    assert len(str(raised.value)) < 200


def test_what_is_missing_names_its_extra(room, monkeypatch, tmp_path):
    monkeypatch.setattr("lidarlive.viewers.viewer.find_spec", lambda name: None)
    scanner = Scanner(room, Sensor.grid(), backend="numpy")
    with pytest.raises(
        LidarError, match=r'requires foxglove-sdk\. Run pip install -e "\.\[live\]"'
    ):
        Foxglove(scanner)
    with pytest.raises(LidarError, match=r'requires rerun-sdk\. Run pip install -e "\.\[rerun\]"'):
        Rerun(scanner)
    with pytest.raises(
        LidarError, match=r'requires foxglove-sdk\. Run pip install -e "\.\[live\]"'
    ):
        simulate(room, Survey(poses=[(0, 0, 1)]), live="foxglove")
    scenario = write_scenario(tmp_path)
    outcome = CliRunner().invoke(cli, ["play", str(scenario), "--as", "foxglove"])
    assert "pip install" in str(outcome.exception)
    assert "\n" not in str(outcome.exception)


@needs_foxglove
@pytest.mark.parametrize("coordinates", ["world", "sensor"])
def test_a_scanner_is_shown_where_it_and_its_actors_are(room, coordinates, capsys):
    scene = room.with_actors([Actor(box("Car 1", (4.5, 1.8, 1.5)))])
    mount = Pose((0.5, 0, 0.4), yaw_deg=30, roll_deg=4)
    sensor = Mounted(load_sensor("velodyne/vlp16"), mount, name="roof")
    scanner = Scanner(scene, sensor, columns=["range"], coordinates=coordinates)
    pose = Pose((-1, 0.5, 1), yaw_deg=70, pitch_deg=-3)
    with Foxglove(scanner, to=":0") as view:
        assert view.description in capsys.readouterr().err
        scanner.move("Car 1", Pose((4, 2, 0), yaw_deg=90))
        before_ns = time.time_ns()
        cloud = scanner.sweep(pose, number=3)
        view.show(cloud, pose)
        with FoxgloveClient(port_of(view.description)) as client:
            client.receive(lambda client: len({topic for topic, *_ in client.messages}) == 4)
    (points,) = client.of("/roof/points")
    assert before_ns <= stamp_ns(points["timestamp"]) <= time.time_ns()
    scanner = Scanner(scanner.scene, sensor)  # in the world
    expected = scanner.sweep(pose, number=3).positions
    assert np.abs(in_world(points, client.of("/tf")[0]) - expected).max() < 0.005
    assert np.array_equal(records(points)["range"], cloud["range"])
    (cube,) = client.of("/actors")[0]["entities"][0]["cubes"]
    assert np.allclose(numbers(cube["pose"]["position"], "xyz"), [4, 2, 0.75])


@needs_foxglove
def test_a_scanner_on_a_trajectory_is_shown_at_its_start(room):
    scanner = Scanner(room, load_sensor("velodyne/vlp16"))
    track = Track([0, 1], [(0, 0, 1), (2, 0, 1)])
    with Foxglove(scanner, to=":0") as view:
        cloud = scanner.sweep(track, number=2, start_s=0.4)
        view.show(cloud, track, start_s=0.4)
        with FoxgloveClient(port_of(view.description)) as client:
            client.receive(lambda client: len({topic for topic, *_ in client.messages}) == 3)
    frames = client.of("/tf")[0]
    assert np.allclose(poses_in_world(frames)["lidar"][0], [0.8, 0, 1])
    assert np.abs(in_world(client.of("/points")[0], frames) - cloud.positions).max() < 1e-5


class Kept(Viewer):
    """Keeps what it is shown."""

    description = "nowhere"

    def __init__(self):
        self.surroundings: list[Surroundings] = []
        self.sweeps: list[ShownSweep] = []
        self.paths = []
        self.closed = False

    def show_surroundings(self, surroundings):
        self.surroundings.append(surroundings)

    def show_path(self, path):
        self.paths.append(path)

    def show_sweep(self, shown):
        self.sweeps.append(shown)

    def close(self):
        self.closed = True


@pytest.mark.extended
def test_a_run_shows_its_finished_sweeps_and_its_path(room, monkeypatch):
    viewer = Kept()
    monkeypatch.setattr("lidarpool.pages.viewer_page.open_viewer", lambda *_, **__: viewer)
    survey = Survey(
        load_sensor("velodyne/vlp16"),
        [Pose((0, 0, 1)), Pose((2, 0, 1), yaw_deg=40)],
        steps=72,
        columns=["time", "intensity"],
        keep_every=1,
    )
    planning = Planning((-8, -8), (8, 8), [(0, 0)], [1.0], trials=2)
    with (
        thread_cluster({"GPU": 1}, {"LIDAR": 4}, {"OTHER": 1}) as cluster,
        Client(cluster) as client,
    ):
        result = simulate(room, survey, planning, client=client, live="foxglove")
    assert viewer.closed
    *shown_sweeps, whole = viewer.sweeps
    sweeps = result.points.sweeps()
    assert len(viewer.surroundings) == 1
    assert viewer.surroundings[0].surface is not None
    assert len(sweeps) == 4
    by_time = {START_NS + round(begin_ns): sweep for sweep, begin_ns in enumerate(sweeps.begins_ns)}
    assert [by_time[shown.start_ns] for shown in shown_sweeps] == [0, 1, 2, 3]
    for shown, points in zip(shown_sweeps, sweeps.points(result.cloud), strict=True):
        assert np.allclose(
            shown.positions, sweeps.in_sensor(by_time[shown.start_ns], points.positions), atol=1e-4
        )
        assert np.array_equal(shown.columns["time"], points["time"])
    assert whole.topic == "/cloud"
    assert np.allclose(whole.positions + whole.transforms[0].position, result.cloud.positions)
    (path,) = viewer.paths
    assert np.allclose(path[:, :2], result.plan.path)


def test_live_may_stand_alone_before_a_scenario():
    run = cli.commands["run"]
    for words, live in (
        (["--live", "s.yaml"], "page"),
        (["s.yaml", "--live"], "page"),
        (["s.yaml", "--live", "--exit"], "page"),
        (["--live", "foxglove", "s.yaml"], "foxglove"),
        (["--live=rerun", "s.yaml"], "rerun"),
        (["s.yaml"], None),
    ):
        parameters = run.make_context("run", words.copy()).params
        assert (parameters["live"], parameters["scenarios"]) == (live, ("s.yaml",)), words


def test_a_server_ends_when_the_process_that_started_it_is_killed():
    server = "import subprocess; subprocess.run(['sleep', '60'])"  # has a child, as Rerun's
    command = [sys.executable, attached_child.__file__, sys.executable, "-c", server]
    parent_code = f"""if True:
        import subprocess, time
        subprocess.Popen({command!r}, stdin=subprocess.PIPE, start_new_session=True)
        print("started", flush=True)
        time.sleep(60)
    """
    with subprocess.Popen([sys.executable, "-c", parent_code], stdout=subprocess.PIPE) as parent:
        assert parent.stdout.readline() == b"started\n"
        time.sleep(0.5)
        parent.kill()
        # All of them hold the other end of this pipe.
        assert parent.communicate(timeout=20)[0] == b""
