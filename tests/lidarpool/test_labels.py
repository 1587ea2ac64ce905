"""The page on labels: its tables are those of the registry of formats, and its scenario labels."""

import json
import re
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path

import pytest
import yaml
from tests.drives import points_of, the_scene, the_sweeps

from lidarfiles.clouds.built_in_formats import FORMATS
from lidarfiles.clouds.format_table import load_format
from lidarfiles.clouds.writing import ExportSpec
from lidarpool.pages.preview import first_sweeps
from lidarscenario.advice import advice
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarscenes.procedural.city import city as city_scene
from lidarscenes.writers.scene_file import write_scene
from lidarsim.sweeps.sweeps import Sweeps

PAGE = (Path(__file__).parents[2] / "docs/how-to/labels.md").read_text("utf-8")


def table_below(heading):
    """Rows of the first table below a heading: {format: further cells}, a row for each format."""
    section = PAGE.partition(f"## {heading}\n")[2].partition("\n## ")[0]
    rows = [line.strip("| ").split(" | ") for line in section.splitlines() if line.startswith("|")]
    return {name: cells for first, *cells in rows[2:] for name in re.findall(r"`([\w.]+)`", first)}


def test_the_table_of_labels_is_that_of_the_registry():
    page = table_below("Labels in each format")
    assert page.keys() == FORMATS.keys()
    for name in FORMATS:
        thing, semantic_class, boxes = page[name]
        cloud_format = load_format(name)
        sweeps = Sweeps.unknown()
        stored, if_named = (
            cloud_format.stored_columns(ExportSpec(name), one)
            for one in (sweeps, replace(sweeps, classes={1: "ground"}))
        )
        assert (thing != "no") == (stored is None or "object" in stored), name
        assert (semantic_class != "no") == (if_named is None or "class" in if_named), name
        only_named = stored is not None and "class" not in stored and semantic_class != "no"
        assert ("if classes have names" in semantic_class) == only_named, name
        assert (boxes != "no") == cloud_format.actor_boxes, name


def test_names_of_classes_are_in_the_formats_that_the_page_says(tmp_path):
    scene = the_scene()
    sweeps = replace(the_sweeps(scene), classes={3: "cobblestone"})
    holding = set()
    for name, row in FORMATS.items():
        if name in ("pcap", "rrd", "images") or row.missing_packages:
            continue  # of a maker's sensors, of a large package, of all rays
        ExportSpec(name).write(tmp_path / row.file, points_of(scene, 0), sweeps)
        files = [tmp_path / row.file, *(tmp_path / row.file).rglob("*")]
        if any(b"cobblestone" in file.read_bytes() for file in files if file.is_file()):
            holding.add(name)
    listed = {*table_below("Names of classes")}
    files = {Path(row.file).name: name for name, row in FORMATS.items()}
    assert {files.get(name, name) for name in listed} & {*FORMATS} - {"rrd"} == holding


def test_the_classes_of_the_page_are_those_of_the_objects_of_the_city():
    entries, names = re.findall(r"```yaml\n(materials:.*?)(classes: .*?)```", PAGE, re.DOTALL)[0]
    materials = yaml.safe_load(entries)["materials"]
    city = city_scene(triangles=20_000)
    expected = {"pavement": "sidewalk", "ground": "road", "tree": "vegetation", "lamp": "pole"}
    found = set()
    for name in city.names:
        kind = name.partition("-")[0]
        semantic_class = next(m["class"] for m in materials if fnmatchcase(name, m["objects"]))
        assert yaml.safe_load(names)["classes"][semantic_class] == expected.get(kind, kind)
        found.add(kind)
    assert found == {"ground", "pavement", "building", "tree", "lamp", "car"}


def test_classes_without_a_name_are_noted_if_others_have_names(tmp_path):
    write_scene(tmp_path / "scene.glb", the_scene())
    scenario = {
        "scene": "scene.glb",
        "poses": [[0, 0, 1]],
        "materials": [{"objects": "*", "class": 4}],
        "cloud": {"precision_m": 0.01},
        "actors": [{"name": "Cart", "box": [1, 1, 1], "at": [4, 0, 0.5], "class": 30}],
    }
    for classes, noted in (({4: "stone"}, ["30"]), ({4: "stone", 30: "cart"}, []), ({}, [])):
        read = Scenario.from_data(scenario | {"classes": classes}, folder=tmp_path)
        notes = [note for note in advice(prepare(read)) if "has no name" in note]
        assert notes == [
            f"class {n} of materials or actors has no name. Add `{{{n}: …}}` to `classes`"
            for n in noted
        ]


def test_the_scenario_of_the_page_labels_its_points():
    code = re.search(r"```yaml\n(.*?)```", PAGE, re.DOTALL)[1]
    job = prepare(Scenario.from_data(yaml.safe_load(code))).job
    (cloud,) = first_sweeps(job)
    assert {*cloud["class"].tolist()} == {40, 70}
    assert job.survey.classes == {40: "road", 70: "vegetation"}


@pytest.mark.parametrize(
    ("materials", "note"),
    [
        ([], "no object has a class, so all points have class 0. Set `class` in `materials`, "),
        ([{"objects": "*", "class": 4}], ""),
        (
            [{"objects": ["Vase", "Cart"], "class": 4}, {"objects": "*"}],
            "5 of 6 static objects have no class (",
        ),
        (
            [{"objects": "Cart", "class": 4}, {"objects": "*"}],
            "6 of 6 static objects have no class (",
        ),
    ],
)
@pytest.mark.parametrize(
    "stored", [{"output": {"write": ["kitti", "las"]}}, {"cloud": {"columns": ["class"]}}, {}]
)
def test_classes_of_points_without_classes_of_objects_are_noted(materials, note, stored):
    cart = {"name": "Cart", "box": [1, 1, 1], "at": [4, 0, 0.5]}
    data = {"scene": "seed", "poses": [[0, 0, 1]], "actors": [cart], "materials": materials}
    told = [one for one in advice(prepare(Scenario.from_data(data | stored))) if "class" in one]
    assert len(told) == bool(note and stored)
    assert all(one.startswith(f"points are labeled by class, but {note}") for one in told)
    named = prepare(Scenario.from_data(data | stored | {"classes": {0: "background", 4: "thing"}}))
    assert not [one for one in advice(named) if "labeled by class" in one]


def test_the_note_on_classes_without_names_says_what_to_give():
    scene = the_scene()
    sweeps = the_sweeps(scene)
    cloud = points_of(scene, 0)
    assert "class" in {column.name for column in cloud.table}
    for name, title in (("mcap", "MCAP"), ("nuscenes", "nuScenes")):
        told = [note for note in ExportSpec(name).notes(cloud, sweeps) if "class" in note]
        assert told == [
            f"{title} can store class only if classes have names. Set `classes: {{1: ground, …}}`; "
            "see docs/how-to/labels.md"
        ]
        named = replace(sweeps, classes={1: "ground"})
        assert not [note for note in ExportSpec(name).notes(cloud, named) if "class" in note]
    (note,) = [note for note in ExportSpec("e57").notes(cloud, sweeps) if "class" in note]
    assert note.startswith("E57 cannot store ") and "classes:" not in note


BUILDING = {
    "type": "CityJSON",
    "version": "1.1",
    "transform": {"scale": [1, 1, 1], "translate": [0, 0, 0]},
    "CityObjects": {
        "b": {
            "type": "Building",
            "geometry": [{"type": "MultiSurface", "lod": "1", "boundaries": [[[0, 1, 2]]]}],
        }
    },
    "vertices": [[0, 0, 0], [9, 0, 0], [0, 0, 9]],
}


@pytest.mark.parametrize(
    ("name", "labeled"), [("nuscenes", True), ("rrd", True), ("laz", True), ("pcd", False)]
)
def test_classes_of_files_are_in_formats_that_have_a_field_for_them(tmp_path, name, labeled):
    (tmp_path / "b.city.json").write_text(json.dumps(BUILDING), "utf-8")
    data = {"scene": {"files": ["b.city.json"]}, "poses": [[20, 20, 2]]}
    run = Scenario.from_data(data | {"output": {"write": [name]}}, folder=tmp_path)
    assert dict(prepare(run).survey.classes) == ({6: "building"} if labeled else {})
    job = prepare(Scenario.from_data(data, folder=tmp_path), columns=ExportSpec(name).added)
    names = {column.name for column in job.survey.stored_columns}
    assert ("class" in names) == labeled
    plain = prepare(Scenario.from_data({"scene": "seed"}), columns=ExportSpec(name).added)
    assert "class" not in {column.name for column in plain.survey.stored_columns}
