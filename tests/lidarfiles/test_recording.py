"""What recordings state, how other processes read them, and parts of recordings."""

from __future__ import annotations

import os
import pickle
from contextlib import closing
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from tests.drives import points_of, the_scene, the_sweeps, write_set
from tests.packet_surveys import points_of as cast_points
from tests.packet_surveys import posts_before_walls

from lidarfiles import PointCloud, Recording, RecordingInfo, SweepsInMemory, open_recording
from lidarfiles.clouds.built_in_formats import FORMATS
from lidarfiles.clouds.cloud_format import CloudFormat
from lidarfiles.clouds.format_table import load_format
from lidarfiles.clouds.recorded_boxes import RecordedBoxes
from lidarfiles.clouds.recording import LastRead, RayTimes, RecordingSection
from lidarfiles.clouds.recording_ref import RecordingRef
from lidarfiles.clouds.writing import ExportSpec
from lidarfiles.recordings.opening import close_recordings, open_ref, sensor_refs
from lidarfiles.work.process_pool import ProcessPool
from lidarsim import LidarError, Survey, load_sensor
from lidarsim.columns.sweep import Sweep
from lidarsim.scene.files.pcd import pcd_bytes
from lidarsim.sweeps.sweeps import SWEEPS_FILE

# {format or kind of file: sensor to choose}
KINDS = {
    "ply": "front",
    "las": None,
    "laz": None,
    "parquet": None,
    "pcd": None,
    "e57": None,
    "kitti": "00",
    "nuscenes": "LIDAR_TOP",
    "webdataset": "front",
    "images": "front",
    "pcap": None,
    "mcap": "/front/points",
    "rosbag2": "/front/points",
    "data set": "front",
    ".bin": None,
    ".npy": None,
    ".ptx": None,
    "foreign .ply": None,
}
PTX = "2\n1\n" + "0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n5 6 7 1\n"
PLY = "ply\nformat ascii 1.0\nelement vertex 2\n"
PLY += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n1 2 3\n4 5 6\n"


@pytest.fixture(scope="module")
def pool():
    """Return a process that was not forked from this one."""
    with closing(ProcessPool(1)) as processes:
        yield processes


@pytest.fixture(scope="module")
def write(tmp_path_factory):
    """Return a function that writes a recording of a kind, and returns its path."""
    scene = the_scene()
    sweeps = the_sweeps(scene)
    cloud = points_of(scene, 0)
    folder = tmp_path_factory.mktemp("recordings")

    @cache
    def written(kind):
        if kind in FORMATS:
            pytest.importorskip((FORMATS[kind].packages or ("numpy",))[0])
            path = folder / FORMATS[kind].file
            if kind == "pcap":
                sensor = load_sensor("velodyne/vlp16")
                columns = ["channel", "ray", "range", "reflectivity"]
                survey = Survey(sensor, poses=[(0, 0, 0)] * 2, steps=36, columns=columns)
                ExportSpec(kind).write(path, *cast_points(survey, posts_before_walls()))
                return path / "lidar.pcap"
            ExportSpec(kind).write(path, cloud, sweeps)
            if kind == "ply":
                sweeps.save(path.with_name(SWEEPS_FILE))
            return path
        path = folder / f"a{kind.removeprefix('foreign ')}"
        if kind == "data set":
            write_set(path, "kitti", scene, sweeps)
        elif kind == ".bin":
            np.arange(20, dtype="<f4").tofile(path)
        elif kind == ".npy":
            np.save(path, np.arange(9.0).reshape(3, 3))
        else:
            path.write_text(2 * (PTX + "1 2 3 0.5\n4 5 6 0.5\n") if kind == ".ptx" else PLY)
        return path

    return written


def points_in(recording):
    """Return the points of all items."""
    return [np.array(item.points) for item in recording]


def read_in_process(data):
    """Unpickle a recording twice, and return its points and what it states."""
    recording = pickle.loads(data)
    again = pickle.loads(data)
    is_shared = again is recording
    return os.getpid(), type(recording).__name__, recording.info, points_in(recording), is_shared


def test_every_format_that_can_be_opened_is_tested():
    opened = {
        name for name in FORMATS if load_format(name).open.__func__ is not CloudFormat.open.__func__
    }
    assert opened == FORMATS.keys() & KINDS.keys()


@pytest.mark.extended(every=3)
@pytest.mark.parametrize("kind", KINDS)
def test_other_processes_read_the_same_points(write, pool, kind):
    recording = open_recording(write(kind), KINDS[kind])
    expected = points_in(recording)
    assert sum(map(len, expected))
    (found,) = pool.map(read_in_process, [pickle.dumps(recording)])
    process, name, info, points, is_shared = found
    assert process != os.getpid() and name == type(recording).__name__
    assert info == recording.info
    for one, other in zip(points, expected, strict=True):
        np.testing.assert_array_equal(one, other)
    assert is_shared


def test_paths_may_be_relative_and_what_was_changed_is_kept(write, pool, monkeypatch):
    path = write("kitti")
    monkeypatch.chdir(path.parent)
    (found,) = pool.map(read_in_process, [pickle.dumps(open_recording(path.name, "01"))])
    _, _, info, _, is_shared = found
    assert info.name == path.name and is_shared
    recording = open_recording(path.name, "01", keep_noise=True).with_info(name="drive")
    (found,) = pool.map(read_in_process, [pickle.dumps(RecordingSection(recording, 1, 2))])
    _, name, info, points, is_shared = found
    assert name == "RecordingSection" and info.name == "drive" and info.noise_classes is None
    assert not is_shared
    for one, other in zip(points, points_in(recording)[1:], strict=True):
        np.testing.assert_array_equal(one, other)


def test_files_that_do_not_exist_there_are_errors(write, pool, tmp_path):
    path = tmp_path / "a.bin"
    np.zeros((2, 4), "<f4").tofile(path)
    data = pickle.dumps(open_recording(path))
    path.unlink()
    with pytest.raises(LidarError, match=r"a\.bin does not exist"):
        list(pool.map(read_in_process, [data]))


def write_point(path, x):
    fields = [(axis, np.full(1, x, np.float32)) for axis in "xyz"]
    content = pcd_bytes(fields, (0, 0, 0), (1, 0, 0, 0), "")
    path.write_bytes(content)


def test_a_process_opens_a_file_once_until_it_changes(tmp_path):
    path = tmp_path / "a.pcd"
    write_point(path, 1)
    ref = RecordingRef(path)
    opened = open_ref(ref)
    assert open_ref(ref) is opened and pickle.loads(pickle.dumps(opened)) is opened
    assert open_ref(replace(ref, keep_noise=True)) is not opened
    write_point(path, 2)
    os.utime(path, ns=(1, 1))
    assert open_ref(ref)[0].points[0, 0] == 2
    again = open_ref(ref)
    close_recordings()
    assert open_ref(ref) is not again


def test_a_reference_for_each_sensor(write):
    assert sensor_refs(RecordingRef(write(".npy"))) == (RecordingRef(write(".npy")),)
    path = write("kitti")
    assert [ref.sensor for ref in sensor_refs(RecordingRef(path))] == ["00", "01"]
    assert [ref.sensor for ref in sensor_refs(RecordingRef(path, "01"))] == ["01"]


def test_info_is_a_value():
    info = RecordingInfo("drive", sensor="roof", meters=(0.01, 0.01, 0.01))
    assert info == pickle.loads(pickle.dumps(info)) == replace(RecordingInfo("x"), **vars(info))
    assert hash(info) == hash(pickle.loads(pickle.dumps(info)))
    assert repr(info) == "RecordingInfo(name='drive', sensor='roof', meters=(0.01, 0.01, 0.01))"
    assert info.intensity_name == "intensity" and not info.energies


def test_clouds_are_no_recordings(write):
    cloud = open_recording(write("las"), keep_noise=True)
    assert isinstance(cloud, PointCloud) and not isinstance(cloud, Recording)
    assert repr(cloud) == f"<PointCloud {cloud.info.name}: 1 part>"
    assert cloud.info.point_count == len(cloud[0]) == sum(map(len, cloud))
    assert len(cloud.sample(360)) == pytest.approx(360, abs=20)
    assert open_recording(write(".npy")).sample(10) is None
    with pytest.raises(IndexError, match="has 1 part, so 1 is out of range"):
        cloud[1]


def numbered(count):
    """Return sweeps whose points are at their number."""
    return [Sweep(np.full((4, 3), 1.0 + number)) for number in range(count)]


def test_sweeps_in_memory_are_pickled():
    poses = np.tile(np.eye(4), (3, 1, 1))
    recording = SweepsInMemory("drive", numbered(3), stamps_ns=np.arange(3.0), poses=poses)
    copy = pickle.loads(pickle.dumps(recording))
    assert repr(copy) == "<Recording drive: 3 sweeps>"
    assert [sweep.points[0, 0] for sweep in copy] == [1, 2, 3]
    assert copy.stamps_ns.tolist() == [0, 1, 2] and copy.poses([1]).shape == (1, 4, 4)
    assert copy.boxes is None and copy.classes == {} and copy.has_stored_poses


class Counting(SweepsInMemory):
    """Recording that counts what is read."""

    def __init__(self, *args, **options):
        super().__init__(*args, **options)
        self.read = []

    def load(self, number):
        self.read.append(number)
        return super().load(number)

    def load_boxes(self):
        rows = [(number, 7, "Car", np.eye(4), (4, 2, 1)) for number in range(len(self))]
        return RecordedBoxes.from_rows(rows)


def test_a_section_has_what_belongs_to_its_sweeps():
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 0, 3] = np.arange(5)
    info = RecordingInfo("drive", files=tuple("abcde"), stations=tuple("ABCDE"))
    whole = Counting(info, numbered(5), stamps_ns=10.0 * np.arange(5), poses=poses)
    part = RecordingSection(whole, 1, 3)
    assert len(part) == 3 and [sweep.points[0, 0] for sweep in part] == [2, 3, 4]
    assert [sweep.number for sweep in part] == [0, 1, 2]
    assert part.info.files == ("b", "c", "d") and part.info.stations == ("B", "C", "D")
    assert part.stamps_ns.tolist() == [10, 20, 30]
    assert part.poses([0, 2])[:, 0, 3].tolist() == [1, 3]
    assert part.boxes.sweep.tolist() == [0, 1, 2]
    assert part.ray_times is None
    with pytest.raises(IndexError, match="drive has 3 sweeps, so 3 is out of range"):
        part[3]


def test_the_last_sweep_is_read_once():
    whole = Counting("drive", numbered(3), stamps_ns=np.arange(3.0))
    kept = LastRead(whole)
    for number in (0, 0, 1, 1, 0):
        assert kept[number].points[0, 0] == 1 + number
    assert whole.read == [0, 1, 0]
    kept.release()
    assert kept[0].points[0, 0] == 1 and whole.read == [0, 1, 0, 0]
    assert kept.stamps_ns.tolist() == [0, 1, 2]


def test_changed_units_apply_to_points_and_poses():
    poses = np.tile(np.eye(4), (1, 1, 1))
    poses[0, 0, 3] = 100
    recording = SweepsInMemory("drive", numbered(1), poses=poses)
    assert recording.poses([0])[0, 0, 3] == 100
    changed = recording.with_info(meters=(0.01, 0.01, 0.01))
    assert changed[0].points[0, 0] == 0.01 and changed.poses([0])[0, 0, 3] == 1
    assert recording[0].points[0, 0] == 1


def test_results_state_the_times_of_their_rays(write):
    result = open_recording(write("ply"), "front")
    assert isinstance(result.ray_times, RayTimes)
    assert result.ray_times.are_same(pickle.loads(pickle.dumps(result)).ray_times)
    assert result.info.has_firing_poses and result.fired(0).firing_poses is not None
