"""Directions in which a vehicle blocks a recorded sensor: they are found, and nothing else is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import yaml
from tests.lidarpool.test_twin import city_drive
from tests.made_recordings import made_recording

from lidarfiles import save_cloud
from lidarfiles.recordings.opening import open_recording
from lidarreal import twin
from lidarreal.reconstruction.blocked_directions import PulseCounts, separated_sweeps
from lidarreal.reconstruction.lost_pulses import SensorCoverage
from lidarreal.reconstruction.recorded_sweeps import RecordedSweeps
from lidarsim import Track, load_sensor
from lidarsim.columns.sweep import Sweep

pytest.importorskip("scipy")

MODEL = "ouster/os1-32"
COLUMNS = 512
STEP_DEG = 360 / COLUMNS
SWEEPS = 16
# Camera posts that block every second channel, and the roof, which blocks the lowest channels.
POSTS = [(channel, 75.0, 83.0) for channel in range(0, 32, 2)]
POSTS += [(channel, -82.0, -76.0) for channel in range(1, 32, 2)]
ROOF = [(channel, 160.0 + 2 * channel, 200.0 - 2 * channel) for channel in range(8)]
BODY = POSTS + ROOF


def at_10_m_s(end_s):
    """A car in a street of the city."""
    return Track([0, end_s], [[-24, -3, 0], [10 * end_s - 24, -3, 0]])


def fired(cloud, rows=None):
    """Return a recording of the points as fired, of which `rows` selects some."""
    opened = open_recording(cloud, name="drive")

    def read(number):
        sweep = opened.fired(number).returns()
        columns = {"ring": sweep.columns["channel"], "intensity": sweep.intensity}
        kept = slice(None) if rows is None else rows(sweep)
        return Sweep(sweep.points, columns).select(kept)

    return made_recording("drive", len(opened), read)


def azimuth_deg(points):
    return np.degrees(np.arctan2(points[:, 1], points[:, 0]))


def is_within(body, channel, azimuth):
    found = np.zeros(len(channel), bool)
    for beam, start, stop in body:
        found |= (channel == beam) & ((azimuth - start) % 360 < (stop - start) % 360)
    return found


def beside_body(sweep):
    return ~is_within(BODY, sweep.columns["channel"], azimuth_deg(sweep.points))


def find_sectors(recording):
    """Return the blocked sectors of a recording, with channels instead of rings."""
    recorded = RecordedSweeps.from_recording(recording)
    coverage = SensorCoverage.from_sweeps(recorded)
    blocked = coverage.with_blocked(recorded, np.arange(recorded.count)).blocked
    return [(recorded.ring_count - 1 - ring, *edges) for ring, *edges in blocked.sectors_deg()]


def matrix(sectors):
    """Return the blocked directions as a mask of 32 channels and 2,880 azimuths."""
    azimuth = (np.arange(2880) + 0.5) / 8 - 180
    return np.stack([is_within(sectors, np.full(2880, k), azimuth) for k in range(32)])


def assert_sectors_match(found, truth):
    """All found directions are within a step of the truth, and few are missing.

    The upper channels see the sky most of the time, so their directions may be unknown.
    """
    found = matrix(found)
    truth = matrix(truth)
    reach = round(8 * STEP_DEG)
    wide = np.any([np.roll(truth, shift, axis=1) for shift in range(-reach, reach + 1)], axis=0)
    narrow = np.all([np.roll(truth, shift, axis=1) for shift in range(-reach, reach + 1)], axis=0)
    assert not (found & ~wide).any()
    assert (found & narrow)[:16].sum() > 0.95 * narrow[:16].sum()


@pytest.fixture(scope="module")
def drive():
    """Return the recorded sweeps of a drive in a city."""
    return city_drive(MODEL, {"columns": COLUMNS}, SWEEPS, at_10_m_s)


@pytest.mark.extended
def test_the_directions_that_a_vehicle_blocks_are_found(drive):
    assert_sectors_match(find_sectors(fired(drive, beside_body)), BODY)


@pytest.mark.extended
def test_a_drive_without_a_vehicle_has_no_blocked_directions(drive):
    """Some pulses meet the sky in all sweeps, also straight ahead between houses."""
    recording = fired(drive)
    assert 0.1 < np.mean([len(recording.load(k)) for k in range(SWEEPS)]) / (32 * COLUMNS) < 0.95
    assert find_sectors(recording) == []


@pytest.mark.extended
def test_random_losses_are_not_blocked_directions(drive):
    random = np.random.default_rng(3)
    recording = fired(drive, lambda sweep: random.random(len(sweep)) < 0.9)
    assert find_sectors(recording) == []


def test_a_sensor_without_rings_has_no_blocked_directions(drive):
    opened = fired(drive, beside_body)
    scattered = np.random.default_rng(1).permutation(20_000)

    def read(number):
        points = opened.load(number).points
        order = scattered[scattered < len(points)]
        return Sweep(points[order] + np.random.default_rng(number).normal(0, 0.3, (len(order), 3)))

    recorded = RecordedSweeps.from_recording(made_recording("drive", SWEEPS, read))
    assert not len(recorded.lasers)
    coverage = SensorCoverage.from_sweeps(recorded)
    assert coverage.with_blocked(recorded, np.arange(SWEEPS)) is coverage


def test_only_sweeps_at_different_positions_count():
    positions = np.zeros((40, 3))
    positions[:, 0] = np.arange(40) * 0.5
    assert separated_sweeps(np.arange(40), positions).tolist() == [*range(0, 40, 2)]
    assert not len(separated_sweeps(np.arange(0, 40, 5), positions))  # 8 sweeps
    assert not len(separated_sweeps(np.arange(40), positions * 0))


def test_sectors_include_those_across_the_back_and_whole_rings():
    counts = PulseCounts.zeros(3, 36)
    ring, column = (index.ravel() for index in np.indices((3, 36)))
    azimuth = np.radians(column * 10 - 175)
    lost = (ring == 2) | ((ring == 1) & ((column < 2) | (column >= 35)))
    for _ in range(8):
        counts.add_returned(azimuth[~lost], ring[~lost], np.full((~lost).sum(), 5.0))
        counts.add_lost(azimuth[lost], ring[lost], np.full(lost.sum(), 5.0))
    blocked = counts.blocked(np.radians([10.0, 0.0, -10.0]))
    assert blocked.sectors_deg() == [(1, 170.0, -160.0), (2, -180.0, 180.0)]
    np.testing.assert_array_equal(blocked.contains(azimuth, ring), lost)


@pytest.mark.slow
def test_a_twin_has_the_blocked_directions_of_the_recorded_sensor(tmp_path):
    """The sensor file of the twin blocks the directions that the recorded sensor blocked."""
    sensor = load_sensor(MODEL, columns=COLUMNS)
    blocked = np.array(BODY)
    blocked[:, 1:] = np.radians(blocked[:, 1:])
    with_body = replace(sensor, beams=replace(sensor.beams, blocked=blocked))
    cloud = city_drive(with_body, {}, 2 * SWEEPS, at_10_m_s)
    save_cloud(cloud, tmp_path / "drive.mcap")
    found = twin(tmp_path / "drive.mcap")
    found.save(tmp_path / "twin")
    stated = yaml.safe_load((tmp_path / "twin" / "sensor.yaml").read_text())
    assert_sectors_match(stated["beams"]["blocked_deg"], BODY)
    assert "blocked" in stated["sources"]
    assert found.figures["held_out"]["no_return"]["f1"] > 0.8
    again = load_sensor(tmp_path / "twin" / "sensor.yaml")
    assert_sectors_match(
        [(int(row[0]), *np.degrees(row[1:])) for row in again.beams.blocked.tolist()], BODY
    )
