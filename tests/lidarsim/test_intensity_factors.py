"""Sensors that report other intensities than they receive."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.shapes import level, wall

from lidarsim import Beams, LidarError, Material, Noise, Pose, Scene, Sensor, Survey, load_sensor
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


def cast(survey, scene=WALL):
    return columns_of([*Rig(scene, survey, "numpy").cast(0, survey.scan_count)]).columns


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


RANGES_M = np.array([10.0, 20.0, 40.0])
BY_RANGE = np.array([[1, 1, 1], [0.5, 2, 1], [3, 2, 0.5], [1, 4, 0.1]])
FLOOR = Scene.from_meshes([level("Floor", -2, half=200)])
OVER_FLOOR = Survey(
    Sensor.grid(40, 4, 20, step_deg=90, horizontal_fov_deg=40),
    poses=[Pose((0, 0, 0), pitch_deg=15)],
    steps=4,
    columns=(*NAMES, "incidence_deg"),
    materials=[Material("*", reflectance=0.5)],
)


def test_factors_by_range_are_interpolated():
    sensor = replace(
        SENSOR,
        beams=replace(SENSOR.beams, intensity_factor=BY_RANGE, intensity_range_m=RANGES_M),
    )
    plain = cast(OVER_FLOOR, FLOOR)
    found = cast(replace(OVER_FLOOR, sensor=sensor), FLOOR)
    range_m = plain["range"]
    assert range_m.min() < 10 and range_m.max() > 20
    factor = [
        np.interp(r, RANGES_M, BY_RANGE[channel])
        for r, channel in zip(range_m, plain["channel"], strict=True)
    ]
    for name in ("intensity", "reflectance"):
        np.testing.assert_allclose(found[name], plain[name] * factor, rtol=1e-5, err_msg=name)
    np.testing.assert_array_equal(found["range"], range_m)


def test_factors_at_a_single_range_apply_everywhere():
    beams = Beams([0.0, 0.1], intensity_factor=[[2], [3]], intensity_range_m=[10])
    found = beams.intensity_factors(np.array([0, 1, 1]), np.array([1.0, 10.0, 90.0]))
    assert found.tolist() == [2, 3, 3]


def with_exponent(exponent):
    return replace(SENSOR, optics=replace(SENSOR.optics, incidence_exponent=exponent))


@pytest.mark.parametrize("exponent", [0.0, 0.3, 2.0])
def test_reported_intensities_have_the_incidence_exponent_of_the_sensor(exponent):
    plain = cast(OVER_FLOOR, FLOOR)
    found = cast(replace(OVER_FLOOR, sensor=with_exponent(exponent)), FLOOR)
    cosine = np.cos(np.radians(plain["incidence_deg"]))
    assert cosine.max() > 2 * cosine.min()
    np.testing.assert_allclose(found["reflectance"], 0.5 * cosine**exponent, rtol=1e-4)
    np.testing.assert_allclose(
        found["intensity"], plain["intensity"] * cosine ** (exponent - 1), rtol=1e-4
    )
    np.testing.assert_array_equal(found["range"], plain["range"])


def test_retroreflectors_have_no_incidence_exponent():
    survey = replace(OVER_FLOOR, materials=[Material("*", 0.5, retro=True)])
    plain = cast(survey, FLOOR)
    found = cast(replace(survey, sensor=with_exponent(0.0)), FLOOR)
    np.testing.assert_array_equal(found["intensity"], plain["intensity"])


def test_a_sensor_file_states_the_response(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(
        "name: Mine\nfiring_us: 50\nbeams: {elevation_deg: [5, -5], intensity_range_m: [5, 20, 60],"
        " intensity_factor: [[1, 2, 3], [4, 5, 6]]}\noptics: {incidence_exponent: 0.25}\n"
    )
    sensor = load_sensor(path)
    assert sensor.beams.intensity_factor.tolist() == [[4, 5, 6], [1, 2, 3]]
    assert sensor.beams.intensity_range_m.tolist() == [5, 20, 60]
    assert sensor.optics.incidence_exponent == 0.25


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
            "beams: {elevation_deg: [0, 1], intensity_factor: [[1], [2]]}",
            "such lists require beams.intensity_range_m",
        ),
        (
            "beams: {elevation_deg: [0, 1], intensity_range_m: [5]}",
            "requires a list of intensity factors for each beam",
        ),
        (
            "beams: {elevation_deg: [0, 1], intensity_range_m: [5, 9], "
            "intensity_factor: [[1, 2], [1]]}",
            "one factor for each of the 2 ranges",
        ),
        (
            "beams: {elevation_deg: [0, 1], intensity_range_m: [9, 5], "
            "intensity_factor: [[1, 2], [1, 1]]}",
            "must contain ascending ranges",
        ),
        (
            "beams: {elevation_deg: [0, 1]}\noptics: {incidence_exponent: -1}",
            "incidence_exponent",
        ),
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
