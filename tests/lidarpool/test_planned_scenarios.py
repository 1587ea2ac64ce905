"""What the scenarios that `lidarpool flight` and `lidarpool stations` write keep of others."""

import pytest
import yaml
from click.testing import CliRunner
from tests.shapes import block

from lidarpool.cli.commands import cli
from lidarscenario.scenario import Scenario
from lidarscenes.writers.scene_file import write_scene
from lidarsim.scene.scene import Scene

REPLACED = {"sensor", "sensors", "mount", "poses", "trajectory", "steps", "flight", "faults"}
# Sections that a plan keeps, each with a value that differs from its default.
KEPT = {
    "scene": {
        "files": [{"file": "meshes/hall.glb", "assets": "meshes", "translation": [0, 0, 1]}],
        "copies": [{"name": "Post", "file": "meshes/hall.glb", "table": "posts.csv", "class": 5}],
        "ground": {"height_m": 0, "margin_m": 60},
    },
    "world": {"epsg": 25832, "origin": [500_000, 5_600_000, 0]},
    "actors": [
        {"name": "Crate", "file": "meshes/hall.glb", "at": [9, 1, 0], "class": 3},
        {"name": "Van", "box": [5, 2, 2], "trajectory": {"file": "van.csv", "beyond": "hold"}},
    ],
    "traffic": {"file": "fcd.xml", "vehicles": [{"file": "meshes/hall.glb", "class": 10}]},
    "materials": [
        {"objects": "Post*", "reflectance": 0.8, "class": 14, "leaf_area_density": 1.5},
        {"objects": "*", "spectrum": "concrete, light", "gap_fraction": 0.25},
    ],
    "classes": {14: "post", 5: "hall"},
    "returns": {"mode": "strongest", "divergence_mrad": 0.0},
    "noise": {"range_m": 0.0, "seed": 3, "detection_range_m": 30},
    "weather": {"rain_mm_h": 4.5},
    "navigation": {"gnss": {"rate_hz": 5}},
    "cloud": {"keep_every": 3, "columns": ["intensity"], "start": "2026-11-21T10:00:00+02:00"},
    "output": {"write": ["laz", {"format": "mcap", "layout": "autoware"}]},
    "planning": {"start": [25, 25], "target": [-30, -20], "obstacles": [{"object": "Post*"}]},
    "pool": {"collectors": 3},
}


@pytest.fixture
def site(tmp_path):
    """Return a scenario file with all sections that a plan keeps."""
    (tmp_path / "site/meshes").mkdir(parents=True)
    write_scene(tmp_path / "site/meshes/hall.glb", Scene.from_meshes([block("Hall", (2, 2, 2))]))
    (tmp_path / "site/posts.csv").write_text("x,y,z\n5,5,0\n", "ascii")
    (tmp_path / "site/van.csv").write_text("time_s,x,y,z\n0,0,9,1\n1,5,9,1\n", "ascii")
    rows = '<vehicle id="a" type="car" x="1" y="-20" angle="90" speed="0"/>'
    steps = "".join(f'<timestep time="{time}">{rows}</timestep>' for time in (0, 1, 99999))
    (tmp_path / "site/fcd.xml").write_text(f"<fcd-export>{steps}</fcd-export>", "ascii")
    return tmp_path / "site/scenario.yaml"


def plan(command, file, folder, **sections):
    """Plan a survey of a scenario, and return its output and the planned scenario."""
    file.write_text(yaml.safe_dump(sections), "utf-8")
    arguments = {
        "flight": ["--sensor", "riegl-vux1uav", "--agl", "50", "--density", "5"],
        "stations": ["--count", "1", "--spacing", "20"],
    }
    done = CliRunner().invoke(
        cli, [command, str(file), "--out", str(folder), *arguments[command]], catch_exceptions=False
    )
    assert done.exit_code == 0, done.output
    return done.output, Scenario.load(folder / f"{command}.yaml")


@pytest.mark.parametrize("command", ["flight", "stations"])
def test_a_plan_keeps_all_sections_that_it_does_not_replace(site, command):
    assert KEPT.keys() | REPLACED == Scenario.model_fields.keys()
    platform = {"poses": [[0, 0, 20]], "mount": [1, 0, 0], "steps": 7}
    sensor = {"model": "velodyne/vlp16", "max_range_m": 60, "step_deg": 90, "unseen": "Hall"}
    folder = site.parent.parent / "plans/new"
    output, planned = plan(command, site, folder, sensor=sensor, **platform, **KEPT)
    given = Scenario.load(site)
    dropped = {"cloud"}
    if command == "stations":
        dropped.add("navigation")
        assert "note: `navigation` is omitted, because the stations are separate poses" in output
        assert planned.navigation is None
        assert planned.sensor == given.sensor.model_copy(update={"step_deg": 10})
    expected, content = (each.content(site.parent) for each in (given, planned))
    kept = KEPT.keys() - dropped
    assert {name: content.get(name) for name in kept} == {name: expected[name] for name in kept}
    assert planned.cloud.keep_every == 3 and planned.cloud.start == given.cloud.start
    grid = ("ray",) if command == "stations" else ()
    new = ("range", "return_number", "returns", "class", "time", *grid)
    assert planned.cloud.columns == ("intensity", *new)
    assert planned.mount is None
    used = {path.resolve() for path in planned.files} - {(folder / "path.csv").resolve()}
    assert used == {path.resolve() for path in given.files}


def test_a_plan_omits_the_replaced_platform_and_the_faults_of_its_sensors(site):
    drive = {"points": [{"time_s": t, "position": [20 * t, 0, 2]} for t in (0, 1)]}
    actors = [
        {"name": "Car", "box": [4, 2, 1]},
        {"name": "Tree", "box": [1, 1, 5], "at": [9, 9, 3]},
    ]
    output, planned = plan(
        "flight",
        site,
        site.parent / "plan",
        scene={"ground": {"margin_m": 60}},
        sensors={"roof": "velodyne/vlp16"},
        trajectory=drive,
        actors=actors,
        faults=[{"kind": "dead_channels", "channels": [3]}],
    )
    assert [actor.name for actor in planned.actors] == ["Tree"]
    assert planned.cloud.columns == ("range", "intensity", "return_number", "returns", "time")
    assert not planned.faults
    assert "The actor Car is omitted, because the plan replaces the platform" in output
    assert "`faults` is omitted, because the plan replaces the sensors" in output
    assert "# Note: The actor Car is omitted" in (site.parent / "plan/flight.yaml").read_text()
