"""Recordings that state whether their points are compensated for the motion of the sensor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from tests.fake_augmenters import identity, rewrite
from tests.made_recordings import made_recording
from tests.simulated_drives import simulated_drive

import lidarfiles
from lidarfiles import PointCloud, open_recording, save_cloud
from lidarfiles.clouds.built_in_formats import DATA_SETS
from lidarfiles.clouds.posed_sweeps import PosedSweeps
from lidarfiles.clouds.recording_ref import RecordingRef
from lidarfiles.clouds.writing import ExportSpec
from lidarfiles.datasets.dataset import DataSet
from lidarfiles.datasets.job_table import JobRow, write_table
from lidarfiles.recordings.opening import open_ref
from lidarreal import compare
from lidarreal.augmentation.conversion import FormatConverter
from lidarreal.comparing.surveys.survey_clouds import SurveyCloud
from lidarreal.reconstruction.alignment import first_alignment
from lidarreal.reconstruction.motion import Motion
from lidarreal.reconstruction.odometry import find_poses
from lidarreal.reconstruction.recorded_sweeps import RecordedSweeps
from lidarsim import Scene, Sensor, Survey, Track, box, load_sensor
from lidarsim.columns.sweep import Sweep
from lidarsim.io.storage import Storage
from lidarsim.sweeps.sweeps import SWEEPS_FILE

SWEEPS = 8
SPEED_M_S = 12.0
TOLERANCE_M = 0.005


def hall():
    """A hall with a wall and a block."""
    sizes = {"Floor": (60, 40, 0.1), "Wall": (1, 20, 6), "Block": (2, 3, 1), "Side": (30, 1, 5)}
    return Scene.from_meshes([box(name, size) for name, size in sizes.items()])


def corridor():
    """A floor and two walls that are the same everywhere, so that no motion is visible."""
    boxes = {"Floor": (200, 20, 0.1), "Left": (200, 1, 5), "Right": (200, 1, 5)}
    middles = {"Floor": (0, 0, 0), "Left": (0, 8, 0), "Right": (0, -9, 0)}
    meshes = []
    for name, size in boxes.items():
        mesh = box(name, size)
        meshes.append(replace(mesh, vertices=mesh.vertices + np.array(middles[name])))
    return Scene.from_meshes(meshes)


def drive(coordinates="world", scene=None, sensor=None):
    """Return the recorded sweeps of a drive, by default along the hall: a cloud in memory."""
    survey = Survey(
        sensor or Sensor.grid(360, 16, vertical_fov_deg=30),
        trajectory=Track([0, 1], [[-11, -6, 2], [SPEED_M_S - 11, -6, 2]]),
        steps=36 * SWEEPS,
        columns=["time", "ray", "range", "intensity", "reflectivity", "class"],
        coordinates=coordinates,
        precision_m=1e-4,
    )
    return simulated_drive(scene or hall(), survey)


def aligned(recording):
    """Return the sweeps of a recording and their first alignment."""
    sweeps = RecordedSweeps.from_recording(recording)
    return sweeps, first_alignment(sweeps, find_poses(sweeps, None))


def test_a_twin_compensates_results_in_sensor_coordinates():
    compensated = open_recording(drive(), name="world")
    sweeps, alignment = aligned(open_recording(drive("sensor"), name="sensor"))
    assert alignment.motion is Motion.TIMED
    for number in (1, 5):
        expected = compensated[number].points
        sweep = sweeps.read(number)
        assert np.abs(sweep.points - expected).max() > 0.5
        points, _ = alignment.compensate(sweep, number)
        np.testing.assert_allclose(points, expected, atol=TOLERANCE_M)


def write_data_set(folder, name, *clouds):
    """Write a data set with one job for each cloud, and return its folder."""
    data = DataSet(Storage.at(folder / name), name)
    rows = [JobRow(number, f"{number:02}") for number in range(len(clouds))]
    for row, cloud in zip(rows, clouds, strict=True):
        data.write_job(row, cloud, cloud.sweeps())
    write_table(data.storage, [], lambda: rows)
    data.finish(rows)
    return folder / name


@pytest.mark.extended(every=2)
@pytest.mark.parametrize("coordinates", ["world", "sensor"])
@pytest.mark.parametrize("name", DATA_SETS)
def test_sweeps_of_data_sets_state_their_compensation(name, coordinates, tmp_path):
    ExportSpec(DATA_SETS[name]).check_installed()
    folder = write_data_set(tmp_path, name, drive(coordinates))
    compensated = coordinates == "world" or name in ("kitti", "nuscenes")
    truth = drive("world" if compensated else "sensor")
    recording = open_recording(folder)
    assert recording.info.compensated is compensated
    for number in (1, 5):
        sweep = lidarfiles.sweeps(folder)[number]
        assert sweep.compensated is compensated
        expected = open_recording(truth)[number].points
        distances, _ = cKDTree(expected).query(sweep.points)
        assert len(sweep) == len(expected)
        assert distances.max() < TOLERANCE_M


def test_data_sets_of_different_jobs_state_no_common_compensation(tmp_path):
    folder = write_data_set(tmp_path, "webdataset", drive(), drive("sensor"))
    recording = open_recording(folder)
    assert recording.info.compensated is None
    assert [recording[number].compensated for number in (0, SWEEPS)] == [True, False]


@pytest.mark.extended(every=2)
@pytest.mark.parametrize("name", ["mcap", "pcd"])
@pytest.mark.parametrize("is_stated", [True, False])
@pytest.mark.parametrize("compensated", [True, False])
def test_conversions_state_what_their_source_states(compensated, is_stated, name, tmp_path):
    ExportSpec(name).check_installed()
    folder = tmp_path / "drive"
    save_cloud(drive(), folder, format="pcd", compensated=compensated)
    for path in () if is_stated else folder.iterdir():
        comment, _, rest = path.read_bytes().partition(b"\n")
        assert b"motion is" in comment
        path.write_bytes(rest)
    stated = compensated if is_stated else None
    recording = open_recording(folder, keep_noise=True)
    assert recording.info.compensated is stated
    converter = FormatConverter(RecordingRef(folder), recording, ExportSpec(name))
    target = tmp_path / f"new{converter.ending}"
    rewrite(converter, target, tmp_path / "work", identity)
    converted = open_recording(target)
    assert converted.info.compensated is stated
    assert (converted[3].times_s is None) == compensated


# {format: options, and whether the points are compensated}
STATED = {
    "mcap": ("mcap", "new.mcap", {}, False),
    "compensated mcap": ("mcap", "new.mcap", {"compensated": True}, True),
    "pcd": ("pcd", "new", {}, False),
    "compensated pcd": ("pcd", "new", {"compensated": True}, True),
    "webdataset": ("webdataset", "new", {}, True),
    "images": ("images", "new", {}, True),
    "nuscenes": ("nuscenes", "new", {}, True),
    "e57": ("e57", "new.e57", {}, True),
}


@pytest.mark.parametrize("key", STATED)
def test_a_twin_uses_the_compensation_that_files_state(key, tmp_path):
    """In a corridor, the points do not show whether they are compensated."""
    name, file, options, compensated = STATED[key]
    ExportSpec(name).check_installed()
    save_cloud(drive(scene=corridor()), tmp_path / file, format=name, **options)
    recording = open_recording(tmp_path / file)
    assert recording.info.compensated is compensated
    assert recording[3].compensated is compensated
    _, alignment = aligned(recording)
    assert alignment.motion is (Motion.COMPENSATED if compensated else Motion.TIMED)


@pytest.mark.parametrize("name", ["webdataset", "images"])
def test_training_formats_state_points_as_fired(name, tmp_path):
    save_cloud(drive("sensor", corridor()), tmp_path / "new", format=name)
    recording = open_recording(tmp_path / "new")
    assert recording.info.compensated is False
    assert recording[3].compensated is False
    _, alignment = aligned(recording)
    assert alignment.motion is Motion.TIMED


def test_packets_are_as_fired(tmp_path):
    save_cloud(drive(sensor=load_sensor("velodyne/vlp16")), tmp_path / "pcap", format="pcap")
    recording = open_recording(tmp_path / "pcap" / "lidar.pcap")
    assert recording.info.compensated is False
    assert recording[3].compensated is False


def test_points_as_fired_without_times_are_compensated_by_their_azimuth():
    fired = open_recording(drive("sensor", corridor()), name="drive")

    def recording(compensated):
        def read(number):
            sweep = fired[number]
            order = np.argsort(sweep.columns["time"], kind="stable")
            columns = {"channel": sweep.columns["channel"]}
            return Sweep(sweep.points, columns, pose=sweep.pose).select(order)

        return made_recording("drive", SWEEPS, read, compensated=compensated)

    assert aligned(recording(None))[1].motion is Motion.COMPENSATED
    assert aligned(recording(True))[1].motion is Motion.COMPENSATED
    assert aligned(recording(False))[1].motion.is_turning


# {name: file, format and options of recordings with points as fired}
AS_FIRED = {
    "result": ("new/cloud.ply", None, {}),
    "mcap": ("new.mcap", "mcap", {}),
    "webdataset": ("new", "webdataset", {}),
    **{
        f"data set {name}": ("", None, {}) for name in ("webdataset", "parquet", "images", "folder")
    },
}


def write_as_fired(folder, key):
    """Write a drive with points as fired, and return its path."""
    file, name, options = AS_FIRED[key]
    cloud = drive("sensor")
    if key.startswith("data set"):
        kind = key.removeprefix("data set ")
        ExportSpec(DATA_SETS[kind]).check_installed()
        return write_data_set(folder, kind, cloud)
    if name is None:
        (folder / "new").mkdir()
        save_cloud(cloud, folder / file)
        cloud.sweeps().save(folder / "new" / SWEEPS_FILE)
        return folder / "new"
    ExportSpec(name).check_installed()
    save_cloud(cloud, folder / file, format=name, **options)
    return folder / file


@pytest.mark.extended(every=2)
@pytest.mark.parametrize("key", AS_FIRED)
def test_points_as_fired_are_compared_in_world_coordinates(key, tmp_path):
    """At the pose of its sweep, a point would be up to 1.2 m from the surface."""
    path = write_as_fired(tmp_path, key)
    truth = drive()
    cloud = replace(truth, sweeps=None)
    found = compare(cloud, path).figures
    for way in ("a_to_b", "b_to_a"):
        assert found["distances"][way]["max_m"] < 3 * TOLERANCE_M
    points, _ = SurveyCloud.open(path, "survey").sample(1_000_000)
    assert len(points) == len(truth)
    assert cKDTree(truth.positions).query(points.positions)[0].max() < 3 * TOLERANCE_M


@pytest.mark.parametrize("name", ["pcd", "images"])
def test_points_as_fired_without_times_of_sweeps_are_noted(name, tmp_path):
    save_cloud(drive("sensor"), tmp_path / "new", format=name)
    cloud = replace(drive(), sweeps=None)
    notes = compare(cloud, tmp_path / "new").figures["notes"]
    assert any("as fired, but not the times of its sweeps" in note for note in notes)
    survey = SurveyCloud.open(tmp_path / "new", "survey")
    survey.sample(1_000_000)
    assert any("as fired, but not the times of its sweeps" in note for note in survey.notes)


def test_points_as_fired_without_times_are_noted():
    fired = open_recording(drive("sensor"), name="drive")

    def read(number):
        sweep = fired[number]
        return Sweep(sweep.points, {"channel": sweep.columns["channel"]}, pose=sweep.pose)

    sweeps = PosedSweeps(made_recording("drive", SWEEPS, read, compensated=False))
    assert sweeps.read(1).firing_poses is None
    (note,) = sweeps.notes
    assert note.startswith("drive contains points as fired, but not the times of its points")
    still = PosedSweeps(made_recording("drive", 1, read, compensated=False))
    assert still.read(0).firing_poses is None and not still.notes


@pytest.mark.parametrize("name", ["ply", "las", "parquet"])
def test_points_as_fired_are_converted_to_world_coordinates(name, tmp_path):
    spec = ExportSpec(name)
    spec.check_installed()
    ExportSpec("mcap").check_installed()
    save_cloud(drive("sensor"), tmp_path / "drive.mcap")
    ref = RecordingRef(tmp_path / "drive.mcap", keep_noise=True)
    converter = FormatConverter(ref, open_ref(ref), spec)
    target = tmp_path / f"new{converter.ending}"
    notes = rewrite(converter, target, tmp_path / "work", identity)
    assert not any("as fired" in note for note in notes)
    truth = drive()
    converted = open_recording(target)
    parts = [converted[number] for number in range(len(converted))]
    points = np.concatenate(
        [part.points if isinstance(converted, PointCloud) else part.in_world() for part in parts]
    )
    assert len(points) == len(truth)
    assert cKDTree(truth.positions).query(points)[0].max() < 3 * TOLERANCE_M


def test_conversions_note_points_as_fired_without_times_of_sweeps(tmp_path):
    save_cloud(drive("sensor"), tmp_path / "drive", format="pcd")
    ref = RecordingRef(tmp_path / "drive", keep_noise=True)
    converter = FormatConverter(ref, open_ref(ref), ExportSpec("ply"))
    notes = rewrite(converter, tmp_path / "new.ply", tmp_path / "work", identity)
    assert any("as fired, but not the times of its sweeps. All points" in note for note in notes)
