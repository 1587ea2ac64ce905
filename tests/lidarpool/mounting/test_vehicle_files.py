"""Vehicle files: short forms, mistakes, and the files that `lidarpool mount` writes."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
import yaml
from click.testing import CliRunner

from lidarpool.cli.commands import cli
from lidarscenario.mount_sections import VehicleFile
from lidarscenario.mounting.search import listed_candidates
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarscenes.procedural.road_users import ROAD_USERS
from lidarsim import LidarError
from lidarsim.schema.vocabulary import BODIES, TARGETS

RING = {
    "name": "Rings",
    "firings_per_turn": 360,
    "rate_hz": 10,
    "range_m": [0.3, 100],
    "beams": {"elevation_deg": [round(-1.5 * n, 1) for n in range(16)]},
}
SMALL = {
    "body": "saloon",
    "sensors": {
        "left": {"model": "rings.yaml", "mounts": {"roof": [0, 0.5, 1.6], "low": [2.4, 0.6, 0.5]}},
        "right": {
            "model": "rings.yaml",
            "mounts": {"roof": [0, -0.5, 1.6], "low": [2.4, -0.6, 0.5]},
        },
    },
    "combine": "names",
    "targets": ["pedestrian", "car"],
    "region": {"distances_m": [4, 10], "bearings": 8, "headings_deg": [0]},
    "map": {"margin_m": 6, "cell_m": 0.5},
}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rings.yaml").write_text(yaml.safe_dump(RING))
    return tmp_path


def load(data):
    return VehicleFile.from_data(data)


def mount(*arguments):
    return CliRunner().invoke(cli, ["mount", *map(str, arguments)])


def sensors(mounts, **further):
    return {"top": {"model": "ouster/os1-64", "mounts": mounts, **further}}


@pytest.mark.parametrize(
    ("mounts", "names"),
    [
        ([0, 0, 1.8], ["mount"]),
        ({"position": [0, 0, 1.8], "yaw_deg": 3}, ["mount"]),
        ([[0, 0, 1.8], {"position": [1, 0, 1]}], ["1", "2"]),
        ({"roof": [0, 0, 1.8], "nose": [2, 0, 1]}, ["roof", "nose"]),
    ],
)
def test_mounts_have_short_forms(mounts, names):
    vehicle = load({"body": "van", "sensors": sensors(mounts)})
    assert [*vehicle.sensors["top"].mounts] == names
    assert [candidate.name for candidate in listed_candidates(vehicle)] == (
        [f"top {name}" for name in names] if len(names) > 1 else ["mount"]
    )


def test_mounts_are_combined_completely_or_by_name():
    two = {
        "a": {"model": "vlp16", "mounts": {"roof": [0, 1, 2], "low": [0, 1, 1]}},
        "b": {"model": "vlp16", "mounts": {"roof": [0, -1, 2], "low": [0, -1, 1]}},
        "c": {"model": "vlp16", "mounts": [2, 0, 1]},
    }
    every = [*listed_candidates(load({"body": "van", "sensors": two}))]
    assert [one.name for one in every] == [
        "a roof, b roof", "a roof, b low", "a low, b roof", "a low, b low"
    ]  # fmt: skip
    paired = [*listed_candidates(load({"body": "van", "sensors": two, "combine": "names"}))]
    assert [one.name for one in paired] == ["roof", "low"]
    assert [pose.position[2] for pose in paired[1].mounts.values()] == [1, 1, 1]


RANGES = {"x": [0, 1], "y": 0, "z": 1.8}


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"body": "saloom"}, "must be saloon, estate, van, a mesh file"),
        ({"body": {"box": [1, 1, 1], "file": "a.glb"}}, "Set exactly one of model, file and box"),
        ({"sensors": {"top": {"model": "vlp16"}}}, "Set exactly one of mounts and ranges"),
        ({"sensors": sensors([0, 0, 2], ranges=RANGES)}, "Set exactly one of mounts and ranges"),
        ({"sensors": sensors("roof")}, "must be a pose, a list of poses, or a mapping"),
        ({"sensors": sensors({"roof": [0, 0]})}, "mounts"),
        ({"sensors": sensors([0, 0, 2], mount=[0, 0, 1])}, "Unknown field 'sensors.top.mount'"),
        ({"sensors": {"top": {"model": "vlp17", "mounts": [0, 0, 2]}}}, "Did you mean 'vlp16"),
        ({"targets": ["pedestrain"]}, "pedestrain is not a built-in target. Use pedestrian"),
        ({"targets": {"truck": {}}}, "set `file` or `box`"),
        ({"targets": {"car": {"weight": 0}}}, "must have a `weight` above 0"),
        ({"traffic": "drive.yaml", "targets": ["car"]}, "`traffic` cannot be combined"),
        ({"rank": {"height_m": 0.5}}, "must be one of the heights in map.heights_m"),
        ({"sensors": sensors({"low": [0, 0, -1.75]})}, "top: mounts: low: z is -1.75 m"),
        (
            {"sensors": {"top": {"model": "vlp16", "ranges": RANGES | {"z": [-0.1, 1]}}}},
            "top: ranges: z is -0.1 m, but a sensor must be above the ground",
        ),
        (
            {"sensors": sensors([0, 0, 2], performance="datasheet", model="hesai/at128")},
            "Omit `performance`, and set `noise` instead",
        ),
        ({"region": {"distances_m": [-1]}}, "region.distances_m"),
        ({"region": {"bearings": 720, "headings_deg": [0] * 60}}, "but the limit is 100,000"),
        ({"sensors": {"top": {"model": "vlp16", "ranges": RANGES | {"x": [1, 0]}}}}, "largest"),
        (
            {"sensors": {"top": {"model": "vlp16", "ranges": RANGES}}, "combine": "names"},
            "`combine: names` requires `mounts`",
        ),
    ],
)
def test_mistakes_are_explained(changes, says):
    with pytest.raises(LidarError) as error:
        load({"body": "saloon", "sensors": sensors([0, 0, 1.8])} | changes)
    assert says in str(error.value)


@pytest.mark.parametrize(
    ("sections", "height_m"),
    [
        ({}, 0.3),
        ({"map": {"heights_m": [0, 0.1, 0.3]}}, 0.3),
        ({"map": {"heights_m": [1, 0]}}, 1),
        ({"map": {"heights_m": [0]}}, 0),
        ({"map": {"heights_m": [0, 1]}, "rank": {"height_m": 0}}, 0),
    ],
)
def test_the_score_depends_on_a_height_of_the_map(sections, height_m):
    data = {"body": "van", "sensors": sensors([0, 0, 3])} | sections
    assert load(data).ranked_height_m == height_m


def test_names_of_mounts_must_agree():
    data = {"body": "van", "combine": "names", "sensors": {}}
    for name, key in (("a", "low"), ("b", "mid")):
        mounts = {"roof": [0, 0, 2], key: [0, 0, 1]}
        data["sensors"][name] = {"model": "vlp16", "mounts": mounts}
    with pytest.raises(
        LidarError,
        match="but the mounts of a are roof and low, and the mounts of b are roof and mid",
    ):
        load(data)


@pytest.mark.extended
def test_the_ranking_is_written(folder):
    Path("car.yaml").write_text(yaml.safe_dump(SMALL))
    outcome = mount("car.yaml", "--workers", "1")
    assert outcome.exit_code == 0, outcome.output
    assert "2 candidates, 4 simulated mounts, 30 targets" in outcome.stdout
    assert "next: lidarpool run car-mounts/best.yaml" in outcome.stdout
    written = sorted(path.name for path in Path("car-mounts").iterdir())
    assert written == ["best.yaml", "mount.json", "report.html", "targets", "vehicle.glb"]
    figures = json.loads(Path("car-mounts/mount.json").read_text())
    first, second = figures["candidates"]
    assert first["name"] == "roof" and first["score"] > second["score"]
    assert first["score"] == pytest.approx(
        first["detection_rate"] - first["blind_m2"]["0.3"] / figures["map_m2"], abs=1e-5
    )
    blind = [first["blind_m2"][height] for height in ("0", "0.3", "1", "1.7")]
    assert blind == sorted(blind, reverse=True) and blind[0] > blind[1] > 0
    best = Scenario.load("car-mounts/best.yaml")
    assert [sensor.mount.position for sensor in best.sensors.values()] == [
        (0, 0.5, 1.6), (0, -0.5, 1.6)
    ]  # fmt: skip
    assert best.sensors["left"].model == "../rings.yaml"
    assert [actor.name for actor in best.actors] == ["pedestrian", "car"]
    page = Path("car-mounts/report.html").read_text()
    assert page.count("<svg") >= 5 and "The best candidate is roof." in page
    assert "left      0.000    0.500    1.600      0.0      0.0      0.0" in outcome.stdout
    cells = re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", page))
    assert "low right 2.400 −0.600 0.500 0.0 0.0 0.0" in cells
    for one in figures["candidates"]:
        shares = " ".join(f"{100 * share:.1f} %" for share in one["detection"].values())
        assert f"{one['name']} {shares}" in cells

    Path("car-mounts/mount.json").unlink()
    again = mount("car.yaml")
    assert isinstance(again.exception, LidarError) and "already exists" in str(again.exception)


def test_any_names_make_a_scenario(folder):
    target = {"box": [1, 1, 1], "reflectance": 0.3}
    mounts = {"top\nroof": [0, 0.5, 1.6]}
    Path("car.yaml").write_text(
        yaml.safe_dump(
            SMALL
            | {"targets": {"*": target, "a[b]": target | {"reflectance": 0.6}}, "combine": "all"}
            | {"sensors": {"left": {"model": "rings.yaml", "mounts": mounts}}}
            | {"noise": {"detection_range_m": 60}, "weather": {"visibility_km": 0.4}}
        )
    )
    outcome = mount("car.yaml", "--workers", "1")
    assert outcome.exit_code == 0, outcome.output
    best = Scenario.load("car-mounts/best.yaml")
    assert best.noise.detection_range_m == 60
    assert best.weather.visibility_km == 0.4
    assert [*yaml.safe_load(Path("car-mounts/best.yaml").read_text())] == [
        "scene", "sensors", "poses", "actors", "materials", "noise", "weather", "cloud"
    ]  # fmt: skip
    survey = prepare(best).survey
    found = {material.objects: material.reflectance for material in survey.materials}
    assert found == {("[*]",): 0.3, ("a[[]b]",): 0.6, ("*",): 0.1}


def test_built_in_names_are_listed_once():
    assert [*ROAD_USERS] == [*TARGETS]
    for name, make in ROAD_USERS.items():
        mesh = make()
        low, high = mesh.bounds
        assert mesh.name == name and low[2] == pytest.approx(0, abs=1e-6) and high[2] < 1.8
        assert np.abs(low[:2] + high[:2]).max() < 0.5  # centered, as footprints are
        assert load({"body": [*BODIES], "sensors": sensors([0, 0, 3]), "targets": [name]})


def test_workers_are_not_combined_with_a_cluster(folder):
    outcome = mount("car.yaml", "--workers", 2, "--scheduler", "tcp://127.0.0.1:9")
    assert outcome.exit_code == 2 and "cannot be combined" in outcome.output


@pytest.mark.extended
def test_ranges_are_searched_with_the_stated_seed(folder):
    """Of heights from 0.6 to 2.2 m and pitches of up to 20°, a lone sensor sees most from above."""
    from lidarscenario.mounting.study import MountStudy

    data = {
        **SMALL,
        "combine": "all",
        "sensors": {
            "top": {
                "model": "rings.yaml",
                "ranges": {"x": 0, "y": 0, "z": [0.6, 2.2], "pitch_deg": [-20, 20]},
            }
        },
        "search": {"samples": 4, "refinements": 2, "seed": 3},
    }
    first, again = (MountStudy.from_file(load(data)).run(workers=1) for _ in range(2))
    assert [one.candidate for one in first.ranked] == [one.candidate for one in again.ranked]
    assert first.best.candidate.name == "mount 1" and first.mounts == len(first.ranked) >= 8
    poses = [one.candidate.mounts["top"] for one in first.ranked]
    assert all(0.6 <= pose.position[2] <= 2.2 and abs(pose.pitch_deg) <= 20 for pose in poses)
    sampled = {p for p in poses if p.position[2] == 1.4 and p.pitch_deg == 0}
    assert sampled  # the center of the ranges
    assert first.best.candidate.mounts["top"].position[2] > 1.6
    scores = [one.score for one in first.ranked]
    assert scores == sorted(scores, reverse=True)
    data["search"]["seed"] = 4
    other = MountStudy.from_file(load(data)).run(workers=1)
    assert {*poses} != {one.candidate.mounts["top"] for one in other.ranked}


DRIVE = """\
scene: {ground: {margin_m: 10}}
trajectory:
  points: [{time_s: 0, position: [0, 0, 0]}, {time_s: 2, position: [20, 0, 0]}]
sensor: velodyne/vlp16
mount: [0, 0, 2]
actors:
  - {name: Own, box: [4, 2, 1.5]}
  - {name: Car.1, box: [4, 1.8, 1.5], at: {position: [15, 6, 0], yaw_deg: 180}}
  - {name: Far, box: [4, 1.8, 1.5], at: [300, 0, 0]}
"""


def test_a_missing_scenario_is_reported_with_its_field(folder):
    from lidarscenario.mounting.study import MountStudy

    Path("file.yaml").write_text("")
    data = {"body": "saloon", "sensors": sensors([0, 0, 1.8]), "traffic": "drive.yaml"}
    with pytest.raises(LidarError) as raised:
        MountStudy.from_file(load(data))
    assert str(raised.value) == "vehicle file: traffic.scenario: drive.yaml does not exist."


@pytest.mark.extended
def test_traffic_is_in_the_report(folder):
    Path("drive.yaml").write_text(DRIVE)
    Path("car.yaml").write_text(
        "body: saloon\nsensors: {top: {model: rings.yaml, mounts: [[0, 0, 1.8], [2, 0, 1.2]]}}\n"
        "traffic: drive.yaml\nmap: {cell_m: 1}\n"
    )
    outcome = mount("car.yaml", "--workers", "1")
    assert outcome.exit_code == 0, outcome.output
    assert "2 candidates, 2 simulated mounts, 2 targets" in outcome.stdout
    assert "do not limit the range of top" in outcome.stdout
    best = Scenario.load("car-mounts/best.yaml")
    assert [actor.name for actor in best.actors] == ["Car.1"]
    figures = json.loads(Path("car-mounts/mount.json").read_text())
    told = json.loads(mount("car.yaml", "--workers", 1, "--overwrite", "--json").stdout)
    assert told == figures


def test_targets_follow_the_traffic_of_a_scenario(folder):
    """A parked car at (15, 6) is 15 m ahead at the start, and 5 m ahead after 1 s."""
    from lidarscenario.mounting.study import MountStudy

    Path("drive.yaml").write_text(DRIVE)
    data = {"body": "saloon", "sensors": sensors([0, 0, 1.8])}
    data["traffic"] = {"scenario": "drive.yaml", "classes": {"car": "Car*", "other": "*"}}
    placements = MountStudy.from_file(load(data)).placements
    np.testing.assert_allclose(placements.positions, [[15, 6, 0], [5, 6, 0]], atol=1e-6)
    np.testing.assert_allclose(np.abs(placements.headings_deg), 180, atol=1e-6)
    assert [target.name for target in placements.targets] == ["car", "other"]
    assert placements.target.tolist() == [0, 0]
    data["traffic"]["classes"] = {"bus": "Bus*"}
    with pytest.raises(LidarError, match=r"No actor of drive\.yaml"):
        MountStudy.from_file(load(data))
