"""The noise and the calibration of a recorded sensor, in the sensor of its twin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import yaml
from tests.lidarreal.test_twin_lasers import recorded_drive, room_sweep, true_lasers
from tests.made_recordings import made_recording

from lidarfiles.recordings.opening import open_recording
from lidarreal import twin
from lidarreal.reconstruction.alignment import AlignedSweeps, Alignment, align
from lidarreal.reconstruction.lost_pulses import SensorCoverage
from lidarreal.reconstruction.motion import Motion
from lidarreal.reconstruction.odometry import RecordedPoses
from lidarreal.reconstruction.range_noise import estimate_range_noise
from lidarreal.reconstruction.recorded_sensor import SweepTiming
from lidarreal.reconstruction.recorded_sweeps import RecordedSweeps
from lidarreal.scan_patterns.lasers import RingLasers, unit_vectors
from lidarscenes.procedural.city import city
from lidarsim import Sensor, load_sensor
from lidarsim.columns.sweep import Sweep

pytest.importorskip("scipy")

RINGS = 64


def noisy_room(sigma_m, pose_error_m=0.0, bias_m=0.0):
    """Return the aligned sweeps of a room, with errors of ranges, poses and rings."""
    lasers, azimuth = true_lasers()
    random = np.random.default_rng(7)
    biases_m = bias_m * random.standard_normal(RINGS)
    sweeps = []
    for number in range(4):
        points, ring = room_sweep(lasers, azimuth, position=(0.3 * number, 0.0))
        origins = lasers.origins(points, ring)
        beams = points - origins
        errors_m = biases_m[ring] + sigma_m * random.standard_normal(len(ring))
        beams *= 1 + (errors_m / np.linalg.norm(beams, axis=1))[:, None]
        time_s = np.zeros(len(ring))
        sweeps.append(Sweep(origins + beams, {"ring": ring, "time": time_s}))
    recorded = RecordedSweeps.from_recording(made_recording("room", 4, sweeps.__getitem__))
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, 0, 3] = 0.3 * np.arange(4)
    poses[:, :3, 3] += pose_error_m * random.standard_normal((4, 3))
    times_s = 0.1 * np.arange(4)
    offsets = np.zeros((RINGS, 3))
    alignment = Alignment(
        poses, times_s, 0.1, 0.2, Motion.COMPENSATED, offsets, lasers=recorded.lasers
    )
    coverage = SensorCoverage(np.ones((RINGS, 720), bool), 60.0)
    return AlignedSweeps(replace(recorded), alignment, coverage)


@pytest.mark.extended
def test_ranges_without_noise_have_none():
    assert estimate_range_noise(noisy_room(0.0), range(4)).range_m < 2e-4


@pytest.mark.extended(every=3)
@pytest.mark.parametrize("sigma_m", [0.005, 0.02, 0.04])
def test_the_range_noise_is_known_despite_errors_of_the_map(sigma_m):
    sweeps = noisy_room(sigma_m, pose_error_m=0.02, bias_m=0.02)
    found = estimate_range_noise(sweeps, range(4))
    assert found.range_m == pytest.approx(sigma_m, rel=0.1)
    known = np.isfinite(found.by_ring_m)
    assert known.sum() > RINGS / 2
    np.testing.assert_allclose(found.by_ring_m[known], sigma_m, rtol=0.35)


CHANNELS = 24
SWEEPS = 10


@pytest.fixture(scope="module")
def calibrated():
    """Aligned sweeps of a sensor with errors of ranges and elevations, and these errors.

    All rings meet the ground and walls, because a ring that meets only upright walls tells little
    about its elevation.
    """
    truth = RingLasers.at_origin(np.radians(np.linspace(-10, -30, CHANNELS)))
    random = np.random.default_rng(3)
    bias_m = random.choice([-0.02, 0.02], CHANNELS)
    error_rad = np.radians(random.choice([-0.1, 0.1], CHANNELS))
    poses = np.tile(np.eye(4), (SWEEPS, 1, 1))
    poses[:, :2, 3] = np.arange(SWEEPS)[:, None] * [0.4, 0.1]
    sweeps = []
    for number, position in enumerate(poses[:, :2, 3]):
        points, ring = room_sweep(
            truth, np.zeros(CHANNELS), turned=0.003 * number, position=position
        )
        azimuth, elevation = truth.angles(points, ring)
        range_m = np.linalg.norm(points, axis=1) + bias_m[ring]
        points = range_m[:, None] * unit_vectors(azimuth, elevation - error_rad[ring])
        sweeps.append(Sweep(points, {"ring": ring, "time": np.zeros(len(ring))}))
    recorded = RecordedSweeps.from_recording(made_recording("room", SWEEPS, sweeps.__getitem__))
    given = RecordedPoses(poses, 0.1 * np.arange(SWEEPS), "given", np.zeros(3), 0.0, 0.0)
    first = Alignment.from_poses(given, 0.15, Motion.COMPENSATED, CHANNELS, recorded.lasers)
    alignment = align(recorded, first, np.arange(SWEEPS), set(range(SWEEPS)))
    aligned = AlignedSweeps(recorded, alignment, SensorCoverage.from_sweeps(recorded))
    return aligned, truth, bias_m


def written_sensor(aligned, folder):
    """Return the sensor that a twin writes, without fitted noise."""
    model = SweepTiming.from_sweeps(aligned).sensor(aligned, 0, None)
    path = folder / "sensor.yaml"
    path.write_text(yaml.safe_dump(model.model_dump(mode="json", exclude_defaults=True)))
    return load_sensor(path)


@pytest.mark.extended
def test_the_sensor_of_a_twin_has_the_errors_of_the_rings(calibrated, tmp_path):
    aligned, truth, bias_m = calibrated
    sensor = written_sensor(aligned, tmp_path)
    found_m = np.array(sensor.noise.channel_bias_m)[::-1]
    # Errors that neighboring rings have in common also bend the map.
    np.testing.assert_allclose(np.diff(found_m), np.diff(bias_m), atol=0.012)
    error_deg = np.degrees(sensor.beams.elevation[::-1] - truth.elevation_rad)
    np.testing.assert_allclose(np.diff(error_deg), 0, atol=0.06)
    assert np.ptp(error_deg) < 0.2


@pytest.mark.extended
def test_the_sensor_of_a_twin_has_the_recorded_ranges(calibrated, tmp_path):
    aligned, _, bias_m = calibrated
    sensor = written_sensor(aligned, tmp_path)
    beams = sensor.beams
    lasers = RingLasers.at_origin(beams.elevation[::-1])
    biases_m = np.array(sensor.noise.channel_bias_m)[::-1]
    recorded = aligned.recorded.read(0)
    points, ring = room_sweep(lasers, beams.azimuth[::-1])
    simulated_m = np.linalg.norm(points, axis=1) + biases_m[ring]
    recorded_m = np.linalg.norm(recorded.points, axis=1)
    assert np.array_equal(ring, recorded.columns["row"])
    difference_m = np.abs(simulated_m - recorded_m)
    assert np.median(difference_m) < 0.005 < np.median(np.abs(bias_m))
    assert np.quantile(difference_m, 0.9) < 0.03


@pytest.mark.extended
def test_a_twin_has_the_intensity_response_of_the_sensor(tmp_path):
    truth = Sensor.grid(360, 32, vertical_fov_deg=30)
    factors = np.random.default_rng(3).choice([0.6, 1.0, 1.5], (32, 1)) * [1.0, 2.0, 1.0]
    beams = replace(truth.beams, intensity_factor=factors, intensity_range_m=[5, 15, 40])
    optics = replace(truth.optics, incidence_exponent=0.3)
    recorder = replace(truth, beams=beams, optics=optics)
    opened = open_recording(recorded_drive(city(5_000), recorder), name="drive")

    def read(number):
        sweep = opened.fired(number)
        time_s = 1e-9 * sweep.columns["time"]
        columns = {"ring": sweep.rings, "timestamp": time_s, "intensity": sweep.intensity}
        return Sweep(sweep.points, columns)

    found = twin(made_recording("drive", len(opened), read, energy_unit=1.0))
    found.save(tmp_path / "twin")
    sensor = load_sensor(tmp_path / "twin" / "sensor.yaml")
    # On the ground, the incidence follows from the range, so they cannot be told apart exactly.
    assert 0 <= sensor.optics.incidence_exponent < 0.5
    down = np.flatnonzero(truth.beams.elevation < np.radians(-5))  # meet the same surfaces
    for range_m in (7.0, 12.0):
        ranges_m = np.full(len(down), range_m)
        ratio = sensor.beams.intensity_factors(down, ranges_m)
        ratio /= beams.intensity_factors(down, ranges_m)
        np.testing.assert_allclose(ratio / np.median(ratio), 1, rtol=0.25)
    assert found.figures["held_out"]["stationary"]["rank_correlation"] > 0.95
    assert found.figures["range_noise"]["sigma_m"] < 0.005  # none was simulated
