"""Augmented copies of KITTI data sets."""

from __future__ import annotations

import shutil
from dataclasses import replace
from functools import partial
from itertools import combinations

import numpy as np
import pytest
from tests.drives import points_of, the_scene, the_sweeps
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
from lidarreal.augmentation.augmented_sweep import AugmentedSweep
from lidarreal.augmentation.rewriting.kitti_labels import KittiCamera
from lidarreal.augmentation.rewriting.opening import open_rewriter
from lidarsim import LidarError
from lidarsim.columns.sweep import Sweep

P2 = np.array([[700.0, 0, 600, 0], [0, 700, 180, 0], [0, 0, 1, 0]])


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    scene = the_scene()
    path = tmp_path_factory.mktemp("kitti") / "drive"
    ExportSpec("kitti").write(path, points_of(scene, 0), the_sweeps(scene))
    return path


def opened(path, sensor=None):
    ref = RecordingRef(path, sensor, keep_noise=True)
    return open_rewriter(ref, open_ref(ref))


def rows_of(path):
    return np.fromfile(path, "<f4").reshape(-1, 4)


def test_identity_keeps_all_bytes(drive, tmp_path):
    before = content(drive)
    notes = rewrite(opened(drive, "00"), tmp_path / "new", tmp_path / "work", identity)
    assert content(tmp_path / "new") == before == content(drive)
    assert notes[0].startswith("Only the sweeps of 00 were augmented. 01 in ")
    assert notes[-1].startswith("Hard links to the original data in")
    poses = "sequences/01/poses.txt"
    assert (tmp_path / "new" / poses).stat().st_ino != (drive / poses).stat().st_ino
    points = "sequences/01/velodyne/000000.bin"
    assert (tmp_path / "new" / points).stat().st_ino == (drive / points).stat().st_ino


def test_points_labels_and_boxes_of_a_sequence(drive, tmp_path):
    augment = partial(changed, boxes=two_boxes(), visibility=[0.5, 0.0])
    rewriter = opened(drive, "00")
    notes = rewrite(rewriter, tmp_path / "new", tmp_path / "work", augment)
    for number in (0, 2):
        expected = augment(rewriter.recording, number)
        read = open_recording(tmp_path / "new", "00", keep_noise=True)[number]
        np.testing.assert_array_equal(read.points, expected.sweep.points.astype(np.float32))
        for name in ("intensity", "class", "object"):
            np.testing.assert_array_equal(
                read.columns[name], expected.sweep.columns[name].astype(read.columns[name].dtype)
            )
        name = f"sequences/00/velodyne/{number:06}.bin"
        rows = rows_of(tmp_path / "new" / name)
        kept = rows_of(drive / name)[expected.template][expected.is_recorded]
        assert rows[expected.is_recorded, :3].tobytes() == kept[:, :3].tobytes()
        labels = np.fromfile(tmp_path / f"new/sequences/00/labels/{number:06}.label", "<u4")
        assert set(labels[~expected.is_recorded] >> 16) == {51, 52}
    old = (drive / "sequences/00/label_2/000000.txt").read_text()
    new = (tmp_path / "new/sequences/00/label_2/000000.txt").read_text()
    assert new.startswith(old)
    (line,) = new[len(old) :].splitlines()  # the walker has no points
    kind, truncation, occlusion, *numbers = line.split()
    assert (kind, truncation, occlusion) == ("Car", "0.00", "1")
    numbers = np.array(numbers, float)
    np.testing.assert_allclose(numbers[5:8], [1.5, 2, 4])
    assert numbers[[1, 2, 3, 4]].tolist() == [0, 0, 0, 0]
    # The bottom of the box is 10 m ahead and 2 m to the left, in the level frame of the camera.
    assert np.linalg.norm(numbers[8:11] - [-2, 1 + 0.75, 10]) < 0.5
    assert any("boxes of inserted objects were not labeled" in note for note in notes)
    tracks = (tmp_path / "new/label_02/00.txt").read_text().splitlines()
    assert [int(track.split()[0]) for track in tracks] == sorted(
        int(track.split()[0]) for track in tracks
    )
    assert [track.split()[0] for track in tracks if track.split()[1] == "51"] == ["0", "1", "2"]


def test_sweeps_without_labels_are_noted(drive, tmp_path):
    path = tmp_path / "drive"
    shutil.copytree(drive, path)
    (path / "sequences/00/labels/000001.label").unlink()
    notes = rewrite(opened(path, "00"), tmp_path / "new", tmp_path / "work", changed)
    assert (
        f"{path} has no 000001.label in the folder `labels`, so the points of these sweeps are not "
        "labeled in the copy."
    ) in notes
    labels = [file.name for file in sorted((tmp_path / "new/sequences/00/labels").iterdir())]
    assert labels == ["000000.label", "000002.label"]


def test_encoded_sweeps_are_the_same_in_any_order(drive, tmp_path):
    for folder, numbers in (("a", range(3)), ("b", (2, 0, 1))):
        rewrite(opened(drive, "01"), tmp_path / folder, tmp_path / f"{folder}w", changed, numbers)
    assert content(tmp_path / "aw") == content(tmp_path / "bw")
    assert content(tmp_path / "a") == content(tmp_path / "b")


def test_several_sequences(drive, tmp_path):
    rewriters = [opened(drive, name) for name in ("00", "01")]
    works = [tmp_path / name for name in ("w0", "w1")]
    augment = partial(changed, boxes=two_boxes())
    for rewriter, work in zip(rewriters, works, strict=True):
        for number in range(3):
            write_sweep(rewriter, work, number, augment(rewriter.recording, number))
    others = [(rewriters[1], works[1])]
    notes = finish(rewriters[0], tmp_path / "both", works[0], others=others)
    assert not any("Only the sweeps" in note for note in notes)
    both = content(tmp_path / "both")
    for sensor in ("00", "01"):
        rewrite(opened(drive, sensor), tmp_path / sensor, tmp_path / f"w-{sensor}", augment)
        single = content(tmp_path / sensor)
        for name in single:
            if name.startswith((f"sequences/{sensor}/", f"label_02/{sensor}")):
                assert both[name] == single[name]
    assert (
        content(drive)["sequences/01/velodyne/000000.bin"]
        != both["sequences/01/velodyne/000000.bin"]
    )


@pytest.mark.parametrize("inner", [".", "velodyne", "velodyne_points/data"])
def test_folders_of_points(tmp_path, inner):
    folder = tmp_path / "set" / inner
    folder.mkdir(parents=True)
    points = np.random.default_rng(0).uniform(-9, 9, (30, 4)).astype("<f4")
    for number in range(2):
        points.tofile(folder / f"{number:010}.bin")
    (tmp_path / "set/timestamps.txt").write_text("12:00\n")
    rewriter = opened(tmp_path / "set")
    boxed = partial(changed, boxes=two_boxes())
    notes = rewrite(rewriter, tmp_path / "new", tmp_path / "work", boxed)
    expected = changed(rewriter.recording, 0)
    rows = rows_of(tmp_path / "new" / inner / "0000000000.bin")
    np.testing.assert_allclose(rows[:, :3], expected.sweep.points, rtol=1e-7)
    np.testing.assert_allclose(rows[:, 3], expected.sweep.columns["intensity"], rtol=1e-7)
    assert (tmp_path / "new/timestamps.txt").read_text() == "12:00\n"
    assert any("has no folder `label_2`, so the boxes" in note for note in notes)
    assert any("has no semantic labels, so the classes" in note for note in notes)


def test_a_single_file(drive, tmp_path):
    file = drive / "sequences/00/velodyne/000000.bin"
    notes = rewrite(opened(file), tmp_path / "one.bin", tmp_path / "work", identity)
    assert (tmp_path / "one.bin").read_bytes() == file.read_bytes()
    assert notes == [
        "The labels of the sweep are not written with a single .bin file. To write them, specify "
        "the folder of the sequence."
    ]


@pytest.fixture
def benchmark(tmp_path):
    """Two frames of the object benchmark."""
    folder = tmp_path / "training"
    for name in ("velodyne", "calib", "label_2", "image_2"):
        (folder / name).mkdir(parents=True)
    angle = 0.01  # by which the cameras are rectified
    rectify = np.array(
        [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    )
    to_camera = np.array([[0, -1, 0, 0], [0, 0, -1, -0.08], [1, 0, 0, -0.27]])
    for number in range(2):
        points = np.random.default_rng(number).uniform(1, 40, (60, 4)).astype("<f4")
        points.tofile(folder / f"velodyne/{number:06}.bin")
        lines = {"P2": P2, "R0_rect": rectify, "Tr_velo_to_cam": to_camera}
        text = "".join(f"{n}: {' '.join(map(str, m.ravel()))}\n" for n, m in lines.items())
        (folder / f"calib/{number:06}.txt").write_text(text)
        (folder / f"label_2/{number:06}.txt").write_text("DontCare -1 -1 -10 1 2 3 4 -1 -1 -1")
        (folder / f"image_2/{number:06}.png").write_bytes(_image())
    return folder, rectify @ to_camera


def _image():
    import io

    from PIL import Image

    memory = io.BytesIO()
    Image.new("RGB", (1200, 360)).save(memory, "png")
    return memory.getvalue()


def test_labels_of_the_object_benchmark(benchmark, tmp_path):
    folder, to_camera = benchmark
    boxes = two_boxes(points=(9, 5))  # the walker is 8 m to the left at a depth of 3 m: not seen
    augment = partial(changed, boxes=boxes, visibility=[0.9, 1.0])
    notes = rewrite(opened(folder), tmp_path / "new", tmp_path / "work", augment)
    first, second, *others = (tmp_path / "new/label_2/000001.txt").read_text().splitlines()
    assert first.startswith("DontCare") and not others
    kind, truncation, occlusion, *numbers = second.split()
    assert (kind, truncation, occlusion) == ("Car", "0.00", "0")
    alpha, left, top, right, bottom, *size, x, y, z, rotation_y = map(float, numbers)
    assert size == [1.5, 2.0, 4.0]
    bottom_center = to_camera @ [10, 2, -1, 1] + [0, 0.75, 0]
    np.testing.assert_allclose([x, y, z], bottom_center, atol=1e-4)
    # The devkit's rule: corners of the box in the camera frame, rotated about y by rotation_y.
    c, s = np.cos(rotation_y), np.sin(rotation_y)
    corners = np.array(
        [[dx, dy, dz] for dx in (-2, 2) for dy in (-1.5, 0) for dz in (-1, 1)], float
    )
    corners = corners @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]).T + [x, y, z]
    pixels = np.column_stack([corners, np.ones(8)]) @ P2.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    expected = [*pixels.min(axis=0), *pixels.max(axis=0)]
    np.testing.assert_allclose([left, top, right, bottom], expected, atol=3)
    # The car is turned by 90 degrees: it points to the left.
    assert rotation_y == pytest.approx(-np.pi, abs=0.02) or rotation_y == pytest.approx(
        np.pi, abs=0.02
    )
    assert alpha == pytest.approx(np.angle(np.exp(1j * (rotation_y - np.arctan2(x, z)))), abs=1e-3)
    assert any("2 of 4 boxes of inserted objects were not labeled" in note for note in notes)
    image = "image_2/000000.png"
    assert (tmp_path / "new" / image).stat().st_ino == (folder / image).stat().st_ino


@pytest.mark.parametrize(("heading_deg", "y_m"), [(0, 2), (35, 2), (-50, -3), (-120, 1), (170, -2)])
def test_headings_of_labels_in_the_object_benchmark(benchmark, tmp_path, heading_deg, y_m):
    """The sensor is not level, and the car is on either side of it."""
    folder, to_camera = benchmark
    heading, center = np.radians(heading_deg), np.array([14.0, y_m, -1.0])
    boxes = two_boxes(points=(9, 0))
    quaternions = np.array([[0, 0, np.sin(heading / 2), np.cos(heading / 2)], [0, 0, 0, 1]])
    boxes = replace(boxes, quaternions=quaternions, centers=np.array([center, [30, 0, 0]]))
    augment = partial(changed, boxes=boxes, visibility=[0.5, 1.0])
    rewrite(opened(folder), tmp_path / "new", tmp_path / "work", augment)
    label = (tmp_path / "new/label_2/000000.txt").read_text().splitlines()[-1]
    kind, _, occlusion, *numbers = label.split()
    assert (kind, occlusion) == ("Car", "1")
    alpha, left, top, right, bottom, *size, x, y, z, rotation_y = map(float, numbers)
    assert size == [1.5, 2.0, 4.0]
    np.testing.assert_allclose([x, y, z], to_camera @ [*center, 1] + [0, 0.75, 0], atol=1e-4)
    # The x axis of the camera points to the right, and its z axis forward, turned by 0.01.
    expected = np.angle(np.exp(1j * (-heading - np.pi / 2 + 0.01)))
    assert np.angle(np.exp(1j * (rotation_y - expected))) == pytest.approx(0, abs=1e-3)
    assert alpha == pytest.approx(np.angle(np.exp(1j * (rotation_y - np.arctan2(x, z)))), abs=1e-3)
    cos, sin = np.cos(heading), np.sin(heading)
    turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    corners = signs * [2, 1, 0.75] @ turn.T + center
    pixels = np.column_stack([corners, np.ones(8)]) @ to_camera.T
    pixels = np.column_stack([pixels, np.ones(8)]) @ P2.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    np.testing.assert_allclose([left, top], pixels.min(axis=0), atol=1e-3)
    np.testing.assert_allclose([right, bottom], pixels.max(axis=0), atol=1e-3)


def test_open3d_ml_reads_the_box_of_an_inserted_car(benchmark, tmp_path):
    """Its reader requires packages that Open3D does not install everywhere."""
    pytest.importorskip("sklearn")
    pytest.importorskip("addict")
    from open3d._ml3d.datasets.kitti import KITTI

    folder, _ = benchmark
    (folder / "label_2/000000.txt").write_text("")
    augment = partial(changed, boxes=two_boxes(points=(9, 0)), visibility=[0.9, 1.0])
    rewrite(opened(folder), tmp_path / "new", tmp_path / "work", augment)
    camera, *others = (tmp_path / "new/calib/000000.txt").read_text().splitlines()
    cameras = [camera.replace("P2", f"P{number}") for number in range(4)]
    (tmp_path / "calib.txt").write_text("\n".join([*cameras, *others]))  # the reader needs four
    calibration = KITTI.read_calib(str(tmp_path / "calib.txt"))
    *_, car = KITTI.read_label(str(tmp_path / "new/label_2/000000.txt"), calibration)
    assert car.label_class == "Car"
    np.testing.assert_allclose(car.center, [10, 2, -1], atol=0.01)
    np.testing.assert_allclose(car.size, [2.0, 1.5, 4.0])
    points = np.array([[10, 2, -1], [10, 3.9, -1], [10.9, 2, -1], [10, 4.2, -1], [11.2, 2, -1]])
    axes = np.array([car.left, car.up, car.front])
    inside = (np.abs((points - car.center) @ axes.T) <= np.array(car.size) / 2).all(axis=1)
    assert inside.tolist() == [True] * 3 + [False] * 2


def test_truncated_boxes(benchmark, tmp_path):
    folder, _ = benchmark
    boxes = two_boxes(points=(9, 0))
    boxes.centers[0] = [6, 5, -1]
    augment = partial(changed, boxes=boxes)
    rewrite(opened(folder), tmp_path / "new", tmp_path / "work", augment)
    line = (tmp_path / "new/label_2/000000.txt").read_text().splitlines()[-1]
    _, truncation, occlusion, _, left, _, right, _ = line.split()[:8]
    assert 0.1 < float(truncation) < 0.9 and occlusion == "3"
    assert float(left) == 0 < float(right) < 1199


@pytest.mark.parametrize(
    ("center", "heading_deg"),
    [((0.5, 2.5, -1), 0), ((1.2, -3, -1), 25), ((-0.4, 2, 0.5), -70), ((0.3, 0, -2), 130)],
)
def test_boxes_are_cut_at_the_camera(center, heading_deg):
    """A camera with a wide angle sees the front parts of cars beside, above and below it."""
    projection = np.array([[20.0, 0, 600, 0], [0, 15, 180, 0], [0, 0, 1, 0]])
    to_camera = np.eye(4)
    to_camera[:3] = [[0, -1, 0, 0.1], [0, 0, -1, -0.08], [1, 0, 0, -0.27]]
    heading = np.radians(heading_deg)
    cos, sin = np.cos(heading), np.sin(heading)
    boxes = replace(
        two_boxes(points=(9, 9)),
        centers=np.array([center, [-6.0, 1, 0]]),  # the walker is behind the camera
        quaternions=np.array([[0, 0, np.sin(heading / 2), np.cos(heading / 2)], [0, 0, 0, 1]]),
    )
    sweep = Sweep(np.zeros((0, 3)))
    augmented = AugmentedSweep(sweep, np.zeros(0, int), np.zeros(0, bool), boxes)
    (label,) = KittiCamera(to_camera, projection, (1200, 360)).labels(augmented)
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    corners = signs * [2, 1, 0.75] @ turn.T + center
    corners = corners @ to_camera[:3, :3].T + to_camera[:3, 3]
    visible = [*corners[corners[:, 2] >= 0.1]]
    for first, second in combinations(range(8), 2):
        ends = corners[[first, second]]
        ends = ends[ends[:, 2].argsort()]
        if (signs[first] != signs[second]).sum() == 1 and ends[0, 2] < 0.1 < ends[1, 2]:
            visible.append([np.interp(0.1, ends[:, 2], axis) for axis in ends.T])
    assert 4 < len(visible) < 12
    x, y, depth = np.array(visible).T
    pixels = np.array([600 + 20 * x / depth, 180 + 15 * y / depth])
    low, high = pixels.min(axis=1), pixels.max(axis=1)
    seen = [low.clip(0, [1199, 359]), high.clip(0, [1199, 359])]
    truncation = 1 - (seen[1] - seen[0]).prod() / (high - low).prod()
    np.testing.assert_allclose(
        np.array(label.values.split()[2:6], float), np.concatenate(seen), atol=1e-4
    )
    assert label.truncation == pytest.approx(truncation)
    assert (label.kind, label.object) == ("Car", 50)


def test_incomplete_calibrations(benchmark, tmp_path):
    folder, _ = benchmark
    (folder / "calib/000000.txt").write_text("P2: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    rewriter = opened(folder)
    augmented = changed(rewriter.recording, 0, two_boxes())
    with pytest.raises(LidarError, match=r"000000\.txt has no `R0_rect:` line, which is required"):
        rewriter.sweep_files(0, augmented)


def test_targets_are_checked(drive, tmp_path):
    rewriter = opened(drive, "00")
    (tmp_path / "full").mkdir()
    (tmp_path / "full/photo.txt").write_text("mine")
    cases = [
        (drive, "is the recording itself"),
        (drive / "new", "is inside the recording"),
        (drive.parent, "contains the recording"),
        (tmp_path / "no/new", "does not exist. Create it first"),
    ]
    for target, words in cases:
        for overwrite in (False, True):
            with pytest.raises(LidarError, match=words):
                rewriter.check_target(target, overwrite=overwrite)
    with pytest.raises(LidarError, match=r"already exists\. Use another path"):
        rewriter.check_target(tmp_path / "full")
    with pytest.raises(LidarError, match="was not written by `lidarpool augment`"):
        rewriter.check_target(tmp_path / "full", overwrite=True)
    target = tmp_path / "new"
    rewrite(rewriter, target, tmp_path / "work", identity)
    with pytest.raises(LidarError, match="already exists"):
        finish(rewriter, target, tmp_path / "work")
    rewrite(rewriter, target, tmp_path / "work", changed, overwrite=True)
    name = "sequences/00/velodyne/000000.bin"
    assert len(rows_of(target / name)) < len(rows_of(drive / name))
    assert not [*tmp_path.glob(".lidarpool-writing-*")]


def test_endings_of_files(drive, tmp_path):
    path = tmp_path / "a.pcd.bin"
    np.arange(20, dtype="<f4").tofile(path)
    with pytest.raises(LidarError, match=r"Specify a path that ends in \.pcd\.bin"):
        opened(path).check_target(tmp_path / "b.bin")
    rewrite(opened(path), tmp_path / "b.pcd.bin", tmp_path / "work", identity)
    assert (tmp_path / "b.pcd.bin").read_bytes() == path.read_bytes()


def test_damaged_files_are_named_once(drive, tmp_path):
    path = tmp_path / "a.bin"
    np.arange(8, dtype="<f4").tofile(path)
    rewriter = opened(path)
    augmented = identity(rewriter.recording, 0)
    path.write_bytes(b"12345")
    with pytest.raises(LidarError) as caught:
        rewriter.sweep_files(0, augmented)
    assert str(caught.value).count(str(path)) == 1


def test_scaled_poses_are_refused(drive, tmp_path):
    shutil.copytree(drive, tmp_path / "set")
    poses = tmp_path / "set/sequences/00/poses.txt"
    values = np.loadtxt(poses).reshape(-1, 3, 4)
    values[1, :, :3] *= 1.5
    np.savetxt(poses, values.reshape(-1, 12))
    recording = open_recording(tmp_path / "set", "00")
    assert recording[0].pose is not None
    with pytest.raises(LidarError, match="the pose of sweep 1 is scaled, skewed or mirrored"):
        recording[1]


def test_broken_boxes_are_told_in_a_sentence(drive, tmp_path):
    shutil.copytree(drive, tmp_path / "set")
    for file in (tmp_path / "set").rglob("label_02/*.txt"):
        file.write_text("1.5 0 Car 0 0 0 0 0 0 0 1 1 1 0 0 0 0\n")
    rewriter = opened(tmp_path / "set", "00")
    augment = partial(changed, boxes=two_boxes(), visibility=[0.5, 0.0])
    with pytest.raises(LidarError, match=r"set cannot be read: invalid literal for int.*'1\.5'"):
        rewrite(rewriter, tmp_path / "new", tmp_path / "work", augment)
    assert not (tmp_path / "new").exists()


def test_links_in_the_source(drive, tmp_path):
    source = tmp_path / "set"
    (source / "velodyne").mkdir(parents=True)
    (source / "velodyne/0.bin").symlink_to(drive / "sequences/00/velodyne/000000.bin")
    (source / "round").symlink_to(source)
    (source / "broken").symlink_to(tmp_path / "none")
    notes = rewrite(opened(source), tmp_path / "new", tmp_path / "work", identity)
    assert {*content(tmp_path / "new")} == {"velodyne/0.bin"}
    assert "broken, round" in notes[-1]


def test_other_formats_are_refused(tmp_path):
    (tmp_path / "a.xyz").write_text("1 2 3\n4 5 6\n")
    ref = RecordingRef(tmp_path / "a.xyz")
    with pytest.raises(LidarError, match=r"Choose another format with `--format`"):
        open_rewriter(ref, open_ref(ref))
