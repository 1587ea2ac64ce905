"""Surveys from carriers that move, and what users get wrong with them."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from lidarpool import Campaign, Mounted, Pose, Scene, Sensor, Survey, Track, read_cloud, simulate
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarscenes.procedural.city import city
from lidarscenes.writers.scene_file import write_scene
from lidarsim.simulator.rig import Rig

ROOT = Path(__file__).parents[2]

POINTS = "{time_s: 0, position: [0, 0, 1]}, {time_s: 1, position: [9, 0, 1]}"
LINE = "1 0 0 0 0 0 0 1\n2 1 0 0 0 0 0 1\n"
CAR = "actors: [{name: Car, box: [4, 2, 1.5]%s}]"
# (scenario, the file it names, what is said)
BAD = [
    ("trajectory: none.txt", "", "trajectory.file: .*none.txt does not exist"),
    ("trajectory: t.txt", LINE + "3 nan 0 0 0 0 0 1\n", "position of pose 2 is not finite"),
    (
        "trajectory: t.txt",
        LINE + "3 5 0 0 0 0 0 1.01\n",
        ("quaternion of pose 2 is not of unit length"),
    ),
    ("trajectory: {file: t.txt, start_s: 4.5}", LINE, "start_s is 4.5 s, which is 2.5 s outside"),
    ("trajectory: {file: t.txt, format: kitti}", LINE, "Set `times` to the file that contains"),
    ("trajectory: {file: t.txt, format: tum}\nsteps: 399", LINE, "1.*s after the end"),
    (
        ("trajectory: {file: t.txt, times: t.txt, format: tum}"),
        LINE,
        "times can only be combined with KITTI poses",
    ),
    ("trajectory: {file: t.txt, ignore: a}", LINE, "columns and ignore require a table"),
    ("trajectory: {file: t.txt}", "time_s,x,y,z,yaw\n", "'yaw' has no unit. Rename it to yaw_deg"),
    ("trajectory: {file: t.txt, topic: /odom}", LINE, "topic requires a bag"),
    ("trajectory: {file: t.txt, origin: [95, 0, 0]}", LINE, "origin"),
    ("trajectory: {file: t.txt, format: csv}", "x,y,z\n1,2,3\n", "no column 'time_s'"),
    ("trajectory: {file: t.txt, points: [" + POINTS + "]}", LINE, "one of file, points and"),
    ("trajectory: {points: [{position: [0, 0, 0]}]}", "", "time_s is required"),
    ("trajectory: t.txt\nposes: [[0, 0, 1]]", LINE, "`poses` and `trajectory` cannot be combined"),
    (
        "sensors: {a: {}}\nmount: {yaw_deg: 3}",
        "",
        "`sensors` cannot be combined with `sensor` or `mount`",
    ),
    (CAR % "", "", r"Actor 'Car' has no trajectory\. Set its .* replace `poses`"),
    (CAR % ", trajectory: t.txt", LINE, "actor 'Car': .* start_s is 0 s, which is 1 s outside"),
    (CAR % ", trajectory: {file: t.txt, start_s: 1}", LINE, "set `offset_s`"),
    (
        CAR % (", trajectory: {points: [" + POINTS + "]}") + "\nsteps: 150",
        "",
        "the last 0.25 s are not covered",
    ),
    ("actors: [{name: Car, file: no.stl, trajectory: t.txt}]", "0 " + LINE[2:], "no.stl does not"),
]


@pytest.mark.parametrize(("text", "content", "said"), BAD, ids=str)
def test_what_cannot_be_is_one_line_and_exit_code_2(tmp_path, lidarpool, text, content, said):
    (tmp_path / "t.txt").write_text(content)
    (tmp_path / "s.yaml").write_text("scene: seed\n" + text)
    done = lidarpool("check", tmp_path / "s.yaml", "--out", tmp_path / "out")
    assert done.code == 2
    assert len(done.err.splitlines()) == 1
    assert re.search(said, done.err), done.err


@pytest.fixture
def town(tmp_path):
    """The example of the documents beside the city that it drives through."""
    write_scene(tmp_path / "city.glb", city(20_000))
    text = (ROOT / "examples" / "drive.yaml").read_text("utf-8")
    text = text.replace("duration_s: 2 ", "duration_s: 0.2 ")
    (tmp_path / "drive.yaml").write_text(text)
    return tmp_path


@pytest.mark.extended
def test_what_check_says_of_a_drive(town, lidarpool):
    told = lidarpool("check", town / "drive.yaml", "--out", town / "out").out
    assert re.search(r"144 scans \(4 sweeps\) along a trajectory, .* \(2 sensors\)", told)
    assert re.search(r"trajectory  1\.\d\d m in 0.200 s", told)
    assert re.search(
        r"roof        Ouster OS1-32, 2,048 firings, 2.00 turns; the platform moves 0\.\d+ m",
        told,
    )
    assert "returns     strongest of each pulse\n" in told
    done = lidarpool("check", town / "drive.yaml", "--out", town / "out", "--json")
    assert [s["name"] for s in json.loads(done.out)["drive"]["sensors"]] == ["roof", "nose"]


def test_the_drive_of_three_sensors_and_ten_actors_can_be_made(tmp_path):
    write_scene(tmp_path / "city.glb", city(20_000))
    for name in ("city-drive.yaml", "car.obj", "pedestrian.glb"):
        (tmp_path / name).write_bytes((ROOT / "examples" / name).read_bytes())
    built = prepare(Scenario.load(tmp_path / "city-drive.yaml"))
    scene = built.scene
    survey = built.survey
    assert [carried.name for carried in survey.mounted_sensors] == ["roof", "left", "right"]
    assert len(scene.actors) == 10
    assert 15e6 < survey.ray_count < 15.2e6
    for actor in scene.actors:
        actor.check(0.0, survey.duration_ns)


@pytest.mark.extended
def test_the_crossing_by_day_and_wet_by_night_can_be_made(tmp_path):
    write_scene(tmp_path / "city.glb", city(20_000))
    for name in ("crossing.yaml", "crossing-night.yaml", "car.obj", "pedestrian.glb"):
        (tmp_path / name).write_bytes((ROOT / "examples" / name).read_bytes())
    day = prepare(Scenario.load(tmp_path / "crossing.yaml"))
    night = Campaign.load(tmp_path / "crossing-night.yaml").job(0)
    for scene, survey in ((day.scene, day.survey), (night.scene, night.survey)):
        people = [actor for actor in scene.actors if actor.name.startswith("Person")]
        assert len(people) == 20
        assert len({id(actor.mesh.animation) for actor in people}) == 1
        for actor in scene.actors:
            actor.check(0.0, survey.duration_ns)
    assert (day.survey.wet, night.survey.wet) == (0, 0.9)


def test_a_frame_says_whose_it_is(cluster_client):
    one = Sensor.grid(layers=4, step_deg=180)
    carrier = Track(np.array([0.0, 1]), np.array([[0.0, 0, 1], [1, 0, 1]]))
    sensors = [Mounted(one, Pose((0, 0, 0)), "roof"), Mounted(one, Pose((1, 0, 0)), "nose")]
    survey = Survey(trajectory=carrier, sensors=sensors, steps=3)
    frames = []
    simulate(Scene.seed(), survey, client=cluster_client, on_frame=frames.append)
    assert [frame.sensor for frame in frames] == ["roof"] * 3 + ["nose"] * 3


@pytest.mark.extended
def test_a_drive_with_actors_on_a_cluster(town, lidarpool, cluster):
    """As rigs of this process cast it, and again with smaller batches."""
    out = town / "out"
    done = lidarpool("run", town / "drive.yaml", "--out", out, "--scheduler", cluster)
    assert done.code == 0, done.err
    report = json.loads((out / "report.json").read_text())
    assert (report["scans"], report["sweeps"]) == (144, 4)
    assert list(report["parameters"]["sensors"]) == ["roof", "nose"]
    assert "144 scans (4 sweeps) along a trajectory of 0.2 s" in (out / "report.html").read_text(
        "utf-8"
    )
    points = report["points_by_object"]
    assert points["Pedestrian"] > 0 and points["Oncoming car"] > 0
    cloud = read_cloud(out / "cloud.ply")
    built = prepare(Scenario.load(town / "drive.yaml"))
    scene = built.scene
    survey = built.survey
    batches = list(Rig(scene, survey, report["backend"]).cast(0, survey.scan_count))
    for column in survey.stored_columns[3:]:
        made = np.concatenate([column.make(batch) for batch in batches])
        assert np.array_equal(cloud[column.name], made), column.name
    on = cloud["object"] == len(scene.names) + 1
    assert set(cloud["class"][on]) == {2}
    assert set(cloud["class"][cloud["object"] < len(scene.names)]) == {0, 1}  # and parked cars
    assert np.array_equal(np.unique(cloud["sensor"]), [0, 1])
    assert (np.diff(cloud["scan"]) >= 0).all()
