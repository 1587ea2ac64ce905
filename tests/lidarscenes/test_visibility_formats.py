"""The visibility of actors in the boxes of data sets, bags and the job table."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from tests.lidarscenes.test_actor_visibility import MOUNT, SENSOR, street
from tests.lidarscenes.test_scene_flow import turning

from lidarfiles import save_cloud
from lidarfiles.clouds.boxes import Boxes, summarize_boxes
from lidarfiles.datasets.dataset import DataSet
from lidarfiles.datasets.job_table import JobRow, read_table, write_table
from lidarfiles.datasets.loader import sweeps as data_set_sweeps
from lidarsim import Mounted, Survey
from lidarsim.columns.table import SCAN
from lidarsim.io.storage import Storage
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.rig import Rig
from lidarsim.sweeps.sweeps import Sweeps


@cache
def drive():
    """The cloud of a sensor on a turning platform among seven actors."""
    scene = street()
    survey = Survey(
        sensors=[Mounted(SENSOR, MOUNT, "lidar")], trajectory=turning(2.0, 1.5), steps=12,
        columns=("time", "intensity", "reflectivity", "class"), actor_visibility=True,
    )  # fmt: skip
    part = columns_of(list(Rig(scene, survey, "numpy").cast(0, survey.scan_count)))
    cloud = part.cloud((SCAN, *survey.stored_columns[3:]), survey.precision_m, scene.origin)
    sweeps = Sweeps.from_survey(survey, scene).with_actor_rays([part.actor_rays])
    return replace(cloud, sweeps=lambda: sweeps)


@cache
def boxes_of_drive():
    cloud = drive()
    sweeps = cloud.sweeps()
    points = enumerate(sweeps.points(cloud))
    return [Boxes.from_points(sweeps, number, points_of) for number, points_of in points]


def test_kitti_labels_have_truncation_and_occlusion(tmp_path):
    save_cloud(drive(), tmp_path / "kitti", format="kitti")
    names = [name.replace(" ", "_") for name in drive().sweeps().actor_types]
    tracks = (tmp_path / "kitti/label_02/00.txt").read_text().splitlines()
    occlusions = set()
    for number, boxes in enumerate(boxes_of_drive()):
        labels = (tmp_path / f"kitti/sequences/00/label_2/{number:06}.txt").read_text().splitlines()
        rows = np.flatnonzero(boxes.present & (boxes.points > 0)).tolist()
        assert len(labels) == len(rows) > 1
        of_frame = [line.split() for line in tracks if line.split()[0] == str(number)]
        for row, line, track in zip(rows, labels, of_frame, strict=True):
            kind, truncated, occluded, *_ = line.split()
            fraction = boxes.visibility.visible_fraction[row]
            expected = 0 if fraction >= 0.8 else 1 if fraction >= 0.4 else 2
            assert (kind, int(occluded)) == (names[row], expected)
            truncation = boxes.visibility.truncation[row]
            assert float(truncated) == pytest.approx(truncation, abs=0.0051)
            level = 0 if truncation <= 0.15 else 1 if truncation <= 0.5 else 2
            assert track[3:5] == [str(level), occluded]
            occlusions.add(expected)
    assert len(occlusions) > 1


def test_nuscenes_annotations_have_visibility_levels(tmp_path):
    save_cloud(drive(), tmp_path / "nu", format="nuscenes")
    tables = next((tmp_path / "nu").glob("v1.0-*"))
    levels = {row["token"]: row["level"] for row in json.loads((tables / "visibility.json").read_text())}  # fmt: skip  # noqa: E501
    assert levels == {"1": "v0-40", "2": "v40-60", "3": "v60-80", "4": "v80-100"}
    rows = json.loads((tables / "sample_annotation.json").read_text())
    assert len(rows) == sum(int(boxes.present.sum()) for boxes in boxes_of_drive())
    for row in rows:
        fraction = row["visible_fraction"] or 0
        lower, upper = map(int, levels[row["visibility_token"]][1:].split("-"))
        assert lower <= 100 * fraction <= upper
        assert (row["nearest_ray_m"] > 0) <= (row["num_lidar_pts"] == 0)
    assert {*(row["visibility_token"] for row in rows)} >= {"1", "4"}
    assert any(row["visible_fraction"] is None for row in rows)


def test_bags_have_diagnostics_of_actors(tmp_path):
    save_cloud(drive(), tmp_path / "a.mcap")
    store = get_typestore(Stores.ROS2_HUMBLE)
    with AnyReader([tmp_path / "a.mcap"], default_typestore=store) as bag:
        messages = [
            bag.deserialize(data, connection.msgtype)
            for connection, _, data in bag.messages()
            if connection.topic == "/lidar/actor_visibility"
        ]
    sweeps = drive().sweeps()
    for boxes, message in zip(boxes_of_drive(), messages, strict=True):
        rows = np.flatnonzero(boxes.present)
        assert len(message.status) == len(rows)
        for row, status in zip(rows, message.status, strict=True):
            values = {pair.key: float(pair.value) for pair in status.values}
            expected = boxes.visibility[row].arrays | {"points": boxes.points[row]}
            assert status.name.replace("_", " ") == sweeps.actors[row]
            for name, value in values.items():
                np.testing.assert_allclose(value, expected[name], rtol=1e-5)


def test_data_sets_have_visibility_and_the_job_table_its_means(tmp_path):
    data = DataSet(Storage(str(tmp_path)), "webdataset")
    row = data.write_job(JobRow(0, "0"), drive(), drive().sweeps())
    assert row.boxes == summarize_boxes(boxes_of_drive())
    present = np.concatenate([boxes.present for boxes in boxes_of_drive()])
    points = np.concatenate([boxes.points for boxes in boxes_of_drive()])[present]
    fractions = np.concatenate([b.visibility.visible_fraction for b in boxes_of_drive()])[present]
    assert row.boxes["boxes"] == len(points)
    assert row.boxes["boxes_with_points"] == (points > 0).sum() < len(points)
    assert row.boxes["visible_fraction"] == pytest.approx(np.nanmean(fractions), rel=1e-5)
    assert row.boxes["nearest_ray_m"] > 1
    rows = [row, JobRow(1, "1", error="failed")]
    storage = Storage(str(tmp_path))
    write_table(storage, [], lambda: rows)
    assert [r.boxes for r in read_table(storage)] == [row.boxes, {}]
    header = (tmp_path / "jobs.csv").read_text().splitlines()[0].split(",")
    assert header[-5:] == ["boxes", "boxes_with_points", "visible_fraction", "truncation",
                           "nearest_ray_m"]  # fmt: skip
    data.finish([row])
    loaded = list(data_set_sweeps(str(tmp_path)))
    assert len(loaded) == 3
    for sweep, boxes in zip(loaded, boxes_of_drive(), strict=True):
        for name, values in boxes.visibility[boxes.present].arrays.items():
            np.testing.assert_array_equal(getattr(sweep.boxes, name), values)


def test_without_the_option_labels_are_as_before(tmp_path):
    cloud = drive()
    plain = replace(cloud.sweeps(), actor_rays=Sweeps.unknown().actor_rays)
    save_cloud(replace(cloud, sweeps=lambda: plain), tmp_path / "kitti", format="kitti")
    lines = (tmp_path / "kitti/sequences/00/label_2/000000.txt").read_text().splitlines()
    assert {tuple(line.split()[1:3]) for line in lines} == {("0.00", "3")}
    assert summarize_boxes([Boxes.from_points(plain, 0, next(plain.points(cloud)))]) == {}
