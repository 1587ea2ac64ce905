"""`lidarpool flight`: what it prints and writes, and that check and report know the plan."""

import json

import numpy as np
import pytest
import yaml
from PIL import Image

from lidarpool import read_cloud
from lidarscenario.scenario import Scenario
from lidarsim.motion.trajectory_files import load_trajectory

FLIGHT = ("--sensor", "riegl-vq780i", "--agl", "120", "--speed", "10-20", "--density", "4")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--overlap", "99%"), "'99%' is not a valid overlap. Expected a value from 0% to 95%"),
        (("--overlap", "0.99"), "'0.99' is not a valid overlap. Expected a value from 0% to 95%"),
        (("--overlap", "1.5"), "'1.5' is not a valid overlap. Expected a value from 0% to 95%"),
        (("--heading", "nan"), "'nan' is not a finite number"),
        (("--agl", "inf"), "inf is not in the range"),
        (("--speed", "12-4"), "the lower limit must come first. Use `--speed 4-12`"),
        (("--speed", "0-4"), "'0-4' is not a valid speed. Expected a speed from 0.1 to 400"),
        pytest.param(
            ("--unit", "mm"),
            "`--unit` and `--up-axis` require a terrain.",
            marks=pytest.mark.extended,
        ),
        (("--fov", "80"), "`--fov` is 80°, but the field of view of RIEGL VQ-780i"),
    ],
)
def test_options_that_are_refused(folder, lidarpool, arguments, words):
    outcome = lidarpool("flight", "0,0,100,50", *FLIGHT, *arguments)
    assert outcome.code != 0
    assert words in " ".join(outcome.err.split())


@pytest.mark.extended
def test_bounds_may_start_with_a_minus_sign(folder, lidarpool):
    outcome = lidarpool("flight", "-75,-50,75,50", *FLIGHT, "--json")
    assert outcome.code == 0, outcome.err
    assert json.loads(outcome.out)["lines"][0]["start"][0] == pytest.approx(-77)


@pytest.mark.extended
def test_a_plan_over_level_ground(folder, lidarpool):
    outcome = lidarpool("flight", "0,0,200,100", *FLIGHT, "--cross", "1", "--epsg", "25832")
    assert outcome.code == 0, outcome.err
    assert outcome.out.startswith("1 flight line and 1 cross strip, ")
    assert outcome.out.endswith(
        "plan in area-flight: flight.yaml, path.csv, flight.png, flight.geojson, flight.kml\n"
        "next: lidarpool check area-flight/flight.yaml\n"
    )
    scenario = Scenario.load("area-flight/flight.yaml")
    assert [*scenario.sensors] == ["line-1", "cross-1"]
    assert scenario.flight.density_m2 == 4
    assert scenario.world.epsg == 25832
    path = load_trajectory(folder / "area-flight/path.csv")
    start_s = scenario.sensors["line-1"].start_s
    assert path.pose(0, start_s * 1e9).position == pytest.approx((-2, 50, 120), abs=0.01)
    with Image.open(folder / "area-flight/flight.png") as image:
        assert image.size == (1600, 1000)
    again = lidarpool("flight", "0,0,200,100", *FLIGHT)
    assert again.code == 2
    assert "area-flight/flight.yaml already exists" in again.err


@pytest.mark.extended
def test_check_and_report_compare_the_density_with_the_plan(folder, lidarpool):
    outcome = lidarpool("flight", "0,0,200,100", *FLIGHT, "--cross", "1", "--json")
    figures = json.loads(outcome.out)
    assert figures["strip_density_m2"] == pytest.approx([4, 4], rel=0.02)
    expected = figures["density"]
    checked = json.loads(lidarpool("check", "area-flight/flight.yaml", "--json").out)["flight"]
    assert checked == pytest.approx(expected)
    run = lidarpool("run", "area-flight/flight.yaml", "--out", "result", "--cloud-only")
    assert run.code == 0, run.err
    found = json.loads((folder / "result/report.json").read_text())["flight"]
    assert found["mean_m2"] == pytest.approx(expected["mean_m2"], rel=0.03)
    assert found["planned_m2"] == 4
    points = read_cloud(folder / "result/cloud.ply").positions
    inside = ((points[:, :2] > 0) & (points[:, :2] < (200, 100))).all(axis=1)
    assert found["mean_m2"] == pytest.approx(inside.sum() / 20_000, rel=0.03)


@pytest.mark.slow
def test_a_geojson_area_is_planned_in_its_utm_zone(folder, lidarpool):
    ring = [[9.1800, 48.7700], [9.1840, 48.7700], [9.1840, 48.7712], [9.1800, 48.7700]]
    area = {"type": "Polygon", "coordinates": [ring]}
    (folder / "site.geojson").write_text(json.dumps(area))
    outcome = lidarpool("flight", "site.geojson", *FLIGHT)
    assert outcome.code == 0, outcome.err
    data = yaml.safe_load((folder / "site-flight/flight.yaml").read_text())
    assert data["world"]["epsg"] == 32632
    assert np.abs(data["flight"]["area"]).max() < 400
    features = json.loads((folder / "site-flight/flight.geojson").read_text())["features"]
    corners = np.array(features[0]["geometry"]["coordinates"][0])
    assert np.sort(corners[:-1, 0]) == pytest.approx(np.sort([r[0] for r in ring[:-1]]), abs=1e-7)
