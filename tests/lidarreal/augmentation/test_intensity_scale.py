"""Intensities of all kinds of sensors, converted to energies and back."""

from __future__ import annotations

import pickle
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.drives import SCANS, points_of, the_scene
from tests.made_recordings import changed_recording, made_recording
from tests.street_recordings import COUNT, record, reflectances, street

from lidarfiles.recordings.opening import open_recording
from lidarreal.augmentation.intensity_fit import (
    NearFactors,
    Quantization,
    RecordedReturns,
    is_compensated,
)
from lidarreal.augmentation.intensity_scale import IntensityScale
from lidarsim import load_sensor
from lidarsim.columns.sweep import Sweep
from lidarsim.errors import LidarError
from lidarsim.media.materials import normal_incidence_energy
from lidarsim.sensor.reflectivity import SCALES

VELODYNE = SCALES["velodyne"]
# 99th percentile of the reflectance multiplied by the cosine of the angle of incidence
BRIGHTEST = 0.638


def codes_of(maker="velodyne", dtype=np.uint8, unit=1):
    """Return a function that computes an intensity column of 8-bit codes."""

    def columns(energy, range_m):
        codes = SCALES[maker].encode(reflectances(energy, range_m))
        return {"intensity": (codes / dtype(unit)).astype(dtype)}

    return columns


def energies_times(factor, dtype=np.float32, max_value=np.inf):
    """Return a function that computes an intensity column proportional to the energy."""

    def columns(energy, range_m):
        values = np.minimum(energy * factor, max_value)
        if np.dtype(dtype).kind == "u":
            values = np.rint(values)
        return {"intensity": values.astype(dtype)}

    return columns


def errors_of(recording, scale, **options):
    """Return the ratios of converted to true energies in the first sweep."""
    points, energy = street(0, **options)
    columns = recording[0].columns
    return scale.energies(columns[scale.column], np.linalg.norm(points, axis=1)) / energy


def byte_scale(**fields):
    """Return the known scale of a sensor by Velodyne."""
    common = {
        "column": "intensity",
        "dtype": np.dtype(np.uint8),
        "quantization": Quantization(1, 255),
        "white": 1.0,
        "compensated": True,
    }
    return IntensityScale(**common | fields).with_codes(VELODYNE)


def drive_energies(written, layout, name, sensor):
    """Return the scale of an exported drive, and its converted and true energies."""
    path = written(name, layout=layout)
    recording = open_recording(path, sensor)
    scale = IntensityScale.for_recording(recording)
    cloud = points_of(the_scene(), 0)
    true = cloud["intensity"][cloud["scan"] < SCANS].astype(float)
    sweep = recording[0]
    return scale, scale.energies(sweep.columns[scale.column], np.ones(len(sweep))), true


@pytest.mark.parametrize(
    ("layout", "white", "step"),
    [("velodyne", 1, 0), ("images", 1, 0), ("autoware", 255, 1 / 255), ("ouster", 10_000, 1e-4)],
)
@pytest.mark.parametrize("name", ["mcap", "rosbag2"])
def test_bags_of_lidarpool_contain_energies(written, layout, white, step, name):
    scale, found, true = drive_energies(written, layout, name, "/front/points")
    assert (scale.is_known, scale.note, scale.white, scale.compensated) == (True, "", white, False)
    # Values of 0 were rounded down, and the greatest value may be greater.
    usable = (true > step) & (true < 1 - step)
    np.testing.assert_allclose(found[usable], true[usable], rtol=1e-6, atol=0.51 * step)
    given_column = open_recording(written(name, layout=layout), "/front/points", "ring")
    assert given_column.info.energy_unit is None


@pytest.mark.parametrize("layout", ["hesai", "robosense", "livox"])
def test_reflectivities_in_bags_require_a_model(written, layout):
    recording = open_recording(written("mcap", layout=layout), "/front/points")
    assert recording.info.energy_unit is None
    note = IntensityScale.for_recording(recording).note
    assert note.startswith("The intensity scale of ") and "is unknown. A white surface" in note


# -- known scales ----------------------------------------------------------------------------


def test_a_white_surface_at_20_m_has_a_quarter_of_the_energy():
    scale = byte_scale()
    codes = np.array([100, 50, 100], np.uint8)
    range_m = np.array([20.0, 10.0, 5.0])
    np.testing.assert_allclose(scale.energies(codes, range_m), [0.25, 0.5, 4.0])
    np.testing.assert_array_equal(scale.intensities(np.array([0.25, 0.5, 4.0]), range_m), codes)


def test_codes_above_white_are_logarithmic():
    scale = byte_scale()
    range_m = np.full(2, 10.0)
    energy = scale.energies(np.array([200, 255], np.uint8), range_m)
    np.testing.assert_allclose(energy, VELODYNE.decode(np.array([200, 255], np.uint8)))
    assert energy[1] == pytest.approx(VELODYNE.max_reflectance)
    # Halving the energy of a retroreflector changes its code by a few steps only.
    codes = np.array([200, 80], np.uint8)
    halved = scale.scale_intensities(
        codes, scale.energies(codes, range_m), scale.energies(codes, range_m) / 2, range_m, range_m
    )
    step = np.log(VELODYNE.max_reflectance) / 155
    np.testing.assert_array_equal(halved, [round(200 - np.log(2) / step), 40])


@pytest.mark.parametrize("maker", SCALES)
@pytest.mark.parametrize(("dtype", "unit"), [(np.uint8, 1), (np.float32, 1), (np.float32, 255)])
def test_all_codes_survive_a_round_trip(maker, dtype, unit):
    codes = (np.arange(256) / dtype(unit)).astype(dtype)
    scale = byte_scale(dtype=np.dtype(dtype), quantization=Quantization(unit, 255 / unit))
    scale = scale.with_codes(SCALES[maker])
    for distance in (0.5, 10.0, 77.7):
        range_m = np.full(256, distance)
        again = scale.intensities(scale.energies(codes, range_m), range_m)
        assert again.dtype == dtype
        np.testing.assert_array_equal(again, codes)


def test_results_contain_energies():
    recording = record(energies_times(1.0), energy_unit=1.0)
    scale = IntensityScale.for_recording(recording)
    assert scale.is_known
    assert not scale.note
    assert not scale.compensated
    np.testing.assert_allclose(errors_of(recording, scale), 1, rtol=1e-6)


def test_a_reflectivity_reveals_simulated_energies():
    def columns(energy, range_m):
        codes = VELODYNE.encode(reflectances(energy, range_m))
        return {"intensity": energy.astype(np.float32), "reflectivity": codes}

    recording = record(columns)
    scale = IntensityScale.for_recording(recording)
    assert (scale.column, scale.is_known, scale.note) == ("intensity", True, "")
    np.testing.assert_allclose(errors_of(recording, scale), 1, rtol=1e-6)


def test_packet_captures_state_the_intensity_of_white():
    scale = IntensityScale.for_recording(record(codes_of(), white=100.0))
    assert (scale.is_known, scale.codes, scale.note) == (True, VELODYNE, "")
    halves = record(codes_of(dtype=np.float32, unit=2), white=50.0)
    scale = IntensityScale.for_recording(halves)
    assert (scale.is_known, scale.white) == (True, 50.0)


@pytest.mark.parametrize("model", ["velodyne/vlp16", "hesai/pandar64", "livox/mid360"])
@pytest.mark.parametrize(("dtype", "unit"), [(np.uint8, 1), (np.float32, 1), (np.float32, 255)])
def test_the_model_determines_the_scale_of_codes(model, dtype, unit):
    sensor = load_sensor(model)
    maker = sensor.optics.reflectivity
    recording = record(codes_of(maker, dtype, unit))
    scale = IntensityScale.for_recording(recording, sensor)
    assert (scale.is_known, scale.codes, scale.note) == (True, SCALES[maker], "")
    errors = errors_of(recording, scale)
    assert np.median(errors) == pytest.approx(1, abs=0.01)
    assert np.quantile(np.abs(errors - 1), 0.9) < 0.5  # weakest codes are rounded


def test_codes_are_recognized_in_16_bit_integers():
    def columns(energy, range_m):
        codes = VELODYNE.encode(reflectances(energy, range_m)).astype(np.uint16)
        return {"intensity": codes * np.uint16(257)}

    recording = record(columns)
    scale = IntensityScale.for_recording(recording, load_sensor("velodyne/vlp16"))
    assert scale.is_known
    assert np.median(errors_of(recording, scale)) == pytest.approx(1, abs=0.01)
    codes = recording[0].columns["intensity"]
    range_m = np.linalg.norm(recording[0].points, axis=1)
    again = scale.intensities(scale.energies(codes, range_m), range_m)
    np.testing.assert_array_equal(again, codes)
    assert again.dtype == np.uint16


def test_the_reflectivity_of_a_known_sensor_is_preferred():
    def columns(energy, range_m):
        codes = SCALES["ouster"].encode(reflectances(energy, range_m)).astype(np.uint16)
        counts = np.rint(3000 * energy).astype(np.float32)
        return {"intensity": counts, "reflectivity": codes, "ambient": codes}

    recording = record(columns)
    scale = IntensityScale.for_recording(recording, load_sensor("ouster/os1-64"))
    assert (scale.column, scale.is_known, scale.note) == ("reflectivity", True, "")
    scale = IntensityScale.for_recording(recording)
    assert (scale.column, scale.is_known) == ("reflectivity", False)
    assert "on the scale of Ouster" in scale.note
    chosen = changed_recording(recording, intensity_column="intensity")
    assert IntensityScale.for_recording(chosen).column == "intensity"


# -- assumed and fitted scales ---------------------------------------------------------------


def test_codes_of_an_unknown_sensor_are_assumed_to_be_calibrated():
    recording = record(codes_of(dtype=np.float32))
    scale = IntensityScale.for_recording(recording)
    assert not scale.is_known
    assert scale.note == (
        "The intensity scale of drive.mcap is unknown. A white surface was assumed to have the "
        "intensity 100, as on the scale of Velodyne, Ouster and RoboSense. Pass `--model` to use "
        "the scale of a sensor."
    )
    assert np.median(errors_of(recording, scale)) == pytest.approx(1, abs=0.01)


def test_codes_recorded_in_fog_are_assumed_to_be_calibrated():
    def columns(energy, range_m):
        attenuated = reflectances(energy, range_m) * np.exp(-0.05 * range_m)
        return {"intensity": VELODYNE.encode(attenuated)}

    scale = IntensityScale.for_recording(record(columns))
    assert (scale.white, scale.codes) == (100, VELODYNE)


def test_livox_columns_are_recognized():
    def columns(energy, range_m):
        codes = SCALES["livox"].encode(reflectances(energy, range_m))
        return {"reflectivity": codes, "tag": np.zeros(len(codes), np.uint8)}

    recording = record(columns)
    scale = IntensityScale.for_recording(recording)
    assert "on the scale of Livox" in scale.note
    assert np.median(errors_of(recording, scale)) == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize(
    ("columns", "white"),
    [
        (energies_times(1.0), 1),  # messages with the layout of velodyne_pointcloud
        (energies_times(255.0, max_value=255.0), 255),  # nuScenes
        (energies_times(255.0, np.uint8, 255), 255),  # messages of Autoware
    ],
)
def test_energies_are_recognized(columns, white):
    recording = record(columns)
    scale = IntensityScale.for_recording(recording)
    assert (scale.white, scale.compensated, scale.is_known) == (white, False, False)
    assert "as in simulations" in scale.note
    _, energy = street(0)
    clear = (energy > 0.05) & (energy < 0.99)
    np.testing.assert_allclose(errors_of(recording, scale)[clear], 1, rtol=0.05)


@pytest.mark.parametrize("compensated", [True, False])
def test_the_white_of_an_unknown_scale_is_a_high_percentile(compensated):
    def columns(energy, range_m):
        level = reflectances(energy, range_m) if compensated else energy
        return {"intensity": np.rint(200_000 * level).clip(0, 4e9).astype(np.uint32)}

    recording = record(columns)
    scale = IntensityScale.for_recording(recording, load_sensor("velodyne/vlp16"))
    assert scale.compensated == compensated
    assert scale.white == pytest.approx(200_000 * BRIGHTEST, rel=0.02)
    distance = "" if compensated else " at 10 m"
    assert f"A white surface{distance} was assumed to have the intensity 1" in scale.note
    assert "99th percentile" in scale.note
    assert "The scale of Velodyne VLP-16 was not used" in scale.note
    errors = errors_of(recording, scale)
    assert np.median(errors) == pytest.approx(1 / BRIGHTEST, rel=0.02)
    assert np.quantile(errors, 0.9) < 1.1 * np.quantile(errors, 0.1)


def test_retroreflectors_do_not_determine_white():
    def columns(energy, range_m):
        values = 5000 * reflectances(energy, range_m)
        values[::40] = 60_000
        return {"intensity": np.rint(values).astype(np.uint16)}

    scale = IntensityScale.for_recording(record(columns))
    assert scale.white == pytest.approx(5000 * BRIGHTEST, rel=0.02)


def test_scales_on_which_surfaces_would_be_too_bright_are_fitted():
    # As in KITTI, values have steps of 0.01, and typical surfaces would be almost white.
    def columns(energy, range_m):
        values = np.floor(100 * np.minimum(reflectances(energy, range_m), 0.99)) / 100
        return {"intensity": values.astype(np.float32)}

    scale = IntensityScale.for_recording(record(columns))
    assert scale.quantization == Quantization(100, 0.99)
    assert scale.white == pytest.approx(BRIGHTEST, abs=0.01)
    implausible = record(codes_of(), brightness=20.0)
    assert "99th percentile" in IntensityScale.for_recording(implausible).note


def test_a_clear_drop_at_close_range_is_fitted_in_both_directions():
    def drop(range_m):
        return np.minimum(1, (range_m / 10) ** 2)

    def columns(energy, range_m):
        return {"intensity": (energy * drop(range_m)).astype(np.float32)}

    recording = record(columns)
    scale = IntensityScale.for_recording(recording)
    assert "below 10 m" in scale.note
    points, _ = street(0)
    range_m = np.linalg.norm(points, axis=1)
    errors = errors_of(recording, scale)
    close = range_m < 4
    assert np.median(errors[close]) > 2 * np.median(drop(range_m[close]))
    assert np.median(errors[close]) < 1.2
    values = recording[0].columns["intensity"]
    again = scale.intensities(scale.energies(values, range_m), range_m)
    np.testing.assert_array_equal(again, values)
    without_drop = IntensityScale.for_recording(record(energies_times(1.0)))
    assert without_drop.near == NearFactors()


def returns_at(range_m, height_m):
    return RecordedReturns({}, range_m, np.broadcast_to(height_m, range_m.shape))


@pytest.mark.parametrize("height_m", [1.0, -2.0])
@pytest.mark.parametrize("exponent", [0.0, -1.0, -2.0, -3.0])
def test_the_law_of_intensities_is_found_beside_saturated_ranges(exponent, height_m):
    """Values within 12 m are at the maximum, whatever the law is."""
    range_m = np.linspace(5, 39, 4000)
    values = np.minimum(200 * (12 / range_m) ** -exponent, 200)
    values[range_m < 12] = 200
    returns = returns_at(range_m, height_m)
    if exponent:
        assert is_compensated(values, returns, 200) == (exponent > -1.5)
    else:
        assert is_compensated(values, returns, 200) is None
    if exponent > -3:
        assert is_compensated(values, returns, 201) is True


def test_factors_at_close_range_are_those_of_the_intervals():
    edges = [1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 15.0]
    centers = (*(np.add(edges[:-2], edges[1:-1]) / 2).tolist(), 10.0)

    def near(factors, count=200, height_m=(0.5, -1.8)):
        """Fit factors to as many returns in each interval, from the ground and above it."""
        parts = [np.linspace(a, b, count, endpoint=False) for a, b in pairwise(edges)]
        range_m = np.tile(np.concatenate(parts), 2)
        levels = 0.3 * np.tile(np.repeat([*factors, 1.0], count), 2)
        heights = np.repeat(height_m, len(range_m) // 2)
        return NearFactors.from_returns(levels, returns_at(range_m, heights))

    drop = [0.2, 0.3, 0.6, 0.75, 0.8, 0.85, 0.9, 0.95, 1.0]
    fitted = near(drop)
    assert fitted.range_m == centers
    assert fitted.factors == pytest.approx((*drop, 1.0))
    np.testing.assert_allclose(fitted.at([0.1, 1.5, 9.0, 99.0]), [0.2, 0.25, 1, 1])
    # Two intervals with a drop are not clear, factors never decrease, and have a minimum.
    assert near([0.2, 0.6, *[1.0] * 7]) == NearFactors()
    assert near([0.2, 0.6, 0.71, *[1.0] * 6]) == NearFactors()
    assert near([0.5, 0.9, 0.4, *[0.6] * 6]).factors == pytest.approx([0.4] * 3 + [0.6] * 6 + [1])
    assert near([0.01, 0.2, 0.3, *[1.0] * 6]).factors[0] == 0.05
    # Fewer than 200 returns from the ground do not show a drop.
    assert near(drop, count=199) == NearFactors()
    assert near(drop, height_m=(0.5, 0.5)) == NearFactors()
    # Returns of the ground are at its height: what is 0.4 m higher or lower is not.
    assert near(drop, height_m=(-1.8, -1.8)).factors == pytest.approx((*drop, 1.0))


@pytest.mark.parametrize("heights_m", [(-1.4, -0.6), (-3.0, -2.2)])
def test_dark_surfaces_above_or_below_the_ground_are_no_drop(heights_m):
    """Most returns at close range come from a dark vehicle or ditch, and 250 from the ground."""
    random = np.random.default_rng(1)
    edges = [1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0]
    ground_m = [random.uniform(*ends, 250) for ends in pairwise(edges)]
    ground_m = np.concatenate([*ground_m, random.uniform(10, 15, 10_000)])
    dark_m = np.linspace(1, 3, 10_000)
    range_m = np.concatenate([ground_m, dark_m])
    height_m = np.append(np.full(len(ground_m), -1.8), random.uniform(*heights_m, len(dark_m)))
    levels = np.where(np.arange(len(range_m)) < len(ground_m), 0.3, 0.05)
    assert NearFactors.from_returns(levels, returns_at(range_m, height_m)) == NearFactors()


# -- recorded values -------------------------------------------------------------------------


def test_unchanged_returns_keep_their_exact_value():
    values = np.array([0.123456789, 0.3, 0.25])  # not on the scale
    scale = byte_scale(dtype=np.dtype(np.float64), quantization=Quantization(255, 1.0))
    energy = np.array([1.0, 2.0, 3.0])
    range_m = np.full(3, 8.0)
    same = scale.scale_intensities(values, energy, energy, range_m, range_m)
    np.testing.assert_array_equal(same, values)
    weaker = scale.scale_intensities(values, energy, [1.0, 1.0, 3.0], range_m, range_m)
    np.testing.assert_array_equal(weaker[[0, 2]], values[[0, 2]])
    assert weaker[1] == 38 / 255


def test_compensated_values_depend_on_the_new_range():
    scale = byte_scale()
    near = np.array([10.0])
    far = np.array([20.0])
    moved = scale.scale_intensities(np.array([20], np.uint8), [0.2], [0.2], near, far)
    assert moved.tolist() == [80]


def test_values_are_quantized_and_clipped():
    scale = byte_scale(dtype=np.dtype(np.float32), quantization=Quantization(1, 255))
    range_m = np.full(5, 10.0)
    values = scale.intensities(np.array([-1, 0, 0.104, 1e9, np.nan]), range_m)
    np.testing.assert_array_equal(values, [0, 0, 10, 255, 0])
    assert values.dtype == np.float32
    continuous = IntensityScale(
        "intensity", np.dtype(np.float64), Quantization(0, np.inf), 7.0, compensated=False
    )
    assert continuous.intensities(np.array([0.1]), np.array([30.0])) == pytest.approx(0.7)


def test_a_recorded_zero_is_a_weak_return():
    scale = byte_scale()
    range_m = np.array([10.0, 10.0])
    codes = np.array([0, 1], np.uint8)
    zero, one = scale.energies(codes, range_m)
    assert 0 < zero < one
    np.testing.assert_array_equal(scale.intensities(np.array([zero, one]), range_m), codes)

    def columns(energy, range_m):
        values = energy.astype(np.float32)
        values[::50] = 0
        return {"intensity": values}

    fitted = IntensityScale.for_recording(record(columns))
    values = np.zeros(1, np.float32)
    energy = fitted.energies(values, np.array([30.0]))
    assert energy > 0
    assert fitted.intensities(energy, np.array([30.0])) == 0


@pytest.mark.parametrize("invalid", [np.nan, -1.0, np.inf, -np.inf])
def test_invalid_intensities_have_a_typical_energy_and_are_not_changed(invalid):
    def columns(energy, range_m):
        values = VELODYNE.encode(reflectances(energy, range_m)).astype(np.float32)
        values[::2] = invalid
        return {"intensity": values}

    recording = record(columns)
    scale = IntensityScale.for_recording(recording, load_sensor("velodyne/vlp16"))
    assert scale.is_known
    range_m = np.array([20.0, 20.0])
    values = np.array([invalid, 40], np.float32)
    energy = scale.energies(values, range_m)
    np.testing.assert_allclose(energy, [scale.typical / 4, 0.1])
    weaker = scale.scale_intensities(values, energy, energy / 2, range_m, range_m)
    np.testing.assert_array_equal(weaker, np.array([invalid, 20], np.float32))


def test_saturated_energies_are_at_least_typical():
    recording = record(energies_times(255.0, np.uint8, 255))
    scale = IntensityScale.for_recording(recording)
    range_m = np.array([2.0, 9.0])
    energy = scale.energies(np.array([255, 255], np.uint8), range_m)
    np.testing.assert_allclose(energy, [scale.typical * 25, 1])
    np.testing.assert_array_equal(scale.intensities(energy, range_m), [255, 255])


@given(
    st.floats(2**-20, 2**20, width=32),
    st.floats(0.1, 300),
    st.sampled_from([np.float32, np.float64]),
    st.booleans(),
)
def test_continuous_values_survive_a_round_trip(value, distance, dtype, compensated):
    near = NearFactors((2.0, 10.0), (0.1, 1.0))
    scale = IntensityScale(
        "intensity", np.dtype(dtype), Quantization(0, np.inf), 61.0, compensated, near=near
    )
    values = np.array([value], dtype)
    range_m = np.array([distance])
    again = scale.intensities(scale.energies(values, range_m), range_m)
    # float64 values may differ in the last bits.
    np.testing.assert_allclose(again, values, rtol=0 if dtype is np.float32 else 1e-14)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        (np.arange(200, dtype=np.uint8), (1, 255)),
        (np.arange(0, 3000, 7, dtype=np.uint16), (1, 65_535)),
        (np.arange(200, dtype=np.float32), (1, 255)),
        (np.arange(200, dtype=np.uint16) * np.uint16(256), (1 / 256, 65_280)),
        (np.arange(200, dtype=np.float32) / np.float32(255), (255, 1)),
        (np.arange(200, dtype=np.float32) / np.float32(256), (256, 255 / 256)),
        (np.arange(100, dtype=np.float32) / np.float32(100), (100, 0.99)),
        (np.arange(101, dtype=np.float32) / np.float32(100), (100, 1)),
        (np.arange(257, dtype=np.float32) / np.float32(256), (256, 1)),
        (np.arange(300, dtype=np.float32) / np.float32(256), (256, np.inf)),
        (np.round(np.linspace(0, 3, 999), 3), (1000, np.inf)),
        (np.append(np.linspace(0, 1.2, 99) ** 2.1, [7.0] * 5), (0, 7)),
        (np.append(np.linspace(0, 1.2, 99) ** 2.1, [7.0] * 4), (0, np.inf)),
        (np.append(np.linspace(0, 1.2, 99) ** 2.1, [7.125] * 5), (0, np.inf)),
        (np.linspace(0, 1, 999) ** 2.1, (0, np.inf)),
        (np.minimum(np.linspace(0, 1.2, 999) ** 2.1, 1), (0, 1)),
    ],
)
def test_quantization(values, expected):
    assert Quantization.from_values(values) == pytest.approx(expected)


# -- without intensities ---------------------------------------------------------------------

ADVICE = (
    "so the energies of its returns are unknown. Pass `--intensity COLUMN` to use another column, "
    "or `--reflectance 0.3` to assume the same reflectance for all returns."
)


@pytest.mark.parametrize(
    ("values", "problem"),
    [
        (None, "drive.mcap has no intensity column, "),
        (0.0, "All intensities of drive.mcap are 0, "),
        (255.0, "All intensities of drive.mcap are 255, "),
        (np.nan, "The column 'intensity' of drive.mcap has no valid intensities, "),
    ],
)
def test_recordings_without_intensities_are_rejected(values, problem):
    columns = {} if values is None else {"intensity": np.full(COUNT, values)}
    recording = record(lambda energy, _: columns)
    with pytest.raises(LidarError) as error:
        IntensityScale.for_recording(recording)
    assert str(error.value) == problem + ADVICE
    assert str(pickle.loads(pickle.dumps(error.value))) == problem + ADVICE


@pytest.mark.parametrize(
    ("files", "item"), [((), "sweep 1"), (("a.pcd", "b.pcd", "c.pcd"), "b.pcd")]
)
def test_the_sweep_without_intensities_is_named(files, item):
    points = np.ones((5, 3))
    sweeps = [Sweep(points, {"intensity": np.arange(5)}), Sweep(points)]
    recording = made_recording("mix", 3, lambda number: sweeps[number % 2], files=files)
    with pytest.raises(LidarError) as error:
        IntensityScale.for_recording(recording)
    assert (
        str(error.value) == f"Unlike other sweeps, {item} in mix has no intensity column, {ADVICE}"
    )


def test_recordings_without_returns_are_rejected():
    empty = made_recording("empty.mcap", 2, lambda _: Sweep(np.zeros((5, 3))))
    with pytest.raises(LidarError, match=r"empty\.mcap has no returns in the sweeps"):
        IntensityScale.for_recording(empty)


def test_a_reflectance_can_be_assumed():
    recording = record(lambda energy, range_m: {})
    scale = IntensityScale.for_recording(recording, assumed_reflectance=0.3)
    assert (scale.column, scale.is_known) == ("", False)
    assert scale.note == "All returns are assumed to have a reflectance of 0.3."
    range_m = np.array([5.0, 20.0])
    expected = 0.3 * normal_incidence_energy(range_m)
    np.testing.assert_allclose(scale.energies(None, range_m), expected)
    np.testing.assert_allclose(scale.energies(np.array([1, 200]), range_m), expected)


@pytest.mark.parametrize("reflectance", [0, -0.1, 1.5, np.nan])
def test_assumed_reflectances_have_limits(reflectance):
    with pytest.raises(LidarError, match="assumed_reflectance"):
        IntensityScale.with_reflectance(reflectance)
