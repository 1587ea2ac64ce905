"""Names of semantic classes: what is refused, and that every format gives them back."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial

import laspy
import numpy as np
import pyarrow.dataset
import pytest
import yaml
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability
from tests.drives import SCANS, TURNS, points_of, the_scene, the_sweeps

import lidarpool
from lidarfiles import read_cloud
from lidarfiles.clouds.built_in_formats import DATA_SETS
from lidarfiles.clouds.writing import ExportSpec
from lidarfiles.datasets.dataset import DataSet
from lidarfiles.datasets.job_table import JobRow, write_table
from lidarfiles.identity.fingerprint import fingerprint
from lidarfiles.picture_file import PICTURE_FILE, PictureContent
from lidarpool.report.charts import draw_sweep
from lidarscenario.advice import advice
from lidarscenario.field_paths import find_field
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarsim import LidarError, Material, Sensor, Survey
from lidarsim.io.storage import Storage
from lidarsim.sweeps.sweeps import SWEEPS_FILE, Sweeps
from lidarview.viewer.result_views import open_result

NAMES = {3: "road", 7: "Straße", 20: "pole, or a sign at one", 299: "car"}


@pytest.fixture(scope="module")
def scene():
    return the_scene()


@pytest.fixture(scope="module")
def sweeps(scene) -> Sweeps:
    return replace(the_sweeps(scene), classes=NAMES)


@pytest.fixture
def saved(scene, sweeps, tmp_path):
    """Write points of the drive in a format, with names or without."""

    def save(name, sweeps=sweeps, **more):
        one = ExportSpec(name, **more)
        one.write(tmp_path / one.row.file, points_of(scene, 0), sweeps, overwrite=True)
        return tmp_path / one.row.file

    return save


@pytest.mark.parametrize(
    "wrong",
    [{"car": 10}, {True: "car"}, {-1: "car"}, {65_536: "car"}, {10: ""}, {10: 5}, {10: "a\nb"},
     {10: 100 * "a"}, {10: "car", 11: "car"}],
)  # fmt: skip
def test_what_is_no_class_with_a_name_is_one_line(wrong):
    for make in (
        lambda: Survey(poses=[(0, 0, 1)], classes=wrong),
        lambda: Scenario.from_data({"classes": wrong}, source="a.yaml"),
    ):
        with pytest.raises(LidarError, match=r"classes: expected whole numbers from 0") as error:
            make()
        assert "\n" not in str(error.value)


def test_names_add_the_column_and_are_no_part_of_the_survey():
    sensor = Sensor.grid(90, 4)
    plain = Survey(sensor, [(0, 0, 1)], columns=["class"])
    named = Survey(sensor, [(0, 0, 1)], classes={40: "road", 10: "car"})
    assert [column.name for column in named.columns] == ["class"]
    assert [*named.classes] == [10, 40]
    assert plain == named and fingerprint(plain) == fingerprint(named)


def test_a_path_of_a_campaign_leads_to_the_name_of_a_class():
    scenario = Scenario.from_data({"classes": {40: "road"}})
    assert [key for key, _ in find_field(scenario, "classes.40")[0]] == ["classes", 40]
    with pytest.raises(LidarError, match=r"no entry .41.\. Available names: 40"):
        find_field(scenario, "classes.41")


@pytest.mark.parametrize(
    ("path", "words"),
    [
        ("poses.1.position", "has 1 entry, so entry 1 does not exist"),
        (f"poses.{'9' * 5000}", "999…999"),
    ],
)
def test_an_entry_beyond_a_list_is_named_in_a_line(path, words):
    scenario = Scenario.from_data({"poses": [[0, 0, 1]]})
    assert [key for key, _ in find_field(scenario, "poses.00.position")[0]][1] == 0
    with pytest.raises(LidarError) as raised:
        find_field(scenario, path)
    assert words in str(raised.value) and len(str(raised.value)) < 200


def test_without_names_sweeps_have_the_bytes_that_they_had(scene, sweeps):
    plain = replace(sweeps, classes={})
    assert b"classes" not in plain.to_bytes()
    assert fingerprint(plain) == fingerprint(sweeps), "which tokens and GUIDs depend on"


def test_las_looks_them_up(saved):
    path = saved("las")
    with laspy.open(path) as file:
        assert file.header.vlrs.get("ClassificationLookupVlr")[0][3] == "road"
    # laspy leaves out signs that are neither letters nor digits.
    _, _, found = path.read_bytes().partition(b"LASF_Spec".ljust(16, b"\0") + b"\0\0")
    assert int.from_bytes(found[:2], "little") == 256 * 16
    rows = [found[k : k + 16] for k in range(34, 34 + 256 * 16, 16)]
    assert [row[0] for row in rows] == [*range(256)]
    assert {row[0]: row[1:].rstrip(b"\0") for row in rows if row[1]} == {
        3: b"road", 7: b"Stra?e", 20: b"pole, or a sign",
    }  # fmt: skip


def test_parquet_has_them_in_its_schema(saved):
    schema = pyarrow.dataset.dataset(saved("parquet")).schema
    assert json.loads(schema.metadata[b"classes"]) == {str(n): name for n, name in NAMES.items()}


def test_ply_has_them_in_comments_however_many(saved, scene, sweeps):
    many = {number: f"class of the number {number}" for number in range(5_000)}
    path = saved("ply", replace(sweeps, classes=many))
    head, _, _ = path.read_bytes().partition(b"element")
    lines = [line for line in head.decode().splitlines() if line.startswith("comment class ")]
    found = (line.removeprefix("comment class ").partition(" ") for line in lines)
    assert {int(number): name for number, _, name in found} == many
    assert np.array_equal(read_cloud(path)["class"], points_of(scene, 0)["class"])
    saved("ply").with_name(SWEEPS_FILE).write_bytes(sweeps.to_bytes())
    assert read_cloud(path).sweeps().classes == NAMES


def test_kitti_has_them_as_semantic_kitti_api_reads_them(saved):
    told = yaml.safe_load((saved("kitti") / "semantic-kitti.yaml").read_text())
    assert told["labels"] == {0: "unlabeled", **NAMES}
    assert told["color_map"].keys() == told["labels"].keys()
    assert len({tuple(color) for color in told["color_map"].values()}) == 5


@pytest.mark.extended
@pytest.mark.parametrize("layout", ["velodyne", "autoware", "ouster"])
def test_bags_tell_late_listeners_and_label_the_points(saved, scene, sweeps, layout):
    with AnyReader([saved("rosbag2", layout=layout)]) as bag:
        (connection,) = [one for one in bag.connections if one.topic == "/label_info"]
        (qos,) = connection.ext.offered_qos_profiles
        assert qos.durability == QosDurability.TRANSIENT_LOCAL
        ((_, _, data),) = bag.messages([connection])
        message = bag.deserialize(data, connection.msgtype)
        assert connection.msgtype == "vision_msgs/msg/LabelInfo"
        assert {one.class_id: one.class_name for one in message.class_map} == NAMES
    path = saved("rosbag2", replace(sweeps, classes={}), layout=layout)
    with AnyReader([path]) as bag:
        assert "/label_info" not in bag.topics
        connection = next(one for one in bag.connections if one.topic == "/front/points")
        _, _, data = next(bag.messages([connection]))
        fields = {field.name for field in bag.deserialize(data, connection.msgtype).fields}
    assert "label" not in fields and "x" in fields


def test_formats_hold_classes_that_have_names(scene, sweeps):
    cloud = points_of(scene, 0)
    plain = replace(sweeps, classes={})
    for name in ("nuscenes", "mcap", "rosbag2"):
        assert "class" in ExportSpec(name).unsupported_columns(cloud, plain)
        assert "class" not in ExportSpec(name).unsupported_columns(cloud, sweeps)


def tables_of(folder):
    return {path.stem: json.loads(path.read_text()) for path in folder.glob("v1.0-*/*.json")}


def check_lidarseg(folder):
    """Check what nuscenes-devkit asserts of labels; return the names by their numbers."""
    tables = tables_of(folder)
    assert len([*folder.glob("lidarseg/v1.0-lidarpool/*.bin")]) == len(tables["lidarseg"])
    files = {row["token"]: row["filename"] for row in tables["sample_data"]}
    for row in tables["lidarseg"]:
        assert row["token"] == row["sample_data_token"]
        size = (folder / files.pop(row["token"])).stat().st_size
        assert (folder / row["filename"]).stat().st_size * 20 == size, "a byte for each point"
    assert not files
    names = {row["index"]: row["name"] for row in tables["category"]}
    assert sorted(names) == list(range(len(names))) == list(range(len(tables["category"])))
    kinds = {row["category_token"] for row in tables["instance"]}
    assert kinds <= {row["token"] for row in tables["category"]}
    return names


def test_nuscenes_has_labels_and_categories(saved, scene, sweeps):
    folder = saved("nuscenes")
    # The devkit allows no gaps between labels; boxes of "Car 1" have the category of class "car".
    names = check_lidarseg(folder)
    assert names == dict(enumerate(["none", "road", "Straße", NAMES[20], "car", "Van"]))
    numbers = [row.get("class") for row in tables_of(folder)["category"]]
    assert numbers == [0, *NAMES, None]
    labels = np.fromfile(folder / "lidarseg/v1.0-lidarpool/samples-rear_left-000001.pcd.bin", "u1")
    points = points_of(scene, 0)
    expected = points["class"][points.scan // SCANS == TURNS + 1]
    told = [0 if label == 0 else [*NAMES][label - 1] for label in labels]
    assert told == np.where(np.isin(expected, [*NAMES]), expected, 0).tolist()
    names = check_lidarseg(saved("nuscenes", replace(sweeps, classes={2: "none"})))
    assert names == {0: "none", 1: "none (2)", 2: "Car", 3: "Van"}
    tables = tables_of(saved("nuscenes", replace(sweeps, classes={})))
    assert "lidarseg" not in tables and "index" not in tables["category"][0]
    many = dict(zip(range(1, 257), map(str, range(256)), strict=True))
    with pytest.raises(LidarError, match=r"256 classes have names"):
        saved("nuscenes", replace(sweeps, classes=many))


def test_boxes_of_nuscenes_are_spelled_as_classes(saved, sweeps):
    classes = {10: "car", 40: "delivery van"}
    sweeps = replace(sweeps, classes=classes, actors=("CAR (b.7)", "Delivery Van 2"))
    tables = tables_of(saved("nuscenes", sweeps))
    names = {row["token"]: row["name"] for row in tables["category"]}
    assert [*names.values()] == ["none", "car", "delivery van"]
    kinds = [names[row["category_token"]] for row in tables["instance"]]
    assert kinds == ["car", "delivery van"]


@pytest.mark.extended(every=3)
@pytest.mark.parametrize("name", DATA_SETS)
def test_data_sets_give_them_back(scene, sweeps, tmp_path, name):
    data = DataSet(Storage.at(tmp_path), name)
    rows = [JobRow(number, f"{number:02}") for number in (0, 1)]
    other = replace(sweeps, classes={3: "lane", 8: "tree"})
    for row, of in zip(rows, (sweeps, other), strict=True):
        data.write_job(row, points_of(scene, row.number), of)
    write_table(data.storage, [], lambda: rows)
    data.finish(rows)
    found = lidarpool.sweeps(tmp_path)
    assert found.classes == NAMES | {3: "road; lane", 8: "tree"}
    points = points_of(scene, 0)
    expected = points["class"][points.scan // SCANS == 2]
    if name == "nuscenes":
        expected = np.where(np.isin(expected, [*NAMES]), expected, 0)
        names = check_lidarseg(tmp_path)  # of all jobs, whose labels are renumbered
        assert [*names.values()][:3] == ["none", "road; lane", "Straße"] and names[3] == "tree"
        other_points = points_of(scene, 1)
        kept = other_points["class"][other_points.scan // SCANS == 2]
        again = found[2 + 2 * TURNS]
        assert again.job == "01"
        assert np.array_equal(again.classes, np.where(np.isin(kept, [3, 8]), kept, 0))
        assert [damage for _, (_, damage) in data.check_jobs(rows, contents=True)] == ["", ""]
        files = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
        data.finish(rows)
        assert files == {path: path.read_bytes() for path in files}
    assert found[2].classes.dtype == np.uint16
    assert np.array_equal(found[2].classes, expected)
    if name == "kitti":
        told = yaml.safe_load((tmp_path / "semantic-kitti.yaml").read_text())
        assert told["labels"][3] == "road; lane"
    few = {"class": np.arange(len(found[2])) % 2 * 3}
    (legend,) = draw_sweep(found[2].replace(columns=few), found.classes).figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["none", "road; lane", "sensor"]


def test_the_page_names_them_in_legend_and_filter(saved, scene, sweeps, tmp_path):
    saved("ply")
    (tmp_path / SWEEPS_FILE).write_bytes(sweeps.to_bytes())
    survey = Survey(
        Sensor.grid(90, 4), [(0, 0, 1)], materials=[Material("*", semantic_class=3)], classes=NAMES
    )
    pictured, _ = PictureContent.before_casting(scene, survey)
    pictured = replace(pictured, hit_counts=np.zeros(pictured.scene.triangles, np.int64))
    for beside in (lambda: None, partial(pictured.save, tmp_path / PICTURE_FILE)):
        beside()
        view = open_result(tmp_path)
        told, _ = view.answer("column", {"name": "class"}, lambda: False)
        labels = {value: name for name, value in told["labels"]}
        assert labels[3] == "road" and labels[7] == "Straße" and labels[4] == "class 4"
        asked = {"color": "class", "most": "100000"}
        told, _ = view.answer("points", asked, lambda: False)
        assert "road" in [name for name, *_ in told["legend"]["labels"]]
    assert PictureContent.load(tmp_path / PICTURE_FILE).classes[3] == "road"


def test_classes_beyond_the_classification_of_las_are_noted(tmp_path):
    """The classification has a byte, and the extra bytes have the true number."""
    (tmp_path / "box.yaml").write_text(
        "scene: {copies: [{name: A, box: [1, 9, 9], at: [[5, 0, 0]], class: 300}]}\n"
        "materials: [{objects: '*', class: 300}]\nposes: [[0, 0, 2]]\nsensor: {layers: 8}\n"
        "cloud: {columns: [class]}\noutput: {write: [las]}\n"
    )
    (note,) = (
        note
        for note in advice(prepare(Scenario.load(tmp_path / "box.yaml")))
        if "classification" in note
    )
    assert "is at most 255, so it is 0 for points of class 300" in note
