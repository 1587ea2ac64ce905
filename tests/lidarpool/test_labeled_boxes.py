"""Labeled boxes of recordings, as `open_recording` reads them and the viewer shows them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.packet_surveys import points_of

from lidarfiles import open_recording
from lidarfiles.clouds.writing import ExportSpec
from lidarpool.pages.opened import open_view, open_views
from lidarsim import Actor, LidarError, Mounted, Scene, Sensor, Survey, Track, box

# Height, width, length, bottom center in camera axes (right, down, forward), and rotation_y.
CAR = "1.5 1.8 4.2 -3 1.6 12 -1.5707963267948966"  # 12 m ahead, 3 m to the left, facing forward
LEFT = "1.7 0.6 0.8 2 1.5 6 3.141592653589793"  # 6 m ahead, 2 m to the right, facing left
IN_IMAGE = "0 0 0 10 20 30 40"
TO_CAMERA = "0 -1 0 0 0 0 -1 0 1 0 0 0.25"


def sweeps(folder, count):
    folder.mkdir(parents=True)
    for number in range(count):
        points = np.random.default_rng(number).uniform(1, 40, (60, 4)).astype("<f4")
        points.tofile(folder / f"{number:06}.bin")


@pytest.fixture
def benchmark(tmp_path):
    """Three frames of the object benchmark, of which the first two have labels."""
    folder = tmp_path / "training"
    sweeps(folder / "velodyne", 3)
    (folder / "label_2").mkdir()
    (folder / "calib").mkdir()
    labels = f"Car {IN_IMAGE} {CAR}\nDontCare -1 -1 -10 1 2 3 4 -1 -1 -1 -1000 -1000 -1000 -10\n"
    (folder / "label_2/000000.txt").write_text(f"{labels}\nPedestrian {IN_IMAGE} {LEFT} 0.93\n")
    (folder / "label_2/000001.txt").write_text(f"Car {IN_IMAGE} {CAR}\n")
    for number in range(3):
        # The lidar is 0.25 m behind the camera in the first frame, and 0.5 m in the others.
        text = f"R0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: {TO_CAMERA}\n"
        text = text.replace("0.25", "-0.25" if number == 0 else "-0.5")
        (folder / f"calib/{number:06}.txt").write_text(text)
    return folder


def labeled(view):
    header, arrays = view.answer("state", {}, bool)
    names = [row["name"] for row in header["labeled"]]
    assert len(header["labeled_colors"]) == len(names)
    parts = ("size", "times", "places", "turns", "there")
    return {
        number: (name, *(arrays[f"labeled{number}_{part}"] for part in parts))
        for number, name in enumerate(names)
    }


def test_labels_of_the_object_benchmark_are_read(benchmark):
    boxes = open_recording(benchmark).boxes
    assert boxes.sweep.tolist() == [0, 0, 1] and boxes.object.tolist() == [0, 1, 2]
    assert boxes.kinds == ("Car", "Pedestrian", "Car") and not boxes.are_tracked
    centers = [[12.25, 3, -0.85], [6.25, -2, -0.65], [12.5, 3, -0.85]]
    assert boxes.poses[:, :3, 3] == pytest.approx(np.array(centers))
    assert boxes.poses[:, :3, 0] == pytest.approx(np.array([[1, 0, 0], [0, 1, 0], [1, 0, 0]]))
    assert boxes.sizes.tolist() == [[4.2, 1.8, 1.5], [0.8, 0.6, 1.7], [4.2, 1.8, 1.5]]


def test_the_viewer_shows_boxes_with_their_names_in_their_sweeps(benchmark):
    view = open_view(benchmark)
    car, pedestrian, later = labeled(view).values()
    assert (car[0], pedestrian[0], later[0]) == ("Car", "Pedestrian", "Car")
    assert car[1].tolist() == [4.2, 1.8, 1.5]
    assert car[3] + view.origin == pytest.approx(np.array([[12.25, 3, -0.85]]))
    assert np.abs(pedestrian[4]) == pytest.approx(np.array([[0, 0, 0.5**0.5, 0.5**0.5]]))
    starts, ends = zip(*(box[5] for box in (car, pedestrian, later)), strict=True)
    assert starts == pytest.approx((0, 0, 0.1))
    assert all(start < end < start + 0.1 for start, end in zip(starts, ends, strict=True))


@pytest.mark.parametrize("label", [f"Car {CAR}", f"Car {IN_IMAGE} {CAR} x".replace("1.8", "wide")])
def test_invalid_labels_do_not_hide_the_points(benchmark, label):
    (benchmark / "label_2/000001.txt").write_text(f"Car {IN_IMAGE} {CAR}\n{label}\n")
    with pytest.raises(LidarError, match=r"label_2/000001\.txt, line 2: a label of KITTI consists"):
        _ = open_recording(benchmark).boxes
    view = open_view(benchmark)
    assert len(view.points) == 180 and not labeled(view)
    assert "Labeled boxes are not shown." in view.note and "000001.txt, line 2" in view.note


@pytest.fixture
def tracked(tmp_path):
    """A sequence of four sweeps with poses and track ids, whose car stops and is hidden once."""
    sequence = tmp_path / "drive/sequences/07"
    sweeps(sequence / "velodyne", 4)
    (sequence / "calib.txt").write_text(f"Tr: {TO_CAMERA.replace('0.25', '0')}\n")
    # The camera, which is in the lidar, moves by 2 m along its z axis, which is the lidar's x axis.
    poses = [f"1 0 0 0 0 1 0 0 0 0 1 {2 * number}" for number in range(4)]
    (sequence / "poses.txt").write_text("\n".join(poses) + "\n")
    rows = [(0, 4, "Car", 12), (1, 4, "Car", 11), (3, 4, "Car", 10), (3, 9, "Van", 30)]
    labels = [
        f"{frame} {track} {kind} {IN_IMAGE} {CAR.replace(' 12 ', f' {z} ')}\n"
        for frame, track, kind, z in rows
    ]
    (tmp_path / "drive/label_02").mkdir()
    (tmp_path / "drive/label_02/07.txt").write_text("".join(labels))
    return tmp_path / "drive"


def test_boxes_of_tracks_are_placed_in_the_world(tracked):
    assert open_recording(tracked).boxes.are_tracked
    view = open_view(tracked)
    car, van = labeled(view).values()
    assert (car[0], van[0]) == ("Car 4", "Van")
    assert car[2].tolist() == pytest.approx([0, 0.1, 0.3])
    world = np.array([[12, 3, -0.85], [13, 3, -0.85], [16, 3, -0.85]])
    assert car[3] + view.origin == pytest.approx(world)
    assert van[3] + view.origin == pytest.approx(np.array([[36, 3, -0.85]]))
    assert car[5].tolist() == [0, np.inf] and van[5].tolist() == pytest.approx([0.3, np.inf])


def test_boxes_remain_if_a_recording_is_shown_beside_others(tracked):
    assert [box[0] for box in labeled(open_views([tracked, tracked])).values()] == ["Car 4", "Van"]


@pytest.mark.parametrize(
    ("kind", "name", "origin_m"),
    [("kitti", "Car 2", 2), ("nuscenes", "Car 0", 0), ("mcap", "Car 0", 0)],
)
def test_boxes_of_exported_actors_are_shown_where_the_actors_were(tmp_path, kind, name, origin_m):
    car = Actor(box("Car 1", (4, 2, 1.5)), Track([0, 0.3], [[8, 1, 0], [11, 1, 0]]))
    scene = Scene.from_meshes([box("Floor", (60, 60, 0.1))]).with_actors([car])
    survey = Survey(
        sensors=[Mounted(Sensor.grid(layers=6), name="roof")],
        trajectory=Track([0, 0.3], [[0, 0, 2], [3, 0, 2.0]]),
        columns=["ray", "range", "intensity", "reflectivity", "time", "object", "class"],
    )
    cloud, sweeps = points_of(survey, scene)
    export = ExportSpec(kind)
    export.write(tmp_path / export.row.file, replace(cloud, sweeps=lambda: sweeps), sweeps)
    view = open_view(tmp_path / export.row.file)
    (shown,) = labeled(view).values()
    assert shown[0] == name and shown[1] == pytest.approx([4, 2, 1.5])
    expected = np.column_stack(
        [8 + 10 * shown[2], np.ones(len(shown[2])), np.full(len(shown[2]), 0.75 - origin_m)]
    )
    assert len(shown[2]) > 1
    # The world frame of KITTI is the frame of the first sweep, 2 m above the floor.
    assert shown[3] + view.origin == pytest.approx(expected, abs=0.02)
