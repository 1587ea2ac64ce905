"""Returns from the air and from the own vehicle are no part of a reconstructed place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.simulated_drives import simulated_drive

from lidarfiles.recordings.opening import open_recording
from lidarreal import twin
from lidarreal.reconstruction.air_returns import find_air_returns
from lidarreal.reconstruction.alignment import AlignedSweeps, Alignment
from lidarreal.reconstruction.isolated_returns import IsolatedRanges, same_range_neighbors
from lidarreal.reconstruction.lost_pulses import SensorCoverage
from lidarreal.reconstruction.motion import Motion
from lidarreal.reconstruction.odometry import find_poses
from lidarreal.reconstruction.recorded_sweeps import RecordedSweeps
from lidarreal.reconstruction.vehicle_detection import find_vehicle_returns
from lidarsim import (
    Actor,
    Material,
    Mounted,
    Noise,
    Pose,
    Returns,
    Scene,
    SceneMesh,
    Sensor,
    Survey,
    Track,
    box,
)
from lidarsim.columns.sweep import Sweep
from lidarsim.columns.table import CAUSES

pytest.importorskip("scipy")

SWEEPS = 12
END_S = SWEEPS * 0.1 + 0.2
SPEED_M_S = 8.0
HEIGHT_M = 1.8
AIR = CAUSES.index("air")
HOOD = (2.0, 1.6, 0.6)


def static_box(name, size, middle):
    """A box on the ground around a place."""
    mesh = box(name, size)
    return SceneMesh(name, mesh.vertices + np.array([*middle, 0.0]), mesh.faces)


def ahead(start, height_m=0.0):
    """The track of something that moves as fast as the sensor."""
    x, y = start
    return Track([0, END_S], [[x, y, height_m], [x + SPEED_M_S * END_S, y, height_m]])


def street(*actors):
    """A street between walls and posts, and a car that comes toward the sensor."""
    corners = np.array([[-60, -9, 0], [60, -9, 0], [60, 9, 0], [-60, 9, 0]], float)
    meshes = [
        SceneMesh("floor", corners, np.array([[0, 1, 2], [0, 2, 3]])),
        static_box("wall left", (120.0, 1.0, 6.0), (0.0, 9.0)),
        static_box("wall right", (120.0, 1.0, 2.5), (0.0, -9.0)),
        static_box("wall ahead", (1.0, 18.0, 6.0), (45.0, 0.0)),
        *(static_box(f"shed {x}", (2.0, 2.0, 2.4), (x, 7.0)) for x in range(-28, 40, 7)),
        *(static_box(f"post {x}", (0.4, 0.4, 3.0), (float(x), -6.0)) for x in range(-30, 40, 6)),
    ]
    car = Actor(box("car", (4.0, 1.8, 1.5)), Track([0, 2], [[20, 3, 0], [0, 3, 0]]))
    return Scene.from_meshes(meshes).with_actors([car, *actors])


def drive(scene, **weather):
    """Return the recorded sweeps of a drive: a cloud in memory."""
    sensor = replace(
        Sensor.grid(512, 32, vertical_fov_deg=40), returns=Returns(divergence_mrad=3.0)
    )
    survey = Survey(
        sensors=[Mounted(sensor, Pose((0, 0, HEIGHT_M)))],
        trajectory=ahead((-10, 0)),
        steps=36 * SWEEPS,
        columns=["time", "intensity", "cause", "object"],
        materials=[Material("floor", 0.2), Material("*", 0.5)],
        noise=Noise(range_m=0.01, detection_range_m=90.0, overlap_m=5.0, seed=1),
        **weather,
    )
    return simulated_drive(scene, survey)


def aligned(recording):
    """Return the sweeps of a result at their recorded poses."""
    recorded = RecordedSweeps.from_recording(recording).with_isolated_ranges()
    poses = find_poses(recorded, None)
    alignment = Alignment.from_poses(
        poses, 0.1, Motion.COMPENSATED, recorded.ring_count, recorded.lasers
    )
    return AlignedSweeps(recorded, alignment, SensorCoverage.from_sweeps(recorded))


def found_and_true(cloud):
    """Return masks of the returns that are found in the air, and that are from the air."""
    recording = open_recording(cloud)
    sweeps = aligned(recording)
    found = find_air_returns(sweeps, range(SWEEPS))
    counts = [len(sweeps.recorded.read(number)) for number in range(SWEEPS)]
    masks = [found.get(number, np.zeros(counts[number], bool)) for number in range(SWEEPS)]
    causes = [recording[number].returns().columns["cause"] for number in range(SWEEPS)]
    return np.concatenate(masks), np.concatenate(causes) == AIR


@pytest.mark.extended(keep=("rain",))
@pytest.mark.parametrize(
    ("weather", "precision", "recall"),
    [
        ({"visibility_km": 0.1}, 0.97, 0.9),
        ({"snow_mm_h": 2.0}, 0.98, 0.97),
        ({"rain_mm_h": 25.0}, 0.9, 0.9),
    ],
    ids=["fog", "snow", "rain"],
)
def test_returns_from_the_air_are_found(weather, precision, recall):
    found, true = found_and_true(drive(street(), **weather))
    assert true.sum() > 50
    assert (found & true).sum() > precision * found.sum()
    assert (found & true).sum() > recall * true.sum()


def test_clear_air_returns_nothing():
    found, true = found_and_true(drive(street()))
    assert not true.any()
    assert not found.any()


@pytest.mark.extended
def test_returns_from_the_vehicle_are_found():
    hood = Actor(box("hood", HOOD), ahead((-8.5, 0), 0.7))
    cloud = drive(street(hood))
    recording = open_recording(cloud)
    recorded = RecordedSweeps.from_recording(recording)
    vehicle = find_vehicle_returns(recorded, find_poses(recorded, None))
    found = [vehicle.contain(recorded.read(number)) for number in range(SWEEPS)]
    objects = [recording[number].returns().columns["object"] for number in range(SWEEPS)]
    true = np.concatenate(objects) == len(street().names) + 1  # after the car
    found = np.concatenate(found)
    assert true.mean() > 0.02
    assert vehicle.share == pytest.approx(true.mean(), rel=0.1)
    assert (found & true).sum() > 0.95 * true.sum()
    assert (found & ~true).sum() < 0.05 * true.sum()


@pytest.mark.extended(every=2)
@pytest.mark.parametrize("faster_m_s", [1.0, -1.5])
def test_a_car_that_drives_alongside_is_not_the_vehicle(faster_m_s):
    x = -8.0 - faster_m_s * END_S / 2
    path = [[x, 2.8, 0.3], [x + (SPEED_M_S + faster_m_s) * END_S, 2.8, 0.3]]
    beside = Actor(box("beside", (4.2, 1.8, 1.3)), Track([0, END_S], path))
    recorded = RecordedSweeps.from_recording(open_recording(drive(street(beside))))
    vehicle = find_vehicle_returns(recorded, find_poses(recorded, None))
    assert not vehicle.are_found


@pytest.mark.extended
def test_a_sensor_without_a_visible_vehicle_has_none():
    recorded = RecordedSweeps.from_recording(open_recording(drive(street())))
    vehicle = find_vehicle_returns(recorded, find_poses(recorded, None))
    assert not vehicle.are_found
    assert vehicle.share == 0


def test_neighbors_at_the_same_range_are_counted_within_a_ring():
    azimuth = np.radians(np.tile(np.arange(-20, 20), 2))
    range_m = np.full(80, 10.0)
    range_m[20] = 4.0
    row = np.arange(2).repeat(40)
    points = np.stack([range_m * np.cos(azimuth), range_m * np.sin(azimuth), 0 * azimuth], axis=1)
    same = same_range_neighbors(Sweep(points, {"row": row}))
    assert same[20] == 0
    assert same[60] == 6
    assert same[19] == 5
    assert same[0] == 3


def test_most_returns_in_an_interval_must_be_isolated():
    azimuth = np.radians(np.arange(-180, 180.0))
    random = np.random.default_rng(0)

    def sweep(near):
        range_m = np.full(360, 20.0)
        range_m[::8] = near
        points = np.stack([range_m * np.cos(azimuth), range_m * np.sin(azimuth), 0 * azimuth], 1)
        return Sweep(points, {"row": np.zeros(360, np.int64)})

    foggy = sweep(random.uniform(1.1, 1.9, 45))
    ranges = IsolatedRanges.from_sweeps([foggy])
    assert (ranges.start_m, ranges.stop_m) == (1.0, 2.0)
    assert len(ranges.without_isolated(foggy)) == 315
    leafy = sweep(random.uniform(6, 7, 45))
    assert not IsolatedRanges.from_sweeps([leafy]).are_found
    assert len(IsolatedRanges.from_sweeps([leafy]).without_isolated(leafy)) == 360


@pytest.mark.extended
def test_a_twin_states_the_visibility_that_explains_its_fog():
    place = twin(drive(street(), visibility_km=0.1))
    weather = place.figures["weather"]
    assert weather["returns"] > 1000
    assert weather["median_range_m"] < 5
    assert 100 / 1.5 < weather["visibility_m"] < 100 * 1.5
    assert place.figures["held_out"]["stationary"]["p90_abs_difference_m"] < 0.2
    assert "from the air" in repr(place)
    clear = twin(drive(street()))
    assert clear.figures["weather"] is None
    assert "from the air" not in repr(clear)
