"""Directions in which the platform blocks a sensor: exactly their pulses have no return."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import yaml
from tests.shapes import block

from lidarsim import (
    Beams,
    Fault,
    LidarError,
    Noise,
    Scene,
    Sensor,
    Spin,
    Survey,
    export_sensor,
    load_sensor,
)
from lidarsim.sensor.plain_data import from_plain_data, to_plain_data
from lidarsim.sensor.ray_sensors import ListedSensor, PrismSensor
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.rig import Rig
from lidarsim.simulator.sampling import sample_survey

COLUMNS = ("time", "range", "intensity", "azimuth", "elevation", "ray", "channel")
ROOM = Scene.from_meshes([block("Room", (12, 9, 8))])
MODEL = {
    "name": "Mine",
    "firings_per_turn": 720,
    "zero_deg": 30.25,  # azimuths are never on an edge
    "beams": {
        "elevation_deg": [15, -15, 5, -5],  # channels 3, 0, 2, 1
        "azimuth_deg": [0, 10, 0, -10],
        "blocked_deg": [[0, 350, 20], [1, 80, 100], [1, 90, 120], [2, -95, -85], [3, 0, 360]],
    },
}


def model_file(folder, **fields):
    path = folder / "mine.yaml"
    path.write_text(yaml.safe_dump(MODEL | fields))
    return path


def cast(sensor, scans_per_batch=10_000, backend="tiles", **fields):
    """Columns of two revolutions, cast so many scans at a time."""
    survey = Survey(sensor, poses=[(0.5, 0, 0)], steps=72, columns=COLUMNS, **fields)
    rig = Rig(ROOM, survey, backend, threads=1)
    parts = [
        columns_of([*rig.cast(first, min(first + scans_per_batch, survey.scan_count))])
        for first in range(0, survey.scan_count, scans_per_batch)
    ]
    columns = {name: np.concatenate([part.columns[name] for part in parts]) for name in COLUMNS}
    counts = np.concatenate([part.counts for part in parts])
    return columns | {"scan": np.repeat(np.arange(len(counts)), counts)}


def without_blocked(sensor):
    return replace(sensor, beams=replace(sensor.beams, blocked=np.zeros((0, 3))))


def in_blocked(columns):
    """Mask of the pulses in the blocked directions of `MODEL`, whose channels are sorted."""
    azimuth = np.asarray(columns["azimuth"]) % 360
    channel = columns["channel"]
    return (
        ((channel == 3) & ((azimuth >= 350) | (azimuth < 20)))
        | ((channel == 0) & (azimuth >= 80) & (azimuth < 120))
        | ((channel == 2) & (azimuth >= 265) & (azimuth < 275))
        | (channel == 1)
    )


@pytest.mark.parametrize("clockwise", [False, True])
def test_exactly_the_pulses_in_blocked_directions_vanish(tmp_path, clockwise):
    sensor = load_sensor(model_file(tmp_path, clockwise=clockwise))
    every = cast(without_blocked(sensor))
    found = cast(sensor)
    blocked = in_blocked(every)

    assert blocked.sum() == 2 * (2 * 30 + 2 * 40 + 2 * 10 + 720)
    for name in found:
        np.testing.assert_array_equal(found[name], every[name][~blocked])


def test_an_estimate_from_a_sample_omits_the_blocked_directions(tmp_path, monkeypatch):
    """Each ray hits the room, and one in seven is cast."""
    sensor = load_sensor(model_file(tmp_path, range_m=[0, 100]))
    survey = Survey(sensor, poses=[(0.5, 0, 0)], steps=360)
    monkeypatch.setattr("lidarsim.simulator.sampling.SAMPLE_RAYS", survey.ray_count // 7)
    share = in_blocked(cast(without_blocked(sensor))).mean()
    for one, returned in ((sensor, 1 - share), (without_blocked(sensor), 1.0)):
        estimate = sample_survey(ROOM, replace(survey, sensor=one))
        assert estimate["rays"] < survey.ray_count / 6
        assert estimate["points"] == estimate["hits"]
        assert estimate["hits"] == pytest.approx(returned * survey.ray_count, rel=0.02)


def test_azimuths_within_a_firing_count(tmp_path):
    """Each beam is blocked at the azimuth at which it is fired."""
    beams = MODEL["beams"] | {"time_us": [0, 50, 100, 130]}  # of 139 µs per firing
    sensor = load_sensor(model_file(tmp_path, beams=beams))
    every = cast(without_blocked(sensor))
    blocked = in_blocked(every)
    assert 0.2 < blocked.mean() < 0.4
    np.testing.assert_array_equal(cast(sensor)["range"], every["range"][~blocked])


def test_the_result_does_not_depend_on_batches_and_backends(tmp_path):
    sensor = load_sensor(model_file(tmp_path, range_m=[0, 100]))
    noise = Noise(range_m=0.02, detection_range_m=30, false_alarm_hz=1e5)
    whole = cast(sensor, noise=noise)
    for part in (cast(sensor, 7, noise=noise), cast(sensor, backend="numpy", noise=noise)):
        for name, values in whole.items():
            np.testing.assert_array_equal(part[name], values)


def test_neither_weather_nor_false_alarms_return_from_blocked_directions(tmp_path):
    sensor = load_sensor(model_file(tmp_path, range_m=[0, 100], optics={"divergence_mrad": 3}))
    effects = {
        "noise": Noise(detection_range_m=60, false_alarm_hz=1e6),
        "rain_mm_h": 60,
    }
    every = cast(without_blocked(sensor), **effects)
    found = cast(sensor, **effects)
    assert in_blocked(every).sum() > 100
    assert not in_blocked(found).any()
    assert len(found["range"]) == (~in_blocked(every)).sum()


def test_faults_act_besides_blocked_directions(tmp_path):
    sensor = load_sensor(model_file(tmp_path))
    every = cast(without_blocked(sensor))
    kept = ~in_blocked(every) & (every["channel"] != 2)
    found = cast(sensor, faults=[Fault("dead_channels", channels=[2])])
    np.testing.assert_array_equal(found["range"], every["range"][kept])


def test_the_ray_pattern_in_a_result_stores_blocked_directions():
    beams = Beams(np.zeros(2), blocked=[[1, 0.5, 1.0]])
    arrays = {}
    again = from_plain_data(to_plain_data(Sensor(beams), arrays), arrays)
    np.testing.assert_array_equal(again.beams.blocked, beams.blocked)
    plain = to_plain_data(Sensor(), arrays := {})
    assert "blocked" not in plain["beams"]
    assert len(from_plain_data(plain, arrays).beams.blocked) == 0


def test_exports_to_other_programs_name_blocked_directions(tmp_path):
    sensor = load_sensor(model_file(tmp_path))
    for name in ("rays.npz", "rays.csv", "sensor.sdf"):
        file = export_sensor(without_blocked(sensor), tmp_path / name)
        assert "directions that the platform blocks" not in file.left_out
        file = export_sensor(sensor, tmp_path / name)
        assert "directions that the platform blocks" in file.left_out


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"beams": {"elevation_deg": [0], "blocked_deg": [[0, 5, 5]]}}, "is empty"),
        ({"beams": {"elevation_deg": [0], "blocked_deg": [[1, 5, 6]]}}, "refer to beam 1"),
        ({"beams": {"elevation_deg": [0], "blocked_deg": [[-1, 5, 6]]}}, "blocked_deg"),
        ({"beams": {"elevation_deg": [0], "blocked_deg": [[0, 5]]}}, "blocked_deg"),
        ({"beams": {"elevation_deg": [0], "blocked_deg": [[0, 5, 999]]}}, "blocked_deg"),
        (
            {
                "zero_deg": 0.0,
                "prisms": [{"wedge_deg": 9, "index": 1.5, "rpm": 9}],
                "beams": {"elevation_deg": [0], "blocked_deg": [[0, 5, 6]]},
            },
            "requires beams that rotate with a head",
        ),
    ],
)
def test_impossible_directions_are_refused(tmp_path, fields, message):
    with pytest.raises(LidarError, match=message):
        load_sensor(model_file(tmp_path, **fields))


def test_sensors_without_a_head_refuse_blocked_directions():
    beams = Beams(np.zeros(1), blocked=[[0, 0, 1]])
    for kind in (PrismSensor, ListedSensor):
        with pytest.raises(LidarError, match="require beams that rotate with a head"):
            kind(beams)
    with pytest.raises(LidarError, match="refer to beam 1, but the beams are numbered from 0 to 0"):
        Sensor(Beams(np.zeros(1), blocked=[[1, 0, 1]]), Spin())
    with pytest.raises(LidarError, match=r"Beams\.blocked"):
        Beams(np.zeros(1), blocked=[[0, 0, np.nan]])


def test_a_calibration_keeps_the_blocked_directions_of_the_model(tmp_path):
    (tmp_path / "unit.csv").write_text("elevation_deg\n14\n-14\n6\n-6\n")
    model = model_file(tmp_path)
    sensor = load_sensor(model, calibration=tmp_path / "unit.csv")
    np.testing.assert_array_equal(sensor.beams.blocked, load_sensor(model).beams.blocked)
