"""The examples that scan in a loop, and those in docstrings."""

from __future__ import annotations

import doctest
import importlib
import re
import runpy
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

import lidarpool
from lidarfiles.clouds.ros.bags import MCAP
from lidarfiles.clouds.writing import ExportSpec
from lidarsim import Pose, Scene, Survey, load_sensor
from lidarsim.sweeps.sweeps import Sweeps

EXAMPLES = Path(__file__).parents[2] / "examples"


class Env:
    """What the example needs of `gymnasium.Env`."""

    def reset(self, *, seed=None, options=None):
        self.np_random = np.random.default_rng(seed)


class Box:
    """What it needs of `gymnasium.spaces.Box`."""

    def __init__(self, low, high):
        self.low = low
        self.high = high
        self.shape = low.shape


@pytest.fixture
def gymnasium(monkeypatch):
    """Gymnasium, or what stands in for it."""
    try:
        import gymnasium as _  # noqa: F401
    except ImportError:
        stand_in = ModuleType("gymnasium")
        stand_in.Env = Env
        stand_in.spaces = SimpleNamespace(Box=Box)
        monkeypatch.setitem(sys.modules, "gymnasium", stand_in)


@pytest.mark.extended
@pytest.mark.usefixtures("gymnasium")
def test_a_robot_reaches_its_goal_by_its_ranges(capsys):
    runpy.run_path(str(EXAMPLES / "robot_env.py"), run_name="__main__")
    said = re.fullmatch(
        r"(\d+) steps, reward (.*), (.*) m from the goal\n", capsys.readouterr().out
    )
    steps, reward, left = map(float, said.groups())
    assert 340 < steps < 400 and 68 < reward < 74 and left < 1


@pytest.mark.extended
def test_a_robot_of_mujoco_scans_while_balls_fall(tmp_path, monkeypatch, capsys):
    pytest.importorskip("mujoco", reason="MuJoCo is not installed: pip install mujoco")
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(EXAMPLES / "mujoco_lidar.py"), run_name="__main__")
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 5 and all(
        re.fullmatch(r"0\.\d+ s: 28,.* on balls", line) for line in lines
    )
    assert (tmp_path / "balls.ply").exists()


@pytest.mark.extended
def test_robots_of_a_vector_environment_avoid_columns(capsys):
    pytest.importorskip("mujoco", reason="MuJoCo is not installed: pip install mujoco")
    pytest.importorskip("gymnasium", reason="Gymnasium is not installed: pip install gymnasium")
    example = runpy.run_path(str(EXAMPLES / "vector_env.py"), run_name="__main__")
    assert capsys.readouterr().out == f"lidar (8, 4, 90), rewards {[2.4] * 8}\n"
    envs = example["LidarVectorEnv"](3)
    observation, infos = envs.reset(seed=2)
    assert envs.observation_space.contains(observation) and infos == {}
    assert observation["lidar"].dtype == np.float32
    assert observation["lidar"].shape == (3, 4, 90)
    again, _ = envs.reset(seed=2)
    assert np.array_equal(again["lidar"], observation["lidar"])
    assert envs.single_observation_space.spaces["state"].shape == (3,)
    ends = np.zeros(3, bool)
    while not ends.any():  # straight ahead, into a column
        observation, reward, ends, cut, infos = envs.step(np.float32([[1, 0]] * 3))
        assert envs.observation_space.contains(observation) and not cut.any()
        assert np.allclose(reward, 0.05 - 5 * ends)
    assert (infos["final_obs"]["lidar"].min(axis=(1, 2))[ends] < 0.35).all()
    assert (observation["lidar"].min(axis=(1, 2)) > 0.35).all()


class Falling:
    """What the example needs of PyBullet: boxes in free fall."""

    DIRECT = GEOM_PLANE = GEOM_BOX = 0

    def __init__(self):
        self.poses = np.zeros((0, 7))
        self.time_s = 0.0

    def do_nothing(self, *values, **options):
        return self

    connect = setGravity = createCollisionShape = disconnect = do_nothing  # noqa: N815

    def createMultiBody(self, mass, shape=None, basePosition=(0, 0, 0)):  # noqa: N802, N803
        if mass:
            self.poses = np.vstack([self.poses, [*basePosition, 0, 0, 0, 1]])
        return len(self.poses) - 1

    def stepSimulation(self):  # noqa: N802
        self.time_s += 1 / 240
        self.poses[:, 2] -= 9.81 * self.time_s / 240

    def getBasePositionAndOrientation(self, body):  # noqa: N802
        return self.poses[body, :3], self.poses[body, 3:]

    def getMatrixFromQuaternion(self, quaternion):  # noqa: N802
        return np.eye(3).ravel()


@pytest.mark.extended
def test_a_lidar_scans_falling_boxes(tmp_path, monkeypatch, capsys):
    """With a stand-in for PyBullet, since its installation is large."""
    monkeypatch.setitem(sys.modules, "pybullet", Falling())
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(EXAMPLES / "pybullet_lidar.py"), run_name="__main__")
    lines = capsys.readouterr().out.splitlines()
    on_boxes = [
        re.fullmatch(r"0\.\d+ s: 1[45],.* points, (.*) on boxes", line)[1] for line in lines
    ]
    assert len(on_boxes) == 5 and all(int(n.replace(",", "")) > 500 for n in on_boxes)
    assert (tmp_path / "boxes.ply").exists()


@pytest.mark.extended
def test_a_node_publishes_what_a_bag_holds(tmp_path):
    node = runpy.run_path(str(EXAMPLES / "ros2_scanner.py"), run_name="ros2_scanner")
    scene = Scene.seed()
    pose = Pose((0.5, 0.2, 1), 30)
    cloud = node["scanner_of"](scene, "velodyne/vlp16").sweep(pose)
    store = get_typestore(Stores.ROS2_HUMBLE)
    types = store.types
    kinds = SimpleNamespace(
        PointField=types["sensor_msgs/msg/PointField"],
        PointCloud2=lambda data, **given: types["sensor_msgs/msg/PointCloud2"](
            data=np.frombuffer(data, np.uint8), **given
        ),
    )
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](10**9, 0), "lidar")
    message = node["message_of"](cloud, 0, header, kinds)
    columns = ["intensity", "time"]
    survey = Survey(load_sensor("velodyne/vlp16"), [pose], columns=columns, coordinates="sensor")
    bag = MCAP(cloud, Sweeps.from_survey(survey, scene))
    bag.write(tmp_path / "a.mcap", ExportSpec("mcap"))
    with AnyReader([tmp_path / "a.mcap"], default_typestore=store) as bag:
        [(connection, _, written)] = bag.messages(
            [c for c in bag.connections if "points" in c.topic]
        )
        assert store.serialize_cdr(message, connection.msgtype) == bytes(written)
    assert len(message.data) == 22 * len(cloud) > 10_000


ROOT = Path(lidarpool.__file__).parents[1]
MODULES = [
    ".".join(path.relative_to(ROOT).with_suffix("").parts)
    for path in sorted(ROOT.glob("lidar*/**/*.py"))
    if ">>> " in path.read_text(encoding="utf-8")
]


@pytest.mark.extended(every=4)
@pytest.mark.parametrize("name", MODULES)
def test_examples(name):
    done = doctest.testmod(importlib.import_module(name))
    assert done.failed == 0 < done.attempted
