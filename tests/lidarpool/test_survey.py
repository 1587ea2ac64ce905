"""Surveys: scans, poses and times of a sensor that stands or moves."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest
from tests.lidarpool.casting import Cart

from lidarpool import LidarpoolError, Mounted, Pose, Sensor, Spin, Survey, Track
from lidarpool.sensor import Stations


def test_the_default_survey_fires_every_ray_of_every_turn_once():
    survey = Survey(Sensor.grid(), poses=[(0, 0, 1), (0, 0, 2), (0, 0, 3)])
    specs = list(survey.scans())
    assert len(specs) == 108
    assert sum(spec.ray_count for spec in specs) == 120_000 == survey.ray_count
    assert [spec.scan for spec in specs] == list(range(108))
    for pose in range(3):
        mine = specs[36 * pose : 36 * pose + 36]
        assert [a for spec in mine for a in range(*spec.firings)] == list(range(1000))
        assert {spec.station for spec in mine} == {pose}
        assert {survey.pose(spec.scan).position[2] for spec in mine} == {pose + 1}


def test_a_survey_may_have_a_trajectory_in_place_of_poses():
    sensor = Sensor(head=Spin(100, step_deg=36, rate_hz=10))
    survey = Survey(sensor, steps=20, trajectory=Cart())
    assert survey.scan_count == 40 and survey.poses == ()
    for scan, seconds, y in ((0, 0, 0), (5, 0.05, 0), (19, 0.19, 0), (20, 0, 10), (25, 0.05, 10)):
        assert survey.pose(scan).position == pytest.approx((5 * seconds, y, 1))
        assert survey.pose(scan).yaw_deg == pytest.approx(90 * seconds)


def test_poses_are_a_trajectory_too():
    poses = (Pose((0, 0, 1)), Pose((1, 2, 3), 10))
    by_poses, by_path = Survey(poses=poses), Survey(trajectory=Stations(poses))
    assert by_poses.path == by_path.path
    assert replace(by_poses, steps=7).path == by_poses.path
    positions, rotations = by_poses.path.poses(1, np.zeros(4))
    assert positions.tolist() == [[1, 2, 3]] * 4
    assert np.array_equal(rotations, [poses[1].rotation] * 4)
    assert by_poses.path.poses(0, np.zeros(4))[1] is None


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
        ({"poses": [(0, 0)]}, r"position\[2\] is missing"),
        ({"poses": [5]}, "poses is 5"),
        ({"poses": [(0, 0, float("nan"))]}, r"position\[2\] is nan"),
        ({"sensor": Sensor.grid(10_000_000, 65_535, 60.0)}, "18,204,181,230 rays, more than"),
        ({"sensor": Sensor.grid(rate_hz=1e-10)}, "would last .* for 292 years"),
        ({"poses": [(0, 0, 0)] * 99, "sensor": Sensor.grid(rate_hz=1e-8)}, "would last 9.9e.09 s"),
        ({"keep_every": 0}, "keep_every"),
        ({"precision_m": 0}, "precision_m"),
        ({"trajectory": Cart()}, "either poses or a trajectory"),
        ({"columns": ["tiem"]}, "There is no column 'tiem'.*'time'"),
    ],
)
def test_values_out_of_range_say_which(arguments, message):
    with pytest.raises(LidarpoolError, match=message):
        Survey(**({"poses": [(0, 0, 0)]} | arguments))


def test_each_sensor_may_start_later_and_take_steps_of_its_own():
    way = Track([0, 10], [[0, 0, 1], [20, 0, 1]])
    head = Spin(100, step_deg=36, rate_hz=10)
    late = Mounted(Sensor(head=head, start_ns=2e9), name="late", steps=20)
    survey = Survey(trajectory=way, sensors=[Mounted(Sensor(head=head), name="all"), late])
    assert survey.steps_each == (1000, 20)
    first, last = survey.scan(1000), survey.scan(1019)
    assert (first.sensor, first.firings, last.firings) == (1, (0, 10), (190, 200))
    assert survey.begins_ns(1000) == 2e9 and survey.begins_ns(1019) == pytest.approx(2.19e9)
    assert survey.pose(1000).position == pytest.approx((4, 0, 1))
    until = Survey(trajectory=way, sensors=[replace(late, steps=None)])
    assert until.steps_each == (800,)
    with pytest.raises(
        LidarpoolError, match=r"steps 900 take until 10[.]99.* trajectory lasts 10 s"
    ):
        Survey(trajectory=way, sensors=[replace(late, steps=900)])


@pytest.mark.parametrize("pitch", [90, -90])
@pytest.mark.parametrize("yaw", [0, 30, 200])
def test_a_pose_that_looks_straight_up_or_down_is_found_again(yaw, pitch):
    turned = Pose((0, 0, 0), yaw, pitch, 20).rotation
    assert np.allclose(Pose.of((1, 2, 3), turned).rotation, turned, atol=1e-12)


def test_a_start_needs_a_time_zone_and_a_year_of_known_leap_seconds():
    for start in (datetime(2026, 11, 21), datetime(2016, 12, 31, tzinfo=UTC)):
        with pytest.raises(LidarpoolError, match="a time from 2017 on, with its time zone"):
            Survey(poses=[(0, 0, 1)], start=start)
    with pytest.raises(LidarpoolError, match="epsg is 5; it must be 1024 to 32767"):
        Survey(poses=[(0, 0, 1)], epsg=5)
