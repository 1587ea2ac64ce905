"""Augmented recordings in other formats."""

from __future__ import annotations

from functools import partial

import cloudpickle
import laspy
import numpy as np
import pytest
from tests.fake_augmenters import changed, content, identity, rewrite, two_boxes

from lidarfiles import read_cloud
from lidarfiles.clouds.recording_ref import RecordingRef
from lidarfiles.clouds.writing import ExportSpec
from lidarfiles.recordings.opening import open_recording, open_ref
from lidarreal.augmentation.augmented_sweep import AugmentedSweep
from lidarreal.augmentation.conversion import FormatConverter
from lidarreal.augmentation.rewriting.opening import open_rewriter
from lidarsim import LidarError


def converter(path, spec, sensor=None):
    spec = ExportSpec(spec) if isinstance(spec, str) else spec
    ref = RecordingRef(path, sensor, keep_noise=True)
    return FormatConverter(ref, open_ref(ref), spec)


def same_points(recording, expected, scale=1.0, atol=1e-4):
    """Check the points and intensities of sweeps."""
    for number, sweep in enumerate(expected):
        read = recording[number].returns()
        kept = sweep.returns()
        np.testing.assert_allclose(read.points, kept.points, atol=atol)
        intensity = kept.columns["intensity"] * scale
        step = 1 / 255 if read.intensity.dtype.kind == "f" else 1
        np.testing.assert_allclose(read.intensity, intensity, atol=0.51 * step * max(scale, 1))


def test_kitti_to_kitti_keeps_poses_times_and_labels(written, tmp_path):
    path = written("kitti")
    new = tmp_path / "new"
    made = converter(path, "kitti", "00")
    notes = rewrite(made, new, tmp_path / "work", changed)
    old, recording = made.recording, open_recording(new, keep_noise=True)
    same_points(recording, [changed(old, number).sweep for number in range(3)])
    first = np.linalg.inv(old.poses([0])[0])
    np.testing.assert_allclose(recording.poses(range(3)), first @ old.poses(range(3)), atol=1e-6)
    np.testing.assert_allclose(recording.stamps_ns, old.stamps_ns - old.stamps_ns[0], atol=1)
    for name in ("class", "object"):
        expected = changed(old, 2).sweep.columns[name]
        np.testing.assert_array_equal(recording[2].columns[name], expected)
    assert notes == []


def test_bag_to_other_formats(written, tmp_path):
    path = written("mcap", layout="autoware")  # with intensities from 0 to 255
    for name, full in (("pcd", 1.0), ("nuscenes", 255.0), ("kitti", 1.0)):
        made = converter(path, name, "/front/points")
        notes = rewrite(made, tmp_path / name, tmp_path / f"{name}w", changed)
        recording = open_recording(tmp_path / name, keep_noise=True)
        expected = [changed(made.recording, number).sweep for number in range(3)]
        same_points(recording, expected, full / 255)
        poses = made.recording.poses(range(3))
        moved = np.linalg.inv(recording.poses([0])[0]) @ recording.poses(range(3))
        np.testing.assert_allclose(moved, np.linalg.inv(poses[0]) @ poses, atol=1e-6)
        assert notes[0].startswith("Intensities from 0 to 255 in ")
        missing = [note for note in notes if "has no column object" in note]
        assert len(missing) == (name != "pcd")
    times = open_recording(tmp_path / "pcd")[0].columns["time"]
    stored = expected[0].columns["time_stamp"]  # ns
    np.testing.assert_allclose(times, 1e-9 * stored, atol=1e-6)


def test_clouds_are_in_world_coordinates(written, tmp_path):
    made = converter(written("kitti"), "las", "01")
    notes = rewrite(made, tmp_path / "new.las", tmp_path / "work", changed)
    sweeps = [changed(made.recording, number).sweep for number in range(3)]
    expected = np.concatenate([sweep.in_world() for sweep in sweeps])
    file = laspy.read(tmp_path / "new.las")
    np.testing.assert_allclose(file.xyz, expected, atol=0.0006)
    classes = np.concatenate([sweep.columns["class"] for sweep in sweeps])
    np.testing.assert_array_equal(file.classification, np.minimum(classes, 255))
    # KITTI has neither times of points nor return numbers.
    for name in ("return_number", "number_of_returns", "gps_time"):
        assert not np.asarray(file[name]).any(), name
    assert notes == [
        "LAS stores 0 as return number, number of returns and GPS time, because "
        f"{written('kitti')} has no columns return_number, returns or time."
    ]
    made = converter(written("kitti"), "ply", "01")
    rewrite(made, tmp_path / "new.ply", tmp_path / "work2", changed)
    cloud = read_cloud(tmp_path / "new.ply")
    np.testing.assert_allclose(cloud.positions, expected, atol=0.0006)
    np.testing.assert_array_equal(cloud["class"], classes)


@pytest.mark.parametrize(
    "layout", ["velodyne", "autoware", "ouster", "livox", "hesai", "robosense"]
)
def test_bare_points_to_bags(tmp_path, layout):
    folder = tmp_path / "set"
    folder.mkdir()
    for number in range(2):
        rng = np.random.default_rng(number)
        rng.uniform(1, 30, (50, 4)).astype("<f4").tofile(folder / f"{number:06}.bin")
    made = converter(folder, ExportSpec("mcap", layout))
    notes = rewrite(made, tmp_path / "new.mcap", tmp_path / "work", changed)
    text = "\n".join(notes)
    assert "has no poses, so these sweeps are at the origin." in text
    assert "has no timestamps, so its sweeps are assumed to be 0.1 s apart." in text
    assert "has no column object, which MCAP requires. It is -1 for all points." in text
    recording = open_recording(tmp_path / "new.mcap", "/points", keep_noise=True)
    assert recording.info.compensated is None  # as in the recording
    assert recording.info.energy_unit is None  # the scale of the recording is unknown
    np.testing.assert_allclose(np.diff(recording.stamps_ns), 1e8)
    for number in range(2):
        expected = changed(made.recording, number).sweep.points
        np.testing.assert_allclose(recording[number].points, expected, atol=1e-4)
        if layout == "autoware":  # UNKNOWN, because the return mode is
            assert not recording[number].columns["return_type"].any()


def test_inserted_objects_are_actors(written, tmp_path):
    path = written("kitti")
    objects = 1 + max(
        open_recording(path, "00")[n].columns["object"].max(initial=0) for n in range(3)
    )
    augment = partial(changed, boxes=two_boxes(int(objects), points=(9, 9)))
    made = converter(path, "kitti", "00")
    rewrite(made, tmp_path / "new", tmp_path / "work", augment)
    lines = (tmp_path / "new/sequences/00/label_2/000000.txt").read_text().splitlines()
    assert [line.split()[0] for line in lines] == ["car", "walker"]
    np.testing.assert_allclose([float(v) for v in lines[0].split()[8:11]], [1.5, 2, 4])
    recording = open_recording(tmp_path / "new", keep_noise=True)
    added = ~augment(made.recording, 2).is_recorded
    assert set(recording[2].columns["object"][added]) == {objects, objects + 1}
    made = converter(path, "nuscenes", "00")
    rewrite(made, tmp_path / "nus", tmp_path / "work2", augment)
    assert "walker" in (tmp_path / "nus/v1.0-lidarpool/category.json").read_text()


def test_parts_depend_on_their_sweep_only(written, tmp_path):
    path = written("mcap")
    for folder, numbers in (("a", range(3)), ("b", (2, 0, 1))):
        made = converter(path, "pcd", "/front/points")
        rewrite(made, tmp_path / folder, tmp_path / f"{folder}w", changed, numbers)
    assert content(tmp_path / "aw") == content(tmp_path / "bw")
    assert content(tmp_path / "a") == content(tmp_path / "b")


def test_parts_state_their_channels_and_objects(written):
    made = converter(written("kitti"), "las", "01")
    augmented = changed(made.recording, 1)
    _, details = made.encode(1, augmented)
    returned = augmented.sweep.has_return
    assert details["kept"] == returned.sum()
    assert details["objects"] == augmented.sweep.columns["object"][returned].max() + 1 > 1
    assert details["channels"] == 1, "the recording has no rings"
    none = np.zeros(0, int)
    empty = AugmentedSweep(augmented.sweep.select(none), none, none.astype(bool))
    _, details = made.encode(1, empty)
    assert (details["kept"], details["objects"], details["channels"]) == (0, 0, 1)
    assert details["cells"] is None
    _, details = made.encode(1, changed(made.recording, 1, two_boxes(70)))
    assert details["objects"] == 72


@pytest.mark.parametrize("name", ["kitti", "pcd", "nuscenes", "mcap"])
def test_other_processes_receive_rewriters(written, name):
    sensor = {"kitti": "00", "nuscenes": "LIDAR_TOP", "mcap": "/front/points"}.get(name)
    path = written(name)
    if name == "pcd":
        path = path / "000000.pcd"
    ref = RecordingRef(path, sensor, keep_noise=True)
    for made in (open_rewriter(ref, open_ref(ref)), converter(path, "ply", sensor)):
        expected = made.sweep_files(0, changed(made.recording, 0))
        copy = cloudpickle.loads(cloudpickle.dumps(made))
        assert copy.sweep_files(0, changed(copy.recording, 0)) == expected


def test_bad_input(written, tmp_path):
    path = written("kitti")
    with pytest.raises(LidarError, match=r"images requires the column ray, which recordings do"):
        converter(path, "images", "00")
    made = converter(path, "las", "00")
    with pytest.raises(LidarError, match=r"Specify a path that ends in \.las"):
        made.check_target(tmp_path / "new")
    (tmp_path / "new.las").write_text("mine")
    with pytest.raises(LidarError, match="already exists"):
        rewrite(made, tmp_path / "new.las", tmp_path / "work", identity)
    assert (tmp_path / "new.las").read_text() == "mine"
