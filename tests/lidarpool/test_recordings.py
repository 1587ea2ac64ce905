"""Recordings of other programs: which sweep is which, when it was, and where the sensor was."""

from __future__ import annotations

import io
import multiprocessing
import re
import sys
import tarfile
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from tests.made_recordings import changed_recording

from lidarfiles.clouds.recording_ref import RecordingRef
from lidarfiles.recordings.opening import open_recording
from lidarpool.pages.opened import open_view
from lidarreal import compare, twin
from lidarreal.augmentation.effects import Effects
from lidarreal.augmentation.running import Augmentation
from lidarreal.augmentation.variants import Variants
from lidarreal.comparing.fit.stack import SweepStack
from lidarreal.reconstruction.alignment import AlignedSweeps, Alignment, first_alignment
from lidarreal.reconstruction.lost_pulses import SensorCoverage
from lidarreal.reconstruction.motion import Motion
from lidarreal.reconstruction.odometry import RecordedPoses, find_poses
from lidarreal.reconstruction.recorded_sweeps import RecordedSweeps
from lidarsim import LidarError, load_trajectory
from lidarsim.columns.bags import POINT_CLOUD
from lidarsim.io.archives import pack_arrays
from lidarsim.scene.files.pcd import pcd_bytes

# From axes of a lidar to those of a camera of KITTI: x to the right, y down, z forward.
TO_CAMERA = np.array([[0, -1, 0, 0], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1.0]])


def write_scan(path, x):
    """Write a .bin with one point at x."""
    np.array([[x, 1, 1, 0.5]], "<f4").tofile(path)


def write_pcd(path, x):
    """Write a .pcd with one point at x."""
    head = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 1\nHEIGHT 1\n"
    path.write_text(f"{head}POINTS 1\nDATA ascii\n{x} 1 1\n")


def write_image(path, x):
    """Write a range image with one ray that ends at x."""
    names = ("x", "y", "z", "range")
    arrays = {name: np.full((1, 1), x, np.float32) for name in names} | {"pose": np.eye(4)}
    path.write_bytes(pack_arrays(arrays))


def first_x(recording):
    """Return the x of the first point of each sweep."""
    return [float(sweep.points[0, 0]) for sweep in recording]


def kitti(folder, frames, pose_count, time_count=None, calibrated=True):
    """Write a sequence; the sensor of frame k is at x = k, and its scan has a point at 50 - k."""
    (folder / "velodyne").mkdir(parents=True)
    for frame in frames:
        write_scan(folder / "velodyne" / f"{frame:06}.bin", 50 - frame)
    poses = np.tile(np.eye(4), (pose_count, 1, 1))
    poses[:, 0, 3] = np.arange(pose_count)
    rows = TO_CAMERA @ poses @ np.linalg.inv(TO_CAMERA) if calibrated else poses
    np.savetxt(folder / "poses.txt", rows[:, :3].reshape(-1, 12))
    if time_count is not None:
        np.savetxt(folder / "times.txt", 0.1 * np.arange(time_count))
    if calibrated:
        numbers = " ".join(map(str, TO_CAMERA[:3].ravel()))
        (folder / "calib.txt").write_text(f"P0: 1 0 0 0 0 1 0 0 0 0 1 0\nTr: {numbers}\n")
    return folder


@pytest.mark.parametrize(
    ("folder", "suffix", "write"),
    [("", ".pcd", write_pcd), ("velodyne", ".bin", write_scan), ("lidar", ".npz", write_image)],
)
def test_files_are_in_the_order_of_the_numbers_in_their_names(tmp_path, folder, suffix, write):
    (tmp_path / folder).mkdir(exist_ok=True)
    names = ["1000.0", "1000.05", "1000.1", "1000.15", "1000.9", "1001", "1001.25", "20000.5"]
    for number in (3, 7, 0, 5, 1, 6, 4, 2):
        write(tmp_path / folder / f"{names[number]}{suffix}", number)
    assert first_x(open_recording(tmp_path)) == [*range(8)]


def test_all_files_have_the_same_column_of_intensities(tmp_path):
    for number, name in enumerate(("intensity", "i", "reflectivity")):
        fields = [(field, np.ones(3, np.float32)) for field in ("x", "y", "z", name)]
        content = pcd_bytes(fields, (0, 0, 0), (1, 0, 0, 0), "")
        (tmp_path / f"{number}.pcd").write_bytes(content)
    recording = open_recording(tmp_path)
    assert recording[1].intensity.tolist() == [1, 1, 1]
    with pytest.raises(LidarError, match=r"2\.pcd.*intensities are in reflectivity, but"):
        recording[2]


def test_the_digits_of_stamps_are_compared_to_the_last(tmp_path):
    names = ["a2_1623456789.123456780", "a2_1623456789.123456789", "a10_0.5", "a10_00.75"]
    for number in (2, 1, 3, 0):
        write_pcd(tmp_path / f"{names[number]}.pcd", number)
    assert first_x(open_recording(tmp_path)) == [0, 1, 2, 3]


def test_rows_of_kitti_belong_to_the_frames_with_their_numbers(tmp_path):
    recording = open_recording(kitti(tmp_path / "some", [10, 11, 13], 20, 20))
    np.testing.assert_allclose(recording.poses(range(3))[:, 0, 3], [10, 11, 13], atol=1e-9)
    np.testing.assert_allclose(recording.poses(range(3))[:, :3, :3], [np.eye(3)] * 3, atol=1e-9)
    np.testing.assert_allclose(recording.stamps_ns, [1.0e9, 1.1e9, 1.3e9])
    for number in range(3):
        assert recording[number].in_world()[0, 0] == pytest.approx(50)
    assert recording.notes[0].endswith(
        "some has no point file for frames 0 to 9, 12, 14 to 19 in poses.txt"
    )
    assert open_recording(kitti(tmp_path / "all", range(3), 3, 3)).notes == ()


@pytest.mark.parametrize(
    ("frames", "rows", "words"),
    [
        ([0, 1, 2, 3, 7], (5, 8), "poses.txt has no row for frame 7. It has 5 rows, and row k"),
        ([0, 1, 2, 3, 7], (8, 3), "times.txt has no row for frames 3, 7. It has 3 rows"),
        ([10, 11], (2, 20), "poses.txt has no row for frames 10 to 11"),
        ([0, 1, 2], (3, 5), "times.txt has rows for frames 3 to 4, but the"),
    ],
)
def test_rows_of_kitti_that_fit_no_frames_are_refused(tmp_path, frames, rows, words):
    with pytest.raises(LidarError, match=words):
        open_recording(kitti(tmp_path / "s", frames, *rows))


def test_files_that_are_not_numbered_have_a_row_each(tmp_path):
    folder = kitti(tmp_path / "s", [], 2)
    for name, x in (("1623456789.5", 50), ("1623456789.25", 49)):
        write_scan(folder / "velodyne" / f"{name}.bin", x)
    recording = open_recording(folder)
    assert first_x(recording) == [49, 50]
    np.testing.assert_allclose(recording.poses(range(2))[:, 0, 3], [0, 1], atol=1e-9)
    write_scan(folder / "velodyne" / "1623456789.75.bin", 51)
    with pytest.raises(LidarError, match="has 2 rows for 3 point files whose names are not"):
        open_recording(folder)


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("element", [(1, 3), (1, 5)])  # a translation and a rotation
def test_poses_that_are_not_finite_are_refused(tmp_path, value, element):
    kitti(tmp_path, range(3), 3)
    rows = np.loadtxt(tmp_path / "poses.txt")
    rows[element] = value
    np.savetxt(tmp_path / "poses.txt", rows)
    recording = open_recording(tmp_path)
    assert recording[0].pose[0, 3] == 0 and recording[2].pose[0, 3] == 2
    for read in (lambda: recording[1], lambda: recording.poses([0, 1])):
        with pytest.raises(LidarError, match="the pose of sweep 1 is not finite"):
            read()
    recording = changed_recording(recording, read_poses=lambda: np.full((3, 4, 4), value))
    with pytest.raises(LidarError, match="the pose of sweep 2 is not finite"):
        recording.poses([2])


def test_calibrations_that_are_not_finite_are_refused(tmp_path):
    kitti(tmp_path, range(3), 3)
    text = (tmp_path / "calib.txt").read_text()
    (tmp_path / "calib.txt").write_text(re.sub(r"Tr: \S+", "Tr: nan", text))
    with pytest.raises(LidarError, match=r"calib\.txt: the matrix in line 2 is not finite"):
        open_recording(tmp_path)


def test_poses_of_kitti_without_a_calibration(tmp_path):
    folder = kitti(tmp_path / "s", range(3), 3, calibrated=False)
    recording = open_recording(folder)
    assert recording.notes[0].endswith("no calib.txt, so its poses are assumed to be lidar poses")
    np.testing.assert_allclose(recording.poses(range(3))[:, 0, 3], [0, 1, 2])
    (folder / "calib.txt").write_text("P0: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    with pytest.raises(LidarError, match=r"calib\.txt has no `Tr:` line, which transforms"):
        open_recording(folder)


# -- times -----------------------------------------------------------------------------------

STORE = get_typestore(Stores.ROS2_HUMBLE)
START_NS = 1_700_000_000 * 10**9
SWEEP_S = 0.1
SWEEPS = 8
HALF_SIZE = np.array([30.0, 8.0])  # of a room whose walls are crossed by all rays
KINDS = {"<f4": 7, "<f8": 8, "<u2": 4, "<u4": 6}  # of PointField


def position(seconds):
    """Return the x of a sensor that accelerates from 10 m/s."""
    return 10 * seconds + np.square(seconds)


def fired(number):
    """Return positions (n, 3) of a sweep as fired, rings, and seconds since the start of all."""
    ring, step = (index.ravel() for index in np.indices((8, 360)))
    azimuth = np.radians(step - 179.5)
    elevation = np.radians(ring - 3.5)
    seconds = SWEEP_S * (number + step / 360)
    level = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
    start = np.stack([position(seconds), 0 * seconds], axis=1)
    ranges = ((np.sign(level) * HALF_SIZE - start) / level).min(axis=1)
    directions = np.column_stack([level, np.tan(elevation)])
    return ranges[:, None] * directions, ring, seconds


def transform(number, parent="map", child="lidar", x=None, quaternion=(0, 0, 0, 1)):
    """Return the TransformStamped of a frame at the stamp of a sweep."""
    types = STORE.types
    stamp = types["builtin_interfaces/msg/Time"](
        *divmod(START_NS + round(1e9 * SWEEP_S * number), 10**9)
    )
    x = position(SWEEP_S * number) if x is None else x
    return types["geometry_msgs/msg/TransformStamped"](
        types["std_msgs/msg/Header"](stamp, parent),
        child,
        types["geometry_msgs/msg/Transform"](
            types["geometry_msgs/msg/Vector3"](float(x), 0.0, 0.0),
            types["geometry_msgs/msg/Quaternion"](*map(float, quaternion)),
        ),
    )


def write_bag(path, sweeps, late_ns=0, transforms=()):
    """Write sweeps (stamp in ns, {field: values}) that were recorded later than stamped."""
    types = STORE.types
    field_type = types["sensor_msgs/msg/PointField"]
    with Writer(path, version=8, storage_plugin=StoragePlugin.MCAP) as bag:
        topic = bag.add_connection("/points", POINT_CLOUD, typestore=STORE)
        for number, (stamp_ns, columns) in enumerate(sweeps):
            kinds = [(name, values.dtype.str) for name, values in columns.items()]
            rows = np.zeros(len(columns["x"]), kinds)
            for name, values in columns.items():
                rows[name] = values
            fields = [
                field_type(name, rows.dtype.fields[name][1], KINDS[kind], 1) for name, kind in kinds
            ]
            stamp = types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9))
            header = types["std_msgs/msg/Header"](stamp, "lidar")
            size = rows.itemsize
            data = rows.view(np.uint8).reshape(-1)
            message = types[POINT_CLOUD](
                header, 1, len(rows), fields, False, size, size * len(rows), data, True
            )
            recorded_ns = START_NS + round(1e9 * SWEEP_S * number) + late_ns
            bag.write(topic, recorded_ns, STORE.serialize_cdr(message, POINT_CLOUD))
        if transforms:
            kind = "tf2_msgs/msg/TFMessage"
            frames = bag.add_connection("/tf", kind, typestore=STORE)
            bag.write(frames, START_NS, STORE.serialize_cdr(types[kind]([*transforms]), kind))
    return path


def drive(times, stamp_s=0.0, kind="<f8", name="time"):
    """Return sweeps through the room.

    `times` maps seconds since 1970, and those of the stamp, to the field of times; stamps are
    `stamp_s` after the first point of a sweep.
    """
    sweeps = []
    for number in range(SWEEPS):
        points, ring, seconds = fired(number)
        stamp_ns = START_NS + round(1e9 * (SWEEP_S * number + stamp_s))
        since_s = seconds - SWEEP_S * number - stamp_s
        columns = dict(zip("xyz", points.T.astype("<f4"), strict=True))
        columns |= {"ring": ring.astype("<u2"), name: times(stamp_ns, since_s).astype(kind)}
        sweeps.append((stamp_ns, columns))
    return sweeps


def write_poses(path, first_s=0.0):
    """Write the poses of the drive as TUM, by a clock that begins at `first_s`."""
    seconds = np.arange(-0.2, SWEEP_S * (SWEEPS + 2), 0.01)
    with path.open("w") as file:
        for second in seconds:
            file.write(f"{first_s + second:.6f} {position(second):.6f} 0 0 0 0 0 1\n")
    return path


def relative(stamp_ns, since_s):
    return since_s


def absolute_s(stamp_ns, since_s):
    return stamp_ns * 1e-9 + since_s


def absolute_ns(stamp_ns, since_s):
    return stamp_ns + 1e9 * since_s


def of_another_clock(stamp_ns, since_s):
    return (stamp_ns - START_NS) * 1e-9 + since_s + 5000


@pytest.mark.extended(every=2)
@pytest.mark.parametrize(
    ("times", "stamp_s", "kind", "name"),
    [
        (relative, 0.0, "<f4", "time"),
        (relative, SWEEP_S, "<f4", "time"),
        (relative, 0.6 * SWEEP_S, "<f4", "time"),
        (lambda _, since_s: 1e9 * since_s, 0.0, "<u4", "t"),
        (absolute_s, SWEEP_S, "<f8", "timestamp"),
        (absolute_s, 0.0, "<f8", "timestamp"),
        (absolute_ns, SWEEP_S, "<f8", "timestamp"),
        (of_another_clock, 0.0, "<f8", "timestamp"),
    ],
)
def test_points_are_where_they_were_fired_whatever_their_times_count_from(
    tmp_path, times, stamp_s, kind, name
):
    path = write_bag(tmp_path / "drive", drive(times, stamp_s, kind, name), late_ns=10**8)
    sweeps = RecordedSweeps.open(path)
    poses = find_poses(sweeps, write_poses(tmp_path / "poses.txt", START_NS * 1e-9))
    alignment = first_alignment(sweeps, poses)
    assert alignment.motion is Motion.TIMED
    aligned = AlignedSweeps(sweeps, alignment, SensorCoverage.from_sweeps(sweeps))
    for number in range(1, SWEEPS - 1):  # the first and the last sweep have one neighbor
        world = aligned.read(number).world[:, :2]
        off_m = np.abs(HALF_SIZE - np.abs(world)).min(axis=1)
        assert off_m.max() < 0.005
        np.testing.assert_allclose(
            aligned.read(number).origins[:, 0], position(fired(number)[2]), atol=0.005
        )
    is_noted = any("use a different clock" in note for note in sweeps.notes)
    assert is_noted == (times is of_another_clock)


@pytest.mark.slow
def test_a_place_of_late_stamps_lies_where_it_is(tmp_path):
    path = write_bag(tmp_path / "drive", drive(absolute_s, SWEEP_S, name="timestamp"))
    found = twin(path, trajectory=write_poses(tmp_path / "poses.txt", START_NS * 1e-9))
    centers = found.scene.vertices.reshape(-1, 4, 3).mean(axis=1)
    ends = centers[np.abs(centers[:, 1]) < 6]
    assert np.median(ends[ends[:, 0] > 20, 0]) == pytest.approx(30, abs=0.02)
    np.testing.assert_allclose(found.times_s, SWEEP_S * np.arange(SWEEPS), atol=1e-6)
    np.testing.assert_allclose(
        found.poses[:, 0, 3], position(SWEEP_S * np.arange(1, SWEEPS + 1)), atol=0.02
    )


def test_poses_by_registration_are_moved_to_the_stamps():
    matrices = np.tile(np.eye(4), (4, 1, 1))
    matrices[:, 0, 3] = np.arange(4)
    for first_s, moved_m in ((0.0, -0.5), (-0.1, 0.5), (-0.05, 0.0)):
        poses = RecordedPoses(
            matrices, 0.1 * np.arange(4), "from registration", np.zeros(3), 0.5, first_s
        )
        found = Alignment.from_poses(poses, 0.1, Motion.TIMED, 1)
        np.testing.assert_allclose(found.poses[:, 0, 3], np.arange(4) + moved_m, atol=1e-9)


def test_sweeps_of_bags_have_the_times_of_their_headers(tmp_path):
    sweeps = drive(relative)
    live = write_bag(tmp_path / "live", sweeps, late_ns=10**8)
    offline = write_bag(tmp_path / "offline", sweeps)
    expected_ns = START_NS + 10**8 * np.arange(SWEEPS)
    np.testing.assert_array_equal(open_recording(live).stamps_ns, expected_ns)
    found = compare(live, offline, match="time").figures
    assert found["pairs"] == SWEEPS
    assert found["ranges"]["residual"]["rmse_m"] < 1e-6


def test_stamps_are_exact_to_the_nanosecond(tmp_path):
    """In double precision, nanoseconds since 1970 are multiples of 256."""
    expected_ns = [START_NS + 123_456_789 + 100_000_001 * number for number in range(SWEEPS)]
    sweeps = [
        (stamp_ns, columns)
        for stamp_ns, (_, columns) in zip(expected_ns, drive(relative), strict=True)
    ]
    recording = open_recording(write_bag(tmp_path / "bag", sweeps))
    assert recording.stamps_ns.dtype == np.int64 and recording.stamps_ns.tolist() == expected_ns
    assert [sweep.time_ns for sweep in recording] == expected_ns
    ref = RecordingRef(tmp_path / "bag")
    clear = Augmentation(ref, Variants(Effects()), output_format="mcap", reflectance=0.3)
    clear.run(tmp_path / "copies", workers=1)
    (copy,) = (tmp_path / "copies").glob("*.mcap")
    assert open_recording(copy).stamps_ns.tolist() == expected_ns


def test_bags_without_stamps_have_the_times_of_their_records(tmp_path):
    unstamped = [(0, columns) for _, columns in drive(relative)]
    recording = open_recording(write_bag(tmp_path / "bag", unstamped, late_ns=10**8))
    expected_ns = START_NS + 10**8 * np.arange(1, SWEEPS + 1)
    np.testing.assert_array_equal(recording.stamps_ns, expected_ns)
    assert recording.notes[0].endswith(
        "bag has no timestamps, so the recording times are used instead"
    )
    # A simulation may begin at zero.
    simulated = [(stamp_ns - START_NS, columns) for stamp_ns, columns in drive(relative)]
    recording = open_recording(write_bag(tmp_path / "simulated", simulated))
    assert [*recording.stamps_ns] == [1e8 * number for number in range(SWEEPS)]
    assert [*recording.notes] == []


def test_a_single_topic_is_the_name_of_the_sensor(tmp_path):
    path = write_bag(tmp_path / "bag", drive(relative))
    recording = open_recording(path)
    assert recording.info.sensor == recording[0].sensor == "/points"
    assert open_view(path).sweeps.sensors == ("/points",)
    kitti(tmp_path / "kitti", range(3), 3)
    assert open_view(tmp_path / "kitti").sweeps.sensors == ("",)


def transforms_but(number, **changes):
    """Return transforms of all sweeps, one of which is changed."""
    return [transform(k, **(changes if k == number else {})) for k in range(SWEEPS)]


@pytest.mark.parametrize(
    "change",
    [
        {"x": np.nan},
        {"quaternion": (0, 0, 0, 0)},
        {"quaternion": (0, 0, 0, 0.9)},
    ],
)
def test_invalid_transforms_are_skipped(tmp_path, change):
    path = write_bag(tmp_path / "bag", drive(relative), transforms=transforms_but(3, **change))
    recording = open_recording(path)
    expected = [position(SWEEP_S * number) for number in range(SWEEPS)]
    expected[3] = (expected[2] + expected[4]) / 2
    for _ in range(2):  # the note is added once
        np.testing.assert_allclose(recording.poses(range(SWEEPS))[:, 0, 3], expected, atol=1e-6)
    (note,) = recording.notes
    assert note == (
        f"{path} has invalid transforms on its tf topics at 1700000000.300000000 s. They contain "
        "NaN or a quaternion whose length is not 1. They are skipped"
    )
    with pytest.raises(LidarError, match=r"invalid transforms .* 1700000000\.3.*Remove them"):
        load_trajectory(path, topic="/tf:lidar")


def test_each_reason_for_unknown_poses_is_named(tmp_path):
    sweeps = drive(relative)
    reasons = {
        "no transform of its frame 'lidar' can be used. .* 1700000000.0*, .* and 5 more": [
            transform(number, x=np.nan) for number in range(SWEEPS)
        ],
        "frame 'lidar' has two parent frames, 'map' and 'odom'": transforms_but(3, parent="odom"),
        "has no pose within 0.2 s of sweep 6, so its poses are not used": [
            transform(number) for number in (0, 1, 2, 3.5)
        ],
        "": [transform(0)],  # a sensor that does not move has no trajectory
    }
    for number, (reason, transforms) in enumerate(reasons.items()):
        recording = open_recording(write_bag(tmp_path / f"{number}", sweeps, transforms=transforms))
        assert recording.poses(range(SWEEPS)) is None
        assert len(recording.notes) == bool(reason)
        assert all(re.search(reason, note) for note in recording.notes)


def test_invalid_static_transforms_are_named(tmp_path):
    moving = [transform(number, child="vehicle") for number in range(SWEEPS)]
    mounted = transform(0, "vehicle", x=1.5)
    path = write_bag(tmp_path / "bag", drive(relative), transforms=[*moving, mounted])
    expected = position(SWEEP_S * np.arange(SWEEPS)) + 1.5
    poses = open_recording(path).poses(range(SWEEPS))
    np.testing.assert_allclose(poses[:, 0, 3], expected, atol=1e-6)
    broken = transform(0, "vehicle", x=np.nan)
    path = write_bag(tmp_path / "broken", drive(relative), transforms=[*moving, broken])
    recording = open_recording(path)
    assert recording.poses(range(SWEEPS)) is None
    assert "no transform of its frame 'lidar' can be used" in recording.notes[0]


def test_sweeps_that_are_out_of_order_are_named(tmp_path):
    sweeps = drive(relative)
    sweeps[3], sweeps[4] = sweeps[4], sweeps[3]
    path = write_bag(tmp_path / "drive", sweeps)
    with pytest.raises(LidarError, match=r"do not increase: sweep 3 is at .*400000 s, and sweep 4"):
        twin(path)


def test_samples_of_tar_files_have_times_if_all_of_them_state_one(tmp_path):
    def write_tar(name, samples):
        with tarfile.open(tmp_path / name, "w") as tar:
            for key, (x, text) in samples.items():
                memory = io.BytesIO()
                np.save(memory, np.full((1, 3), x))
                contents = {"points.npy": memory.getvalue(), "json": text.encode()}
                for ending, content in contents.items():
                    member = tarfile.TarInfo(f"{key}.{ending}")
                    member.size = len(content)
                    tar.addfile(member, io.BytesIO(content))

    write_tar("shard-10.tar", {"d": (3, '{"time_ns": 300}')})
    write_tar("shard-9.tar", {"b": (1, '{"time_ns": 100}'), "c": (2, '{"time_ns": 200}')})
    recording = open_recording(tmp_path)
    assert first_x(recording) == [1, 2, 3]
    assert [*recording.stamps_ns] == [100, 200, 300]
    write_tar("shard-11.tar", {"e": (4, "{}")})
    assert open_recording(tmp_path).stamps_ns is None


# -- poses -----------------------------------------------------------------------------------


def test_poses_with_times_are_looked_up_though_there_is_one_for_each_sweep(tmp_path):
    sweeps = RecordedSweeps.open(write_bag(tmp_path / "drive", drive(relative)))
    seconds = START_NS * 1e-9 + np.linspace(-0.5, 1.5, SWEEPS)
    poses = tmp_path / "poses.txt"
    poses.write_text("".join(f"{s:.6f} {s - 1.7e9:.6f} 0 0 0 0 0 1\n" for s in seconds))
    found = find_poses(sweeps, poses)
    np.testing.assert_allclose(found.matrices[:, 0, 3], SWEEP_S * np.arange(SWEEPS), atol=1e-5)
    with pytest.raises(LidarError, match=r"covers -0.200 to .*timestamps from 1700000000\.000 to"):
        find_poses(sweeps, write_poses(poses))


def test_rows_of_kitti_are_poses_of_the_sweeps(tmp_path):
    folder = kitti(tmp_path / "s", range(4), 4)
    rows = np.loadtxt(folder / "poses.txt")
    (folder / "poses.txt").unlink()
    poses = tmp_path / "poses.txt"
    np.savetxt(poses, rows)
    sweeps = RecordedSweeps.open(folder)
    # The poses are of a camera: its place is in the sequence.
    np.testing.assert_allclose(find_poses(sweeps, poses).matrices[:, 0, 3], range(4), atol=1e-9)
    np.testing.assert_allclose(find_poses(sweeps, poses).times_s, 0.1 * np.arange(4))
    # Or beside the poses of a recording in another format.
    for number in range(4):
        write_pcd(tmp_path / f"{number}.pcd", 50 - number)
    files = RecordedSweeps.open(tmp_path)
    with pytest.raises(LidarError, match=r"its z axis, .*Put KITTI's calib\.txt next to the file"):
        find_poses(files, poses)
    (folder / "calib.txt").rename(tmp_path / "calib.txt")
    np.testing.assert_allclose(find_poses(files, poses).matrices[:, 0, 3], range(4), atol=1e-9)
    # Without a calibration they are poses of the lidar.
    (tmp_path / "calib.txt").unlink()
    np.savetxt(poses, lidar_rows(4))
    np.testing.assert_allclose(find_poses(files, poses).matrices[:, 0, 3], range(4))
    np.savetxt(poses, lidar_rows(3))
    with pytest.raises(LidarError, match=r"contains 3 rows without times, but .* has 4 sweeps"):
        find_poses(files, poses)


def lidar_rows(count):
    """Return rows (count, 12) of a lidar at x = 0, 1, …."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = np.arange(count)
    return poses[:, :3].reshape(-1, 12)


def read_by_a_fork(recording, expected):
    """Return the first x of sweeps in any order, read while a forked process reads them, too."""
    numbers = np.random.default_rng(0).integers(0, len(recording), 60).tolist()

    def count_wrong(queue):
        queue.put(sum(recording[n].points[0, 0] != expected[n] for n in numbers))

    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    process = context.Process(target=count_wrong, args=(queue,))
    process.start()
    found = [recording[number].points[0, 0] for number in numbers]
    assert queue.get(timeout=60) == 0
    process.join()
    return found, [expected[number] for number in numbers]


def write_e57(path):
    """Write two scans, each with a point at x."""
    pytest.importorskip("pye57", reason="pye57 is an extra")
    from tests.e57_files import write_scans

    axes = ("cartesianX", "cartesianY", "cartesianZ")
    scans = [
        {"fields": {axis: (np.full(1000, x), "double") for axis in axes}, "name": f"at {x}"}
        for x in (2.0, 3.0)
    ]
    return write_scans(path, scans)


@pytest.mark.parametrize("name", ["bag", "e57"])
def test_sweeps_can_be_read_by_threads_and_forked_processes(tmp_path, name, request):
    """Both move the position of the same open file."""
    request.addfinalizer(partial(sys.setswitchinterval, sys.getswitchinterval()))
    sys.setswitchinterval(1e-6)  # so that threads meet in the middle of a read
    if name == "bag":
        path = write_bag(tmp_path / "drive", drive(relative))
    else:
        path = write_e57(tmp_path / "a.e57")
    recording = open_recording(path)
    expected = first_x(recording)
    assert len(set(expected)) == len(recording) > 1
    recording[0]  # leaves the file open at the second sweep
    found, wanted = read_by_a_fork(recording, expected)
    assert found == wanted
    numbers = np.random.default_rng(1).integers(0, len(recording), 100).tolist()
    with ThreadPoolExecutor(8) as pool:
        stamps = pool.submit(lambda: recording.stamps_ns)
        sweeps = [*pool.map(recording.__getitem__, numbers)]
    assert [sweep.points[0, 0] for sweep in sweeps] == [expected[number] for number in numbers]
    assert (stamps.result() is None) == (name == "e57")


def test_sweeps_after_a_damaged_sweep_can_be_read(tmp_path):
    sweeps = drive(relative)
    sweeps[1] = (sweeps[1][0], {"x": sweeps[1][1]["x"]})
    recording = open_recording(write_bag(tmp_path / "drive", sweeps))
    for _ in range(2):
        with pytest.raises(LidarError, match="coordinates are incomplete"):
            recording[1]
        assert len(recording[2]) and len(recording[0])


def test_items_are_whole_numbers(tmp_path):
    write_pcd(tmp_path / "0.pcd", 1)
    recording = open_recording(tmp_path)
    assert recording[np.int64(-1)].points[0, 0] == 1
    for item in (0.0, slice(1)):
        with pytest.raises(TypeError, match="cannot be interpreted as an integer"):
            recording[item]


@pytest.mark.parametrize("intensity", ["intensity", "echo"])
def test_a_chosen_column_of_intensities_must_exist(tmp_path, intensity):
    write_pcd(tmp_path / "0.pcd", 1)
    with pytest.raises(LidarError, match=f"no column '{intensity}' .* as intensity\\.$"):
        open_recording(tmp_path, intensity=intensity)[0]


def test_an_incomplete_bag_is_named_with_a_remedy(tmp_path):
    bag = write_bag(tmp_path / "drive", drive(relative))
    (file,) = bag.glob("*.mcap")
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(file.read_bytes()[:-1000])
    with pytest.raises(LidarError, match=r"not a complete MCAP file.*`mcap recover`\.$"):
        open_recording(cut)


def test_an_error_of_a_later_sweep_names_the_recording_once(tmp_path):
    """The rings follow from several sweeps, which are read while the first is put into cells."""
    pytest.importorskip("scipy", reason="the extra fit is not installed")
    for number in range(5):
        write_pcd(tmp_path / f"{number}.pcd", number + 1)
    (tmp_path / "4.pcd").write_text("VERSION 0.7\n")
    with pytest.raises(LidarError) as told:
        SweepStack.read(open_recording(tmp_path))
    assert str(told.value).count(str(tmp_path)) == 1
