"""`lidarpool stations`: what it prints and writes for a hall with a column, and its errors."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
from PIL import Image

from lidarfiles.clouds.folder import result_folder
from lidarpool.report.result_pictures import COLORS, COVERED, OTHER, UNCOVERED
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario

pytestmark = pytest.mark.usefixtures("pictures")


@pytest.fixture
def hall(tmp_path):
    """Write hall.glb, two rooms with a door between them and a column, and go to its folder."""
    boxes = {
        "Floor": ((12, 6, 0.2), (0, 0, -0.1)),
        "North": ((12, 0.2, 3), (0, 3.1, 1.5)),
        "South": ((12, 0.2, 3), (0, -3.1, 1.5)),
        "Wall-1": ((0.2, 2.5, 3), (0, -1.75, 1.5)),
        "Wall-2": ((0.2, 2.5, 3), (0, 1.75, 1.5)),
        "Column": ((0.6, 0.6, 3), (3, 0, 1.5)),
    }
    scene = trimesh.Scene()
    for name, (size, place) in boxes.items():
        mesh = trimesh.creation.box(size)
        mesh.apply_translation(place)
        scene.add_geometry(mesh, node_name=name, geom_name=name)
    (tmp_path / "hall.glb").write_bytes(scene.export(file_type="glb"))
    (tmp_path / "hall.yaml").write_text("scene: {files: [{file: hall.glb, up_axis: z}]}")
    return tmp_path


def pixels_of_kind(picture, kind):
    """Count the pixels in the hue of a kind of surface, left of the legend."""
    with Image.open(picture) as image:
        pixels = np.asarray(image.convert("RGB"), float)[:, :1200] / 255
    hue = COLORS[kind] / COLORS[kind].max()
    difference = np.abs(pixels / np.maximum(pixels.max(axis=2, keepdims=True), 0.01) - hue)
    return int((difference.max(axis=2) < 0.05).sum())


@pytest.mark.slow
def test_stations_become_a_scenario_and_a_picture(hall, lidarpool):
    arguments = ("stations", "hall.yaml", "--sensor", "vlp16", "--coverage", "90%")
    arguments += ("--slant", "85", "--spacing", "1.5")
    outcome = lidarpool(*arguments)
    assert outcome.code == 0, outcome.err
    assert outcome.out.endswith(
        "stations in hall-stations: stations.yaml, stations.png\n"
        "next: lidarpool check hall-stations/stations.yaml\n"
    )
    for name in ("Floor", "Column"):
        assert f"\n{name} " in outcome.out
    folder = hall / "hall-stations"
    assert sorted(p.name for p in folder.iterdir()) == ["stations.png", "stations.yaml"]
    written = yaml.safe_load((folder / "stations.yaml").read_text())
    assert written["sensor"] == {"model": "velodyne/vlp16"}
    assert written["scene"] == {"files": [{"file": "../hall.glb", "up_axis": "z"}]}
    assert lidarpool("check", folder / "stations.yaml", "--backend", "numpy").code == 0
    for kind in (COVERED, UNCOVERED):
        assert pixels_of_kind(folder / "stations.png", kind) > 500

    with result_folder(folder):
        locked = lidarpool(*arguments, "--overwrite")
    assert locked.code == 2 and "Another run or export is using the folder" in locked.err

    # The same again, as JSON, and in place of the first.
    again = lidarpool(*arguments, "--json")
    assert again.code == 2 and "stations.yaml already exists. Use another output" in again.err
    told = json.loads(lidarpool(*arguments, "--json", "--overwrite").out)
    stations = [tuple(one["position"]) for one in told["stations"]]
    assert [pose.position for pose in Scenario.load(folder / "stations.yaml").poses] == stations
    assert len(stations) >= 2 and {round(z, 3) for _, _, z in stations} == {1.7}
    shares = [one["coverage"] for one in told["stations"]]
    assert shares == sorted(shares) and shares[-2] < 0.9 <= shares[-1]
    seen = [object_["reachable_m2"] for object_ in told["objects"].values()]
    covered = [object_["covered_m2"] for object_ in told["objects"].values()]
    assert sum(covered) / sum(seen) == pytest.approx(shares[-1])


@pytest.mark.extended
def test_a_mesh_needs_no_scenario_and_a_number_may_be_more_than_needed(hall, lidarpool):
    arguments = ("--sensor", "velodyne/vlp16", "--count", "100", "--out", "a/b", "--spacing", "2")
    outcome = lidarpool("stations", "hall.glb", *arguments)
    assert outcome.code == 0, outcome.err
    assert "of 100 stations already cover all surfaces" in outcome.out
    written = Scenario.load(hall / "a/b/stations.yaml")
    assert [entry.file for entry in written.scene.files] == ["../../hall.glb"]
    # The sensor of a scenario is the default.
    again = lidarpool("stations", "a/b/stations.yaml", "--count", "1", "--spacing", "4")
    assert again.code == 0, again.err
    assert Scenario.load(hall / "stations-stations/stations.yaml").sensor.model == "velodyne/vlp16"


@pytest.mark.extended
def test_a_sensor_file_is_relative_to_the_folder_of_its_scenario(hall, lidarpool):
    folder = hall / "plan"
    folder.mkdir()
    sensor = "name: Preview\nfirings_per_turn: 72\nrate_hz: 10\nrange_m: [0.5, 50]\n"
    sensor += "beams: {elevation_deg: {first: -40, last: 60, count: 9}}\n"
    (folder / "scan.yaml").write_text("scene: ../hall.glb\nsensor: preview.yaml\n")
    arguments = ("stations", "plan/scan.yaml", "--count", "1", "--spacing", "4", "--out", "b")
    outcome = lidarpool(*arguments)
    assert outcome.code == 2
    assert f"{Path('plan/preview.yaml')} does not exist." in outcome.err
    (folder / "preview.yaml").write_text(sensor)
    outcome = lidarpool(*arguments)
    assert outcome.code == 0, outcome.err
    assert Scenario.load(hall / "b/stations.yaml").sensor.model == "../plan/preview.yaml"


@pytest.mark.extended
def test_targets_are_in_all_that_is_written(hall, lidarpool):
    arguments = ("--sensor", "vlp16", "--count", "1", "--spacing", "2", "--slant", "85")
    targets = ("--target", "Wall-*", "--target", "Column")
    outcome = lidarpool("stations", "hall.glb", *arguments, *targets)
    assert outcome.code == 0, outcome.err
    assert " m² of Wall-* and Column are reachable (within" in outcome.out
    assert "Floor" not in outcome.out and "Column " in outcome.out
    head = (hall / "hall-stations/stations.yaml").read_text()
    assert "% of the\n# reachable area of Wall-* and Column." in head
    assert pixels_of_kind(hall / "hall-stations/stations.png", OTHER) > 10_000


@pytest.mark.extended
def test_open_ground_that_decides_is_noted(tmp_path, lidarpool):
    scene = trimesh.Scene()
    for name, size in {"Ground": (40, 40, 0.2), "Hut": (3, 3, 3)}.items():
        scene.add_geometry(trimesh.creation.box(size), node_name=name, geom_name=name)
    (tmp_path / "site.glb").write_bytes(scene.export(file_type="glb"))
    arguments = ("site.glb", "--up-axis", "z", "--sensor", "riegl-vz400", "--spacing", "5")
    outcome = lidarpool("stations", *arguments, "--count", "1")
    assert (
        "note: Ground accounts for " in outcome.out and "select them with `--target`" in outcome.out
    )
    outcome = lidarpool(
        "stations", *arguments, "--count", "1", "--target", "Hut", "--overwrite", "--json"
    )
    figures = json.loads(outcome.out)
    assert [*figures["objects"]] == ["Hut"] and figures["notes"] == []


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--sensor", "riegl-vz4000"], "Did you mean 'riegl-vz400'?"),
        (["--sensor", "vlp16", "--coverage", "most"], "'most' is not a valid percentage"),
        (["--sensor", "mid70"], "Livox Mid-70 does not scan the full circle"),
    ],
)
def test_what_cannot_be_planned_writes_nothing(arguments, says, hall, lidarpool):
    outcome = lidarpool("stations", "hall.yaml", *arguments)
    assert outcome.code == 2 and outcome.out == ""
    assert says in outcome.err
    assert not (hall / "hall-stations").exists()


@pytest.mark.extended
def test_the_picture_agrees_with_the_table(tmp_path, lidarpool):
    """The two slopes of a roof share the corners of the ridge: their normals are not its mean.

    The slopes rise 14.0 degrees. Seen from 4 m away, and 1 m above the eaves, they are 62 to 77
    degrees from the line of sight, by the mean of the two slopes up to 90 degrees.
    """
    corners = [[x, y, 3 + (y == 0)] for y in (-4, 0, 4) for x in (-6, 6)]
    faces = [[0, 1, 3], [0, 3, 2], [2, 3, 5], [2, 5, 4]]
    ground = trimesh.creation.box((24, 20, 0.2))
    scene = trimesh.Scene()
    scene.add_geometry(ground, node_name="Ground", geom_name="Ground")
    roof = trimesh.Trimesh(corners, faces, process=False)
    scene.add_geometry(roof, node_name="Roof", geom_name="Roof")
    (tmp_path / "site.glb").write_bytes(scene.export(file_type="glb"))
    arguments = ("site.glb", "--up-axis", "z", "--sensor", "riegl-vz400", "--spacing", "2")
    outcome = lidarpool("stations", *arguments, "--height", "4", "--count", "100", "--json")
    assert outcome.code == 0, outcome.err
    table = json.loads(outcome.out)["objects"]
    assert all(entry["covered_m2"] == entry["reachable_m2"] > 90 for entry in table.values())
    picture = tmp_path / "site-stations/stations.png"
    assert pixels_of_kind(picture, COVERED) > 100_000
    assert pixels_of_kind(picture, UNCOVERED) < 100


@pytest.mark.extended
def test_the_picture_shows_copies(tmp_path, lidarpool):
    """Only the crates hide parts of a level ground from a station that sees up to 90 degrees."""
    (tmp_path / "ground.stl").write_bytes(
        trimesh.creation.box((20, 20, 0.2)).export(file_type="stl")
    )
    (tmp_path / "crate.stl").write_bytes(trimesh.creation.box((3, 3, 3)).export(file_type="stl"))
    (tmp_path / "crates.csv").write_text("x,y,z\n-5,5,2\n-5,-5,2\n5,-5,2\n5,5,2\n")
    (tmp_path / "site.yaml").write_text(
        "scene:\n  files: [{file: ground.stl, up_axis: z}]\n"
        "  copies: [{name: Crate, file: crate.stl, table: crates.csv}]\n"
    )
    arguments = ("site.yaml", "--sensor", "riegl-vz400", "--spacing", "3", "--slant", "90")
    outcome = lidarpool("stations", *arguments, "--count", "1")
    assert outcome.code == 0, outcome.err
    assert pixels_of_kind(tmp_path / "site-stations/stations.png", UNCOVERED) > 80_000


@pytest.mark.slow
def test_files_of_copies_are_found_from_the_new_folder(hall, lidarpool):
    (hall / "crate.stl").write_bytes(trimesh.creation.box((1, 1, 1)).export(file_type="stl"))
    (hall / "crates.csv").write_text("x,y,z\n-3,1,0.5\n-3,-1,0.5\n")
    (hall / "hall.yaml").write_text(
        "scene:\n  files: [{file: hall.glb, up_axis: z}]\n"
        "  copies: [{name: Crate, file: crate.stl, table: crates.csv, class: 4}]\n"
    )
    outcome = lidarpool(
        "stations", "hall.yaml", "--sensor", "vlp16", "--count", "1", "--spacing", "2"
    )
    assert outcome.code == 0, outcome.err
    written = Scenario.load(hall / "hall-stations" / "stations.yaml")
    assert prepare(written).scene.names[-2:] == ("Crate", "Crate.2")
    assert written.scene.copies[0].semantic_class == 4
