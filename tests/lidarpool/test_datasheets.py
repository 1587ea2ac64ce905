"""Data sheets of sensors: what their figures become, and that simulated walls give them back."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from tests.shapes import beam_along_x, cast, wall

from lidarpool.cli.scenario_commands import sensors
from lidarscenario.advice import advice
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarsim import LidarError, Material, Mounted, Noise, Returns, Survey, load_sensor
from lidarsim.schema.model_names import model_names
from lidarsim.sensor.models import Detection, read_model

RAYS = 20_000
STATED = [name for name in model_names() if read_model(name).performance]
DETECTED = [name for name in STATED if read_model(name).performance.detection]


def returned(name, distance, reflectance):
    """Ranges of the returns of a wall, one ray to a pulse, with a data sheet's noise."""
    noise = read_model(name).datasheet().noise
    sensor = beam_along_x(RAYS, 1e4)
    materials = [Material("*", reflectance=reflectance)]
    columns = ("range", "cause")
    found = cast([wall("W", distance)], sensor, noise=noise, materials=materials, columns=columns)
    return found["range"][found["cause"] == 0]


@pytest.mark.parametrize("name", model_names())
def test_each_model_says_where_its_figures_are_from_or_that_none_were_found(name):
    model = read_model(name)
    if model.performance is None:
        assert model.sources["performance"].startswith("no available source")
        with pytest.raises(LidarError, match="set `noise` instead"):
            model.datasheet()
        return
    sheet = model.datasheet()
    assert model.sources["performance"]
    assert len(sheet.missing) < 4
    assert sheet.returns.subrays == (1 if model.optics.divergence_mrad is None else 7)


@pytest.mark.slow(every=4)
@pytest.mark.parametrize("name", DETECTED)
def test_a_wall_at_the_stated_range_returns_the_stated_share(name):
    stated = read_model(name).performance.detection
    count = len(returned(name, stated.range_m, stated.reflectance))
    spread = RAYS * stated.probability * (1 - stated.probability)
    assert abs(count - RAYS * stated.probability) < 4 * math.sqrt(spread)


@pytest.mark.slow(every=5)
@pytest.mark.parametrize(
    "name", [name for name in STATED if read_model(name).datasheet().noise.range_m]
)
def test_a_wall_has_the_stated_scatter(name):
    stated = read_model(name).performance
    places = [(20.0, 0.8, (stated.range_m or 0) + 20 * stated.range_per_m)]
    if stated.precision:
        places = [(one.range_m, one.reflectance, one.sigma_m) for one in stated.precision]
    for distance, reflectance, sigma in places:
        found = returned(name, distance, reflectance)
        assert len(found) == RAYS
        assert np.std(found) == pytest.approx(sigma, rel=4 / math.sqrt(2 * RAYS))


def test_a_stated_range_becomes_that_of_half_the_pulses_on_ten_per_cent():
    assert Detection(range_m=90, probability=0.5).threshold_m == pytest.approx(90)
    # 90 % of pulses need 1 + 1.2816 / 5 of the threshold's energy.
    assert Detection(range_m=90, probability=0.9).threshold_m == pytest.approx(90 * 1.25631**0.5)
    white = Detection(range_m=90, reflectance=0.8, probability=0.5)
    assert white.threshold_m == pytest.approx(90 / 8**0.5)


def test_stated_false_alarms_are_a_share_of_the_pulses():
    noise = read_model("livox/mid40").datasheet().noise
    gate_s = 2 * (260 - 1) / 299_792_458
    assert -math.expm1(-noise.false_alarm_hz * gate_s) == pytest.approx(1e-4)


def carried(**sections):
    survey = prepare(Scenario.from_data({"scene": "seed", "poses": [[0, 0, 1]], **sections})).survey
    return list(zip(survey.noise_each, survey.returns_each, strict=True))


def test_a_scenario_takes_the_data_sheet_with_one_word_and_its_own_figures_before_it():
    sensor = {"model": "ouster/os1-64", "performance": "datasheet"}
    sheet = read_model("ouster/os1-64").datasheet()
    assert carried(sensor=sensor) == [(sheet.noise, sheet.returns)]
    ((noise, returns),) = carried(
        sensor=sensor, noise={"range_m": 0.0, "walk_m": 0.05, "seed": 3}, returns={"subrays": 1}
    )
    assert (noise.range_m, noise.walk_m, noise.seed) == (0, 0.05, 3)
    assert noise.detection_range_m == sheet.noise.detection_range_m
    assert returns == Returns()
    ((noise, _),) = carried(sensor={"model": "ouster/os1-64"})
    assert not noise.loses_returns


def test_a_file_that_states_its_performance_is_used_with_it_unless_it_shall_be_ideal(tmp_path):
    text = (
        "{name: Mine, firings_per_turn: 360, range_m: [0, 80], beams: {elevation_deg: [0, 1]}, "
        "performance: {range_m: 0.02, dropout: 0.1, mode: last}}"
    )
    file = tmp_path / "mine.yaml"
    file.write_text(text)
    sheet = read_model(file).datasheet()
    other = Noise(range_m=0.5)
    at = {"poses": [(0, 0, 1)]}
    assert sheet.noise == Noise(range_m=0.02, dropout=0.1) and sheet.returns.mode == "last"
    given = {"sensor": str(file), "noise": {"dropout": 0, "seed": 3}}
    assert carried(**given) == [(Noise(range_m=0.02, seed=3), sheet.returns)]
    ideal = {"sensor": {"model": str(file), "performance": "ideal"}}
    assert carried(**ideal) == [(Noise(), Returns())]
    sensor = load_sensor(file)
    named = load_sensor("ouster/os1-64")
    for survey in (Survey(sensor, **at), Survey(sensors=[Mounted(sensor)], **at)):
        assert (survey.noise_each, survey.returns_each) == ((sheet.noise,), (sheet.returns,))
    both = Survey(sensors=[Mounted(sensor, name="a"), Mounted(named, name="b")], **at)
    assert both.noise_each == (sheet.noise.for_sensor("a"), Noise().for_sensor("b"))
    for given in ({"sensor": sensor}, {"sensors": [Mounted(sensor)]}):
        assert Survey(**given, **at, noise=other).noise_each == (other,)
    assert load_sensor(file, performance="ideal").noise is None and named.noise is None
    stated = load_sensor("ouster/os1-64", performance="datasheet")
    assert stated.noise == read_model("ouster/os1-64").datasheet().noise


def test_each_of_several_sensors_has_its_own():
    found = carried(
        sensors={
            "roof": {"model": "hesai/xt32", "performance": "datasheet"},
            "front": {"model": "livox/mid70"},
        },
        noise={"range_m": 0.5},
    )
    (roof, _), (front, returns) = found
    assert (roof.range_m, roof.detection_range_m is not None) == (0.5, True)
    assert (front.range_m, front.detection_range_m, returns) == (0.5, None, Returns())


@pytest.mark.parametrize("model", ["velodyne/vlp16", "ouster/os1-64"])
def test_figures_that_a_data_sheet_lacks_are_told_only_on_request(model):
    sheet = {"model": model, "performance": "datasheet"}
    data = {"scene": "seed", "poses": [[0, 0, 1]], "sensor": sheet}
    assert advice(prepare(Scenario.from_data(data))) == []
    shown = CliRunner().invoke(sensors, [model]).output
    (unknown,) = re.findall("^unknown .*", shown, re.MULTILINE)
    assert unknown.endswith("false alarms (noise.false_alarm_hz)")


@pytest.mark.parametrize(
    ("sensor", "lacks", "proposed"),
    [
        ({"performance": "datasheet"}, "is not in its data sheet", 65),
        ({}, "is not set", 65),
        ({"max_range_m": 40}, "is not set", 20),
    ],
)
def test_rain_without_a_detection_range_proposes_one_that_can_be_written(sensor, lacks, proposed):
    rain = {"sensor": {"model": "velodyne/vlp16", **sensor}, "weather": {"rain_mm_h": 10}}
    with pytest.raises(LidarError, match=lacks) as told:
        carried(**rain)
    (entry,) = re.findall(r"`(noise: {.*})`", str(told.value))
    assert yaml.safe_load(entry) == {"noise": {"detection_range_m": proposed}}
    carried(**rain, **yaml.safe_load(entry))


@pytest.mark.parametrize(
    ("sensor", "says"),
    [
        ({"performance": "datasheet"}, "requires a sensor model"),
        ({"model": "velodyne/hdl32e", "performance": "datasheet"}, "set `noise` instead"),
        ({"model": "velodyne/vlp16", "performance": "typical"}, "datasheet"),
    ],
)
def test_a_switch_that_cannot_work_says_so(sensor, says):
    with pytest.raises(LidarError, match=says):
        carried(sensor=sensor)


def test_the_command_shows_what_a_data_sheet_says(tmp_path):
    run = CliRunner().invoke(sensors, ["livox/mid70", "--out", str(tmp_path / "a.png")])
    assert "noise        range_m: 0.02, angle_deg: 0.1, detection_range_m: 100.9" in run.output
    assert "returns      mode: strongest, subrays: 7" in run.output
    assert "unknown      false alarms (noise.false_alarm_hz)" in run.output


# As the sources of each file state them: points and pulses per second, degrees of a line, distance
# from the sensor in meters, standard deviation in millimeters, divergence in mrad.
SURVEYING = {
    "terrestrial/riegl-vz1000": (125_000, 300_000, 100, 2.5, 8, 0.3),
    "terrestrial/riegl-vz2000i": (500_000, 1_200_000, 100, 1.5, 5, 0.27),
    "mobile/riegl-vq450": (550_000, 550_000, 360, 1.5, 8, 0.3),
    "mobile/riegl-vux1ha22": (1_800_000, 1_800_000, 360, 1, 5, 0.5),
    "drone/riegl-vux1uav": (504_000, 550_000, 330, 3, 10, 0.5),
    "drone/riegl-vux1uav22": (1_200_000, 1_200_000, 360, 3, 10, 0.5),
    "drone/dji-zenmuse-l1": (240_000, None, None, 1, 20, 0.89),
}


@pytest.mark.parametrize("name", SURVEYING)
def test_scanners_of_surveys_have_the_rates_and_angles_of_their_sources(name):
    points_s, pulses_s, width_deg, min_m, sigma_mm, divergence_mrad = SURVEYING[name]
    sensor = load_sensor(name, performance="datasheet")
    head = sensor.head
    assert sensor.channels * head.firings_per_turn * head.rate_hz == pytest.approx(
        points_s, rel=1e-3
    )
    assert sensor.min_range_m == min_m
    assert sensor.noise.range_m == pytest.approx(sigma_mm / 1000)
    assert sensor.optics.divergence_mrad == divergence_mrad
    if pulses_s is None:
        return
    count = round(head.firings_per_turn) if sensor.channels == 1 else 1
    times_s = np.sort(sensor.times_ns(np.arange(count)).ravel()) / 1e9
    assert 1 / np.median(np.diff(times_s)) == pytest.approx(pulses_s, rel=2e-3)
    directions = sensor.directions(np.arange(count)).reshape(-1, 3)
    steps = np.arccos(np.clip(np.sum(directions[1:] * directions[:-1], axis=1), -1, 1))
    assert np.degrees(steps.sum()) == pytest.approx(width_deg, rel=2e-3)


def test_a_zenmuse_l1_has_the_field_of_view_of_its_guide_and_its_detection_range():
    sensor = load_sensor("drone/dji-zenmuse-l1", performance="datasheet")
    x, y, z = sensor.directions(np.arange(40_000)).reshape(-1, 3).T
    across, along = (np.degrees(np.arctan2(side, x)) for side in (y, z))
    assert np.ptp(across) == pytest.approx(70.4, abs=4) or np.ptp(along) == pytest.approx(
        70.4, abs=4
    )
    assert max(np.ptp(across), np.ptp(along)) == pytest.approx(77.2, abs=4)
    detection = Detection(range_m=190, probability=0.9)
    assert sensor.noise.detection_range_m == pytest.approx(detection.threshold_m)
