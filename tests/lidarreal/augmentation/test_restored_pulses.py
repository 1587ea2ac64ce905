"""Pulses without a return that are restored from recorded sweeps."""

from dataclasses import replace

import numpy as np
import pytest
from tests.made_recordings import made_recording

from lidarreal.augmentation.augmenter import Augmenter
from lidarreal.augmentation.effects import Effects
from lidarreal.augmentation.scan_pattern import ScanPattern
from lidarsim import Noise, Scanner, Scene, Track, load_sensor
from lidarsim.columns.sweep import Sweep
from lidarsim.columns.table import CAUSES
from lidarsim.media.weather import Weather
from lidarsim.scene.scene_mesh import SceneMesh

HEIGHT_M = 1.9
SPEED_M_S = 15.0
SWEEPS = 3
FACES = np.array([[0, 1, 2], [0, 2, 3]])
FLOOR = SceneMesh(
    "floor", np.array([[-80, -80, 0], [80, -80, 0], [80, 80, 0], [-80, 80, 0.0]]), FACES
)
WALL = SceneMesh("wall", np.array([[-20, 6, 0], [20, 6, 0], [20, 6, 4], [-20, 6, 4.0]]), FACES)
TRACK = Track([0, 1], [(0, 0, HEIGHT_M), (SPEED_M_S, 0, HEIGHT_M)])


def scan(scene, sensor, seed=0, **weather):
    """Simulate a drive along x, and return the points as fired."""
    noise = replace(sensor.noise, seed=seed)
    columns = ["intensity", "cause", "time"]
    scanner = Scanner(scene, sensor, columns=columns, coordinates="sensor", noise=noise, **weather)
    return [scanner.sweep(TRACK, number=number) for number in range(SWEEPS)]


def recording_of(clouds, *, compensated=False):
    """Make a recording of a simulated drive, whose energies are known."""
    stamps_ns = 1e8 * np.arange(SWEEPS)
    poses = np.repeat(np.eye(4)[None], SWEEPS, axis=0)
    poses[:, :3, 3] = [(1e-9 * SPEED_M_S * stamp_ns, 0, HEIGHT_M) for stamp_ns in stamps_ns]

    def read(number):
        cloud = clouds[number]
        time_s = 1e-9 * (np.asarray(cloud["time"]) - stamps_ns[number])
        points = np.asarray(cloud.positions, np.float64)
        if compensated:
            points = points + np.outer(SPEED_M_S * time_s, [1, 0, 0])
        columns = {name: cloud[name] for name in ("channel", "intensity")}
        return Sweep(points, {**columns, "time": time_s}, pose=poses[number])

    return made_recording(
        "drive",
        SWEEPS,
        read,
        energy_unit=1.0,
        read_stamps=lambda: stamps_ns,
        read_poses=lambda: poses,
        compensated=compensated,
    )


def sensor_of(name, detection_range_m=60.0):
    sensor = load_sensor(name, columns=512)
    noise = Noise(detection_range_m=detection_range_m)
    return replace(sensor, noise=noise)


@pytest.mark.parametrize("name", ["ouster/os1-32", "ouster/os1-64", "ouster/os1-128"])
def test_pulses_start_at_the_origins_of_the_beams(name):
    """Rings at close range appear at elevations that differ from those of their beams."""
    sensor = sensor_of(name)
    recording = recording_of(scan(Scene.from_meshes([FLOOR, WALL]), sensor))
    grid = ScanPattern.from_recording(recording, sensor).grid(recording[0])
    assert grid.origins is not None
    reach = np.linalg.norm(grid.origins, axis=-1)
    np.testing.assert_allclose(reach, np.linalg.norm(sensor.beams.origin[0]), rtol=1e-9)
    elevation = np.degrees(np.arcsin(grid.directions[..., 2]))
    expected = np.degrees(np.sort(sensor.beams.elevation))
    restored = np.ones(grid.fired.shape, np.bool_)
    restored.reshape(-1)[grid.cell] = False
    errors = np.abs(elevation - expected)
    assert errors[restored].max() < 1e-6
    assert errors[~restored].max() < 0.05  # recorded positions are rounded to 1 cm


def test_pulses_at_ground_beyond_the_detection_range_are_restored():
    sensor = sensor_of("ouster/os1-64", detection_range_m=12.0)
    recording = recording_of(scan(Scene.from_meshes([FLOOR]), sensor))
    lowest = np.degrees(np.arcsin(recording[0].points[:, 2] / HEIGHT_M)).max()
    assert lowest < -3  # rings between the ground and the horizon never return
    grid = ScanPattern.from_recording(recording, sensor).grid(recording[0])
    assert grid.fired.all()


def test_returns_close_to_the_threshold_are_lost_as_often_as_in_a_simulation():
    wall = replace(WALL, vertices=WALL.vertices * [8, 7, 5] - [0, 0, 10])
    scene = Scene.from_meshes([wall])
    sensor = sensor_of("ouster/os1-64", detection_range_m=25.0)
    recording = recording_of(scan(scene, sensor))
    augmenter = Augmenter(recording, Effects(weather=Weather(visibility_km=3.0)), sensor)
    kept = sum(int(augmenter.sweep(number).is_recorded.sum()) for number in range(SWEEPS))
    before = sum(len(recording[number]) for number in range(SWEEPS))
    truth = scan(scene, sensor, seed=1, visibility_km=3.0)
    surface = CAUSES.index("surface")
    expected = sum(int((cloud["cause"] == surface).sum()) for cloud in truth)
    lost = before - expected
    assert lost > 500
    assert abs(kept - expected) < 4 * np.sqrt(2 * lost)


def test_compensated_sweeps_are_augmented_like_the_points_as_fired():
    sensor = sensor_of("ouster/os1-64")
    clouds = scan(Scene.from_meshes([FLOOR, WALL]), sensor)
    effects = Effects(weather=Weather(snow_mm_h=2.0))
    expected = Augmenter(recording_of(clouds), effects, sensor).sweep(1)
    result = Augmenter(recording_of(clouds, compensated=True), effects, sensor).sweep(1)
    np.testing.assert_array_equal(result.is_recorded, expected.is_recorded)
    np.testing.assert_array_equal(result.template, expected.template)
    assert (~result.is_recorded).sum() > 500
    late_s = result.sweep.columns["time"]
    as_fired = result.sweep.points - np.outer(SPEED_M_S * late_s, [1, 0, 0])
    np.testing.assert_allclose(as_fired, expected.sweep.points, atol=2e-3)


@pytest.mark.parametrize("farthest", range(SWEEPS))
def test_the_maximum_range_is_that_of_all_sweeps(farthest):
    points = np.random.default_rng(0).uniform(1, 20, (50, 3))
    points[7] = [-48, 0, -14]
    sweeps = [Sweep(points[8:])] * SWEEPS
    sweeps[farthest] = Sweep(points)
    pattern = ScanPattern.from_recording(made_recording("drive", SWEEPS, sweeps.__getitem__))
    assert pattern.max_range_m == pytest.approx(50)
