"""Sensors: beams and the head that moves them, and what follows for each ray."""

from __future__ import annotations

import itertools
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidarpool import Beams, LidarpoolError, Sensor, Spin


@given(rays=st.integers(1, 5000), steps=st.integers(1, 720))
def test_the_steps_of_a_turn_hold_each_firing_once(rays, steps):
    """360 / steps is rarely exact, in decimal or in binary; the steps must meet all the same."""
    if steps > rays:
        return
    sensor = Sensor.grid(rays_per_revolution=rays, layers=1, step_deg=360 / steps)
    sectors = [sensor.firings(step) for step in range(steps)]
    assert sectors[0][0] == 0
    assert all(a[1] == b[0] for a, b in itertools.pairwise(sectors))
    assert all(first < stop for first, stop in sectors)
    assert sectors[-1][1] == rays


def test_a_grid_fires_from_plus_x_counter_clockwise_lowest_channel_first():
    sensor = Sensor.grid(rays_per_revolution=4, layers=3, vertical_fov_deg=90, step_deg=90)
    found = sensor.directions(np.arange(8))
    assert found.shape == (8, 3, 3)
    assert np.allclose(np.linalg.norm(found, axis=-1), 1, atol=1e-15)
    assert np.allclose(found[:4, 1], [[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])
    assert np.allclose(np.degrees(np.arcsin(found[0, :, 2])), [-45, 0, 45])
    assert np.array_equal(found[:4], found[4:]), "after a turn it stands as before"
    assert sensor.origins(np.arange(4)) is None
    assert Sensor.grid(layers=1).beams.elevation.tolist() == [0.0]


def test_a_turn_that_is_no_whole_number_of_firings():
    """Firing rate and turning rate of real sensors do not fit: each turn begins elsewhere."""
    head = Spin(firings_per_turn=1808.449, step_deg=360, rate_hz=10)
    assert head.period is None
    turns = [head.firings(turn) for turn in range(1000)]
    assert all(a[1] == b[0] for a, b in itertools.pairwise(turns))
    assert {stop - first for first, stop in turns} == {1808, 1809}
    assert turns[-1][1] == 1_808_449
    firings = np.array([0, 1808, 1809, 1_808_448])
    expected = [float(Fraction(int(f)) % Fraction("1808.449")) for f in firings]
    assert np.allclose(head.azimuths(firings), 2 * np.pi * np.array(expected) / 1808.449, atol=1e-9)
    assert np.allclose(head.times_ns(np.array([1_808_449])), 1000 * 1e9 / 10)


def test_beams_have_offsets_in_azimuth_time_and_origin():
    beams = Beams(
        np.radians([-10, 0, 20]),
        azimuth=np.radians([1, 0, -2]),
        time_ns=[0, 1152, 2304.4],
        origin=[[0, 0, 0], [0.1, 0, 0], [0, 0.2, 0.3]],
    )
    sensor = Sensor(beams, Spin(firings_per_turn=8, step_deg=90, rate_hz=5))
    firings = np.array([0, 2, 9])
    x, y, z = sensor.directions(firings).transpose(2, 0, 1)
    azimuth = np.array([[1, 0, -2], [91, 90, 88], [46, 45, 43]])
    assert np.allclose(np.degrees(np.arctan2(y, x)), azimuth)
    assert np.allclose(np.degrees(np.arcsin(z)), [-10, 0, 20])
    origins = sensor.origins(firings)
    assert np.allclose(origins[0], beams.origin), "as given where the head is at azimuth 0"
    assert np.allclose(origins[1], [[0, 0, 0], [0, 0.1, 0], [-0.2, 0, 0.3]]), "turned with it"
    times = sensor.times_ns(firings)
    assert times.dtype == np.int64
    assert times.tolist() == [[f * 25_000_000 + t for t in (0, 1152, 2304)] for f in firings]


def test_beams_cannot_be_changed_in_place():
    """The fingerprint of a run is taken once."""
    given = np.array([0.0, 0.1])
    beams = Beams(given)
    given[0] = 5
    assert beams.elevation.tolist() == [0, 0.1]
    with pytest.raises(ValueError, match="read-only"):
        beams.elevation[0] = 5


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Beams([]), "1 to 65535 beams, not 0"),
        (lambda: Beams(np.zeros(65_536)), "not 65536"),
        (lambda: Beams([0, 1], azimuth=[0]), r"Beams\.azimuth must be \(2,\)"),
        (lambda: Beams([0, np.nan]), r"Beams\.elevation"),
        (lambda: Beams([0], time_ns=[np.inf]), r"Beams\.time_ns"),
        (lambda: Beams([0, 1], origin=[0, 0, 0]), r"Beams\.origin must be \(2, 3\)"),
        (lambda: Spin(step_deg=0.1), r"less than one firing \(0.36 degrees\)"),
        (lambda: replace(Sensor(), min_range_m=-1), "min_range_m"),
        (lambda: replace(Sensor(), min_range_m=5, max_range_m=5), "max_range_m"),
        (lambda: Sensor.grid(step_deg=float("nan")), "step_deg"),
    ],
)
def test_values_out_of_range_name_the_field(make, message):
    with pytest.raises(LidarpoolError, match=message):
        make()
