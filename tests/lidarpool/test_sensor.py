from __future__ import annotations

import doctest
import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import lidarpool.sensor
from lidarpool import LidarpoolError, Sensor


def test_examples_in_the_docstrings():
    assert doctest.testmod(lidarpool.sensor).failed == 0


@given(
    rays=st.integers(1, 5000),
    steps=st.integers(1, 720),
)
def test_the_sectors_of_a_revolution_hold_each_azimuth_once(rays, steps):
    """360 / steps is rarely exact, in decimal or in binary; the sectors must meet all the same."""
    if steps > rays:
        return
    sensor = Sensor(rays_per_revolution=rays, layers=1, step_deg=360 / steps)
    sectors = [sensor.sector(step) for step in range(steps)]
    assert sectors[0][0] == 0
    assert all(a[1] == b[0] for a, b in itertools.pairwise(sectors))
    assert all(first < stop for first, stop in sectors)
    assert sectors[-1][1] == rays


@pytest.mark.parametrize(("rays", "step", "steps"), [(1000, 10, 36), (720, 0.5, 720), (7, 72, 5)])
def test_decimal_steps_are_exact(rays, step, steps):
    sensor = Sensor(rays_per_revolution=rays, layers=1, step_deg=step)
    assert sensor.sector(steps - 1)[1] == rays


def test_directions_are_unit_vectors_in_lidar_order():
    sensor = Sensor(rays_per_revolution=4, layers=3, vertical_fov_deg=90, step_deg=90)
    assert sensor.directions.shape == (4, 3, 3)
    assert np.allclose(np.linalg.norm(sensor.directions, axis=-1), 1, atol=1e-15)
    assert np.allclose(sensor.directions[:, 1], [[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])
    assert np.allclose(np.degrees(np.arcsin(sensor.directions[0, :, 2])), [-45, 0, 45])


def test_one_layer_looks_straight_ahead():
    assert Sensor(layers=1).elevations.tolist() == [0.0]


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("rays_per_revolution", 0),
        ("layers", 0),
        ("layers", 65_536),
        ("vertical_fov_deg", 0),
        ("vertical_fov_deg", 181),
        ("vertical_fov_deg", float("nan")),
        ("step_deg", 0),
        ("step_deg", 361),
        ("step_deg", 0.1),
        ("min_range_m", -1),
        ("max_range_m", 0),
    ],
)
def test_values_out_of_range_name_the_field(field, value):
    with pytest.raises(LidarpoolError, match=field):
        Sensor(**{field: value})
