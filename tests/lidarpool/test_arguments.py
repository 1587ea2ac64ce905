"""Arguments of the wrong kind: each is told of in a line or two that says what to do."""

from __future__ import annotations

import inspect
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import get_type_hints

import numpy as np
import pytest

from lidarfiles import open_recording, save_cloud, sweeps
from lidarlive import Foxglove, Rerun, play
from lidarpool import Campaign, merge, remove_run, show, simulate, to_dask
from lidarpool.run.options import RunKeywords, RunOptions
from lidarreal import Augment, augment, compare, fit, fit_pattern, twin
from lidarscenario import Job, Planning
from lidarscenario.scenario import Scenario
from lidarscenario.sections import PoolSection
from lidarsim import (
    Actor,
    Beams,
    Cloud,
    Column,
    Fault,
    Follower,
    Gnss,
    Imu,
    LidarError,
    Material,
    Mounted,
    MujocoScanner,
    Navigation,
    NewtonScanner,
    Noise,
    Optics,
    Packets,
    Pose,
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
    load_sensor,
)

POINTS = np.eye(3)
FACES = np.array([[0, 1, 2]])
OWNERS = np.zeros(1, int)
AT = [(0, 0, 1)]
GRID = Sensor.grid()
SCENE = Scene.from_meshes([SceneMesh("Car", POINTS, FACES)])
SCANNER = Scanner(SCENE, GRID, backend="numpy")
CAMPAIGN = Campaign(lambda number, rng: Job(Scene.seed(), Survey(poses=AT)), 2)

# Arguments that would otherwise be accepted, or fail far from the mistake, and what is answered.
WRONG = {
    # A number, a name or a path where an object is expected.
    Actor: [
        ("Car", "mesh must be a SceneMesh, but is 'Car'"),
        (SceneMesh("Car", POINTS, FACES), "drive.tum", "trajectory must … load_trajectory("),
    ],
    Job: [
        ("hall.glb", Survey(poses=AT), "Scene.load('hall.glb')"),
        (SCENE, Survey(poses=AT), ["fog"], "planning must be a Planning or None, but is ['fog']"),
    ],
    Mounted: [(GRID, "rear", "mount must be a Pose, but is 'rear'")],
    Navigation: [("imu", "imu"), (None, None, "down", "gravity_m_s2")],
    Scanner: [
        ("hall.glb", GRID, "Scene.load('hall.glb')"),
        (SCENE, Survey(poses=AT), "sensor must be a Sensor, but is a Survey"),
    ],
    SceneInstance: [
        (SceneMesh("Tree", POINTS, FACES), "here", "transform must … but is 'here'"),
        (SceneMesh("Tree", POINTS, FACES), np.diag([1, 1, 0, 1]), "flattens the mesh"),
    ],
    Sensor: [("vlp16", "beams must be a Beams"), (Beams([0]), Spin(), "1", "min_range_m must")],
    Survey: [
        (GRID, [1, 2, 3], "such as (0, 0, 1)"),
        ("velodyne/vlp16", AT, "load_sensor('velodyne/vlp16')"),
        (GRID, AT, 36, None, (), ["glass"], "materials must be a list of Material"),
        (GRID, (), None, "drive.tum", "trajectory must … load_trajectory("),
    ],
    Foxglove: [("lidar", "scanner must be a Scanner, but is 'lidar'")],
    Rerun: [("lidar", "scanner must be a Scanner, but is 'lidar'")],
    play: [(3, AT[0], "scanner must be a Scanner, but is 3")],
    simulate: [
        ("hall.glb", Survey(poses=AT), "Scene.load('hall.glb')"),
        (SCENE, Survey(poses=AT), (25, 25), "planning must be a Planning or None"),
    ],
    to_dask: [(Cloud(POINTS, {}), "points must be a StoredCloud")],
    # A text, or a single object, where a list is expected.
    Campaign.from_scenarios: [
        ("a.yaml", "paths must be a list, but is 'a.yaml'"),
        ([], "at least"),
    ],
    Scene.from_meshes: [("a.glb", "meshes must be a list"), ([GRID], "contains a Sensor")],
    Follower: [
        (3, GRID, "bodies must be a list, but is 3"),
        (["car"], GRID, "bodies[0] must be a SceneMesh, but is 'car'"),
        ([], GRID, "at least one object"),
    ],
    merge: [
        ("part-1", "ds", "shards must be a list, but is 'part-1'"),
        (["a"], 3, "out must … but is 3"),
        ([], "ds", "no shards to"),
    ],
    show: [
        ("vlp16", "scanner must be a list, but is 'vlp16'"),
        ([], "different names"),
        ([3], "scanner[0] must be a Scanner, but is 3"),
    ],
    # A number that is out of range, NaN, a fraction, or of another shape.
    Beams: [("x", "array of numbers"), ([[1], [2, 3]], "[[1")],
    Beams.even: [("4", 60, "layers must … but is '4'"), (4.5, 60, "whole")],
    box: [
        (3, (1, 1, 1), "name must be text, but is 3"),
        ("Car", 4, "size_m must be a list of 3 finite numbers, but is 4"),
        ("Car", (4, 2), "size_m must be a list of 3"),
    ],
    Campaign: [(print, "4", "count must be a whole number from 1 … but is '4'")],
    Gnss: [(0, "rate_hz must … but is 0"), (10, Pose((0, 0, 2)), -1, "horizontal")],
    Imu: [("fast", "rate_hz"), (200, Pose((0, 0, 1)), -1, "gyroscope")],
    Noise: [
        ("0.1", "range_m must be a number from 0 to 1000, but is '0.1'"),
        ([1], "a number"),
        (0, 0, 0, 0, None, 1.5, "seed must be a whole number … but is 1.5"),
    ],
    Optics: [("red", "wavelength_nm"), (905, None, None, "pulse_ns")],
    Planning: [("a", "start must … but is 'a'"), ((0, 0), 5, "target must … but is 5")],
    Pose: [(1, "a list of 3 finite numbers"), ((0, 0, 1), "90", "yaw_deg must … but is '90'")],
    SCANNER.sweep: [(None, "pose must … but is None"), ((0, 1), "position must be a list of 3")],
    SCANNER.ranges: [(None, "a list of Pose"), ([AT], "(k, 4, 4)")],
    Sensor.grid: [("1000", "whole"), (1000, 40, 60, None, "step_deg must … but is None")],
    Spin: [("1000", "a number"), (1000, 10, 10, "no", "true or false")],
    Track: [("a", "b", "times_s must … but is 'a'"), ([0, 1], POINTS[:2], [[1]], "(1, 1)")],
    Cloud: [("x", {}, "positions"), ([["a", 0, 0]], {}, "numbers")],
    Scene: [
        (POINTS, FACES, ["x"], ("a",), POINTS[0], "face_object"),
        (POINTS, FACES, OWNERS, ("a",), "o", "origin must … but is 'o'"),
    ],
    SceneMesh: [(3, POINTS, FACES, "name must be text, but is 3"), ("a", POINTS, "x", "integers")],
    # A name that does not exist.
    Column: [("a b", "u1", "", "", "must be an identifier"), ("a", "text", "", "", "integer or")],
    Fault: [("dust", "kind must … but is 'dust'"), ("frozen", -1, "from_s must … but is -1")],
    Material: [(3, "a list of text"), ("a", None, "tree", "semantic_class must be a whole number")],
    Packets: [(3, "sensor must be a Sensor, but is 3"), (GRID, "has no packet format")],
    Returns: [
        ("strong", "'strongest', 'first'"),
        ("all", 7, "wide", "divergence_mrad must … but is 'wide'"),
    ],
    SCANNER.move: [("Car", AT[0], "Unknown actor or instance 'Car'")],
    MujocoScanner: [(None, GRID, "body=NAME or site=NAME")],
    NewtonScanner: [(None, GRID, "body=LABEL or site=LABEL")],
    load_sensor: [(3, "Unknown sensor model '3'")],
    # A file that does not exist.
    Campaign.load: [("a.yaml", "not exist")],
    compare: [("a.ply", "b.ply", "a.ply does not exist. Specify the folder of a result")],
    fit: [("nowhere", "nowhere does not exist")],
    open_recording: [("nowhere", "nowhere does not exist")],
    remove_run: [(3, "location must be a str or a Path, but is 3")],
    sweeps: [("nowhere", "nowhere does not exist. Specify the output folder of a campaign")],
    twin: [("nowhere", "nowhere does not exist")],
    augment: [
        ("nowhere", "nowhere does not exist"),
        ("nowhere", {"scene": "seed"}, "`scene` cannot be applied to a recording"),
    ],
    Augment: [("nowhere.yaml", "nowhere.yaml"), ({"steps": 3}, "`steps` cannot be applied")],
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
        ({"columns": "time"}, "columns must be a list of text or a Column, but is 'time'"),
        ({"keep_every": 0}, "keep_every must be a whole number from 1 to 1000000, but is 0"),
        ({"precision_m": "fine"}, "precision_m must be a number from … but is 'fine'"),
        ({"visibility_km": float("nan")}, "visibility_km must … but is nan"),
        ({"epsg": 25832.5}, "epsg must be a whole number from … but is 25832.5"),
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
    assert options.keys() - keywords.keys() == {"stay", "scheduler", "files", "cluster"}
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
        (partial(simulate, Scene.seed(), Survey(poses=AT)), "parts", "simulate() got"),
        (CAMPAIGN.stream, "resume", "stream() got"),
        (CAMPAIGN.stream, "scratch_dir", "stream() got"),
        (CAMPAIGN.stream, "scheduler", "stream() got"),
    ],
)
def test_options_that_a_call_does_not_take_are_refused(call, keyword, says):
    with pytest.raises(TypeError) as raised:
        call(**{keyword: True})
    assert f"unexpected keyword argument {keyword!r}" in str(raised.value)
    assert all(words in str(raised.value) for words in says.split(" … "))


@pytest.mark.parametrize(
    ("call", "keywords", "says"),
    [
        ("simulate", {"resume": True}, "`resume` requires `folder`"),
        ("simulate", {"scratch_dir": "points"}, "`scratch_dir` requires `folder`"),
        ("simulate", {"client": object(), "gpu_workers": 2}, "`gpu_workers` applies to a local"),
        ("simulate", {"client": object(), "other_workers": 2}, "`other_workers` applies"),
        ("twin", {"resume": True}, "`resume` requires `out`"),
        ("twin", {"restart": True}, "`restart` requires `out`"),
        ("twin", {"out": "twin", "resume": True, "restart": True}, "cannot be combined"),
        ("run", {"client": object(), "tls": True}, "`tls` applies to a local cluster"),
        ("stream", {"client": object(), "gpu_workers": 2}, "`gpu_workers` applies"),
    ],
)
def test_options_without_an_effect_are_refused(tmp_path, call, keywords, says):
    calls = {
        "simulate": partial(simulate, Scene.seed(), Survey(poses=AT)),
        "run": partial(CAMPAIGN.run, tmp_path / "set"),
        "stream": CAMPAIGN.stream,
        "twin": partial(twin, tmp_path),
    }
    with pytest.raises(LidarError) as raised:
        calls[call](**keywords)
    assert says in str(raised.value)
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize("file", ["cloud.ply", "cloud.laz", None])
def test_a_sensor_of_a_cloud_without_sensors_is_refused(tmp_path, file):
    cloud = Cloud(np.random.default_rng(1).uniform(0, 9, (60, 3)), {})
    if file is not None:
        save_cloud(cloud, tmp_path / file)
    source = cloud if file is None else tmp_path / file
    assert len(open_recording(source, None)) == 1
    with pytest.raises(LidarError, match=r"Remove the sensor 'roof'\."):
        open_recording(source, "roof")


@pytest.mark.parametrize("call", [fit, fit_pattern, twin])
def test_the_sensor_of_an_open_recording_is_not_chosen_again(call):
    recording = open_recording(Cloud(POINTS, {}), name="points")
    with pytest.raises(LidarError, match=r"points is already open\. Pass `sensor` to `open_rec"):
        call(recording, sensor="roof")


@pytest.mark.parametrize("name", ["las", "parquet", "ply"])
def test_a_layout_of_a_format_without_layouts_is_refused(tmp_path, name):
    with pytest.raises(LidarError, match=rf"{name} does not support `layout`.* for mcap and ros"):
        save_cloud(Cloud(POINTS, {}), tmp_path / "cloud", format=name, layout="autoware")
    with pytest.raises(LidarError, match="does not support `layout`"):
        Scenario.from_data({"output": {"write": [{"format": name, "layout": "ouster"}]}})


def test_cells_of_range_images_require_sweeps():
    cloud = Cloud(POINTS, {})
    with pytest.raises(LidarError, match="cloud A has no sweeps, which `--azimuth-deg` requires"):
        compare(cloud, cloud, azimuth_deg=1)


@pytest.mark.parametrize(
    ("keyword", "value", "says"),
    [
        ("match", "tme", "match must be 'order' or 'time', but is 'tme'. Did you mean 'time'?"),
        ("unit_a", "inches", "unit must be 'um', 'mm', … but is 'inches'"),
        ("azimuth_deg", 0, "azimuth_deg must be a number above 0 and at most 90, but is 0"),
        ("max_points", 10.5, "max_points must be a whole number at least 1000, but is 10.5"),
    ],
)
def test_options_of_functions_are_checked(keyword, value, says):
    with pytest.raises(ValueError) as raised:
        compare("a.las", "b.las", **{keyword: value})
    assert all(words in str(raised.value) for words in says.split(" … "))


def test_numbers_of_a_sweep_are_checked():
    for options, says in (
        ({"number": -1}, "number must be a whole number at least 0 and below 2147483648"),
        ({"number": 0.5}, "but is 0.5"),
        ({"start_s": float("nan")}, "start_s must be a number at least 0 … or None, but is nan"),
    ):
        with pytest.raises(LidarError) as raised:
            SCANNER.sweep((0, 0, 1), **options)
        assert all(words in str(raised.value) for words in says.split(" … "))


def test_help_shows_what_the_source_says():
    assert [*inspect.signature(Spin).parameters] == [field.name for field in fields(Spin)]
    for thing in (Scanner, Survey, Sensor.grid, simulate, Scene.load):
        assert not hasattr(thing, "__signature__")
        assert not hasattr(thing, "__wrapped__")


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"backend": "opencl"}, "backend must be … but is 'opencl'"),
        ({"batch_mb": 0}, "batch_mb must be a whole number from 1 to 1000000, but is 0"),
        ({"client": "tcp://x"}, "client must be a Client or None, but is 'tcp://x'"),
        ({"startup_timeout_s": -1}, "startup_timeout_s must be a number at least 0, but is -1"),
    ],
)
def test_options_of_runs_are_checked(options, says):
    for call in (partial(simulate, Scene.seed(), Survey(poses=AT)), CAMPAIGN.stream):
        with pytest.raises(LidarError) as raised:
            call(**options)
        assert all(words in str(raised.value) for words in says.split(" … "))


def test_what_is_like_it_will_do():
    survey = Survey(poses=np.array([[0, 0, 1.0]]), steps=np.int64(3), keep_every=np.uint8(2))
    assert survey.scan_count == 3
    assert Noise(np.float32(0.5), dropout=1).dropout == 1
    with pytest.raises(LidarError, match="does not exist"):
        Scene.load(Path("nothing.glb"))
