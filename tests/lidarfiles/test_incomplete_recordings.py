"""Pieces of recordings whose other files are missing or in another folder."""

from __future__ import annotations

import json
import re
import shutil

import numpy as np
import pytest
from tests.simulated_drives import simulated_drive

from lidarfiles import open_recording, save_cloud
from lidarsim import LidarError, Scene, Sensor, Survey, Track, box

SWEEPS = 10
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
    stored = [rows[number] for number in (0, 1, 2, 5, 6)]
    expected_ns = np.array(stored, "datetime64[ns]").astype(np.int64)
    np.testing.assert_array_equal(recording.stamps_ns, expected_ns)
    assert recording[3].time_ns == expected_ns[3]
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


@pytest.fixture(scope="module")
def cloud():
    """Ten sweeps of a moving sensor."""
    survey = Survey(
        Sensor.grid(360, 8),
        trajectory=Track([0, 1], [[0, 0, 1], [2, 0, 1]]),
        steps=36 * SWEEPS,
        columns=["time", "intensity", "reflectivity", "class"],
    )
    return simulated_drive(Scene.from_meshes([box("Floor", (30, 30, 0.1))]), survey)


def write_bag(cloud, folder, mode):
    """Write a bag as MCAP with a kind of compression, and return the file and the folder."""
    rosbags = pytest.importorskip("rosbags.rosbag2")
    store = pytest.importorskip("lidarfiles.clouds.ros.messages").message_store()
    save_cloud(cloud, folder / "plain.mcap")
    writer = rosbags.Writer(folder / "bag", version=9, storage_plugin=rosbags.StoragePlugin.MCAP)
    writer.set_compression(rosbags.CompressionMode[mode], rosbags.CompressionFormat.ZSTD)
    with writer, rosbags.Reader(folder / "plain.mcap") as bag:
        ids = {
            connection.id: writer.add_connection(
                connection.topic,
                connection.msgtype,
                typestore=store,
                offered_qos_profiles=connection.ext.offered_qos_profiles,
            )
            for connection in bag.connections
        }
        for connection, time_ns, data in bag.messages():
            writer.write(ids[connection.id], time_ns, data)
    (file,) = (path for path in (folder / "bag").iterdir() if path.suffix != ".yaml")
    return file


@pytest.mark.parametrize(
    ("mode", "words"),
    [
        ("MESSAGE", "its messages are compressed one by one, which only the file metadata.yaml"),
        ("FILE", "It is a compressed file of a ROS 2 bag. Specify the folder that contains it"),
    ],
)
def test_compressed_files_of_bags_need_their_metadata(cloud, tmp_path, mode, words):
    file = write_bag(cloud, tmp_path, mode)
    assert len(open_recording(file.parent)) == SWEEPS
    with pytest.raises(LidarError, match=re.escape(words)):
        open_recording(file)
    file.with_name("metadata.yaml").unlink()
    with pytest.raises(
        LidarError, match=r"not the file metadata\.yaml\. Create it with `ros2 bag re"
    ):
        open_recording(file.parent)


@pytest.mark.parametrize("is_beside", [True, False])
def test_a_file_of_a_split_bag_is_noted(cloud, tmp_path, is_beside):
    file = write_bag(cloud, tmp_path, "NONE")
    assert not open_recording(file).notes
    metadata = file.with_name("metadata.yaml")
    text = metadata.read_text().replace(f"- {file.name}\n", f"- {file.name}\n  - bag_1.mcap\n", 1)
    assert text != metadata.read_text()
    metadata.write_text(text)
    if not is_beside:
        file = file.replace(tmp_path / file.name)
    notes = open_recording(file).notes
    assert bool(notes) == is_beside
    assert not notes or "is one of 2 files of a bag, so further sweeps" in notes[0]


def test_nuscenes_may_contain_only_key_frames(cloud, tmp_path):
    save_cloud(cloud, tmp_path / "set", format="nuscenes")
    whole = open_recording(tmp_path / "set")
    assert len(whole) == SWEEPS
    assert not whole.notes
    for table in (tmp_path / "set").glob("v1.0-*/sample_data.json"):
        rows = json.loads(table.read_text())
        for row in rows[1::2]:  # in nuScenes, one in ten sweeps is a key frame
            name = row["filename"].replace("samples", "sweeps")
            (tmp_path / "set" / row["filename"]).unlink()
            row |= {"filename": name, "is_key_frame": False}
        table.write_text(json.dumps(rows))
    recording = open_recording(tmp_path / "set")
    assert len(recording) == SWEEPS // 2
    (note,) = recording.notes
    assert "contains only the 5 key frames of this lidar. The files of 5 sweeps between" in note
    np.testing.assert_array_equal(recording[1].points, whole[2].points)
    np.testing.assert_array_equal(recording.stamps_ns, whole.stamps_ns[::2])
    (points,) = (tmp_path / "set/samples").iterdir()
    (note,) = open_recording(points).notes
    assert "is read without the poses and times in the tables of nuScenes. Specify" in note


def test_one_of_several_tar_files_is_noted(cloud, tmp_path):
    save_cloud(cloud, tmp_path / "set", format="webdataset")
    (file,) = (tmp_path / "set").rglob("*.tar")
    assert not open_recording(file).notes
    shutil.copy(file, file.with_name("000010.tar"))
    (note,) = open_recording(file).notes
    assert "is one of 2 tar files in its folder. Specify the folder" in note
