"""World files whose bodies another program moves by name."""

from __future__ import annotations

import json

import numpy as np
import pytest

from lidarsim import Follower, LidarError, Mounted, Pose, Scanner, Scene, Sensor, load_sensor
from lidarsim.worlds.frame_tree import FrameTree
from lidarsim.worlds.world import World, WorldFrame

VLP16 = load_sensor("velodyne/vlp16")
COLUMNS = ["range", "time"]
ROOM = """
<sdf version="1.9"><world name="room">
  <include><uri>model://ground_plane</uri></include>
  <model name="wall"><static>true</static><pose>-6 0 0 0 0 0.3</pose>
    <link name="link"><visual name="visual"><geometry><box><size>0.2 8 4</size></box></geometry>
    </visual></link></model>
  <model name="crate"><pose>6 0 0.5 0 0 0</pose>
    <link name="link"><visual name="visual"><geometry><box><size>1 2 1</size></box></geometry>
    </visual></link></model>
  <model name="tilted"><pose>2 5 1 0.1 0.2 0.4</pose>
    <link name="link"><pose>0.1 0 0 0.3 0 0</pose>
      <visual name="visual"><geometry><box><size>1 1 1</size></box></geometry></visual></link>
  </model>
  <model name="robot"><pose>0 0 0.2 0 0 0</pose>
    <link name="base"><visual name="visual"><geometry><box><size>.4 .4 .2</size></box></geometry>
    </visual></link>
    <link name="lidar"><pose>0 0 0.3 0 0 0</pose></link></model>
</world></sdf>
"""


@pytest.fixture
def room(tmp_path):
    (tmp_path / "room.sdf").write_text(ROOM)
    return tmp_path / "room.sdf"


def at(x, y, z, yaw_deg=0.0):
    pose = Pose((x, y, z), yaw_deg)
    matrix = np.eye(4)
    matrix[:3, :3] = pose.rotation_matrix
    matrix[:3, 3] = pose.position
    return matrix


def follow(follower, poses, start_s, stop_s, step_s=0.02):
    """Return the sweeps; `poses` returns the poses at a time."""
    clouds = []
    for number in range(round((stop_s - start_s) / step_s) + 1):
        time_s = start_s + number * step_s
        clouds += follower.update(time_s, poses(time_s))
    return clouds


def test_the_frames_of_a_gazebo_world_are_its_models_and_links(room):
    world = World.load(room)
    assert [body.name for body in world.bodies] == [
        "ground_plane/link", "wall/link", "crate/link", "tilted/link", "robot/base",
    ]  # fmt: skip
    assert [body.is_static for body in world.bodies] == [True, True, False, False, False]
    assert world.frames["robot/lidar"].parent == "robot"
    assert world.chain("robot/lidar") == ("robot/lidar", "robot")
    assert world.roots == {"room"}
    body = world.bodies[3]
    mesh = body.mesh()  # a box around the origin of its link
    assert np.allclose(mesh.bounds, [[-0.5] * 3, [0.5] * 3])


def test_ranges_of_a_still_world_are_those_of_a_scanner_bit_for_bit(room):
    scanner = Scanner(Scene.load(room), VLP16, columns=COLUMNS)
    follower = Follower.from_world(room, VLP16, frame="robot/lidar", columns=COLUMNS)
    # Published poses have rounding errors, unlike those of the file.
    tilted = World.load(room).frames["tilted"].matrix + 1e-14
    tilted[3] = 0, 0, 0, 1
    clouds = follow(follower, lambda _: {"robot": at(0, 0, 0.2), "tilted": tilted}, 100, 100.5)
    assert len(clouds) == 4
    for number, cloud in enumerate(clouds):
        expected = scanner.sweep(Pose((0, 0, 0.5)), number=number)
        assert cloud.positions.tobytes() == expected.positions.tobytes()
        for name, values in expected.columns.items():
            assert cloud[name].tobytes() == values.tobytes(), name
    assert len(clouds[0]) > 10_000


def test_each_beam_meets_a_moving_body_where_it_is_at_the_firing_time(room):
    follower = Follower.from_world(room, VLP16, frame="robot/lidar", columns=COLUMNS)
    crate = follower.names.index("crate/link")

    def poses(time_s):
        return {"crate": at(6 + 3 * (time_s - 50), 0, 0.5)}

    clouds = follow(follower, poses, 50, 50.5)
    assert len(clouds) == 4
    for cloud in clouds:
        on_crate = cloud.object == crate
        front = on_crate & (cloud.positions[:, 2] < 0.99)
        since_s = cloud["time"][front] / 1e9
        assert on_crate.sum() > 100
        assert np.abs(cloud.positions[front, 0] - (5.5 + 3 * since_s)).max() < 0.006  # precision
        assert np.ptp(since_s) > 0.001


def test_a_frame_without_an_earlier_pose_moves_from_its_pose_in_the_file(room):
    follower = Follower.from_world(room, VLP16, frame="robot/lidar", columns=COLUMNS)
    crate = follower.names.index("crate/link")
    assert follower.update(0, {}) == []
    clouds = follower.update(0.21, {"crate": at(6 + 2.1, 0, 0.5)})  # 10 m/s
    assert len(clouds) == 2
    for cloud in clouds:
        front = (cloud.object == crate) & (cloud.positions[:, 2] < 0.99)
        assert front.sum() > 50
        since_s = cloud["time"][front] / 1e9
        assert np.abs(cloud.positions[front, 0] - (5.5 + 10 * since_s)).max() < 0.006


def test_each_beam_starts_where_the_moving_sensor_is_at_the_firing_time(room):
    mounted = Mounted(VLP16, Pose((0.1, 0, 0), yaw_deg=90))
    follower = Follower.from_world(room, mounted, frame="robot/lidar", columns=COLUMNS)
    wall = follower.names.index("wall/link")

    def poses(time_s):  # it drives and turns at once
        return {"robot": at(2 * (time_s - 1), 0.5, 0.2, 40 * (time_s - 1))}

    clouds = follow(follower, poses, 1, 1.5, 0.01)
    normal = np.array([np.cos(0.3), np.sin(0.3), 0])
    offset = normal @ [-6, 0, 0] + 0.1
    for cloud in clouds:
        points = cloud.positions[cloud.object == wall].astype(float)
        assert len(points) > 100
        assert np.abs(points @ normal - offset).max() < 0.02  # also the edges of the wall
        since_s = cloud["time"][cloud.object == wall] / 1e9
        angle = np.radians(40 * since_s)
        origins = np.stack(
            [2 * since_s + 0.1 * np.cos(angle), 0.5 + 0.1 * np.sin(angle), 0.5 + 0 * since_s], 1
        )
        ranges = np.linalg.norm(points - origins, axis=1)
        assert np.abs(ranges - cloud["range"][cloud.object == wall]).max() < 0.02


def test_objects_keep_their_numbers_when_bodies_start_to_move(room):
    follower = Follower.from_world(room, VLP16, frame="robot/lidar")
    names = follower.names

    def poses(time_s):
        return {"tilted": at(2, 5, 1 if time_s < 0.2 else 1.5)}

    for cloud in follow(follower, poses, 0, 0.5):
        tilted = cloud.positions[cloud.object == names.index("tilted/link")]
        crate = cloud.positions[cloud.object == names.index("crate/link")]
        assert np.abs(tilted[:, 1] - 5).max() < 1 and np.abs(crate[:, 0] - 6).max() < 0.6
    assert follower.names == names


def test_a_world_in_which_everything_moves(tmp_path):
    (tmp_path / "box.sdf").write_text(
        '<sdf version="1.9"><model name="box"><link name="link"><visual name="visual"><geometry>'
        "<box><size>1 1 1</size></box></geometry></visual></link></model></sdf>"
    )
    follower = Follower.from_world(tmp_path / "box.sdf", VLP16)
    (cloud,) = follow(follower, lambda t: {"box": at(3 + t, 0, 0)}, 0, 0.14)
    assert len(cloud) > 100 and set(cloud.object.tolist()) == {0}
    assert follower.names == ("box/link",)


def test_time_that_decreases_starts_the_sweeps_again(room):
    follower = Follower.from_world(room, Sensor.grid(90, 4), columns=COLUMNS)
    first = follow(follower, lambda _: {}, 7, 7.3)
    again = follow(follower, lambda _: {}, 2, 2.3)
    assert len(first) == len(again) == 3
    assert first[0].positions.tobytes() == again[0].positions.tobytes()


@pytest.mark.parametrize(
    ("poses", "message"),
    [
        ({"crat": np.eye(4)}, "no frame 'crat'. Did you mean 'crate'"),
        ({"crate": np.eye(3)}, "pose of 'crate' must be a rigid transform"),
        ({"crate": 2 * np.eye(4)}, "pose of 'crate' must be a rigid transform"),
        ({"crate": np.full((4, 4), np.nan)}, "pose of 'crate' must be a rigid transform"),
    ],
)
def test_poses_that_cannot_be_are_errors(room, poses, message):
    follower = Follower.from_world(room, Sensor.grid(90, 4))
    with pytest.raises(LidarError, match=message):
        follower.update(0, poses)


def test_a_sensor_on_an_unknown_frame_is_an_error(room):
    with pytest.raises(LidarError, match=r"no frame 'robot/lidr'\. Did you mean"):
        Follower.from_world(room, VLP16, frame="robot/lidr")


def gltf_file(path):
    """A car with a body and a wheel, in a file whose y axis points up."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], "<f4")
    faces = np.array([0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3], "<u2")
    binary = corners.tobytes() + faces.tobytes()
    import base64

    uri = "data:application/octet-stream;base64," + base64.b64encode(binary).decode()
    path.write_text(
        json.dumps(
            {
                "asset": {"version": "2.0"},
                "scene": 0,
                "scenes": [{"nodes": [0]}],
                "nodes": [
                    {"name": "Car", "translation": [10, 2, 0], "children": [1, 2]},
                    {"name": "Body", "mesh": 0, "scale": [2, 2, 2]},
                    {"name": "Wheel", "mesh": 0, "translation": [1, 0, 0]},
                ],
                "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
                "buffers": [{"uri": uri, "byteLength": len(binary)}],
                "bufferViews": [
                    {"buffer": 0, "byteLength": 48},
                    {"buffer": 0, "byteOffset": 48, "byteLength": 24},
                ],
                "accessors": [
                    {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3",
                     "min": [0, 0, 0], "max": [1, 1, 1]},
                    {"bufferView": 1, "componentType": 5123, "count": 12, "type": "SCALAR"},
                ],
            }
        )
    )  # fmt: skip


def test_the_frames_of_gltf_nodes_have_z_up_and_carry_their_children(tmp_path):
    gltf_file(tmp_path / "car.gltf")
    world = World.load(tmp_path / "car.gltf")
    assert [body.name for body in world.bodies] == ["Body", "Wheel"]
    assert world.chain("Wheel") == ("Wheel", "Car")
    assert np.allclose(world.frames["Car"].matrix, at(10, 0, 2))
    assert np.allclose(world.frames["Wheel"].matrix, at(1, 0, 0))
    # The scale of the node belongs to the mesh, whose y axis is the z axis of the frame.
    assert np.allclose(world.bodies[0].mesh().bounds, [[0, -2, 0], [2, 0, 2]])


def test_two_frames_with_the_same_name_cannot_be_moved(tmp_path):
    gltf_file(tmp_path / "car.gltf")
    data = json.loads((tmp_path / "car.gltf").read_text())
    data["scenes"][0]["nodes"].append(3)
    data["nodes"].append({"name": "Car", "translation": [20, 2, 0], "children": [4]})
    data["nodes"].append({"name": "Roof", "mesh": 0})
    (tmp_path / "car.gltf").write_text(json.dumps(data))
    world = World.load(tmp_path / "car.gltf")
    assert world.ambiguous == {"Car"} and "Car" not in world.frames
    assert np.allclose(world.frames["Roof"].matrix, at(20, 0, 2))
    follower = Follower.from_world(tmp_path / "car.gltf", Sensor.grid(90, 4))
    with pytest.raises(LidarError, match="several frames with the name 'Car'"):
        follower.update(0, {"Car": np.eye(4)})


def test_the_frames_of_mujoco_bodies(tmp_path):
    pytest.importorskip("mujoco")
    (tmp_path / "hall.xml").write_text(
        '<mujoco><worldbody><geom name="floor" type="plane" size="5 5 .1"/>'
        '<body name="ball" pos="3 1 .5" euler="0 0 90"><freejoint/><geom size=".4"/></body>'
        "</worldbody></mujoco>"
    )
    world = World.load(tmp_path / "hall.xml")
    assert [(body.name, body.is_static) for body in world.bodies] == [
        ("floor", True),
        ("ball", False),
    ]
    assert np.allclose(world.frames["ball"].matrix, at(3, 1, 0.5, 90))


def pose(x=0.0, y=0.0, z=0.0, yaw_deg=0.0):
    half = np.radians(yaw_deg) / 2
    return (x, y, z, 0, 0, np.sin(half), np.cos(half))


FRAMES = {"robot": WorldFrame("", at(0, 0, 0)), "arm": WorldFrame("robot", at(1, 0, 0))}


def test_poses_are_composed_and_interpolated_at_a_constant_rate():
    tree = FrameTree(FRAMES, ["map"])
    tree.add("robot", "map", 0, pose())
    tree.add("robot", "map", 1000, pose(2, yaw_deg=90))
    times_ns = np.array([-5, 0, 500, 1000, 2000])
    arms = tree.poses(["arm"], times_ns)["arm"]
    root = np.sqrt(0.5)
    expected = [[1, 0, 0], [1, 0, 0], [1 + root, root, 0], [2, 1, 0], [2, 1, 0]]
    assert np.allclose(arms[:, :3, 3], expected)
    assert tree.sample_times(["robot", "arm"], 0, 5000) == [1000]


def test_received_frames_that_do_not_lead_to_the_world_leave_frames_at_their_poses():
    tree = FrameTree(FRAMES, ["map"])
    tree.add("robot", "odom", 0, pose(7))
    tree.add("camera", "odom", 0, pose(7))
    assert tree.chain("robot") == ("robot",) and tree.chain("camera") is None
    assert np.allclose(tree.poses(["robot"], np.array([0]))["robot"], np.eye(4))
    tree.add("odom", "map", 0, pose(0, 3))
    assert tree.chain("camera") == ("camera", "odom")
    assert tree.poses(["robot"], np.array([0]))["robot"][0, :3, 3].tolist() == [7, 3, 0]
    # A second parent, which does not lead to the world, has no effect.
    tree.add("robot", "elsewhere", 5, pose(9))
    assert tree.chain("robot") == ("robot", "odom")


def test_frames_in_a_circle_have_no_pose():
    tree = FrameTree({}, ["map"])
    tree.add("a", "b", 0, pose())
    tree.add("b", "a", 0, pose())
    assert tree.chain("a") is None and tree.poses(["a"], np.array([0])) == {}


def test_a_jump_is_not_interpolated():
    tree = FrameTree(FRAMES, max_speed_m_s=100)
    second = 10**9
    assert tree.add("robot", "", 0, pose()) is None
    assert tree.add("robot", "", second, pose(50)) is None
    jump = tree.add("robot", "", second + 10**7, pose(80))
    assert (jump.frame, jump.distance_m) == ("robot", 30) and np.isclose(jump.duration_s, 0.01)
    times_ns = np.array([second, second + 9 * 10**6, second + 10**7])
    assert tree.poses(["robot"], times_ns)["robot"][:, 0, 3].tolist() == [50, 50, 80]


def test_poses_before_a_jump_of_time_are_forgotten():
    tree = FrameTree(FRAMES)
    tree.add("robot", "", 8 * 10**9, pose(8))
    tree.restart(0)
    times_ns = np.array([0, 10**9])
    assert tree.poses(["robot"], times_ns)["robot"][:, 0, 3].tolist() == [8, 8]  # until it is known
    tree.add("robot", "", 10**9, pose(1))
    assert tree.poses(["robot"], times_ns)["robot"][:, 0, 3].tolist() == [1, 1]
    # Even if the clock has not jumped yet.
    tree.add("robot", "", 10**8, pose(2))
    assert tree.poses(["robot"], times_ns)["robot"][:, 0, 3].tolist() == [2, 2]


def test_a_flood_of_poses_is_thinned_out():
    tree = FrameTree(FRAMES)
    for number in range(20_000):
        tree.add("robot", "", number * 10_000, pose(number * 1e-5))  # 100 kHz
    assert len(tree.sample_times(["robot"], -1, 10**9)) <= 420
    times_ns = np.array([190_000_000])
    assert np.isclose(tree.poses(["robot"], times_ns)["robot"][0, 0, 3], 0.19)


def test_samples_are_kept_until_they_are_dropped():
    tree = FrameTree(FRAMES)
    for number in range(20_000):  # as long as the sweep of a terrestrial scanner
        tree.add("robot", "", number * 10**6, pose(number * 1e-3))
    times_ns = np.array([500_000_000])
    assert np.isclose(tree.poses(["robot"], times_ns)["robot"][0, 0, 3], 0.5)
    tree.drop_before(19_000_500_000)
    assert tree.sample_times(["robot"], -1, 10**11) == [n * 10**6 for n in range(19_000, 20_000)]


@pytest.mark.parametrize("bad", [(np.nan, 0, 0, 0, 0, 0, 1), (0, 0, 0, 0, 0, 0, 0), [0] * 7])
def test_poses_without_a_rotation_are_refused(bad):
    with pytest.raises(ValueError, match="not finite, or the norm"):
        FrameTree(FRAMES).add("robot", "", 0, bad)
