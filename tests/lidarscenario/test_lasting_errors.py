"""Errors with memory: of channels, while warming up, and of the encoder, against closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.shapes import wall

from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarsim import LidarError, Mounted, Noise, Scene, Sensor, Survey, Track, load_sensor
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.rig import Rig

CHANNELS = 100
TURNS = 4
SENSOR = Sensor.grid(40, CHANNELS, 20, step_deg=90, horizontal_fov_deg=40)
WALL = Scene.from_meshes([wall("Wall", 30)])
SURVEY = Survey(SENSOR, poses=[(0, 0, 0)], steps=TURNS, columns=["range", "time", "azimuth"])


def cast(survey, size=10_000, backend="numpy"):
    rig = Rig(WALL, survey, backend, threads=1)
    stop = survey.scan_count
    parts = [
        columns_of([*rig.cast(first, min(first + size, stop))]).columns
        for first in range(0, stop, size)
    ]
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


TRUE = cast(SURVEY)


def errors(noise):
    return cast(replace(SURVEY, noise=noise))["range"].astype(float) - TRUE["range"]


@pytest.mark.extended
def test_a_channels_error_is_constant_and_its_own():
    """Of 30 units: normal with the standard deviation given, uncorrelated, the same for ever."""
    each = []
    for seed in range(30):
        found = errors(Noise(channel_bias_m=0.05, seed=seed)).reshape(-1, CHANNELS)
        assert np.ptp(found, axis=0).max() < 1e-5  # autocorrelation of 1
        each.append(found[0])
    made = np.array(each)
    count = made.size
    assert abs(made.mean()) < 4.5 * 0.05 / np.sqrt(count)
    assert abs(made.std() / 0.05 - 1) < 4.5 / np.sqrt(2 * count)
    neighbors = np.corrcoef(made[:, :-1].ravel(), made[:, 1:].ravel())[0, 1]
    units = np.corrcoef(made[:-1].ravel(), made[1:].ravel())[0, 1]
    assert max(abs(neighbors), abs(units)) < 4.5 / np.sqrt(count)


def test_biases_may_be_those_of_a_calibration():
    biases = np.linspace(-0.1, 0.2, CHANNELS)
    found = errors(Noise(channel_bias_m=biases))
    np.testing.assert_allclose(found, biases[TRUE["channel"]], atol=1e-5)


def test_sensors_have_errors_of_their_own():
    two = [Mounted(SENSOR, name="left"), Mounted(SENSOR, name="right")]
    survey = replace(SURVEY, sensor=SENSOR, sensors=two, noise=Noise(channel_bias_m=0.05))
    left, right = cast(survey)["range"].reshape(2, -1)
    assert np.abs(left - right).max() > 0.05


def test_ranges_drift_while_it_warms_up():
    noise = Noise(warm_up_m=0.4, warm_up_s=0.04)
    expected = 0.4 * np.exp(-TRUE["time"] / 0.04e9)
    assert expected.min() < 0.05
    np.testing.assert_allclose(errors(noise), expected, atol=1e-5)
    both = errors(replace(noise, channel_bias_m=0.05, range_m=0.01, seed=1))
    left = both - expected - errors(Noise(channel_bias_m=0.05, seed=1))
    assert abs(left.std() / 0.01 - 1) < 4.5 / np.sqrt(2 * len(left))


@pytest.mark.parametrize("way", [None, Track([0, 1], [(0, 0, 0), (1e-9, 0, 0)])], ids=["", "moves"])
@pytest.mark.parametrize("returns", ["one", "several"])
def test_azimuths_err_as_the_head_turns(way, returns):
    """A beam at azimuth a is cast at a + A sin(k a + p), with its elevation: x is 30 m away."""
    limit = {"detection_range_m": 1e5} if returns == "several" else {}
    noise = Noise(ripple_deg=0.5, ripple_cycles=3, ripple_phase_deg=30, **limit)
    place = {} if way is None else {"poses": (), "trajectory": way}
    found = cast(replace(SURVEY, noise=noise, **place))
    azimuth = np.radians(TRUE["azimuth"].astype(float))
    true = azimuth + np.radians(0.5) * np.sin(3 * azimuth + np.radians(30))
    expected = 30 / (np.cos(SENSOR.beams.elevation[TRUE["channel"]]) * np.cos(true))
    assert np.abs(expected - TRUE["range"]).max() > 0.09
    np.testing.assert_allclose(found["range"], expected, atol=0.002)
    assert np.array_equal(found["azimuth"], TRUE["azimuth"])


def test_batches_and_backends_do_not_matter():
    noise = Noise(
        0.01, channel_bias_m=0.02, warm_up_m=0.1, warm_up_s=1, ripple_deg=0.1, ripple_cycles=2
    )
    survey = replace(SURVEY, sensor=load_sensor("velodyne/vlp16"), noise=noise, steps=20)
    whole = cast(survey)
    for other in (cast(survey, 3), cast(survey, backend="tiles")):
        assert all(np.array_equal(whole[name], other[name]) for name in whole)


def test_what_does_not_fit():
    with pytest.raises(LidarError, match=r"100 channels .* but has 2 values"):
        replace(SURVEY, noise=Noise(channel_bias_m=[0.1, 0.2]))
    with pytest.raises(LidarError, match="but the head of Livox"):
        Survey(load_sensor("livox/mid70"), poses=[(0, 0, 0)], noise=Noise(ripple_deg=0.1))
    with pytest.raises(
        LidarError, match=r"channel_bias_m must be a number from 0 to .* but is 'x'"
    ):
        Scenario.from_data({"noise": {"channel_bias_m": "x"}})


def test_scenarios_have_them_beside_a_data_sheet():
    noise = {"channel_bias_m": [0.01] * 16, "warm_up_m": 0.02, "ripple_deg": 0.02}
    sensor = {"model": "velodyne/vlp16", "performance": "datasheet"}
    made = prepare(Scenario.from_data({"scene": "seed", "sensor": sensor, "noise": noise}))
    made = made.survey.noise_each[0]
    assert made.range_m == 0.03 and made.warm_up_s == 600 and len(made.channel_bias_m) == 16
