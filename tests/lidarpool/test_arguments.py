"""Arguments of the wrong kind: each is told of in a line or two that says what to do."""

from __future__ import annotations

import inspect
import re
from functools import partial
from pathlib import Path
from typing import get_type_hints

import numpy as np
import pytest

import lidarpool
from lidarpool import (
    Actor,
    Beams,
    Campaign,
    Cloud,
    Column,
    Fault,
    Follower,
    Foxglove,
    Gnss,
    Imu,
    Job,
    LidarError,
    Material,
    Mounted,
    MujocoScanner,
    Navigation,
    Noise,
    Optics,
    Packets,
    Planning,
    Pose,
    Rerun,
    Returns,
    Scanner,
    Scene,
    SceneInstance,
    SceneMesh,
    Sensor,
    Spin,
    Survey,
    Track,
    box,
    compare,
    fit,
    load_robot,
    load_sensor,
    load_trajectory,
    merge,
    open_recording,
    play,
    read_cloud,
    remove_run,
    save_cloud,
    show,
    simulate,
    sweeps,
    to_dask,
    to_open3d,
    twin,
)
from lidarpool.run.options import RunKeywords, RunOptions
from lidarpool.scenario.sections import PoolSection

POINTS = np.eye(3)
FACES = np.array([[0, 1, 2]])
OWNERS = np.zeros(1, int)
AT = [(0, 0, 1)]
GRID = Sensor.grid()
SCENE = Scene.from_meshes([SceneMesh("Car", POINTS, FACES)])
SCANNER = Scanner(SCENE, GRID, backend="numpy")
CAMPAIGN = Campaign(lambda number, rng: Job(Scene.seed(), Survey(poses=AT)), 2)

# Of everything public that takes arguments, calls that cannot be meant, and what is answered.
WRONG = {
    Actor: [
        ("Car", "a SceneMesh, but is … For example, pass SceneMesh("),
        (SceneMesh("Car", POINTS, FACES), "drive.tum", "trajectory must … but is 'drive.tum'"),
    ],
    Beams: [("x", "array of numbers"), ([[1], [2, 3]], "[[1")],
    Beams.even: [("4", 60, "layers must … but is '4'"), (4.5, 60, "whole")],
    box: [
        (3, (1, 1, 1), "name must … but is 3"),
        ("Car", 4, "list of numbers"),
        ("Car", (4, 2), "size_m[2] is required"),
    ],
    Campaign: [
        (3, 4, "make must be a function, but is 3"),
        (print, "4", "count must be a whole number, but is '4'"),
    ],
    Campaign.load: [(3, "path must … but is 3"), ("a.yaml", "not exist")],
    Campaign.of_scenarios: [
        ("a.yaml", "paths must be a list of text, but is 'a.yaml'"),
        ([], "at least one"),
    ],
    Job: [
        ("hall.glb", Survey(poses=AT), "Scene.load('hall.glb')"),
        (SCENE, Survey(poses=AT), ["fog"], "planning must be a Planning or None, but is ['fog']"),
    ],
    Cloud: [("x", {}, "positions"), ([["a", 0, 0]], {}, "numbers")],
    Column: [(1, "u1", "", "", "name"), ("a", "u1", "", "", 3, "source must … but is 3")],
    SceneInstance: [
        ("Tree", Pose((0, 0, 0)), "a SceneMesh, but is … For example, pass SceneMesh("),
        (SceneMesh("Tree", POINTS, FACES), "here", "transform must … but is 'here'"),
        (SceneMesh("Tree", POINTS, FACES), np.diag([1, 1, 0, 1]), "flattens the mesh"),
    ],
    Material: [(3, "list of text"), ("a", None, "tree", "whole number")],
    SceneMesh: [(3, POINTS, FACES, "name must … but is 3"), ("a", POINTS, "x", "integers")],
    Mounted: [(GRID, "rear", "For example, pass Pose(("), (GRID, (0, 0, 1), "mount")],
    Fault: [("dust", "kind must … but is 'dust'"), ("frozen", -1, "from_s must … but is -1")],
    Foxglove: [
        ("lidar", "scanner must … but is 'lidar'"),
        (SCANNER, 8765, "to must be text or None, but is 8765"),
    ],
    Gnss: [(0, "rate_hz must … but is 0"), (10, Pose((0, 0, 2)), -1, "horizontal")],
    Imu: [("fast", "rate_hz"), (200, Pose((0, 0, 1)), -1, "gyroscope")],
    Navigation: [("imu", "imu"), (None, None, "down", "gravity_m_s2")],
    Noise: [
        ("0.1", "range_m must … but is '0.1'"),
        ([1], "a number"),
        (0, 0, 0, 0, None, 1.5, "seed must … but is 1.5"),
    ],
    Optics: [("red", "wavelength_nm"), (905, None, None, "pulse_ns")],
    Packets: [(3, "sensor must be a Sensor … but is 3"), (GRID, "has no packet format")],
    Planning: [("a", "start must … but is 'a'"), ((0, 0), 5, "target must … but is 5")],
    Pose: [(1, "list of numbers"), ((0, 0, 1), "90", "yaw_deg must … but is '90'")],
    Rerun: [
        ("lidar", "scanner must … but is 'lidar'"),
        (SCANNER, 9876, "to must be text or None, but is 9876"),
    ],
    Returns: [
        ("strong", "'strongest', 'first'"),
        ("all", 7, "wide", "divergence_mrad must … but is 'wide'"),
    ],
    Scene: [
        (POINTS, FACES, ["x"], ("a",), POINTS[0], "face_object"),
        (POINTS, FACES, OWNERS, ("a",), "o", "origin must … but is 'o'"),
    ],
    Scene.from_meshes: [("a.glb", "[SceneMesh('"), (GRID, "a Sensor")],
    Scanner: [
        ("hall.glb", GRID, "Scene.load('hall.glb')"),
        (SCENE, Survey(poses=AT), "sensor must be a Sensor … but is a Survey"),
    ],
    Follower: [
        (3, GRID, "bodies must be a list, but is 3"),
        (["car"], GRID, "bodies[0] must be a SceneMesh, but is 'car'"),
        ([], 3, "sensor must be a Sensor … but is 3"),
        ([], GRID, "at least one object"),
    ],
    MujocoScanner: [
        (None, GRID, "body=NAME or site=NAME"),
        (None, "velodyne/vlp16", "body=NAME or site=NAME"),
    ],
    SCANNER.sweep: [(None, "pose must … but is None"), ((0, 1), "position[2] is required")],
    SCANNER.ranges: [(None, "a list of Pose"), ([AT], "(k, 4, 4)")],
    SCANNER.move: [
        (3, AT[0], "name must … but is 3"),
        ("Car", AT[0], "Unknown actor or instance 'Car'"),
    ],
    fit: [
        (3, "recording must … but is 3"),
        ("nowhere", "nowhere does not exist"),
    ],
    twin: [
        (3, "recording must … but is 3"),
        ("nowhere", "nowhere does not exist"),
    ],
    compare: [
        (3, "a.ply", "a must … but is 3"),
        ("a.ply", "b.ply", "a.ply does not exist. Specify the folder of a result"),
    ],
    open_recording: [
        (3, "source must … but is 3"),
        ("nowhere", "nowhere does not exist"),
    ],
    load_robot: [(3, "path must … but is 3"), (None, "path must … but is None")],
    Scene.load: [(3, "path must … but is 3"), (None, "path must … but is None")],
    Sensor: [("vlp16", "beams"), (Beams([0]), Spin(), "1", "min")],
    Sensor.grid: [("1000", "whole"), (1000, 40, 60, None, "step_deg must … but is None")],
    Spin: [("1000", "a number"), (1000, 10, 10, "no", "true or false")],
    Survey: [
        (GRID, [1, 2, 3], "such as (0, 0, 1)"),
        ("velodyne/vlp16", AT, "load_sensor('velodyne/vlp16')"),
        (GRID, AT, 36, None, (), ["glass"], "Material("),
    ],
    Track: [("a", "b", "times_s must … but is 'a'"), ([0, 1], POINTS[:2], [[1]], "(1, 1)")],
    play: [
        (3, AT[0], "scanner must be a Scanner, but is 3"),
        (SCANNER, AT[0], "has no packet format"),
        (SCANNER, 3, "trajectory must … but is 3"),
    ],
    load_sensor: [(3, "model must … but is 3"), ([1], "text, a path or None")],
    load_trajectory: [(3, "path must … but is 3"), ([AT], "text or a path")],
    read_cloud: [(3, "path must … but is 3"), (["a.ply"], "text or a path")],
    merge: [
        ("part-1", "ds", "shards must … but is 'part-1'"),
        (["a"], 3, "out must … but is 3"),
        ([], "ds", "no shards to"),
    ],
    remove_run: [(3, "folder must … but is 3"), ([], "text, a path or a Storage")],
    save_cloud: [
        (Cloud(POINTS, {}), 3, "path must … but is 3"),
        (Cloud(POINTS, {}), ["a.ply"], "text or a path"),
    ],
    show: [
        ("vlp16", "scanner must … but is 'vlp16'"),
        ([], "different names"),
        ([3], "must be a Scanner"),
    ],
    simulate: [
        ("hall.glb", Survey(poses=AT), "Scene.load('hall.glb')"),
        (SCENE, Survey(poses=AT), (25, 25), "Planning(("),
    ],
    sweeps: [
        (3, "location must … but is 3"),
        ("nowhere", "nowhere does not exist. Specify the output folder of a campaign"),
    ],
    to_dask: [
        (3, "points must … but is 3"),
        (Cloud(POINTS, {}), "must be a StoredCloud"),
    ],
    to_open3d: [(3, "cloud must … but is 3"), ("a.ply", "must be a Cloud")],
}


@pytest.mark.parametrize(
    ("call", "arguments", "says"),
    [(call, given[:-1], given[-1]) for call, all_given in WRONG.items() for given in all_given],
    ids=lambda value: getattr(value, "__qualname__", ""),
)
def test_it_is_told_what_is_expected(call, arguments, says):
    with pytest.raises(LidarError) as raised:
        call(*arguments)
    assert all(words in str(raised.value) for words in says.split(" … "))
    assert len(str(raised.value).splitlines()) <= 2 and len(str(raised.value)) < 320


def test_options_of_a_survey_are_checked_too():
    for options, says in (
        ({"columns": "time"}, "columns must be a list of text, but is 'time'"),
        ({"keep_every": 0}, "keep_every must be from 1 to 1000000, but is 0"),
        ({"precision_m": "fine"}, "precision_m must be a number, but is 'fine'"),
        ({"visibility_km": float("nan")}, "visibility_km must … but is nan"),
        ({"epsg": 25832.5}, "epsg must be a whole number or None, but is 25832.5"),
        ({"coordinates": "map"}, "coordinates must be 'world' or 'sensor', but is 'map'"),
    ):
        with pytest.raises(LidarError) as raised:
            Survey(poses=AT, **options)
        assert all(words in str(raised.value) for words in says.split(" … "))


def test_a_scenario_says_how_it_is_run_unless_python_does():
    pool = PoolSection(gpu=3, batch_mb=64, backend="numpy")
    said = RunOptions(live=True).with_pool(pool)
    assert (said.gpu_workers, said.batch_mb, said.backend, said.live) == (3, 64, "numpy", True)
    given = RunOptions(gpu_workers=2).with_pool(pool, {"backend": "tiles", "batch_mb": None})
    assert (given.gpu_workers, given.batch_mb, given.backend) == (2, 64, "tiles")


def test_keywords_are_the_options_of_runs():
    """But for the place of a result, ways to a cluster, and what only commands do at the end."""
    keywords = get_type_hints(RunKeywords)
    options = get_type_hints(RunOptions)
    assert options.keys() - keywords.keys() == {"out", "stay", "scheduler", "files", "cluster"}
    assert keywords.keys() <= options.keys()
    for name, hint in keywords.items():
        assert hint in (options[name], options[name] | None), name


@pytest.mark.parametrize(
    ("call", "keyword", "says"),
    [
        (partial(simulate, Scene.seed(), Survey(poses=AT)), "retry_failed", "simulate() got"),
        (
            partial(simulate, Scene.seed(), Survey(poses=AT)),
            "startup_timeout",
            "Did you mean 'startup_",
        ),
        (partial(CAMPAIGN.run, "nowhere"), "folder", "run() got"),
        (CAMPAIGN.stream, "resume", "stream() got"),
        (CAMPAIGN.stream, "scheduler", "stream() got"),
    ],
)
def test_options_that_a_call_does_not_take_are_refused(call, keyword, says):
    with pytest.raises(TypeError) as raised:
        call(**{keyword: True})
    assert f"unexpected keyword argument {keyword!r}" in str(raised.value)
    assert all(words in str(raised.value) for words in says.split(" … "))


@pytest.mark.parametrize(
    ("call", "keyword", "says"),
    [
        (partial(Material, "Car"), "class_", "Did you mean 'semantic_class'?"),
        (
            partial(Actor, box("Car", (4, 2, 1))),
            "class_",
            "such as Material('Car', semantic_class=1)",
        ),
        (partial(Pose, (0, 0, 0)), "heading_deg", "'yaw_deg'? It is 90 minus a compass heading."),
        (partial(Pose, (0, 0, 0)), "yaw", "Did you mean 'yaw_deg'?"),
        (partial(Scanner, SCENE, GRID), "visibility", "Did you mean 'visibility_km'?"),
        (partial(SCANNER.sweep, (0, 0, 1)), "start", "sweep() got an unexpected keyword argument"),
    ],
)
def test_unknown_arguments_are_refused_with_a_hint(call, keyword, says):
    with pytest.raises(
        TypeError, match=f"got an unexpected keyword argument '{keyword}'"
    ) as raised:
        call(**{keyword: 1})
    assert says in str(raised.value)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"backend": "opencl"}, "backend must be … but is 'opencl'"),
        ({"batch_mb": 0}, "batch_mb must be from 1 to 1000000, but is 0"),
        ({"client": "tcp://x"}, "client must be a Client or None, but is 'tcp://x'"),
        ({"startup_timeout_s": -1}, "startup_timeout_s must be at least 0, but is -1"),
    ],
)
def test_options_of_runs_are_checked(options, says):
    for call in (partial(simulate, Scene.seed(), Survey(poses=AT)), CAMPAIGN.stream):
        with pytest.raises(LidarError) as raised:
            call(**options)
        assert all(words in str(raised.value) for words in says.split(" … "))


def test_nothing_public_is_left_out():
    """But for what only runs make, or a reader of files."""
    assert dir(lidarpool) == sorted(lidarpool.__all__)
    made = {
        "Comparison",
        "Fit",
        "Twin",
        "CampaignRun",
        "ScanFrame",
        "Plan",
        "Result",
        "Robot",
        "ScanSpec",
        "LidarError",
        "Recording",
        "Sweep",
        "__version__",
    }
    public = {getattr(lidarpool, name) for name in {*lidarpool.__all__} - made}
    assert public <= {*WRONG}
    assert all(len(calls) >= 2 for calls in WRONG.values())


def test_signatures_can_be_read():
    """`help` and notebooks show them: types that readers know, and no addresses of objects."""
    assert str(inspect.signature(Survey)).startswith(
        "(sensor: Sensor = …, poses: Sequence[Any] = (), steps: int | None = None, "
        "trajectory: Trajectory | None = None, sensors: Sequence[Mounted] = (), "
        "materials: Sequence[Material] = (), returns: Returns | None = None"
    )
    assert str(inspect.signature(Scanner.sweep)) == (
        "(self, pose: Pose | Trajectory | Sequence[float], *, number: int | None = None, "
        "start_s: float | None = None) -> Cloud"
    )
    assert "'refuse' | 'hold' | 'absent' = 'refuse'" in str(inspect.signature(Track))
    for name in lidarpool.__all__:
        thing = getattr(lidarpool, name)
        if not callable(thing) or thing is LidarError:
            continue
        assert not re.search(r"<|: '\w+'[,)=]|[(,] _| at 0x", str(inspect.signature(thing))), name
        methods = [getattr(thing, one) for one in dir(thing) if not one.startswith("_")]
        for one in filter(lambda one: inspect.isfunction(one) or inspect.ismethod(one), methods):
            text = str(inspect.signature(one))
            assert not re.search(r"Annotated|about\(| at 0x|<", text), name


def test_what_is_like_it_will_do():
    survey = Survey(poses=np.array([[0, 0, 1.0]]), steps=np.int64(3), keep_every=np.uint8(2))
    assert survey.scan_count == 3
    assert Noise(np.float32(0.5), dropout=1).dropout == 1
    with pytest.raises(LidarError, match="does not exist"):
        Scene.load(Path("nothing.glb"))
