"""`lidarpool stations`: what it prints and writes for a hall with a column, and its errors."""

import json

import numpy as np
import pytest
import trimesh
import yaml
from PIL import Image

from lidarpool.report.result_pictures import COLOURS, COVERED, UNCOVERED
from lidarpool.scenario.build import build
from lidarpool.scenario.scenario import Scenario

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
    with Image.open(folder / "stations.png") as image:
        pixels = np.asarray(image.convert("RGB"), float) / 255
    for kind in (COVERED, UNCOVERED):
        hue = COLOURS[kind] / COLOURS[kind].max()
        alike = np.abs(pixels / np.maximum(pixels.max(axis=2, keepdims=True), 0.01) - hue)
        assert (alike.max(axis=2) < 0.05)[:, :1200].sum() > 500  # beside the legend

    # The same again, as JSON, and in place of the first.
    again = lidarpool(*arguments, "--json")
    assert again.code == 2 and "stations.yaml exists: give another folder" in again.err
    told = json.loads(lidarpool(*arguments, "--json", "--overwrite").out)
    stations = [tuple(one["position"]) for one in told["stations"]]
    assert [pose.position for pose in Scenario.load(folder / "stations.yaml").poses] == stations
    assert len(stations) >= 2 and {round(z, 3) for _, _, z in stations} == {1.7}
    shares = [one["coverage"] for one in told["stations"]]
    assert shares == sorted(shares) and shares[-2] < 0.9 <= shares[-1]
    seen = [object_["visible_m2"] for object_ in told["objects"].values()]
    covered = [object_["covered_m2"] for object_ in told["objects"].values()]
    assert sum(covered) / sum(seen) == pytest.approx(shares[-1])


def test_a_mesh_needs_no_scenario_and_a_number_may_be_more_than_needed(hall, lidarpool):
    arguments = ("--sensor", "velodyne/vlp16", "--count", "100", "--out", "a/b", "--spacing", "2")
    outcome = lidarpool("stations", "hall.glb", *arguments)
    assert outcome.code == 0, outcome.err
    assert "of 100 stations already see all that can be seen" in outcome.out
    written = Scenario.load(hall / "a/b/stations.yaml")
    assert [entry.file for entry in written.scene.files] == ["../../hall.glb"]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--sensor", "riegl-vz4000"], "Did you mean 'riegl-vz400'?"),
        (["--sensor", "vlp16", "--coverage", "most"], "'most' is not 1% to 100%"),
        (["--sensor", "mid70"], "Livox Mid-70 does not look all around"),
    ],
)
def test_what_cannot_be_planned_writes_nothing(arguments, says, hall, lidarpool):
    outcome = lidarpool("stations", "hall.yaml", *arguments)
    assert outcome.code == 2 and outcome.out == ""
    assert says in outcome.err
    assert not (hall / "hall-stations").exists()


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
    assert build(written).scene.names[-2:] == ("Crate", "Crate.2")
    assert written.scene.copies[0].semantic_class == 4
