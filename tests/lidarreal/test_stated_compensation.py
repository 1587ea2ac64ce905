"""Recordings that state whether their points are compensated for the motion of the sensor."""

from __future__ import annotations

import numpy as np
import pytest
from tests.simulated_drives import simulated_drive

from lidarfiles import open_recording
from lidarreal.reconstruction.alignment import first_alignment
from lidarreal.reconstruction.motion import Motion
from lidarreal.reconstruction.odometry import find_poses
from lidarreal.reconstruction.recorded_sweeps import RecordedSweeps
from lidarsim import Scene, Sensor, Survey, Track, box

pytest.importorskip("scipy")

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
        columns=["time", "channel", "intensity"],
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
