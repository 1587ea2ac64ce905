"""Recordings that state whether their points are compensated for the motion of the sensor."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree
from tests.fake_augmenters import identity, rewrite
from tests.simulated_drives import simulated_drive

import lidarfiles
from lidarfiles import open_recording, save_cloud
from lidarfiles.clouds.format_table import DATA_SETS
from lidarfiles.clouds.writing import ExportSpec
from lidarfiles.datasets.dataset import DataSet
from lidarfiles.datasets.job_table import JobRow, write_table
from lidarreal.augmentation.conversion import open_converter
from lidarreal.reconstruction.alignment import first_alignment
from lidarreal.reconstruction.motion import Motion
from lidarreal.reconstruction.odometry import find_poses
from lidarreal.reconstruction.recorded_sweeps import RecordedSweeps
from lidarsim import Scene, Sensor, Survey, Track, box
from lidarsim.io.storage import Storage

SWEEPS = 8
SPEED_M_S = 12.0
TOLERANCE_M = 0.005


def hall():
    """A hall with a wall and a block."""
    sizes = {"Floor": (60, 40, 0.1), "Wall": (1, 20, 6), "Block": (2, 3, 1), "Side": (30, 1, 5)}
    return Scene.from_meshes([box(name, size) for name, size in sizes.items()])


def drive(coordinates, speed_m_s=SPEED_M_S):
    """Return the recorded sweeps of a drive along the hall: a cloud in memory."""
    survey = Survey(
        Sensor.grid(360, 16, vertical_fov_deg=30),
        trajectory=Track([0, 1], [[-9, -6, 2], [speed_m_s - 9, -6, 2]]),
        steps=36 * SWEEPS,
        columns=["time", "ray", "range", "intensity", "reflectivity", "class"],
        coordinates=coordinates,
        precision_m=1e-4,
    )
    return simulated_drive(hall(), survey)


def aligned(recording):
    """Return the sweeps of a recording and their first alignment."""
    sweeps = RecordedSweeps.from_recording(recording)
    return sweeps, first_alignment(sweeps, find_poses(sweeps, None))


def test_a_twin_compensates_results_in_sensor_coordinates():
    compensated = open_recording(drive("world"), name="world")
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


@pytest.mark.parametrize("coordinates", ["world", "sensor"])
@pytest.mark.parametrize("name", DATA_SETS)
def test_sweeps_of_data_sets_state_their_compensation(name, coordinates, tmp_path):
    ExportSpec(DATA_SETS[name]).check_installed()
    folder = write_data_set(tmp_path, name, drive(coordinates))
    compensated = coordinates == "world" or name in ("kitti", "nuscenes")
    truth = drive("world" if compensated else "sensor")
    recording = open_recording(folder)
    assert recording.compensated is compensated
    for number in (1, 5):
        sweep = lidarfiles.sweeps(folder)[number]
        assert sweep.compensated is compensated
        expected = open_recording(truth)[number].points
        distances, _ = cKDTree(expected).query(sweep.points)
        assert len(sweep) == len(expected)
        assert distances.max() < TOLERANCE_M


def test_data_sets_of_different_jobs_state_no_common_compensation(tmp_path):
    folder = write_data_set(tmp_path, "webdataset", drive("world"), drive("sensor"))
    recording = open_recording(folder)
    assert recording.compensated is None
    assert [recording[number].compensated for number in (0, SWEEPS)] == [True, False]


@pytest.mark.parametrize("name", ["mcap", "pcd"])
@pytest.mark.parametrize("is_stated", [True, False])
@pytest.mark.parametrize("compensated", [True, False])
def test_conversions_state_what_their_source_states(compensated, is_stated, name, tmp_path):
    ExportSpec(name).check_installed()
    folder = tmp_path / "drive"
    save_cloud(drive("world"), folder, format="pcd", compensated=compensated)
    for path in () if is_stated else folder.iterdir():
        comment, _, rest = path.read_bytes().partition(b"\n")
        assert b"motion is" in comment
        path.write_bytes(rest)
    stated = compensated if is_stated else None
    recording = open_recording(folder, keep_noise=True)
    assert recording.compensated is stated
    converter = open_converter(folder, recording, ExportSpec(name))
    target = tmp_path / f"new{converter.ending}"
    rewrite(converter, target, tmp_path / "work", identity)
    converted = open_recording(target)
    assert converted.compensated is stated
    assert (converted[3].times_s is None) == compensated
