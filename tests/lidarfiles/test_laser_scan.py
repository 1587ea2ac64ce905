"""Sweeps of 2D scanners as LaserScan: which sensors have them, and their rays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.shapes import room

from lidarfiles.clouds.laser_scan import ScanRays, has_laser_scans, has_planar_sensors, is_planar
from lidarfiles.clouds.writing import ExportSpec, with_format_columns
from lidarsim import Beams, Cloud, Sensor, Spin, Survey, load_sensor
from lidarsim.columns.table import SCAN
from lidarsim.sensor.beams import Mirror
from lidarsim.sensor.sensor import LineSensor
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.rig import Rig
from lidarsim.sweeps.sweeps import Sweeps

FLAT = Sensor(Beams(np.zeros(1)), Spin(360, 10), min_range_m=0.5, max_range_m=4.55)


def scanned(survey: Survey) -> tuple[Cloud, Sweeps]:
    """Return the points and sweeps of a survey of a room."""
    part = columns_of(list(Rig(room(), survey, "tiles").cast(0, survey.scan_count)))
    cloud = part.cloud((SCAN, *survey.stored_columns[3:]), survey.precision_m, room().origin)
    return cloud, Sweeps.from_survey(survey, room())


@pytest.mark.parametrize(
    ("sensor", "planar"),
    [
        (FLAT, True),
        (Sensor.grid(layers=1, vertical_fov_deg=0, horizontal_fov_deg=180), True),
        (Sensor(Beams(np.array([0.1])), Spin(360, 10)), False),  # its rays are a cone
        (Sensor(Beams(np.zeros(2), np.array([0.0, 0.1])), Spin(360, 10)), False),
        (replace(FLAT, beams=Beams(np.zeros(1), origin=np.array([[0.1, 0, 0]]))), False),
        (load_sensor("livox/mid40"), False),
        (LineSensor(Beams.even(1, 1.0), Mirror(200, 36.0, width_deg=150.0)), False),
    ],
)
def test_a_sensor_is_planar_if_a_beam_turns_in_a_plane_about_its_center(sensor, planar):
    assert is_planar(sensor) is planar
    survey = Survey(sensor, poses=[(0, 0, 0)], steps=4)
    assert has_planar_sensors(survey) is planar
    complete = with_format_columns(survey, [ExportSpec("mcap")])
    assert has_laser_scans(Sweeps.from_survey(complete, room())) is planar
    assert not has_laser_scans(Sweeps.from_survey(survey, room()))
    for formats, added in ((["mcap"], planar), (["rosbag2", "las"], planar), (["las"], False)):
        complete = with_format_columns(survey, [*map(ExportSpec, formats)])
        names = [column.name for column in complete.stored_columns]
        assert ({"ray", "range"} <= {*names}) is added
    thinned = replace(survey, keep_every=2)
    names = {column.name for column in with_format_columns(thinned, [ExportSpec("mcap")]).columns}
    assert names == {"intensity", "time"}


@pytest.mark.parametrize("light", ["intensity", "signal", None])
def test_rays_of_a_sweep_have_ranges_of_a_room(light):
    columns = ("ray", "range", *((light,) if light else ()))
    survey = Survey(FLAT, poses=[(0, 0, 0), (1, 0.5, 0)], steps=36, columns=columns)
    cloud, sweeps = scanned(survey)
    for sweep, points in enumerate(sweeps.points(cloud)):
        rays = ScanRays.from_points(sweeps, sweep, points)
        steps = np.diff(rays.angles)
        np.testing.assert_allclose(np.abs(steps), np.radians(1), atol=1e-9)
        assert len(rays.angles) == 360 and rays.scan_time_s == pytest.approx(0.1)
        assert rays.time_increment_s == pytest.approx(0.1 / 360)
        assert rays.range_limits_m == (0.5, 4.55)
        x, y = ((0, 0), (1, 0.5))[sweep]  # in a room of 10 by 8 m
        cos = np.cos(rays.angles)
        sin = np.sin(rays.angles)
        with np.errstate(divide="ignore"):
            walls = np.where(cos > 0, 5 - x, -5 - x) / cos, np.where(sin > 0, 4 - y, -4 - y) / sin
        true = np.minimum(*np.abs(walls))
        there = true <= 4.55
        assert 0 < there.sum() == len(points) < 360
        np.testing.assert_allclose(rays.ranges[there], true[there], atol=2e-3)
        assert np.isposinf(rays.ranges[~there]).all()
        if light is None:
            assert not rays.intensities.any()
        else:
            assert not rays.intensities[~there].any()
            # Energies are in the order of the points, which are in that of the rays.
            np.testing.assert_array_equal(rays.intensities[there], points[light])


def test_ranges_without_a_limit_and_sweeps_without_rays():
    far = replace(FLAT, max_range_m=np.inf)
    survey = Survey(far, poses=[(0, 0, 0)], steps=36, columns=("ray", "range"))
    cloud, sweeps = scanned(survey)
    (points,) = sweeps.points(cloud)
    rays = ScanRays.from_points(sweeps, 0, points)
    assert rays.range_limits_m == (0.5, float(np.finfo(np.float32).max))
    without = Cloud(points.positions, {"scan": points.scan, "ray": points.ray})
    assert ScanRays.from_points(sweeps, 0, without) is None
    assert ScanRays.from_points(replace(sweeps, fired=None), 0, points) is None
    lines = replace(survey, sensor=load_sensor("velodyne/vlp16"), trajectory=None)
    assert ScanRays.from_points(Sweeps.from_survey(lines, room()), 0, points) is None
