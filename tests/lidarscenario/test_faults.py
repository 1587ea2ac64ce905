"""Faults of sensors: what each does, that nothing else changes, and that labels list it."""

from __future__ import annotations

import io
import json
import tarfile
from dataclasses import replace

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from tests.shapes import block, wall

from lidarfiles.clouds.boxes import Boxes
from lidarfiles.clouds.images import RayImage
from lidarfiles.clouds.ros.bags import Rosbag2
from lidarfiles.clouds.webdataset import WebDataset
from lidarfiles.clouds.writing import ExportSpec
from lidarfiles.datasets.job_table import JobRow
from lidarfiles.datasets.sweep_data import sweep_of_job
from lidarscenario.campaign.campaign import CampaignSpec
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarsim import (
    Actor,
    Cloud,
    Fault,
    LidarError,
    Mounted,
    Noise,
    Pose,
    Returns,
    Scene,
    Sensor,
    Survey,
    Track,
    load_sensor,
)
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.rig import Rig
from lidarsim.sweeps.sweeps import Sweeps

LIDAR = load_sensor("velodyne/vlp16")  # 1808.4 firings a turn: sweeps do not repeat firings
COLUMNS = ("time", "range", "intensity", "azimuth", "elevation", "ray", "object")
ROOM = Scene.from_meshes([block("Room", (12, 9, 8))])
STANDING = Survey(LIDAR, poses=[(0.5, 0, 0)], steps=108, columns=COLUMNS)
DRIVE = replace(STANDING, poses=(), trajectory=Track([0, 1], [(0, 0, 0), (3, 1, 0)]), steps=108)
STATIONS = replace(STANDING, trajectory=None, poses=[(0, 0, 0), (1, 0, 0), (2, 0, 1)], steps=50)
SWEEP = 36  # scans


def cast(survey, size=10_000, backend="tiles", scene=ROOM):
    """Columns of a survey, cast so many scans at a time, with `scan` and the counts."""
    rig = Rig(scene, survey, backend, threads=1)
    parts = [
        columns_of([*rig.cast(first, min(first + size, survey.scan_count))])
        for first in range(0, survey.scan_count, size)
    ]
    columns = {c: np.concatenate([part.columns[c] for part in parts]) for c in parts[0].columns}
    counts = np.concatenate([part.counts for part in parts])
    return columns | {"scan": np.repeat(np.arange(len(counts)), counts)}


def same(one, other, but=()):
    return all(np.array_equal(one[name], other[name]) for name in one if name not in but)


def rows(columns, which):
    return {name: values[which] for name, values in columns.items()}


@pytest.fixture(scope="module")
def bare():
    return cast(STANDING)


FAULTS = {
    "dirt": Fault("dirt", 0.05, 0.2, transmission=0.3, azimuth_deg=(-20, 20)),
    "dead channels": Fault("dead_channels", 0.05, 0.2, channels=[3, 7]),
    "packets": Fault("dropped_packets", share=0.2, packet=12),
    "frozen": Fault("frozen", 0.15, 0.25),
    "time jump": Fault("time_jump", 0.05, by_s=-0.5),
}
SURVEYS = {"standing": STANDING, "drive": DRIVE, "stations": STATIONS}


@pytest.mark.extended(every=3)
@pytest.mark.parametrize("place", SURVEYS)
def test_batches_and_backends_do_not_matter(place):
    survey = replace(SURVEYS[place], faults=[*FAULTS.values()])
    assert not same(whole := cast(survey), cast(SURVEYS[place]))
    assert same(whole, cast(survey, 7)) and same(whole, cast(survey, backend="numpy"))


@pytest.mark.extended
@pytest.mark.parametrize("kind", FAULTS)
def test_other_sensors_keep_their_points(kind):
    two = [Mounted(LIDAR, name="left"), Mounted(LIDAR, Pose((1, 0, 0)), name="right")]
    survey = Survey(sensors=two, poses=[(0, 0, 0)], steps=108, columns=COLUMNS)
    before = cast(survey)
    after = cast(replace(survey, faults=[replace(FAULTS[kind], sensor="right")]))
    kept = [rows(columns, columns["scan"] < 108) for columns in (before, after)]
    assert same(*kept) and not same(before, after)


def test_dirt_takes_energy_in_its_sector_while_it_is_there(bare):
    found = cast(replace(STANDING, faults=[FAULTS["dirt"]]))
    assert same(found, bare, but=["intensity"])
    azimuth = (bare["azimuth"] + 180) % 360 - 180
    time = bare["time"] / 1e9
    dirty = (np.abs(azimuth) <= 20) & (time >= 0.05) & (time < 0.2)
    assert 0.02 < dirty.mean() < 0.1
    expected = bare["intensity"] * np.where(dirty, 0.3, 1)
    np.testing.assert_allclose(found["intensity"], expected, rtol=1e-6)
    low = Fault("dirt", transmission=0, azimuth_deg=(90, -90), elevation_deg=(-15, 0))
    behind = (bare["azimuth"] >= 90) & (bare["azimuth"] <= 270) & (bare["elevation"] <= 0)
    assert same(cast(replace(STANDING, faults=[low])), rows(bare, ~behind))


def test_dirt_shortens_the_range_of_detection():
    """Where 50 % of reflectance return 20 times the threshold, with 5 % of it half are lost."""
    scene = Scene.from_meshes([wall("Wall", 50)])
    sensor = Sensor.grid(4000, 1, 1, step_deg=360, horizontal_fov_deg=0.9)
    survey = Survey(
        sensor, poses=[(0, 0, 0)], steps=4, noise=Noise(detection_range_m=100), columns=COLUMNS
    )
    count = [
        len(cast(replace(survey, faults=faults), scene=scene)["x"])
        for faults in ((), [Fault("dirt", transmission=0.05)])
    ]
    assert count[0] == survey.ray_count > 4000
    assert abs(count[1] / count[0] - 0.5) < 4.5 * 0.5 / np.sqrt(count[0])


@pytest.mark.extended(keep=("none",))
@pytest.mark.parametrize("waveform", ["none", "gaussian"])
def test_dirt_is_before_all_light(waveform):
    """With sub-rays, rain and echoes: returns of the air are weaker, too."""
    survey = replace(
        STANDING, returns=Returns("all", 7, 3, waveform=waveform), rain_mm_h=30, steps=3,
        noise=Noise(detection_range_m=90), columns=(*COLUMNS, "cause"),
    )  # fmt: skip
    clear = cast(survey)
    thin, shut = (
        cast(replace(survey, faults=[Fault("dirt", transmission=share)])) for share in (0.5, 0)
    )
    assert not len(shut["x"])
    assert 0 < (thin["cause"] == 1).sum() < 0.8 * (clear["cause"] == 1).sum()


def test_dead_channels_return_nothing_while_they_are_dead(bare):
    time = bare["time"] / 1e9
    dead = np.isin(bare["channel"], [3, 7]) & (time >= 0.05) & (time < 0.2)
    assert same(cast(replace(STANDING, faults=[FAULTS["dead channels"]])), rows(bare, ~dead))
    noise = Noise(detection_range_m=90, false_alarm_hz=2e5)
    lidar = load_sensor("velodyne/vlp16", max_range_m=100)
    alarmed = replace(
        STANDING, sensor=lidar, noise=noise, faults=[Fault("dead_channels", channels=[3])]
    )
    assert 3 in cast(replace(alarmed, faults=()))["channel"]
    assert 3 not in cast(alarmed)["channel"]


def test_packets_are_lost_as_a_whole(bare):
    survey = replace(STANDING, faults=[FAULTS["packets"]])
    firsts = np.array([survey.scan(scan).firings[0] for scan in range(survey.scan_count)])
    packets = [
        np.unique((firsts[columns["scan"]] + columns["ray"] // 16) // 12, return_counts=True)
        for columns in (bare, cast(survey))
    ]
    (every, all_points), (there, points) = packets
    assert np.array_equal(points, all_points[np.isin(every, there)])
    lost = 1 - len(there) / len(every)
    count = len(every)
    assert abs(lost - 0.2) < 4.5 * np.sqrt(0.2 * 0.8 / count)
    other = cast(replace(survey, noise=Noise(seed=1)))
    assert not np.array_equal(other["scan"], cast(survey)["scan"])


def test_a_frozen_sensor_sends_the_last_sweep_again(bare):
    """Sweeps that begin from 0.15 to 0.25 s, the third, repeat the second."""
    found = cast(replace(STANDING, faults=[FAULTS["frozen"]]))
    first, second, third = (
        rows(found, (found["scan"] >= k * SWEEP) & (found["scan"] < (k + 1) * SWEEP))
        for k in range(3)
    )
    assert same(second, third, but=["time", "scan"])
    late = third["time"] - second["time"]
    begins = STANDING.begins_ns(2 * SWEEP) - STANDING.begins_ns(SWEEP)
    assert (late == round(begins)).all() and np.array_equal(third["scan"], second["scan"] + SWEEP)
    assert same(rows(found, found["scan"] < 2 * SWEEP), rows(bare, bare["scan"] < 2 * SWEEP))
    assert first["ray"].size


def test_a_frozen_sensor_takes_its_points_along():
    """They stay where they were in its axes: in the world, they move as it does."""
    survey = replace(DRIVE, faults=[FAULTS["frozen"]], precision_m=0.001)
    sweeps = Sweeps.from_survey(survey, ROOM)
    found = cast(survey)
    places = np.stack([found[axis] for axis in "xyz"], axis=1) * survey.precision_m
    inside = [
        sweeps.in_sensor(
            k, places[(found["scan"] >= k * SWEEP) & (found["scan"] < (k + 1) * SWEEP)]
        )
        for k in (1, 2)
    ]
    assert np.abs(inside[0] - inside[1]).max() <= 0.0011
    assert np.linalg.norm(sweeps.pose.positions[2] - sweeps.pose.positions[1]) > 0.3


def test_faults_may_follow_each_other(bare):
    faults = [Fault("frozen", 0.05, 0.15), Fault("frozen", 0.15), Fault("time_jump", 0.15, by_s=1)]
    found = cast(replace(STANDING, faults=faults))
    first, *others = (rows(found, found["scan"] // SWEEP == k) for k in range(3))
    assert all(same(first, other, but=["time", "scan"]) for other in others)
    since = [other["time"] - first["time"] for other in others]
    turns = [round(STANDING.begins_ns(k * SWEEP) - STANDING.begins_ns(0)) for k in (1, 2)]
    assert (since[0] - turns[0] == 1_000_000_000 * (others[0]["time"] > 1e9)).all()
    assert (since[1] - turns[1] == 1_000_000_000).all()


def test_a_time_jump_shifts_stamps_alone(bare):
    found = cast(replace(STANDING, faults=[FAULTS["time jump"]]))
    assert same(found, bare, but=["time"])
    assert np.array_equal(found["time"] - bare["time"], -500_000_000 * (bare["time"] >= 50_000_000))


def test_images_find_the_rays_of_frozen_sweeps():
    survey = replace(DRIVE, faults=[FAULTS["frozen"]], keep_every=1)
    sweeps = Sweeps.from_survey(survey, ROOM)
    found = cast(survey)
    some = rows(found, (found["scan"] >= 2 * SWEEP) & (found["scan"] < 3 * SWEEP))
    points = Cloud(np.zeros((len(some["scan"]), 3)), {name: some[name] for name in ("scan", "ray")})
    image = RayImage.from_points(sweeps, 2, points)
    azimuth = image.ray_arrays()["azimuth"][image.row, image.column]
    np.testing.assert_allclose(azimuth, some["azimuth"], atol=1e-4)


def clouds(survey, scene):
    """Sweeps of a survey and their points."""
    sweeps = Sweeps.from_survey(survey, scene)
    found = cast(survey, scene=scene)
    places = np.stack([found.pop(axis) for axis in "xyz"], axis=1) * survey.precision_m
    return sweeps, Cloud(places, found)


def test_labels_list_the_faults_of_each_sweep(tmp_path):
    faults = [FAULTS["dead channels"], replace(FAULTS["time jump"], from_s=0.22)]
    survey = replace(STANDING, faults=faults, columns=(*COLUMNS, "class"))
    sweeps, cloud = clouds(survey, ROOM)
    sweeps.save(tmp_path / "sweeps.npz")
    again = Sweeps.load(tmp_path / "sweeps.npz")
    kinds = [[one.kind for one in again.faults_in(k)] for k in range(3)]
    assert kinds == [["dead_channels"], ["dead_channels"], ["time_jump"]]
    frozen = Sweeps.from_survey(replace(STANDING, faults=[FAULTS["frozen"]]), ROOM)
    assert [len(frozen.faults_in(k)) for k in range(3)] == [0, 0, 1]  # those that repeat another
    job = JobRow(0, "0", "", {}, {})
    assert sweep_of_job(job, again, 2, (None, {}), None, compensated=True).faults[0].by_s == -0.5
    output = WebDataset(cloud, sweeps)
    told = [
        b"".join(output.sample_files(k, points, None))
        for k, points in enumerate(sweeps.points(cloud))
    ]
    with tarfile.open(fileobj=io.BytesIO(told[2] + bytes(1024))) as tar:
        (name,) = [name for name in tar.getnames() if name.endswith("json")]
        about = json.load(tar.extractfile(name))
    assert about["faults"] == [{"kind": "time_jump", "from_s": 0.22, "by_s": -0.5}]
    assert about["time_ns"] == round(survey.begins_ns(2 * SWEEP))
    assert b'"faults"' not in Sweeps.from_survey(STANDING, ROOM).to_bytes()


@pytest.mark.extended
def test_bags_have_wrong_stamps_and_boxes_true_places(tmp_path):
    crate = Actor(block("Crate", (1, 1, 1)), Track([0, 1], [(3, 0, 0), (3, 2, 0)]))
    scene = ROOM.with_actors([crate])
    survey = replace(STANDING, columns=(*COLUMNS, "class"))
    bags = []
    boxes = []
    for faults in ((), [Fault("time_jump", 0.1, by_s=-7.5)]):
        sweeps, cloud = clouds(replace(survey, faults=faults), scene)
        boxes.append(
            [Boxes.from_points(sweeps, k, points) for k, points in enumerate(sweeps.points(cloud))]
        )
        Rosbag2(cloud, sweeps).write(path := tmp_path / f"{len(bags)}", ExportSpec("rosbag2"))
        with AnyReader([path]) as bag:
            bags.append([
                (bag.deserialize(data, one.msgtype), when)
                for one, when, data in bag.messages(bag.connections)
                if one.topic == "/points"
            ])  # fmt: skip
    for number, ((right, begun), (wrong, same_time)) in enumerate(zip(*bags, strict=True)):
        stamps = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in (right, wrong)]
        assert begun == same_time == stamps[0]
        assert stamps[1] - stamps[0] == (number > 0) * -7_500_000_000
        assert number == 0 or np.array_equal(right.data, wrong.data)  # times since the stamp
    for one, other in zip(*boxes, strict=True):
        np.testing.assert_allclose(one.centers, other.centers, atol=0.005)


WRONG = {
    "Unknown sensor 'roof'": Fault("frozen", 0.1, sensor="roof"),
    "Channel 99 does not exist. The channels are 0 to 15": Fault("dead_channels", channels=[3, 99]),
    "from_s must be less than the duration of the survey": Fault("frozen", 10),
    "repeats its previous sweep, so from_s must be after": Fault("frozen"),
}


@pytest.mark.parametrize("words", WRONG)
def test_what_does_not_fit_the_survey(words):
    with pytest.raises(LidarError, match=words) as caught:
        replace(STANDING, faults=[FAULTS["dirt"], WRONG[words]])
    assert str(caught.value).startswith("faults[1]: ")


def test_numbers_of_numpy_and_sets_are_as_good(tmp_path):
    """In labels as well, which are JSON."""
    faults = [
        Fault("dead_channels", np.float32(0.25), channels=np.arange(2)),
        Fault("dead_channels", channels={1}),
        Fault("dropped_packets", share=np.float32(0.5), packet=np.int64(3)),
        Fault("dirt", transmission=1, azimuth_deg=np.array([1, 2])),
    ]
    Sweeps.from_survey(replace(STANDING, faults=faults), ROOM).save(tmp_path / "sweeps.npz")
    assert [*Sweeps.load(tmp_path / "sweeps.npz").faults] == faults
    assert faults[0].channels == (0, 1)


PACKETS = {"share": 0.1, "packet": 9}


@pytest.mark.parametrize(
    ("words", "fields"),
    [
        ("Set transmission", {"kind": "dirt"}),
        ("Remove share", {"kind": "frozen", "share": 0.5}),
        ("share and packet. Remove by_s", {"kind": "dropped_packets", **PACKETS, "by_s": 1}),
        (("to_s must be greater than from_s .2., "
          "but is 1"), {"kind": "frozen", "from_s": 2, "to_s": 1}),
        ("to_s must be greater than from_s", {"kind": "frozen", "from_s": 2, "to_s": 2}),
        ("least, largest", {"kind": "dirt", "transmission": 1, "elevation_deg": [2, 1]}),
    ],
)  # fmt: skip
def test_what_is_no_fault(words, fields):
    with pytest.raises(LidarError, match=words):
        Scenario.from_data({"faults": [fields]})
    with pytest.raises(LidarError, match=words):
        Fault(**fields)


@pytest.mark.parametrize(
    ("in_file", "in_python", "fields"),
    [
        (
            "kind cannot be 'dirrt'. Did you mean 'dirt'",
            "kind must be 'dirt', .* but is 'dirrt'",
            {"kind": "dirrt"},
        ),
        (
            "transmission must be from 0 to 1, but is 2",
            "transmission must be a number from 0 to 1 or None, but is 2",
            {"kind": "dirt", "transmission": 2},
        ),
    ],
)
def test_values_that_no_fault_has(in_file, in_python, fields):
    with pytest.raises(LidarError, match=in_file):
        Scenario.from_data({"faults": [fields]})
    with pytest.raises(LidarError, match=in_python):
        Fault(**fields)


def test_scenarios_and_campaigns(tmp_path):
    base = tmp_path / "base.yaml"
    base.write_text(
        "scene: seed\nposes: [[0, 0, 1]]\nsensor: velodyne/vlp16\n"
        "faults:\n  - {kind: dirt, azimuth_deg: [-20, 20], transmission: 0.3}\n"
        "  - {kind: frozen, from_s: 0.05}\n"
    )
    given = prepare(Scenario.load(base)).survey.faults
    assert given[0] == Fault("dirt", transmission=0.3, azimuth_deg=(-20, 20))
    campaign = tmp_path / "campaign.yaml"
    campaign.write_text(
        "base: base.yaml\ncount: 3\nseed: 1\nkeep: kitti\nvary:\n"
        "  faults.0.transmission: {uniform: [0.1, 0.9]}\n"
        "  faults.1.from_s: {choice: [0.02, 0.05]}\n"
    )
    spec = CampaignSpec.load(campaign)
    faults = [spec.job(number).survey.faults for number in range(3)]
    assert len({one[0].transmission for one in faults}) == 3
    assert {one[1].from_s for one in faults} <= {0.02, 0.05}
