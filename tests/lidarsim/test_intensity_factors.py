"""Beams that report other intensities than they receive."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.shapes import wall

from lidarpool import Beams, LidarError, Material, Noise, Scene, Sensor, Survey, load_sensor
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.rig import Rig

FACTORS = np.array([0.5, 1.0, 1.25, 0.8])
SENSOR = Sensor.grid(40, 4, 20, step_deg=90, horizontal_fov_deg=40)
NAMES = ("ray", "intensity", "reflectance", "reflectivity", "signal", "amplitude", "range")
SURVEY = Survey(
    SENSOR,
    poses=[(0, 0, 0)],
    steps=4,
    columns=NAMES,
    noise=Noise(range_m=0.01, detection_range_m=19.1, saturation=4.0),
    materials=[Material("*", reflectance=0.5)],
)
WALL = Scene.from_meshes([wall("Wall", 40)])
WITH_FACTORS = replace(SENSOR, beams=replace(SENSOR.beams, intensity_factor=FACTORS))


def cast(survey):
    return columns_of([*Rig(WALL, survey, "numpy").cast(0, survey.scan_count)]).columns


def test_reported_intensities_have_the_factor_of_their_beam():
    plain = cast(SURVEY)
    found = cast(replace(SURVEY, sensor=WITH_FACTORS))
    factor = FACTORS[found["channel"]]
    for name in ("intensity", "reflectance", "amplitude"):
        np.testing.assert_allclose(found[name], plain[name] * factor, rtol=1e-6, err_msg=name)
    for name in ("reflectivity", "signal"):
        np.testing.assert_allclose(found[name], plain[name] * factor, atol=1.2, err_msg=name)
        assert not np.array_equal(found[name], plain[name])


def test_factors_change_neither_detection_nor_ranges():
    plain = cast(SURVEY)
    found = cast(replace(SURVEY, sensor=WITH_FACTORS))
    assert 0 < len(plain["range"]) < 160  # the other returns are too weak
    for name in ("ray", "channel", "range"):
        np.testing.assert_array_equal(found[name], plain[name])


def test_saturation_applies_before_the_factors():
    near = Scene.from_meshes([wall("Wall", 3)])
    survey = replace(SURVEY, sensor=WITH_FACTORS)
    found = columns_of([*Rig(near, survey, "numpy").cast(0, 4)]).columns
    threshold = SURVEY.noise_each[0].threshold
    np.testing.assert_allclose(
        found["signal"], 10_000 * 4 * threshold * FACTORS[found["channel"]], atol=0.6
    )


def test_factors_of_a_sensor_file_are_in_the_order_of_its_beams(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(
        "name: Mine\nfiring_us: 50\nbeams: {elevation_deg: [5, -5, 0], "
        "intensity_factor: [0.5, 1, 2]}\nperformance: {channel_bias_m: [0.01, 0.02, -0.03]}\n"
    )
    sensor = load_sensor(path)
    assert sensor.beams.intensity_factor.tolist() == [1, 2, 0.5]
    assert sensor.noise.channel_bias_m == (0.02, -0.03, 0.01)
    assert not load_sensor("velodyne/vlp16").beams.has_intensity_factors


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("beams: {elevation_deg: [0, 1], intensity_factor: [1]}", "intensity_factor must be"),
        ("beams: {elevation_deg: [0, 1], intensity_factor: [1, 0]}", "must be greater than 0"),
        ("beams: {intensity_factor: [1, 2]}", "requires beams.elevation_deg"),
        (
            "beams: {elevation_deg: [0, 1]}\nperformance: {channel_bias_m: [0.1]}",
            "one value for each of the 2 beams, but has 1",
        ),
    ],
)
def test_factors_and_biases_must_match_the_beams(tmp_path, text, says):
    path = tmp_path / "mine.yaml"
    path.write_text(f"name: Mine\nfiring_us: 50\n{text}\n")
    with pytest.raises(LidarError, match=says):
        load_sensor(path)


def test_beams_keep_their_factors():
    beams = Beams(np.radians([3, 1, 2]), intensity_factor=[0.5, 1, 2])
    assert beams.sort_by_elevation().intensity_factor.tolist() == [1, 2, 0.5]
    assert beams.with_rotation(1e-6).intensity_factor.tolist() == [0.5, 1, 2]
