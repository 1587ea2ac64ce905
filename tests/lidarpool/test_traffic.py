"""Actors that appear and leave, and traffic of SUMO."""

from __future__ import annotations

import gzip
import json
import re
from types import SimpleNamespace

import numpy as np
import pytest
from tests.shapes import cast_between, made

from lidarfiles import save_cloud
from lidarfiles.identity.fingerprint import fingerprint
from lidarfiles.picture_file import PictureContent
from lidarpool.report.picture_content import picture_content
from lidarscenario.advice import advice
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarsim import Actor, Cloud, LidarError, Mounted, Pose, Scene, Survey, Track, box, load_sensor
from lidarsim.casting.surfaces import SceneSurfaces
from lidarsim.io import allowance
from lidarsim.simulator.rig import Rig
from lidarsim.sweeps.sweeps import Sweeps

FLOOR = box("Floor", (60, 60, 0.01))
COLUMNS = ["time", "range", "triangle", "intensity", "class"]


def passing(beyond, times=(0.02, 0.065)):
    """A car that drives from x -2 to 2 at y 6."""
    return Actor(
        box("Car", (4, 2, 1.5)), Track(times, [[-2, 6, 0], [2, 6, 0]], start_s=0.0, beyond=beyond)
    )


@pytest.mark.extended
@pytest.mark.parametrize("backend", ["numpy", "tiles"])
@pytest.mark.parametrize("model", ["velodyne/vlp16", "livox/mid40"])
def test_an_actor_is_hit_only_while_it_is_there(model, backend):
    mount = Pose((0, 0, 0), 90 if "livox" in model else 0)
    survey = Survey(
        sensors=[Mounted(load_sensor(model), mount)], poses=[(0, 0, 1.0)], steps=72,
        keep_every=1, columns=COLUMNS,
    )  # fmt: skip
    plain = Scene.from_meshes([FLOOR])
    start = {"times": (0.0, 0.11)}
    scenes = {
        "absent": plain.with_actors([passing("absent", **start)]),
        "held": plain.with_actors([passing("hold", **start)]),
        "none": plain,
    }
    found = {name: made(survey, scene, backend) for name, scene in scenes.items()}
    there = {name: columns["time"] <= 110_000_000 for name, columns in found.items()}
    for column in found["none"]:
        absent, held, none = (found[name][column] for name in ("absent", "held", "none"))
        assert np.array_equal(absent[there["absent"]], held[there["held"]]), column
        assert np.array_equal(absent[~there["absent"]], none[~there["none"]]), column
    cars = {name: columns["object"] == 1 for name, columns in found.items()}
    assert cars["absent"].sum() > 20 and (cars["held"] & ~there["held"]).sum() > 20
    # However the scans are cast.
    rig = Rig(scenes["absent"], survey, backend)
    whole = cast_between(rig, survey, [0, 72])
    assert cast_between(rig, survey, [0, 1, 37, 38, 40, 72]) == whole


def test_an_actor_is_refused_held_or_absent_beyond_its_trajectory():
    times = np.array([-1e9, 0.02e9, 1e9])
    with pytest.raises(LidarError, match="outside"):
        passing("refuse").trajectory.poses(0, times)
    for beyond in ("hold", "absent"):
        places, _ = passing(beyond).trajectory.poses(0, times)
        assert places[:, 0].tolist() == pytest.approx([-2, -2, 2])
    with pytest.raises(LidarError, match="start_s must be a finite number or None, but is nan"):
        Track([0, 1], [[0, 0, 0], [1, 0, 0]], start_s=np.nan, beyond="absent")


@pytest.fixture
def sweeps_of_three():
    survey = Survey(load_sensor("velodyne/vlp16"), poses=[(0, 0, 1.0)], steps=108)
    scene = Scene.from_meshes([FLOOR]).with_actors([passing("absent", (0.05, 0.15))])
    return Sweeps.from_survey(survey, scene)


def test_labels_and_frames_are_of_actors_that_are_there(sweeps_of_three, tmp_path):
    assert sweeps_of_three.actor_there.tolist() == [[False, True, False]]
    columns = {"scan": [0, 40, 80], "object": [0] * 3, "channel": [0] * 3, "time": [0, 1e8, 2e8]}
    columns |= {"intensity": [1.0] * 3, "class": [0] * 3}
    cloud = Cloud(np.zeros((3, 3)), columns, sweeps=lambda: sweeps_of_three)
    save_cloud(cloud, tmp_path / "nu", format="nuscenes")
    tables = {path.stem: json.loads(path.read_text()) for path in tmp_path.glob("nu/v1.0-*/*")}
    (row,) = tables["sample_annotation"]
    assert row["sample_token"] == tables["sample"][1]["token"]
    assert tables["instance"][0]["nbr_annotations"] == 1

    rosbags = pytest.importorskip("rosbags.highlevel")
    from rosbags.typesys import Stores, get_typestore

    save_cloud(cloud, tmp_path / "a.mcap", layout="velodyne")
    store = get_typestore(Stores.ROS2_HUMBLE)
    shown = []
    frames = []
    with rosbags.AnyReader([tmp_path / "a.mcap"], default_typestore=store) as bag:
        for connection, _, data in bag.messages():
            message = bag.deserialize(data, connection.msgtype)
            if connection.topic == "/actors":
                shown += [marker.action for marker in message.markers]
            elif connection.topic == "/tf":
                frames.append([one.child_frame_id for one in message.transforms])
    assert shown == [2, 0, 2]  # DELETE, ADD, DELETE
    # The last frame is at the end of the last sweep.
    assert frames == [["base_link"], ["base_link", "Car"], ["base_link"], ["base_link"]]


# A car that drives east at 10 m/s, and at 2 s is taken out for a step; a person who walks north;
# a bus that is there at 9 s alone.
FCD = """<?xml version="1.0" encoding="UTF-8"?>
<fcd-export>
  <timestep time="0.00"><vehicle id="a.1" x="10" y="5" angle="90" type="car" slope="0"/></timestep>
  <timestep time="1.00">
    <vehicle id="a.1" x="20" y="5" angle="90" type="car" slope="5.0"/>
    <person id="p" x="0" y="0" z="0.5" angle="0" type="walker" slope="0"/>
  </timestep>
  <timestep time="2.00"><person id="p" x="0" y="1" z="0.5" angle="0" type="walker"/></timestep>
  <timestep time="3.00"><vehicle id="a.1" x="40" y="5" angle="45" type="car"/></timestep>
  <timestep time="4.00"><vehicle id="a.1" x="50" y="5" angle="45" type="car"/></timestep>
  <timestep time="9.00"><vehicle id="bus" x="50" y="5" angle="45" type="bus"/></timestep>
</fcd-export>
"""
SHAPES = [
    {"types": "walk*", "name": "Person", "box": [0.4, 0.5, 1.7], "class": 7},
    {"types": ["car", "bus"], "box": [4, 2, 1.5], "class": 10},
]


def scenario(folder, text=FCD, traffic=(), **sections):
    (folder / "fcd.xml").write_text(text)
    data = {
        "scene": {"ground": {"margin_m": 60}, "copies": [{"name": "Post", "box": [1, 1, 3],
                  "at": [[0, 9, 0]]}]},
        "poses": [[10, 8, 1.5]],
        "sensor": {"model": "velodyne/vlp16"},
        "steps": 36 * 50,
        "traffic": {"file": "fcd.xml", "vehicles": SHAPES, **dict(traffic)},
        "cloud": {"columns": ["time", "class"], "keep_every": 1},
    }  # fmt: skip
    return Scenario.from_data(data | sections, folder=folder)


@pytest.mark.extended
def test_vehicles_and_persons_are_actors_while_they_are_there(tmp_path):
    read = scenario(tmp_path)
    built = prepare(read)
    assert [actor.name for actor in built.scene.actors] == ["car (a.1)", "Person (p)", "car (a.1)"]
    assert built.scene.object_names[2:] == ("car (a.1)", "Person (p)", "car (a.1).2")
    first, person, again = (actor.trajectory for actor in built.scene.actors)
    assert [way.presence_ns for way in (first, person, again)] == [
        (0, 1e9), (1e9, 2e9), (3e9, 4e9)
    ]  # fmt: skip
    # The front is where SUMO says: 2 m ahead of the middle.
    places, turns = first.poses(0, np.array([0.5e9, 1e9]))
    front = places + turns @ [2, 0, 0]
    np.testing.assert_allclose(front, [[15, 5, 0], [20, 5, 0]], atol=0.02)
    np.testing.assert_allclose(turns[1, :, 0], [np.cos(np.radians(5)), 0, np.sin(np.radians(5))])
    place, turn = person.poses(0, np.array([1.5e9]))
    np.testing.assert_allclose(place + turn @ [0.2, 0, 0], [[0, 0.5, 0.5]], atol=1e-9)
    np.testing.assert_allclose(again.poses(0, np.array([3e9]))[1][0, :2, 0], [0.5**0.5] * 2)
    summary = built.findings.sources["fcd.xml"]
    assert summary.startswith("3 actors during the survey, out of 3 vehicles")

    job = prepare(read).job
    found = made(job.survey, job.scene, "tiles")
    for number, semantic_class, (begin, end) in ((2, 10, (0, 1)), (3, 7, (1, 2)), (4, 10, (3, 4))):
        own = found["object"] == number
        assert own.any() and set(found["class"][own]) == {semantic_class}
        times = found["time"][own] / 1e9
        assert begin <= times.min() and times.max() <= end
    assert set(found["class"][found["object"] < 2]) == {0}


def test_traffic_is_moved_in_time_and_place_and_read_no_further_than_needed(tmp_path):
    traffic = {"offset_s": -3.2, "translation": [100, 0, 7]}
    # What comes after the survey is not read: here the end of the file is missing.
    text = FCD.replace("</fcd-export>", f"<!--{'x' * 3_000_000}--><")
    read = scenario(tmp_path, text, traffic, steps=36)
    (car,) = prepare(read).scene.actors
    assert car.trajectory.presence_ns == pytest.approx((-0.2e9, 0.8e9))
    assert car.trajectory.positions[0].tolist() == pytest.approx(
        [140 - 2 * 0.5**0.5, 5 - 2 * 0.5**0.5, 7]
    )

    (tmp_path / "fcd.xml.gz").write_bytes(gzip.compress(FCD.encode()))
    packed = scenario(tmp_path, traffic={"file": "fcd.xml.gz"})
    assert len(prepare(packed).scene.actors) == 3


def in_unit(count, start=0):
    """Floating car data whose times are numbers of units, `count` a second."""
    return re.sub(r'time="(\d+)\.00"', lambda match: f'time="{start + int(match[1]) * count}"', FCD)


@pytest.mark.parametrize(
    ("unit", "name", "count", "start_s"),
    [
        ("ns", "nanoseconds", 10**9, 1_700_000_000),
        ("ns", "nanoseconds", 10**9, 0),
        ("ms", "milliseconds", 1000, 1_700_000_000),
    ],
)
def test_times_of_traffic_that_cannot_be_seconds_need_their_unit(
    tmp_path, unit, name, count, start_s
):
    text = in_unit(count, start_s * count)
    with pytest.raises(LidarError, match=f"They are probably {name}. Set `time_unit: {unit}"):
        prepare(scenario(tmp_path, text))
    timed = {"time_unit": unit, "offset_s": -start_s}
    expected = [actor.trajectory for actor in prepare(scenario(tmp_path)).scene.actors]
    for actor, track in zip(
        prepare(scenario(tmp_path, text, timed)).scene.actors, expected, strict=True
    ):
        assert actor.trajectory.times_s.tolist() == track.times_s.tolist()
        assert np.allclose(actor.trajectory.positions, track.positions)


@pytest.mark.parametrize("shown", ["{:02}:{:02}:{:02}.00", "0:{:02}:{:02}:{:02}", "{}:{:02}:{:02}"])
def test_human_readable_times_of_sumo(tmp_path, shown):
    def readable(match):
        minutes, seconds = divmod(int(match[1]) + 3598, 60)
        return f'time="{shown.format(*divmod(minutes, 60), seconds)}"'

    text = re.sub(r'time="(\d+)\.00"', readable, FCD)
    plain = prepare(scenario(tmp_path)).scene
    read = prepare(scenario(tmp_path, text, {"offset_s": -3598})).scene
    assert len(plain.actors) == 3 and fingerprint(read) == fingerprint(plain)
    with pytest.raises(
        LidarError, match="hours, minutes and seconds, so `time_unit` cannot be set"
    ):
        prepare(scenario(tmp_path, text, {"time_unit": "s"}))


def test_days_and_times_before_zero_of_sumo(tmp_path):
    rows = '<vehicle id="c" x="{}" y="5" angle="90" type="car"/>'
    times = ("-00:00:01.50", "00:00:02.25", "1:01:01:01.00", "12:00:00:00.00")
    steps = "".join(
        f'<timestep time="{time}">{rows.format(x)}</timestep>' for x, time in enumerate(times)
    )
    read = scenario(tmp_path, f"<fcd-export>{steps}</fcd-export>", steps=36)
    (car,) = prepare(read).scene.actors
    assert car.trajectory.times_s.tolist() == [-1.5, 2.25]
    read = scenario(tmp_path, f"<fcd-export>{steps}</fcd-export>", {"offset_s": -90_000}, steps=36)
    (car,) = prepare(read).scene.actors
    assert car.trajectory.times_s.tolist() == [2.25 - 90_000, 61.0]


RAMP = "o Ramp\nv 0 0 0\nv 18.5 0 1.85\nv 18.5 9 1.85\nv 0 9 0\nf 1 2 3\nf 1 3 4\n"
UPHILL = np.array([10, 0, 1]) / 101**0.5


def test_traffic_stands_on_surfaces_and_is_absent_beside_them(tmp_path):
    (tmp_path / "ramp.obj").write_text(RAMP)
    steps = "".join(
        f'<timestep time="{k}"><vehicle id="c" x="{2 * k}" y="5" z="9" angle="90" type="car"/>'
        "</timestep>"
        for k in range(15)
    )
    read = scenario(
        tmp_path, f"<fcd-export>{steps}</fcd-export>", {"surfaces": "Ramp"},
        scene={"files": "ramp.obj"}, steps=36 * 140,
    )  # fmt: skip
    (car,) = prepare(read).scene.actors
    # Its middle is 2 m behind the front, and on the ramp until x is 18.5.
    np.testing.assert_allclose(car.trajectory.presence_ns, (1e9, 10.25e9), atol=0.26e9)
    places, turns = car.trajectory.poses(0, np.array([3.1e9]))
    np.testing.assert_allclose(places, [[4.2, 5, 0.42]], atol=1e-9)
    np.testing.assert_allclose(turns[0, :, 0], UPHILL, atol=1e-9)


@pytest.mark.parametrize("far", [(0, 0, 0), (690_000, 5_330_000, 4_000)])
def test_a_carrier_follows_surfaces_and_must_stay_on_them(tmp_path, far):
    (tmp_path / "ramp.obj").write_text(RAMP)
    x, y, z = far
    points = [{"time_s": t, "position": [x + 18 - 2 * t, y + 5, 0.3]} for t in (0, 8)]

    def read(points, **options):
        scene = {"files": {"file": "ramp.obj", "translation": far}}
        return Scenario.from_data(
            {"scene": scene, "trajectory": {"points": points, "surfaces": "Ramp", **options}},
            folder=tmp_path,
        )

    downhill = read(points)
    built = prepare(downhill)
    scene = built.scene
    path = built.survey.path
    assert path.duration_ns == 8e9
    places, turns = path.poses(0, np.array([0, 1.3e9, 8e9]))
    np.testing.assert_allclose(places[:, 2] + scene.origin[2] - z, [2.1, 1.84, 0.5], atol=1e-6)
    np.testing.assert_allclose(turns[:, :, 0], np.tile(-UPHILL, (3, 1)), atol=1e-6)
    np.testing.assert_allclose(turns[:, :, 1], np.tile([0, -1, 0], (3, 1)), atol=1e-6)
    stops = ((0, 18), (3, 10), (5, 10), (8, 2))
    stop = [{"time_s": t, "position": [x + at, y + 5, 0.3]} for t, at in stops]
    path = prepare(read(stop, interpolation="smooth")).survey.path
    poses = path.times_s[1:-1, None] * 1e9 + [-10, 10]
    speeds = path.velocities(0, poses.ravel())[0].reshape(-1, 2, 3)
    np.testing.assert_allclose(speeds[:, 0], speeds[:, 1], atol=1e-5)
    assert not path.velocities(0, np.linspace(3e9, 4.9e9, 20))[0].any()
    points[1]["position"] = [x + 30, y + 5, 0]
    points.insert(1, {"time_s": 4, "position": [x + 10, y + 5, 0.3]})
    assert prepare(read(points, duration_s=3)).survey.path.duration_ns == 3e9
    with pytest.raises(LidarError, match=r"leaves the surfaces that it follows \(Ramp\)"):
        prepare(read(points))
    with pytest.raises(LidarError, match=r"`trajectory\.beyond` is only allowed for actors"):
        read(points, beyond="hold")


def test_vehicles_of_one_entry_share_a_mesh_also_in_the_file_of_pictures(tmp_path):
    built = prepare(scenario(tmp_path))
    first, _, again = (actor.mesh for actor in built.scene.actors)
    assert first.vertices is again.vertices
    survey = built.survey
    result = SimpleNamespace(
        scene=built.scene, survey=survey, hit_counts=np.arange(built.scene.counters), trials=(),
        sample_rays=np.zeros((0, 2, 3)), planning=None, plan=None,
    )  # fmt: skip
    picture_content(result).save(tmp_path / "p.npz")
    back = PictureContent.load(tmp_path / "p.npz").scene.actors
    assert back[0].mesh.vertices is back[2].mesh.vertices
    assert [actor.name for actor in back] == ["car (a.1)", "Person (p)", "car (a.1)"]
    assert back[2].trajectory.presence_ns == pytest.approx((3e9, 4e9))


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "no element found"),
        ("<a/>", "it has no time steps"),
        (FCD.replace("</fcd-export>", ""), "no element found"),
        (FCD.replace('time="3.00"', 'time="1.5"'), "the time 1.5 is not after"),
        (FCD.replace('time="3.00"', 'time="nan"'), "the time nan is not after"),
        (FCD.replace('x="40"', 'x="inf"'), "vehicle 'a.1' has no finite position at 3 s"),
        (FCD.replace('x="40"', ""), "'x' is missing"),
        (
            FCD.replace('x="40"', 'x="40" heading="3"'),
            r"vehicle has the attribute 'heading', which SUMO does not define\. To ignore it, "
            r"set `ignore: \[heading\]`",
        ),
        (FCD.replace('x="40"', 'x="east"'), "x of vehicle 'a.1' must be a number, but is 'east'"),
        (
            FCD.replace('time="3.00"', 'time="3:00"'),
            "time of a timestep must be a number, but is '3:00'",
        ),
        (FCD.replace('angle="45"', ""), "'angle' is missing"),
        (FCD.replace("?>", '?><!DOCTYPE a [<!ENTITY b "c">]>', 1), "declares the XML entity"),
    ],
)
def test_unusable_data_is_refused(tmp_path, text, told):
    with pytest.raises(LidarError, match=rf"fcd\.xml cannot be read as floating .*{told}"):
        prepare(scenario(tmp_path, text))


@pytest.mark.extended
@pytest.mark.parametrize(
    ("vehicles", "limit_bytes", "told"),
    [
        (
            '<vehicle id="' + "1" * 20_000_000 + '"/>',
            2**25,
            "it contains a tag or comment longer than 16.00 MiB",
        ),
        (
            "".join(f"<vehicle id='{i}' x='0' y='0' angle='0'/>" for i in range(2_000)),
            3 * 2**19,
            "the limit is 1.50 MiB. Simulate a shorter time, or fewer vehicles.",
        ),
        ("<x/>" * 1_000_000, 2**20, "the limit is 1.00 MiB. Decompress it with gunzip first."),
    ],
)
def test_packed_data_that_unpacks_to_far_more_is_refused(
    tmp_path, monkeypatch, vehicles, limit_bytes, told
):
    monkeypatch.setattr(allowance, "MIN_LIMIT_BYTES", limit_bytes)
    monkeypatch.setattr(allowance, "UNPACKED_TIMES", 1)
    text = f'<fcd-export><timestep time="0">{vehicles}</timestep></fcd-export>'
    (tmp_path / "fcd.xml.gz").write_bytes(gzip.compress(text.encode()))
    with pytest.raises(LidarError) as raised:
        prepare(scenario(tmp_path, traffic={"file": "fcd.xml.gz"}))
    message = str(raised.value)
    assert "fcd.xml.gz" in message and told in message and "\n" not in message


def test_attributes_that_sumo_defines_or_the_user_ignores(tmp_path):
    plain = prepare(scenario(tmp_path)).scene
    text = FCD.replace('x="40"', 'x="40" lane="e_0" pos="3" speed="1" odometer="4"')
    known = prepare(scenario(tmp_path, text)).scene
    text = text.replace('x="40"', 'x="40" battery.level="3" batteryMode="1"')
    ignoring = prepare(scenario(tmp_path, text, {"ignore": "battery*"})).scene
    assert fingerprint(plain) == fingerprint(known) == fingerprint(ignoring)


def test_classes_are_of_vehicles_alone_and_leave_their_materials(tmp_path):
    read = scenario(
        tmp_path,
        FCD.replace('id="p"', 'id="a.1"'),
        {"vehicles": [{"types": "walk*", "box": [1, 1, 1]}, {"box": [4, 2, 1.5], "class": 10}]},
        scene={"ground": {}, "copies": [{"name": "House (old)", "box": [1, 1, 1], "at": [[0, 9]]}]},
        materials=[
            {"objects": "car (a.1)", "reflectance": 0.1},
            {"objects": "*", "reflectance": 0.3, "class": 2},
        ],
    )
    job = prepare(read).job
    names = job.scene.object_names
    assert names[2:] == ("car (a.1)", "walker (a.1)", "car (a.1).2")
    table = SceneSurfaces(job.scene, tuple(job.survey.materials)).materials
    assert table.semantic_class.tolist() == [2, 2, 10, 2, 10]
    np.testing.assert_allclose(table.reflectance, [0.3, 0.3, 0.1, 0.3, 0.3])


def test_who_rides_in_a_vehicle_is_no_actor(tmp_path):
    rows = "".join(
        f'<timestep time="{k}"><vehicle id="b" x="{k}" y="5" angle="90" type="car"/>'
        f'<person id="r" x="{k}" y="5" angle="90" type="walker"/>'
        '<person id="w" x="9" y="9" angle="90" type="walker"/></timestep>'
        for k in range(3)
    )
    actors = prepare(scenario(tmp_path, f"<fcd-export>{rows}</fcd-export>")).scene.actors
    assert [actor.name for actor in actors] == ["car (b)", "Person (w)"]


def test_what_is_wrong_with_traffic_is_told(tmp_path):
    nobody = scenario(tmp_path, traffic={"offset_s": 300})
    assert any("has no vehicle or person in the" in n for n in advice(prepare(nobody)))
    with pytest.raises(LidarError, match=r"traffic\.surfaces"):
        scenario(tmp_path, traffic={"surfaces": []})
    with pytest.raises(LidarError, match=r"type 'car', but no entry .* Add one, such as"):
        prepare(scenario(tmp_path, traffic={"vehicles": SHAPES[:1]}))
    with pytest.raises(LidarError, match="Set exactly one of file and box"):
        scenario(tmp_path, traffic={"vehicles": [{"types": "*"}]})
    with pytest.raises(LidarError, match=r"traffic\.file: .*no\.xml does not exist"):
        prepare(scenario(tmp_path, traffic={"file": "no.xml"}))
    with pytest.raises(LidarError, match="`surfaces` contains 'Street'"):
        prepare(scenario(tmp_path, traffic={"surfaces": "Street"}))


def carried(folder, trajectory, text=FCD, **traffic):
    """A scenario whose sensors are on a vehicle of the traffic."""
    (folder / "fcd.xml").write_text(text)
    data = {
        "scene": {"ground": {"margin_m": 60}, "copies": [{"name": "Post", "box": [1, 1, 3],
                  "at": [[0, 9, 0]]}]},
        "trajectory": trajectory,
        "mount": [0, 0, 2],
        "sensor": {"model": "velodyne/vlp16"},
        "traffic": {"file": "fcd.xml", "vehicles": SHAPES, **traffic},
    }  # fmt: skip
    return Scenario.from_data(data, folder=folder)


def test_a_vehicle_of_the_traffic_carries_the_sensors(tmp_path):
    rider = '<vehicle id="r" x="9" y="9" angle="0" type="car"/><person id="p" x="0"'
    text = FCD.replace('<person id="p" x="0"', rider)
    built = prepare(carried(tmp_path, {"vehicle": "p"}, text, offset_s=10))
    assert [actor.name for actor in built.scene.actors] == ["car (r)"]
    survey = built.survey
    assert survey.trajectory.start_s == 11 and survey.duration_ns == pytest.approx(1e9, rel=0.11)
    position, rotation = survey.trajectory.poses(0, np.array([0.5e9]))
    # The frame of the mesh, whose foremost point is where SUMO says: it walks north.
    np.testing.assert_allclose(position + built.scene.origin, [[0, 0.5 - 0.2, 0.5]], atol=1e-9)
    np.testing.assert_allclose(rotation[0, :, 0], [0, 1, 0], atol=1e-9)

    second = prepare(carried(tmp_path, {"vehicle": "a.1", "start_s": 3.25, "duration_s": 0.5}))
    assert [actor.name for actor in second.scene.actors] == []
    position, _ = second.survey.trajectory.poses(0, np.zeros(1))
    front = position + second.scene.origin + [2 * 0.5**0.5, 2 * 0.5**0.5, 0]
    np.testing.assert_allclose(front, [[42.5, 5, 0]], atol=1e-9)


def test_what_is_wrong_with_a_carrier_of_the_traffic_is_told(tmp_path):
    for trajectory, message in (
        ({"vehicle": "a.2"}, r"vehicle` is 'a\.2', but fcd\.xml does not contain .*'a\.1'"),
        ({"vehicle": 7}, r"vehicle` is '7', but .* Available names: a\.1, bus, p\."),
        (
            {"vehicle": "bus"},
            "vehicle` is 'bus', but fcd.xml does not contain this vehicle in at least two",
        ),
        ({"vehicle": "a.1"}, "from 0 to 1, 3 to 4 s. Set `trajectory.start_s`"),
        ({"vehicle": "a.1", "start_s": 2}, "from 0 to 1, 3 to 4 s. Set `trajectory.start_s`"),
        ({"vehicle": "p", "offset_s": 1}, r"not with `trajectory\.offset_s`"),
        ({"vehicle": "p", "file": "a.tum"}, "Set exactly one of file, points and vehicle"),
        ({"vehicle": ""}, "vehicle"),
    ):
        with pytest.raises(LidarError, match=message) as caught:
            prepare(carried(tmp_path, trajectory))
        assert "\n" not in str(caught.value)
    with pytest.raises(LidarError, match=r"Set `traffic\.file`"):
        Scenario.from_data({"trajectory": {"vehicle": "p"}}, folder=tmp_path)
    follower = {"name": "Van", "box": [4, 2, 2], "trajectory": {"vehicle": "p"}}
    with pytest.raises(LidarError, match="vehicles of `traffic` are already actors"):
        scenario(tmp_path, actors=[follower])
