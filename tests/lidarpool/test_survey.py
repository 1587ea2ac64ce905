from __future__ import annotations

import doctest

import numpy as np
import pytest

import lidarpool.survey
from lidarpool import LidarpoolError, Pose, ScanSpec, Sensor, Survey


def test_examples_in_the_docstrings():
    assert doctest.testmod(lidarpool.survey).failed == 0


def test_the_default_survey_fires_every_ray_of_every_revolution_once():
    survey = Survey(Sensor(), poses=[(0, 0, 1), (0, 0, 2), (0, 0, 3)])
    specs = list(survey.scans())
    assert len(specs) == 108
    assert sum(spec.ray_count(survey.sensor) for spec in specs) == 120_000 == survey.ray_count
    assert [spec.scan for spec in specs] == list(range(108))
    for pose in range(3):
        sectors = [spec.azimuths for spec in specs[36 * pose : 36 * pose + 36]]
        assert [a for first, stop in sectors for a in range(first, stop)] == list(range(1000))


def test_a_scan_travels_as_numbers():
    spec = ScanSpec(7, Pose((1.5, -2, 1e6 + 0.1), 10, 20, 30), (28, 56))
    assert ScanSpec.from_wire(tuple(spec.wire())) == spec


def test_rotation_is_yaw_then_pitch_then_roll():
    assert Pose((0, 0, 0)).rotation is None
    x, y, z = np.eye(3)
    assert np.allclose(Pose((0, 0, 0), yaw_deg=90).rotation @ x, y)
    assert np.allclose(Pose((0, 0, 0), pitch_deg=90).rotation @ x, -z)
    assert np.allclose(Pose((0, 0, 0), roll_deg=90).rotation @ y, z)
    both = Pose((0, 0, 0), 30, 40, 50).rotation
    assert np.allclose(both @ both.T, np.eye(3))
    yaw, pitch, roll = (
        Pose((0, 0, 0), **{name: angle}).rotation
        for name, angle in (("yaw_deg", 30), ("pitch_deg", 40), ("roll_deg", 50))
    )
    assert np.allclose(both, yaw @ pitch @ roll)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"poses": []}, "at least one pose"),
        ({"poses": [(0, 0)]}, "three finite"),
        ({"poses": [(0, 0, float("nan"))]}, "three finite"),
        ({"poses": [(0, 0, 0)], "steps": 0}, "steps"),
        ({"poses": [(0, 0, 0)], "keep_every": 0}, "keep_every"),
        ({"poses": [(0, 0, 0)], "precision_m": 0}, "precision_m"),
        ({"poses": [(0, 0, 0)], "precision_m": float("inf")}, "precision_m"),
    ],
)
def test_values_out_of_range_say_which(arguments, message):
    with pytest.raises(LidarpoolError, match=message):
        Survey(**arguments)
