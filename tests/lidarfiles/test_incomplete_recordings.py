"""Pieces of recordings whose other files are missing or in another folder."""

from __future__ import annotations

import numpy as np
import pytest

from lidarfiles import open_recording
from lidarsim import LidarError

STAMP = "2011-09-26 13:02:{seconds:012.9f}"


def write_frames(folder, frames, digits=10):
    """Write KITTI point files with a few points, whose x coordinate is the frame number."""
    folder.mkdir(parents=True, exist_ok=True)
    for number in frames:
        rows = np.full((4, 4), number, "<f4")
        (folder / f"{number:0{digits}}.bin").write_bytes(rows.tobytes())


@pytest.mark.parametrize("opened", ["drive", "drive/velodyne_points/data"])
def test_timestamps_of_raw_drives_are_read(tmp_path, opened):
    """The file has a row for each frame, also for those that were not recorded."""
    points = tmp_path / "drive/velodyne_points"
    write_frames(points / "data", (0, 1, 2, 5, 6))
    seconds = 25.5 + 0.1033 * np.arange(7)
    rows = [STAMP.format(seconds=value) for value in seconds]
    rows[3] = ""
    (points / "timestamps.txt").write_text("\n".join(rows) + "\n")
    recording = open_recording(tmp_path / opened)
    first_ns = np.datetime64("2011-09-26T13:02:25.5", "ns").astype(np.int64)
    expected_ns = first_ns + 1e9 * (seconds[[0, 1, 2, 5, 6]] - 25.5)
    np.testing.assert_allclose(recording.stamps_ns, expected_ns, rtol=0, atol=1e3)
    assert recording[3].time_ns == pytest.approx(expected_ns[3], abs=1e3)
    (note,) = recording.notes
    assert note.endswith("has no point file for frames 3 to 4 in timestamps.txt")
    rows[5] = ""
    (points / "timestamps.txt").write_text("\n".join(rows))
    with pytest.raises(LidarError, match=r"timestamps.txt has no time for 0000000005\.bin"):
        open_recording(tmp_path / opened)
    rows[5] = "noon"
    (points / "timestamps.txt").write_text("\n".join(rows))
    with pytest.raises(LidarError, match=r"timestamps\.txt: line 6 is not a time such as 2011-09"):
        open_recording(tmp_path / opened)


@pytest.mark.parametrize("name", ["bin", "pcd"])
def test_missing_frames_without_times_are_noted(tmp_path, name):
    pcd = (
        "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 1\nHEIGHT 1\n"
        "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 1\nDATA ascii\n1 2 3\n"
    )

    def notes_of(folder, frames):
        if name == "bin":
            write_frames(folder, frames, digits=6)
        else:
            folder.mkdir()
            for frame in frames:
                (folder / f"{frame:06}.pcd").write_text(pcd)
        return open_recording(folder).notes

    (note,) = notes_of(tmp_path / "gap", (3, 4, 7, 8, 10))
    assert "file for frames 5 to 6, 9 and no times, so its sweeps are treated as evenly" in note
    assert not notes_of(tmp_path / "whole", range(5, 9))
    assert not notes_of(tmp_path / "each tenth", range(0, 50, 10))
    assert not notes_of(tmp_path / "stamps", (1317042145, 1317042146, 1317042149))


def test_poses_of_the_odometry_benchmark_are_read(tmp_path):
    write_frames(tmp_path / "sequences/04/velodyne", range(3), digits=6)
    (tmp_path / "poses").mkdir()
    rows = np.tile(np.eye(4)[:3], (3, 1, 1))
    rows[:, 0, 3] = (0, 1, 2)
    np.savetxt(tmp_path / "poses/04.txt", rows.reshape(3, 12))
    for path in (tmp_path, tmp_path / "sequences/04"):
        recording = open_recording(path)
        np.testing.assert_allclose(recording.poses(range(3))[:, 0, 3], (0, 1, 2))
    np.savetxt(tmp_path / "poses/04.txt", rows[:2].reshape(2, 12))
    with pytest.raises(LidarError, match=r"poses/04.txt has no row for frame 2\."):
        open_recording(tmp_path)


def test_the_point_folder_of_a_sequence_names_its_other_tables(tmp_path):
    write_frames(tmp_path / "00/velodyne", range(3), digits=6)
    (tmp_path / "00/times.txt").write_text("0\n0.1\n0.2\n")
    assert open_recording(tmp_path / "00").stamps_ns is not None
    (note,) = open_recording(tmp_path / "00/velodyne").notes
    assert "is read without times.txt in its parent folder. Specify the parent folder" in note
