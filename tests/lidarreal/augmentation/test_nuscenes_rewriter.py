"""Augmented copies of nuScenes data sets."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from tests.drives import points_of, the_scene, the_sweeps, write_set
from tests.fake_augmenters import (
    changed,
    content,
    finish,
    identity,
    rewrite,
    two_boxes,
    write_sweep,
)

from lidarfiles.clouds.recording_ref import RecordingRef
from lidarfiles.clouds.writing import ExportSpec
from lidarfiles.recordings.opening import open_recording, open_ref
from lidarreal.augmentation.rewriting.nuscenes_categories import visibility_token
from lidarreal.augmentation.rewriting.opening import open_rewriter
from lidarsim import LidarError
from lidarsim.motion.rotations import matrices

CLASSES = {3: "road", 7: "Car"}
VERSION = "v1.0-lidarpool"


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    return write_drive(tmp_path_factory.mktemp("nuscenes") / "drive", CLASSES)


def write_drive(path, classes):
    """Write a data set, with labels if classes have names."""
    scene = the_scene()
    sweeps = replace(the_sweeps(scene), classes=classes)
    ExportSpec("nuscenes").write(path, points_of(scene, 0), sweeps)
    tables = path / VERSION
    levels = ("v0-40", "v40-60", "v60-80", "v80-100")
    rows = [{"token": str(k), "level": level, "description": ""} for k, level in enumerate(levels)]
    (tables / "visibility.json").write_text(json.dumps(rows))
    rows = [{"token": f"a{name}", "name": name} for name in ("vehicle.parked", "vehicle.moving")]
    (tables / "attribute.json").write_text(json.dumps(rows))
    return path


def opened(path, sensor="LIDAR_TOP"):
    ref = RecordingRef(path, sensor, keep_noise=True)
    return open_rewriter(ref, open_ref(ref))


def tables_of(path):
    return {
        file.stem: {row["token"]: row for row in json.loads(file.read_text())}
        for file in (path / VERSION).glob("*.json")
    }


def with_objects(recording, number, **options):
    """Augment a sweep, and add the objects of inserted points."""
    augmented = changed(recording, number, two_boxes(), [0.5, 1.0], **options)
    added = ~augmented.is_recorded
    objects = np.full(len(augmented.sweep), -1)
    objects[added] = 50 + np.arange(added.sum()) % 2
    columns = {**augmented.sweep.columns, "object": objects}
    return replace(augmented, sweep=augmented.sweep.replace(columns=columns))


def test_identity_keeps_all_bytes(drive, tmp_path):
    before = content(drive)
    for source in (drive, drive / VERSION):
        notes = rewrite(
            opened(source), tmp_path / "new", tmp_path / "work", identity, overwrite=True
        )
        assert content(tmp_path / "new") == before == content(drive)
    assert notes[0].startswith("Only the sweeps of LIDAR_TOP were augmented. rear_left in")


def test_points_and_labels(drive, tmp_path):
    rewriter = opened(drive)
    new = tmp_path / "new"
    notes = rewrite(rewriter, new, tmp_path / "work", with_objects)
    recording = open_recording(new, "LIDAR_TOP", keep_noise=True)
    categories = {row["name"]: row for row in tables_of(new)["category"].values()}
    assert {name: row["index"] for name, row in categories.items()} == {
        "none": 0, "road": 1, "Car": 2, "Van": 3, "walker": 4,
    }  # fmt: skip
    assert "These categories were added for inserted objects: walker." in notes
    for number in range(3):
        expected = with_objects(rewriter.recording, number)
        sweep = recording[number]
        np.testing.assert_array_equal(sweep.points, expected.sweep.points.astype(np.float32))
        strength = expected.sweep.columns["intensity"].astype(np.float32)
        np.testing.assert_array_equal(sweep.columns["intensity"], strength)
        name = f"samples/LIDAR_TOP/{number:06}.pcd.bin"
        labels = np.fromfile(new / f"lidarseg/{VERSION}/{name.replace('/', '-')}", "u1")
        added = ~expected.is_recorded
        objects = expected.sweep.columns["object"][added]
        np.testing.assert_array_equal(labels[added], np.where(objects == 50, 2, 4))
        old = np.fromfile(drive / f"lidarseg/{VERSION}/{name.replace('/', '-')}", "u1")
        np.testing.assert_array_equal(labels[~added], old[expected.template[~added]])


@pytest.mark.parametrize("has_panoptic", [False, True])
def test_several_new_categories(drive, tmp_path, has_panoptic):
    """Their order differs between sweeps, which are encoded independently of each other."""
    source = tmp_path / "source"
    shutil.copytree(drive, source)
    if has_panoptic:
        panoptic_labels(source)
    rewriter = opened(source)
    kinds = [("hoverboard", "walker"), ("walker", "Car"), ("walker", "hoverboard")]

    def augment(recording, number):
        augmented = with_objects(recording, number)
        boxes = replace(augmented.boxes, types=kinds[number], names=kinds[number])
        return replace(augmented, boxes=boxes)

    new = tmp_path / "new"
    notes = rewrite(rewriter, new, tmp_path / "work", augment)
    assert "These categories were added for inserted objects: hoverboard, walker." in notes
    categories = {row["name"]: row["index"] for row in tables_of(new)["category"].values()}
    assert categories == {"none": 0, "road": 1, "Car": 2, "Van": 3, "hoverboard": 4, "walker": 5}
    for number, names in enumerate(kinds):
        expected = augment(rewriter.recording, number)
        added = ~expected.is_recorded
        own = expected.sweep.columns["object"][added] - 50
        wanted = np.array([categories[name] for name in names])[own]
        stem = f"{VERSION}/samples-LIDAR_TOP-{number:06}"
        labels = np.fromfile(new / f"lidarseg/{stem}.pcd.bin", "u1")
        np.testing.assert_array_equal(labels[added], wanted)
        if has_panoptic:
            with np.load(new / f"panoptic/{stem}.pcd.npz") as archive:
                np.testing.assert_array_equal(archive["data"][added] // 1000, wanted)
    instances = tables_of(new)["instance"].values()
    by_category = [row["category_token"] for row in instances if row["nbr_annotations"] > 0]
    assert len(by_category) == len(tables_of(drive)["instance"]) + 3


def points_in_box(row, points):
    """Return the number of points in an annotation, by the rule of nuscenes-devkit."""
    w, x, y, z = row["rotation"]
    (rotation,) = matrices(np.array([[x, y, z, w]]))
    width, length, height = row["size"]
    corner = np.array(row["translation"]) + rotation @ [length / 2, width / 2, height / 2]
    inside = np.ones(len(points), bool)
    for axis, side in enumerate((length, width, height)):
        edge = -side * rotation[:, axis]
        along = (points - corner) @ edge
        inside &= (along >= 0) & (along <= edge @ edge)
    return int(inside.sum())


def test_annotations(drive, tmp_path):
    rewriter = opened(drive)
    new = tmp_path / "new"
    rewrite(rewriter, new, tmp_path / "work", with_objects)
    old, tables = tables_of(drive), tables_of(new)
    for name in tables.keys() - {"instance", "sample_annotation", "category"}:
        assert tables[name] == old[name]
    added = tables["instance"].keys() - old["instance"].keys()
    assert len(added) == 2
    sweeps = [row for row in tables["sample_data"].values() if row["is_key_frame"]]
    world = {}
    for sweep in sweeps:
        pose = tables["ego_pose"][sweep["ego_pose_token"]]
        w, x, y, z = pose["rotation"]
        (rotation,) = matrices(np.array([[x, y, z, w]]))
        points = np.fromfile(new / sweep["filename"], "<f4").reshape(-1, 5)[:, :3].astype(float)
        world.setdefault(sweep["sample_token"], []).append(
            points @ rotation.T + pose["translation"]
        )
    for row in tables["sample_annotation"].values():
        assert (
            row["num_lidar_pts"] == points_in_box(row, np.concatenate(world[row["sample_token"]]))
            or row["token"] in old["sample_annotation"]
        )
    for token in added:
        instance = tables["instance"][token]
        token = instance["first_annotation_token"]
        chain = []
        while token:
            row = tables["sample_annotation"][token]
            assert row["instance_token"] == instance["token"]
            assert row["prev"] == (chain[-1]["token"] if chain else "")
            chain.append(row)
            token = row["next"]
        assert len(chain) == instance["nbr_annotations"] == 3
        assert chain[-1]["token"] == instance["last_annotation_token"]
        is_car = tables["category"][instance["category_token"]]["name"] == "Car"
        assert chain[0]["size"] == ([2, 4, 1.5] if is_car else [0.5, 0.5, 1.8])
        assert chain[0]["visibility_token"] == ("1" if is_car else "3")
        samples = [tables["sample"][row["sample_token"]]["timestamp"] for row in chain]
        assert samples == sorted(samples) and len(set(samples)) == 3
    # The first pose of the sensor maps the center of the car to its annotation.
    pose = rewriter.recording[0].pose
    car = next(
        row
        for row in tables["sample_annotation"].values()
        if row["size"] == [2, 4, 1.5]
        and row["prev"] == ""
        and row["token"] not in old["sample_annotation"]
    )
    np.testing.assert_allclose(car["translation"], pose[:3, :3] @ [10, 2, -1] + pose[:3, 3])
    w, x, y, z = car["rotation"]
    half = np.sqrt(0.5)
    turned = matrices(np.array([[x, y, z, w], [0, 0, half, half]]))
    np.testing.assert_allclose(turned[0], pose[:3, :3] @ turned[1], atol=1e-12)


def test_counts_of_recorded_boxes(drive, tmp_path):
    """Points in the boxes of recorded cars are counted again where sweeps change."""

    def only_first(recording, number):
        if number:
            return identity(recording, number)
        augmented = changed(recording, number)
        row = next(iter(tables_of(drive)["sample_annotation"].values()))
        inside = np.linalg.inv(recording[0].pose) @ [*row["translation"], 1]
        points = np.array(augmented.sweep.points)
        points[:7] = inside[:3]
        return replace(augmented, sweep=augmented.sweep.replace(points=points))

    new = tmp_path / "new"
    notes = rewrite(opened(drive), new, tmp_path / "work", only_first)
    old, rows = tables_of(drive)["sample_annotation"], tables_of(new)["sample_annotation"]
    first, *others = rows
    assert rows[first]["num_lidar_pts"] >= 7
    samples = tables_of(drive)["sample"]
    later = [token for token in others if samples[rows[token]["sample_token"]]["prev"]]
    assert later and all(rows[token] == old[token] for token in later)
    assert any(note.startswith("`num_lidar_pts` was updated in") for note in notes)


def panoptic_labels(source):
    """Add panoptic labels to a data set, and return their table."""
    tables = tables_of(source)
    rows = []
    for token, row in tables["lidarseg"].items():
        name = row["filename"].replace("lidarseg/", "panoptic/").replace(".bin", ".npz")
        labels = np.fromfile(source / row["filename"], "u1").astype(np.uint16)
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(source / name, data=1000 * labels + 7)
        rows.append({"token": token, "sample_data_token": token, "filename": name})
    (source / VERSION / "panoptic.json").write_text(json.dumps(rows))
    return rows


def test_panoptic_labels(drive, tmp_path):
    source = tmp_path / "source"
    shutil.copytree(drive, source)
    rows = panoptic_labels(source)
    new = tmp_path / "new"
    rewriter = opened(source)
    rewrite(rewriter, new, tmp_path / "work", with_objects)
    number = 2
    expected = with_objects(rewriter.recording, number)
    (name,) = [
        row["filename"] for row in rows if f"samples-LIDAR_TOP-{number:06}" in row["filename"]
    ]
    with np.load(new / name) as archive:
        labels = archive["data"]
    assert labels.dtype == np.uint16
    added = ~expected.is_recorded
    objects = expected.sweep.columns["object"][added]
    np.testing.assert_array_equal(labels[added], np.where(objects == 50, 2008, 4009))
    with np.load(source / name) as archive:
        kept = archive["data"][expected.template[~added]]
    np.testing.assert_array_equal(labels[~added], kept)


def test_augmented_copies_can_be_augmented_again(drive, tmp_path):
    rewrite(opened(drive), tmp_path / "a", tmp_path / "aw", with_objects)
    rewrite(opened(tmp_path / "a"), tmp_path / "b", tmp_path / "bw", with_objects)
    tables = tables_of(tmp_path / "b")
    for name in ("instance", "sample_annotation", "category"):
        text = (tmp_path / f"b/{VERSION}/{name}.json").read_text()
        assert len(tables[name]) == len(json.loads(text))
    assert len(tables["instance"]) == len(tables_of(drive)["instance"]) + 4


def test_several_channels(drive, tmp_path):
    channels = ("LIDAR_TOP", "rear_left")
    rewriters = [opened(drive, channel) for channel in channels]
    works = [tmp_path / "w0", tmp_path / "w1"]
    for rewriter, work in zip(rewriters, works, strict=True):
        for number in range(3):
            write_sweep(rewriter, work, number, with_objects(rewriter.recording, number))
    new = tmp_path / "new"
    finish(rewriters[0], new, works[0], others=[(rewriters[1], works[1])])
    tables = tables_of(new)
    assert len(tables["instance"]) == len(tables_of(drive)["instance"]) + 4
    assert [row["name"] for row in tables["category"].values()].count("walker") == 1
    for channel, rewriter in zip(channels, rewriters, strict=True):
        recording = open_recording(new, channel, keep_noise=True)
        expected = with_objects(rewriter.recording, 2)
        np.testing.assert_allclose(recording[2].points, expected.sweep.points, rtol=1e-6)
        added = ~expected.is_recorded
        (name,) = (new / "lidarseg" / VERSION).glob(f"*-{channel}-000002.pcd.bin")
        assert set(np.fromfile(name, "u1")[added]) == {2, 4}


def test_one_of_several_scenes(tmp_path):
    scene = the_scene()
    source = tmp_path / "set"
    write_set(source, "nuscenes", scene, the_sweeps(scene))
    sensor = "01 LIDAR_TOP"
    rewriter = opened(source / VERSION, sensor)
    new = tmp_path / "new"
    notes = rewrite(rewriter, new, tmp_path / "work", with_objects)
    assert notes[0].startswith("Only the sweeps of 01 LIDAR_TOP were augmented. 00 LIDAR_TOP, 00")
    before, after = content(source), content(new)
    differ = {name for name in before if before[name] != after[name]}
    tables = {f"{VERSION}/{name}.json" for name in ("category", "instance", "sample_annotation")}
    # The second sweep is empty.
    assert differ == tables | {f"samples/LIDAR_TOP/01/00000{number}.pcd.bin" for number in (0, 2)}
    assert before.keys() == after.keys()


@pytest.mark.parametrize(
    ("table", "column", "reason"),
    [
        ("ego_pose", "translation", "the pose in the row with the token {} is not finite"),
        ("ego_pose", "rotation", "the quaternion of the row with the token {} is not finite"),
        ("calibrated_sensor", "translation", "the pose in the row with the token {} is not finite"),
    ],
)
def test_poses_that_are_not_finite_are_refused(drive, tmp_path, table, column, reason):
    source = tmp_path / "source"
    shutil.copytree(drive, source)
    rows = json.loads((source / VERSION / f"{table}.json").read_text())
    rows[0][column][1] = np.nan
    (source / VERSION / f"{table}.json").write_text(json.dumps(rows))
    recording = open_recording(source, "LIDAR_TOP")
    with pytest.raises(LidarError, match=reason.format(rows[0]["token"])):
        recording.poses(range(len(recording)))


def test_tables_of_other_versions_are_unchanged(drive, tmp_path):
    source = tmp_path / "source"
    shutil.copytree(drive, source)
    (source / "v1.0-other").mkdir()
    (source / "v1.0-other/sample_data.json").write_text("[]")
    rewriter = opened(source / VERSION, "LIDAR_TOP")
    rewrite(rewriter, tmp_path / "new", tmp_path / "work", changed)
    assert (tmp_path / "new/v1.0-other/sample_data.json").read_text() == "[]"


def test_visibility_levels():
    rows = [{"token": "1", "level": "v0-40"}, {"token": "4", "level": "v80-100"}]
    found = [visibility_token(rows, share) for share in (0, 0.4, 0.5, 0.9, 1.2, None)]
    assert found == ["1", "1", "", "4", "4", ""]


def test_types_without_a_category_in_lidarseg(drive, tmp_path):
    source = tmp_path / "source"
    shutil.copytree(drive, source)
    rows = json.loads((source / VERSION / "category.json").read_text())
    rows.append({"token": "other", "name": "static.other", "description": "", "index": 4})
    (source / VERSION / "category.json").write_text(json.dumps(rows))
    notes = rewrite(opened(source), tmp_path / "new", tmp_path / "work", with_objects)
    assert "nuScenes has no category for walker, so these inserted objects have the" in notes[-1]
    tables = tables_of(tmp_path / "new")
    assert len(tables["category"]) == len(rows)
    assert "other" in {row["category_token"] for row in tables["instance"].values()}


def test_the_devkit_reads_the_copy(tmp_path):
    nuscenes = pytest.importorskip("nuscenes.nuscenes")
    from nuscenes.utils.data_classes import LidarPointCloud
    from nuscenes.utils.geometry_utils import points_in_box as inside

    # Without labels, because the devkit accepts only the labels of nuScenes.
    drive = write_drive(tmp_path / "drive", {})
    new = tmp_path / "new"
    rewrite(opened(drive), new, tmp_path / "work", with_objects)
    data = nuscenes.NuScenes(VERSION, str(new), verbose=False)
    for sample in data.sample:
        path, boxes, _ = data.get_sample_data(sample["data"]["LIDAR_TOP"])
        cloud = LidarPointCloud.from_file(path)
        assert {"Car", "walker"} <= {box.name for box in boxes}
        for box in boxes:
            row = data.get("sample_annotation", box.token)
            assert inside(box, cloud.points[:3]).sum() <= row["num_lidar_pts"]
