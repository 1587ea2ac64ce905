"""Several columns with the strength of returns, and the detection threshold of the sensor."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from tests.made_recordings import made_recording
from tests.street_recordings import record, reflectances

from lidarreal.augmentation.detection_threshold import detection_threshold
from lidarreal.augmentation.intensity_scale import IntensityScale
from lidarreal.augmentation.strength_columns import StrengthColumns
from lidarsim import load_sensor
from lidarsim.columns.sweep import Sweep
from lidarsim.sensor.reflectivity import SCALES

OUSTER = SCALES["ouster"]
THRESHOLD = 0.001  # of a surface with 10 % reflectance at 100 m


def ouster(energy, range_m):
    """Return the columns of ouster-ros, with 3,000 counts for a white surface at 10 m."""
    return {
        "intensity": np.rint(3000 * energy).astype(np.float32),
        "reflectivity": OUSTER.encode(reflectances(energy, range_m)).astype(np.uint16),
        "ambient": np.full(len(energy), 77, np.uint16),
    }


def result(energy, range_m):
    """Return the columns of a lidarpool result."""
    return {
        "intensity": energy.astype(np.float32),
        "reflectivity": OUSTER.encode(reflectances(energy, range_m)),
        "signal": np.minimum(np.rint(10_000 * energy), 65_535).astype(np.uint16),
        "reflectance": reflectances(energy, range_m).astype(np.float32),
    }


def test_counts_are_related_to_the_calibrated_reflectivity():
    recording = record(ouster)
    strengths = StrengthColumns.for_recording(recording, load_sensor("ouster/os1-64"))
    (counts,) = strengths.others
    assert (strengths.scale.column, counts.column) == ("reflectivity", "intensity")
    assert counts.white == pytest.approx(3000, rel=0.01)
    assert not counts.compensated
    sweep = recording[0]
    range_m = np.linalg.norm(sweep.points, axis=1)
    energy = strengths.energies(sweep.columns, range_m)
    same = strengths.scale_intensities(sweep.columns, energy, energy, range_m, range_m)
    assert same.keys() == {"intensity", "reflectivity"}  # the ambient light is kept
    for name, values in same.items():
        np.testing.assert_array_equal(values, sweep.columns[name])
        assert values.dtype == sweep.columns[name].dtype
    halved = strengths.scale_intensities(sweep.columns, energy, energy / 2, range_m, range_m)
    np.testing.assert_allclose(halved["intensity"], sweep.columns["intensity"] / 2, atol=0.5)
    diffuse = sweep.columns["reflectivity"] <= 100
    np.testing.assert_allclose(
        halved["reflectivity"][diffuse], sweep.columns["reflectivity"][diffuse] / 2, atol=0.5
    )


@pytest.mark.parametrize("white", [3e5, 3e6])
def test_saturated_values_do_not_change_the_factor_of_a_column(white):
    """A quarter or half of the counts have the largest value."""

    def columns(energy, range_m):
        counts = np.minimum(np.rint(white * energy), 65_535)
        return ouster(energy, range_m) | {"signal": counts.astype(np.uint16)}

    strengths = StrengthColumns.for_recording(record(columns), load_sensor("ouster/os1-64"))
    scales = {scale.column: scale for scale in strengths.others}
    assert scales["signal"].white == pytest.approx(white, rel=0.02)


def test_new_returns_have_values_in_all_columns():
    strengths = StrengthColumns.for_recording(record(result))
    values = strengths.intensities(np.array([0.25, 0.1]), np.array([20.0, 10.0]))
    assert {name: array.dtype.name for name, array in values.items()} == {
        "intensity": "float32",
        "reflectivity": "uint8",
        "signal": "uint16",
        "reflectance": "float32",
    }
    np.testing.assert_allclose(values["intensity"], [0.25, 0.1], rtol=1e-6)
    np.testing.assert_array_equal(values["reflectivity"], [100, 10])
    np.testing.assert_allclose(values["signal"], [2500, 1000], rtol=0.002)
    np.testing.assert_allclose(values["reflectance"], [1, 0.1], rtol=1e-4)


def test_the_column_that_the_user_chose_is_changed_like_the_intensity():
    def columns(energy, range_m):
        return {"echo": OUSTER.encode(reflectances(energy, range_m))}

    recording = record(columns, intensity_column="echo")
    strengths = StrengthColumns.for_recording(recording)
    values = strengths.intensities(np.array([0.25]), np.array([20.0]))
    assert {name: array.tolist() for name, array in values.items()} == {
        "intensity": [100],
        "echo": [100],
    }


def test_columns_without_values_are_not_changed():
    def columns(energy, range_m):
        return ouster(energy, range_m) | {"signal": np.zeros(len(energy), np.uint16)}

    strengths = StrengthColumns.for_recording(record(columns))
    names = strengths.intensities(np.array([0.25]), np.array([20.0])).keys()
    assert names == {"reflectivity", "intensity"}
    points = {"reflectivity": np.array([9], np.uint16)}  # a sweep that lacks a column
    scaled = strengths.scale_intensities(points, [1.0], [0.5], [10.0], [10.0])
    assert scaled.keys() == {"reflectivity"}


def test_without_intensities_no_column_is_written():
    recording = record(lambda energy, range_m: {})
    strengths = StrengthColumns.for_recording(recording, assumed_reflectance=0.3)
    np.testing.assert_allclose(strengths.energies({}, np.array([10.0])), 0.3)
    assert strengths.intensities(np.array([0.3]), np.array([10.0])) == {}
    assert strengths.scale_intensities({}, [0.3], [0.2], [10.0], [10.0]) == {}
    assert strengths.note.startswith("All returns are assumed to have a reflectance of 0.3. Half ")


# -- threshold -------------------------------------------------------------------------------


@pytest.mark.parametrize("columns", [result, ouster])
def test_the_threshold_is_estimated_from_the_weakest_returns(columns):
    recording = record(columns, threshold=THRESHOLD)
    threshold = StrengthColumns.for_recording(recording).threshold
    assert not threshold.is_known
    assert threshold.energy == pytest.approx(THRESHOLD, rel=0.25)
    assert threshold.range_m == pytest.approx(100, rel=0.15)
    assert threshold.note == (
        "Half of the returns from a surface with 10 % reflectance are detected at "
        f"{threshold.range_m:.3g} m (estimated from the weakest returns)."
    )


def test_the_threshold_of_a_data_sheet_is_used():
    model = load_sensor("ouster/os1-64", performance="datasheet")
    strengths = StrengthColumns.for_recording(record(ouster), model)
    assert strengths.threshold.is_known
    assert strengths.threshold.energy == model.noise.threshold
    assert strengths.threshold.range_m == pytest.approx(model.noise.detection_range_m)
    assert "from the data sheet" in strengths.threshold.note
    assert strengths.note == ""


def test_rounded_values_do_not_lower_the_threshold():
    def columns(energy, range_m):
        codes = OUSTER.encode(reflectances(energy, range_m))
        codes[::3] = 0
        return {"intensity": codes}

    threshold = StrengthColumns.for_recording(record(columns, threshold=THRESHOLD)).threshold
    assert 0.3 * THRESHOLD < threshold.energy < 1.5 * THRESHOLD


def test_nothing_is_lost_without_returns():
    scale = IntensityScale.with_reflectance(0.3)
    threshold = detection_threshold(scale, None, np.zeros(0))
    assert (threshold.energy, threshold.range_m) == (0, np.inf)


def test_scales_can_be_sent_to_workers():
    strengths = StrengthColumns.for_recording(record(ouster))
    assert pickle.loads(pickle.dumps(strengths)) == strengths


def test_weak_returns_have_the_energies_of_the_column_with_the_finest_steps():
    """The reflectivity of an Ouster is a byte, but the signal has thousands of steps."""
    random = np.random.default_rng(0)
    range_m = random.uniform(5, 60, 20_000)
    energy = random.uniform(0.005, 0.6, len(range_m)) * (10 / range_m) ** 2
    signal = np.rint(10_000 * energy).astype(np.uint16)
    reflectivity = OUSTER.encode(energy / (10 / range_m) ** 2)
    columns = {"intensity": signal, "reflectivity": reflectivity}
    points = np.outer(range_m, [1.0, 0, 0])
    recording = made_recording("drive", 1, lambda _: Sweep(points, columns))
    strengths = StrengthColumns.for_recording(recording, load_sensor("ouster/os1-64"))
    assert strengths.scale.column == "reflectivity"
    weak = (reflectivity < 8) & (signal > 30)
    errors = strengths.energies(columns, range_m)[weak] / energy[weak] - 1
    assert weak.sum() > 1000
    assert np.abs(errors).max() < 0.05
    halved = strengths.scale_intensities(columns, energy, energy / 2, range_m, range_m)
    expected = OUSTER.encode(energy / 2 / (10 / range_m) ** 2)
    np.testing.assert_array_equal(halved["reflectivity"], expected)


def test_saturated_returns_are_clipped():
    random = np.random.default_rng(0)
    range_m = random.uniform(5, 60, 5_000)
    reflectivity = random.integers(5, 90, len(range_m)).astype(np.uint8)
    points = np.outer(range_m, [1.0, 0, 0])
    columns = {"reflectivity": reflectivity}
    recording = made_recording("drive", 1, lambda _: Sweep(points, columns))
    strengths = StrengthColumns.for_recording(recording, load_sensor("ouster/os1-64"))
    energy = strengths.energies(columns, range_m)
    full = float(np.median(energy))
    clipped = strengths.scale_intensities(columns, energy, energy, range_m, range_m, full)
    after = strengths.energies(clipped, range_m)
    step = 0.01 * (10 / range_m) ** 2
    assert (after <= full + step).all()
    weak = energy <= full
    np.testing.assert_array_equal(clipped["reflectivity"][weak], reflectivity[weak])
