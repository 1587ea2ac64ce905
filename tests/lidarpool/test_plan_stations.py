"""Stations for terrestrial scans: areas that are known by hand, and where nobody can stand."""

import json
import pickle
import re
from contextlib import contextmanager

import numpy as np
import pytest
from click.testing import CliRunner
from tests.shapes import block, level, quad, wall

from lidarpool.cli.commands import cli
from lidarscenario.plan import stations
from lidarscenario.plan.stations import (
    StationVisibility,
    candidates,
    plan_stations,
    sensor_elevations,
    survey_coverage,
)
from lidarscenes.writers.scene_file import write_scene
from lidarsim import LidarError, Scene, SceneMesh, Sensor, box, load_sensor
from raybeam import RayCaster

EVERYWHERE = Sensor.grid(vertical_fov_deg=180)


def placed(name, size, place):
    """Put a box of a size with the middle of its underside at a place."""
    return block(name, size, np.add(place, (0, 0, size[2] / 2)))


def rooms(*partitions):
    """Return two rooms, 12 x 6 x 3 m, without a ceiling, parted by walls along y."""
    return [
        placed("Floor", (12.4, 6.4, 0.2), (0, 0, -0.2)),
        placed("North", (12.4, 0.2, 3), (0, 3.1, 0)),
        placed("South", (12.4, 0.2, 3), (0, -3.1, 0)),
        placed("West", (0.2, 6, 3), (-6.1, 0, 0)),
        placed("East", (0.2, 6, 3), (6.1, 0, 0)),
        *(
            placed("Partition", (0.2, end - start, 3), (x, (start + end) / 2, 0))
            for x, start, end in partitions
        ),
    ]


POLES = [placed(f"Pole-{x}", (0.2, 0.2, 3), (x, 0, 0)) for x in (-10, 10)]


def areas(plan, scene):
    return {
        name: (visible, covered)
        for name, visible, covered in zip(
            scene.names, plan.reachable_m2, plan.covered_m2, strict=True
        )
    }


@pytest.mark.parametrize("faces_up", [True, False])
def test_a_side_is_visible_in_range_in_view_and_not_too_slanted(faces_up):
    """A floor below and beside a station, with a screen that hides a part of it."""
    floor = level("Floor", 0.3, half=9, middle=(1, -2))
    if not faces_up:
        floor = SceneMesh("Floor", floor.vertices, floor.faces[:, ::-1])
    screen = quad("Screen", (3, 0, 0), (3, 6, 0), (3, 6, 6), (3, 0, 6))
    scene = Scene.from_meshes([floor, screen])
    station = np.array([1.0, -1.5, 2.0])
    random = np.random.default_rng(4)
    points = random.uniform((-6, -9, 0.3), (9, 6, 0.3), (3000, 3))
    local = points - scene.origin
    normals = np.tile([0.0, 0.0, 1.0 if faces_up else -1.0], (3000, 1))
    offsets = points - station
    distance = np.linalg.norm(offsets, axis=1)
    # Rays cross the plane of the screen at its height and width.
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (3 - station[0]) / offsets[:, 0]
        crossing = station + share[:, None] * offsets
    hidden = (share > 0) & (share < 1) & (crossing[:, 1] > 0) & (crossing[:, 2] > 0)
    assert hidden.sum() > 100
    for sensor, slant_deg in (
        (Sensor.grid(vertical_fov_deg=180, min_range_m=2.5, max_range_m=6.0), 90),
        (Sensor.grid(vertical_fov_deg=80), 90),
        (Sensor.grid(vertical_fov_deg=180), 55),
    ):
        low, high = sensor_elevations(sensor)
        sine = offsets[:, 2] / distance
        expected = ~hidden & (distance >= sensor.min_range_m) & (distance <= sensor.max_range_m)
        expected &= (sine >= low) & (sine <= high) & (-sine >= np.cos(np.radians(slant_deg)))
        sight = StationVisibility(scene, sensor, slant_deg)
        found = sight.visible_sides(station - scene.origin, local, normals)
        # A few points are closer to a limit than the tolerance.
        assert (found == np.where(expected, 1 if faces_up else -1, 0)).mean() > 0.998
        assert 200 < expected.sum() < 2800
    below = station * (1, 1, -1)
    under = StationVisibility(scene, EVERYWHERE, 90).visible_sides(
        below - scene.origin, local, normals
    )
    assert set(under[distance < 2].tolist()) == {-1 if faces_up else 1}


def test_elevations_of_a_sensor_are_those_of_its_outermost_rays():
    low, high = sensor_elevations(Sensor.grid(vertical_fov_deg=60))
    assert (low, high) == pytest.approx((-0.5, 0.5), abs=0.02)
    low, high = sensor_elevations(load_sensor("velodyne/hdl32e"))
    assert np.degrees(np.arcsin([low, high])) == pytest.approx((-30.67, 10.67), abs=0.05)


def places(meshes, spacing_m, height_m=1.5):
    """Return the candidate positions in world coordinates."""
    scene = Scene.from_meshes(meshes)
    caster = RayCaster(scene.vertices, scene.faces)
    return candidates(scene, caster, height_m, spacing_m) + scene.origin


def test_candidates_are_on_the_floor_with_space_around_and_above_them():
    floor = placed("Floor", (8, 4, 0.2), (10, -20, 0.1))  # its top is at 0.3 m
    curb = placed("Curb", (8, 1, 0.15), (10, -18.5, 0.3))
    stage = placed("Stage", (1, 3, 1.3), (13.5, -20.5, 0.3))
    roof = placed("Roof", (2, 3, 0.1), (7, -20.5, 2.0))
    pole = placed("Pole", (0.4, 0.4, 3), (9.9, -20.6, 0.3))
    found = places([floor, curb, stage, roof, pole], 1.0)
    expected = [
        (x + 0.5, y + 0.5, 1.8 + 0.15 * (y == -19))
        for x in range(6, 14)
        for y in range(-22, -18)
        if y == -19 or not (x == 13 or x < 8)  # neither on the stage nor below the roof
    ]
    expected.remove((9.5, -20.5, 1.8))  # 0.2 m from the pole
    np.testing.assert_allclose(sorted(found.tolist()), sorted(expected), atol=1e-4)
    assert len(places([floor, curb, stage, roof, pole], 1.0, height_m=1.35)) == len(expected) + 6


def test_candidates_climb_slopes_of_up_to_45_degrees():
    def ramp(rise):
        meshes = [
            quad("Low", (0, 0, 0), (6, 0, 0), (6, 4, 0), (0, 4, 0)),
            quad("Ramp", (6, 0, 0), (8, 0, rise), (8, 4, rise), (6, 4, 0)),
            quad("High", (8, 0, rise), (12, 0, rise), (12, 4, rise), (8, 4, rise)),
        ]
        return places(meshes, 1.0)

    assert len(ramp(1.9)) == len(ramp(-1.9)) == 48
    steep = ramp(3.0)
    assert len(steep) == 28 and steep[:, 0].max() < 7  # the lower half of the ramp is 0.75 m high
    assert ramp(1.9)[:, 2].max() == pytest.approx(3.4, abs=1e-4)


def test_a_cloud_covers_what_its_stations_see_near_its_points():
    """Of two sheets, a station sees one from the front, another sees both sides of the other."""
    sheets = [wall("Near", 2, (-1, 1), (0, 2)), wall("Far", 6, (-2, 2), (0, 2))]
    scene = Scene.from_meshes([*sheets, level("Ground", -5, half=1, middle=(40, 40))])
    positions = np.array([[0.0, 0, 1], [8.0, 0, 1], [4.0, 0, 1]])
    y, z = np.mgrid[-2:0:0.05, 0:2:0.05].reshape(2, -1)
    clouds = [
        np.stack([6 + 0 * y, y, z], axis=1),
        np.zeros((0, 3)),
        np.stack([2 + 0 * y, y, z], axis=1),
    ]
    options = {"targets": ["Near", "Far"], "slant_deg": 90}
    one = survey_coverage(scene, EVERYWHERE, positions[:1], clouds, **options)
    # The near sheet hides 6 x 2 / 2 = 6 m of the width of the far one.
    assert one.reachable_m2 == pytest.approx([4, 0, 0], abs=0.1)
    assert one.covered_m2 == pytest.approx([4 / 2 + 0.1, 0, 0], abs=0.06)
    assert one.area_m2 == pytest.approx([4, 8, 0])
    every = survey_coverage(scene, EVERYWHERE, positions, clouds, **options)
    assert every.reachable_m2 == pytest.approx([8, 16, 0], abs=0.2)
    assert every.covered_m2[1] == pytest.approx(16 / 2 + 0.2, abs=0.15)
    wide = survey_coverage(scene, EVERYWHERE, positions, clouds, within_m=0.5, **options)
    assert wide.covered_m2[1] == pytest.approx(16 / 2 + 1.8, abs=0.2)
    assert every.targets.tolist() == [True, True, False]


def test_further_stations_are_chosen_while_they_see_more():
    """Three rooms in a row, of 6, 4 and 2 m, whose walls hide each other."""
    walls = [wall(f"Wall {x}", x, (0, 3), (0, 2.5)) for x in (0, 6, 10, 12)]
    floor = quad("Floor", (0, 0, 0), (12, 0, 0), (12, 3, 0), (0, 3, 0))
    sides = [quad(f"Side {y}", (0, y, 0), (12, y, 0), (12, y, 2.5), (0, y, 2.5)) for y in (0, 3)]
    scene = Scene.from_meshes([floor, *walls, *sides])
    options = {"spacing_m": 1.5, "slant_deg": 90}
    plan = plan_stations(scene, EVERYWHERE, **options)
    lengths = np.array([6.0, 4.0, 2.0])
    rooms_m2 = 3 * lengths + 2 * (3 + lengths) * 2.5
    np.testing.assert_allclose(plan.coverage, np.cumsum(rooms_m2) / rooms_m2.sum(), atol=0.01)
    in_order = [(x > 6).astype(int) + (x > 10) for x in plan.stations[:, 0]]
    assert in_order == [0, 1, 2]
    assert plan.reachable_m2.sum() == pytest.approx(rooms_m2.sum(), rel=0.01)
    assert plan.covered_m2 == pytest.approx(plan.reachable_m2)
    assert plan.area_m2[:2] == pytest.approx([36, 7.5])
    two = plan_stations(scene, EVERYWHERE, count=2, **options)
    np.testing.assert_array_equal(two.stations, plan.stations[:2])
    np.testing.assert_array_equal(two.coverage, plan.coverage[:2])
    enough = plan_stations(scene, EVERYWHERE, coverage=float(plan.coverage[1]) - 0.01, **options)
    assert len(enough.stations) == 2


@pytest.mark.slow
def test_a_hall_with_a_column_and_a_door():
    column = placed("Column", (0.6, 0.6, 3), (3, 0, 0))
    scene = Scene.from_meshes([*rooms((0, -3, -0.5), (0, 0.5, 3)), column])
    plans = {n: plan_stations(scene, EVERYWHERE, count=n, slant_deg=90) for n in (1, 40)}
    found = {n: areas(plan, scene) for n, plan in plans.items()}
    sides = 4 * 0.6 * 3
    assert found[1]["Floor"][0] == pytest.approx(72 - 1 - 0.36, rel=0.02)
    assert found[1]["Column"][0] == pytest.approx(sides, rel=0.1)
    assert found[1]["Column"][1] <= sides / 2 * 1.1  # two of four sides at most
    assert found[40]["Column"] == (found[1]["Column"][0],) * 2
    # Through the door the first sees some of the other room; the second sees more.
    assert 0.6 < plans[1].coverage[0] < plans[40].coverage[1] < 1
    assert plans[40].coverage[-1] == 1 and 3 <= len(plans[40].stations) < 40
    assert (np.diff(plans[40].coverage) > 0).all()
    # Each is the beginning of the longer one, and always the same.
    enough = plan_stations(scene, EVERYWHERE, coverage=plans[40].coverage[1], slant_deg=90)
    for plan, n in ((plans[1], 1), (enough, 2)):
        np.testing.assert_array_equal(plan.stations, plans[40].stations[:n])
    left = np.abs(plans[1].candidates[:, :2] - (3, 0)).max(axis=1)
    assert left.min() >= 0.3  # none in the column


@pytest.mark.slow
def test_what_is_inside_closed_things_or_under_them_does_not_count():
    house = placed("House", (4, 4, 4), (0, 0, 0))
    table = placed("Table", (2, 2, 0.1), (5, 5, 1))
    scene = Scene.from_meshes([placed("Ground", (20, 20, 0.2), (0, 0, -0.2)), house, table])
    plan = plan_stations(scene, EVERYWHERE, slant_deg=90)
    found = areas(plan, scene)
    assert found["House"][0] == pytest.approx(4 * 16, rel=0.03)  # its sides, not its roof
    assert found["Table"][0] == pytest.approx(4 + 8 * 0.1, rel=0.1)  # its top and edges
    within = np.abs(plan.candidates[:, :2])
    assert len(plan.candidates) > 300 and not (within < 2).all(axis=1).any()
    assert not (np.abs(within - 5) < 1).all(axis=1).all()


@pytest.mark.extended
def test_each_side_of_a_thin_wall_counts_by_itself():
    scene = Scene.from_meshes([*rooms(), wall("Sheet", 2, (-3, 3), (0, 3))])
    plan = plan_stations(scene, EVERYWHERE, count=1, slant_deg=90)
    assert areas(plan, scene)["Sheet"] == pytest.approx((36, 18), rel=0.02)


@pytest.mark.extended
def test_a_hall_may_be_modeled_by_its_outside_alone():
    scene = Scene.from_meshes([box("Hall", (8, 6, 3)), placed("Case", (1, 1, 2.5), (2.1, 1.1, 0))])
    plan = plan_stations(scene, EVERYWHERE, slant_deg=90)
    # Inner sides of the hall, less what the case stands on; and the sides of the case.
    assert plan.reachable_m2 == pytest.approx([180 - 1, 10], rel=0.03)
    assert (np.abs(plan.candidates[:, :2] - (2.1, 1.1)).max(axis=1) > 0.5).all()


@pytest.mark.slow
def test_range_field_of_view_and_slant_limit_what_is_seen():
    far = placed("Far", (2, 2, 5), (60, 0, 0))
    scene = Scene.from_meshes([placed("Ground", (10, 10, 0.2), (0, 0, -0.2)), far])

    def seen(sensor, slant_deg=90):
        return plan_stations(scene, sensor, count=1, spacing_m=1, slant_deg=slant_deg)

    assert seen(EVERYWHERE).reachable_m2[1] > 9
    assert seen(Sensor.grid(vertical_fov_deg=180, max_range_m=50)).reachable_m2[1] == 0
    # Below 30 degrees, or within 60 degrees of upright: a disc around the one place in the middle.
    middle = Scene.from_meshes([placed("Ground", (10, 10, 0.2), (0, 0, -0.2))])
    for sensor, slant_deg, expected in (
        (EVERYWHERE, 60, np.pi * 3 * 1.7**2),
        (Sensor.grid(vertical_fov_deg=60), 90, 100 - np.pi * 3 * 1.7**2),
    ):
        plan = plan_stations(middle, sensor, spacing_m=10, slant_deg=slant_deg)
        assert plan.stations.tolist() == [[0, 0, 1.7]]
        assert plan.reachable_m2[0] == pytest.approx(expected, rel=0.02)


@pytest.mark.slow
def test_stations_are_in_world_coordinates_and_stand_on_pavements():
    where = np.array([500_000.0, 5_400_000.0, 300.0])
    parts = (
        placed("Ground", (20, 20, 0.2), (0, 0, -0.2)),
        placed("Pavement", (20, 20, 0.15), (0, 0, 0)),
    )
    scene = Scene.from_meshes([SceneMesh(m.name, m.vertices + where, m.faces) for m in parts])
    plan = plan_stations(scene, EVERYWHERE, count=1, height_m=1.5)
    assert np.abs(plan.candidates[:, :2] - where[:2]).max() < 10
    assert plan.stations[0, 2] == pytest.approx(300 + 0.15 + 1.5)
    assert plan.reachable_m2[0] == 0 < plan.reachable_m2[1]


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"count": 2, "coverage": 0.9}, "cannot be combined"),
        ({"coverage": 95.0}, "coverage must be .* but is 95.0"),
        ({"spacing_m": 0.001}, "larger spacing"),
        ({"sensor": Sensor.grid(max_range_m=0.5)}, "Nothing is reachable"),
        ({"scene": Scene.from_meshes(POLES), "spacing_m": 3.0}, "No floor was found"),
        ({"scene": Scene.from_meshes(POLES[:1])}, "No free space was found on the floor"),
    ],
)
def test_what_cannot_be_is_refused(given, says):
    given = {"scene": Scene.from_meshes(rooms()), "sensor": EVERYWHERE, **given}
    with pytest.raises(LidarError, match=says):
        plan_stations(**given)


def test_targets_are_covered_and_other_objects_only_occlude():
    """Of a house on open ground, with a screen in front of a wall, only the walls count."""
    house = [
        placed("Ground", (40, 40, 0.2), (0, 0, -0.2)),
        placed("House", (6, 6, 4), (0, 0, 0)),
        placed("Screen", (0.2, 8, 4), (3.15, 0, 0)),
    ]
    scene = Scene.from_meshes(house)
    options = {"spacing_m": 4.0, "slant_deg": 85}
    plan = plan_stations(scene, EVERYWHERE, targets=["Ho*"], coverage=0.95, **options)
    assert plan.targets.tolist() == [False, True, False]
    assert 2 <= len(plan.stations) <= 6
    # Three sides of 24 m²: neither the roof, nor the side behind the screen.
    assert plan.reachable_m2.tolist() == [0, pytest.approx(72, rel=0.02), 0]
    assert plan.covered_m2[1] == pytest.approx(plan.coverage[-1] * plan.reachable_m2[1])
    open_scene = Scene.from_meshes(house[:2])
    unscreened = plan_stations(open_scene, EVERYWHERE, targets=["House"], count=1, **options)
    assert unscreened.reachable_m2[1] == pytest.approx(96, rel=0.02)
    with pytest.raises(
        LidarError, match=r"target 'Hose' does not match any object\. Did you mean 'House'\?"
    ):
        plan_stations(scene, EVERYWHERE, targets=["House", "Hose"])
    with pytest.raises(LidarError, match="No target is reachable"):
        buried = [*house, placed("Buried", (1, 1, 1), (0, 0, 1))]
        plan_stations(Scene.from_meshes(buried), EVERYWHERE, targets=["Buried"], **options)


@pytest.mark.extended
@pytest.mark.parametrize(("slant_deg", "is_noted"), [(80, False), (65, True)])
def test_a_target_that_is_mostly_out_of_reach_is_noted(tmp_path, slant_deg, is_noted):
    """A flat roof of 100 m², 0.5 m below the instrument.

    At 65 degrees only points within 1.1 m of the instrument's foot are reachable, which is not on
    the roof; at 80 degrees, points within 2.8 m.
    """
    parts = [
        placed("Ground", (30, 30, 0.2), (0, 0, -0.2)),
        placed("Roof", (10, 10, 1.2), (0, 0, 0)),
    ]
    write_scene(tmp_path / "site.glb", Scene.from_meshes(parts))
    command = ["stations", str(tmp_path / "site.glb"), "--sensor", "riegl-vz400", "--target"]
    command += ["Roof", "--slant", str(slant_deg), "--spacing", "1", "--count", "4"]
    command += ["--out", str(tmp_path / "plan")]
    told = json.loads(CliRunner().invoke(cli, [*command, "--json"]).stdout)
    roof = told["objects"]["Roof"]
    assert roof["area_m2"] == pytest.approx(2 * 100 + 4 * 12)
    assert 0 < roof["covered_m2"] <= roof["reachable_m2"] < roof["area_m2"]
    notes = [note for note in told["notes"] if "reachable from the candidate positions" in note]
    assert bool(notes) == is_noted
    text = CliRunner().invoke(cli, [*command, "--overwrite"]).stdout
    assert re.search(r"^Roof +248\.0 m² +[\d.]+ m² +[\d.]+%$", text, re.M)
    assert re.search(r"^object +area +reachable +covered$", text, re.M)
    if is_noted:
        assert notes[0].startswith(f"Only {roof['reachable_m2']:.1f} of 248.0 m² of Roof is ")


def test_the_report_names_the_targets(tmp_path):
    house = [
        placed("Ground", (30, 30, 0.2), (0, 0, -0.2)),
        placed("House", (4, 4, 2), (0, 0, 0)),
        placed("Tower", (2, 2, 5), (0, 9, 0)),
    ]
    write_scene(tmp_path / "site.glb", Scene.from_meshes(house))
    plan = tmp_path / "plan.yaml"
    plan.write_text("scene: site.glb\nposes: [[-8, 0, 1.7]]\nsensor: ouster/os0-128\n")
    x, y = np.full(40, -2.0), np.linspace(-2, 2, 40)
    np.save(tmp_path / "scan.npy", np.stack([x, y, 0 * x + 1], axis=1))
    command = ["stations", str(plan), "--cloud", str(tmp_path / "scan.npy"), "--target", "H*"]
    command += ["--slant", "90"]
    figures = json.loads(CliRunner().invoke(cli, [*command, "--json"]).stdout)
    assert [*figures["objects"]] == ["House"]
    assert figures["reachable_m2"] == pytest.approx(8, rel=0.1)  # the side that faces the station
    assert figures["covered"] == pytest.approx(0.2 / 2, rel=0.2)  # a strip of 0.2 m
    text = CliRunner().invoke(cli, [*command, "--target", "Tower"]).stdout
    assert re.match(
        r"[\d,]+ m² of H\* and Tower are reachable from 1 station, and [\d.]+% of", text
    )
    assert "Ground" not in text


def test_a_scan_is_compared_with_what_its_stations_see(tmp_path):
    """Of a floor of 12 m x 6 m, a cloud has points on the half with x > 0."""
    write_scene(tmp_path / "hall.glb", Scene.from_meshes(rooms()))
    y, x = np.mgrid[-3:3:0.05, 0:6:0.05].reshape(2, -1)
    np.save(tmp_path / "scan.npy", np.stack([x, y, 0 * x], axis=1))
    plan = tmp_path / "plan.yaml"
    plan.write_text("scene: hall.glb\nposes: [[-3, 0, 1.7], [3, 0, 1.7]]\nsensor: ouster/os0-128\n")
    command = ["stations", str(plan), "--cloud", str(tmp_path / "scan.npy"), "--slant", "90"]
    figures = json.loads(CliRunner().invoke(cli, [*command, "--json"]).stdout)
    floor = figures["objects"]["Floor"]
    assert floor["covered_m2"] == pytest.approx(6.05 * 6, rel=0.03)
    assert floor["reachable_m2"] > 70 and figures["objects"]["West"]["covered_m2"] == 0
    assert figures["covered"] == pytest.approx(
        sum(entry["covered_m2"] for entry in figures["objects"].values()) / figures["reachable_m2"]
    )
    assert (
        " m² are reachable from 2 stations"
        in CliRunner().invoke(cli, [*command, "--within", "0.02"]).stdout
    )


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["hall.glb", "--cloud", "scan.npy"], "the scenario has no poses"),
        (
            ["hall.glb", "--cloud", "scan.npy", "--count", "2"],
            "`--count` cannot be used with `--cloud`",
        ),
        (
            ["hall.glb", "--cloud", "scan.npy", "--resume", "--workers", "2"],
            "`--resume` and `--workers` cannot be used with `--cloud`",
        ),
        (
            ["hall.glb", "--cloud", "scan.npy", "--within", "0"],
            "`--within` must be greater than 0, but is 0",
        ),
        (["hall.glb"], "`--sensor` is required, because hall.glb does not specify a sensor model"),
    ],
)
def test_a_scan_that_cannot_be_compared(tmp_path, monkeypatch, options, says):
    monkeypatch.chdir(tmp_path)
    write_scene(tmp_path / "hall.glb", Scene.from_meshes(rooms()))
    np.save(tmp_path / "scan.npy", np.zeros((1, 3)) + 1)
    outcome = CliRunner().invoke(cli, ["stations", *options])
    assert outcome.exit_code != 0
    assert says in outcome.output + str(outcome.exception)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--sensor", "livox/mid70"], "Livox Mid-70 does not scan the full circle"),
        (["--sensor", "riegl-vz400", "--slant", "91"], "91.0 is not in the range 0<x<=90"),
        (["--sensor", "riegl-vz400", "--height", "0"], "0.0 is not in the range x>0"),
        (["--sensor", "riegl-vz400", "--spacing", "-1"], "-1.0 is not in the range x>0"),
    ],
)
def test_options_are_checked_before_the_scene_is_read(tmp_path, options, says):
    (tmp_path / "damaged.obj").write_text("v 1 2\n")
    outcome = CliRunner().invoke(cli, ["stations", str(tmp_path / "damaged.obj"), *options])
    assert outcome.exit_code != 0
    assert says in outcome.output + str(outcome.exception)


@pytest.mark.parametrize(
    "options", [["--resume", "--restart"], ["--workers", "2", "--scheduler", "tcp://h:1"]]
)
def test_options_that_contradict_each_other(tmp_path, options):
    outcome = CliRunner().invoke(cli, ["stations", str(tmp_path / "hall.glb"), *options])
    assert outcome.exit_code != 0 and "cannot be combined" in outcome.output
    assert not any(tmp_path.iterdir())


def test_the_visibility_is_computed_by_processes_in_chunks(monkeypatch):
    """Without processes, a scene with few candidates does not need to wait for them to start."""
    scene = Scene.from_meshes(rooms((0, -3, 2)))
    monkeypatch.setattr(stations, "_POINTS", 500)
    counts = []

    @contextmanager
    def parallel_map(client, count, worker_bytes, workers):
        counts.append(count)
        # As in processes, which receive pickled functions and items.
        yield lambda function, items: [
            pickle.loads(pickle.dumps(function))(pickle.loads(pickle.dumps(item))) for item in items
        ]

    plans = [plan_stations(scene, EVERYWHERE, spacing_m=1.0, slant_deg=90)]
    monkeypatch.setattr(stations, "parallel_map", parallel_map)
    plans += [
        plan_stations(scene, EVERYWHERE, spacing_m=1.0, slant_deg=90, workers=workers)
        for workers in (None, 2)
    ]
    chunks = -(-len(plans[0].candidates) // 32)
    assert chunks > 1 and counts == [0, chunks]
    for name in ("stations", "coverage", "reachable_m2", "covered_m2"):
        first, *others = (getattr(plan, name).tobytes() for plan in plans)
        assert others == [first, first]


@pytest.mark.extended
def test_a_plan_does_not_depend_on_the_number_of_processes():
    scene = Scene.from_meshes(rooms((0, -3, 2)))
    first, *others = (
        plan_stations(scene, EVERYWHERE, spacing_m=0.7, workers=workers) for workers in (1, 2, 3)
    )
    assert len(first.candidates) > 96
    for plan in others:
        np.testing.assert_array_equal(plan.stations, first.stations)
        assert plan.covered_m2.tobytes() == first.covered_m2.tobytes()


def test_the_table_has_the_names_that_targets_match(tmp_path):
    parts = [SceneMesh(f"site_{mesh.name}", mesh.vertices, mesh.faces) for mesh in rooms()]
    write_scene(tmp_path / "hall.glb", Scene.from_meshes(parts))
    plan = tmp_path / "plan.yaml"
    plan.write_text("scene: hall.glb\nposes: [[3, 0, 1.7]]\nsensor: ouster/os0-128\n")
    np.save(tmp_path / "scan.npy", np.array([[3.0, 1.0, 0.0]]))
    command = ["stations", str(plan), "--cloud", str(tmp_path / "scan.npy"), "--target"]
    outcome = CliRunner().invoke(cli, [*command, "site_*"])
    shown = re.findall(r"^(site_\w+) +[\d,.]+ m² +[\d,.]+ m²", outcome.output, re.M)
    assert {*shown} == {f"site_{mesh.name}" for mesh in rooms()}
    refused = CliRunner().invoke(cli, [*command, "nor*"])
    assert str(refused.exception).endswith(" Similar names: site_North.")
