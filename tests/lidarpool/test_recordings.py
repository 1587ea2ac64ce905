"""Recordings of other programs: which sweep is which, when it was, and where the sensor was."""

from __future__ import annotations

import numpy as np
import pytest

from lidarpool import LidarError
from lidarpool.recordings.opening import open_recording
from lidarsim.base.archives import packed

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
    path.write_bytes(packed(arrays))


def first_x(recording):
    """Return the x of the first point of each sweep."""
    return [float(recording.read(number)[0][0, 0]) for number in range(recording.count)]


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


def test_the_digits_of_stamps_are_compared_to_the_last(tmp_path):
    names = ["a2_1623456789.123456780", "a2_1623456789.123456789", "a10_0.5", "a10_00.75"]
    for number in (2, 1, 3, 0):
        write_pcd(tmp_path / f"{names[number]}.pcd", number)
    assert first_x(open_recording(tmp_path)) == [0, 1, 2, 3]


def test_rows_of_kitti_belong_to_the_frames_with_their_numbers(tmp_path):
    recording = open_recording(kitti(tmp_path / "some", [10, 11, 13], 20, 20))
    np.testing.assert_allclose(recording.poses(range(3))[:, 0, 3], [10, 11, 13], atol=1e-9)
    np.testing.assert_allclose(recording.poses(range(3))[:, :3, :3], [np.eye(3)] * 3, atol=1e-9)
    np.testing.assert_allclose([*recording.times()], [1.0e9, 1.1e9, 1.3e9])
    for number in range(3):
        assert recording.read_points(number, in_world=True).points[0, 0] == pytest.approx(50)
    assert recording.notes[0].endswith(
        "some has no file of points for frames 0 to 9, 12, 14 to 19 of poses.txt"
    )
    assert open_recording(kitti(tmp_path / "all", range(3), 3, 3)).notes == ()


@pytest.mark.parametrize(
    ("frames", "rows", "words"),
    [
        ([0, 1, 2, 3, 7], (5, 8), "poses.txt has no row for frame 7: it has 5 rows, and row k"),
        ([0, 1, 2, 3, 7], (8, 3), "times.txt has no row for frames 3, 7: it has 3 rows"),
        ([10, 11], (2, 20), "poses.txt has no row for frames 10 to 11"),
        ([0, 1, 2], (3, 5), "times.txt has rows for frames 3 to 4, which have no file"),
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
    with pytest.raises(LidarError, match="has 2 rows for 3 files of points, whose names are not"):
        open_recording(folder)


def test_poses_of_kitti_without_a_calibration(tmp_path):
    folder = kitti(tmp_path / "s", range(3), 3, calibrated=False)
    recording = open_recording(folder)
    assert recording.notes[0].endswith("no calib.txt, so its poses count as poses of the lidar")
    np.testing.assert_allclose(recording.poses(range(3))[:, 0, 3], [0, 1, 2])
    (folder / "calib.txt").write_text("P0: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    with pytest.raises(LidarError, match=r"calib\.txt has no line `Tr:`, the transform from the"):
        open_recording(folder)
