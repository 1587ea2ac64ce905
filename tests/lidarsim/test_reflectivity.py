"""Reflectivity and signal, as makers of sensors publish them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.shapes import beam_along_x, cast, wall

from lidarsim import LidarError, Material, Noise, load_sensor
from lidarsim.schema.model_names import model_names
from lidarsim.sensor.models import read_model
from lidarsim.sensor.reflectivity import SCALES

COLUMNS = ("range", "intensity", "reflectivity", "signal")


def seen(reflectance, distance, maker="velodyne", *, retro=False, **options):
    """Reflectivity and signal of a wall at right angles."""
    material = Material("*", reflectance, retro=retro)
    sensor = beam_along_x(reflectivity=maker)
    found = cast([wall("W", distance)], sensor, columns=COLUMNS, materials=[material], **options)
    assert found["reflectivity"].dtype == np.uint8 and found["signal"].dtype == np.uint16
    return int(found["reflectivity"][0]), int(found["signal"][0])


@pytest.mark.parametrize("maker", SCALES)
def test_scales_are_inverted_exactly(maker):
    scale = SCALES[maker]
    codes = np.arange(256)
    reflectances = scale.decode(codes)
    assert (np.diff(reflectances) > 0).all() and reflectances[0] == 0
    assert reflectances[-1] == pytest.approx(scale.max_reflectance)
    assert scale.encode(reflectances).tolist() == codes.tolist()
    assert scale.encode(np.array([2 * scale.max_reflectance, 1e9])).tolist() == [255, 255]


@pytest.mark.parametrize(
    ("maker", "codes"),
    [
        ("velodyne", [0, 10, 50, 100]),
        ("ouster", [0, 10, 50, 100]),
        ("vls128", [0, 11, 55, 110]),
        ("livox", [0, 15, 75, 150]),
        ("hesai", [0, 10, 50, 100]),
    ],
)
def test_diffuse_surfaces_have_the_codes_of_manuals(maker, codes):
    assert SCALES[maker].encode(np.array([0, 0.1, 0.5, 1.0])).tolist() == codes


def test_above_white_scales_are_logarithmic_or_linear():
    steps = np.log(SCALES["ouster"].decode(np.arange(100, 256)))
    assert np.diff(steps) == pytest.approx(np.log(8 * 220) / 155)
    assert SCALES["hesai"].encode(np.array([1.01, 1.5, 2.55, 220])).tolist() == [101, 150, 255, 255]


@pytest.mark.extended
@pytest.mark.parametrize("maker", SCALES)
@pytest.mark.parametrize("reflectance", [0.1, 0.5, 0.9])
def test_reflectivity_is_that_of_the_surface_at_all_ranges(reflectance, maker):
    expected = int(SCALES[maker].encode(np.array([reflectance]))[0])
    found = [seen(reflectance, distance, maker) for distance in (10.0, 30.0, 60.0)]
    assert [code for code, _ in found] == [expected] * 3
    for distance, (_, signal) in zip((10, 30, 60), found, strict=True):
        assert signal == pytest.approx(1e4 * reflectance * (10 / distance) ** 2, abs=0.5)


@pytest.mark.parametrize("maker", SCALES)
def test_retro_reflectors_are_above_white_and_signals_end(maker):
    codes, signals = zip(
        *(seen(0.9, place, maker, retro=True) for place in (10, 30, 60)), strict=True
    )
    assert len(set(codes)) == 1 and codes[0] > SCALES[maker].encode(np.ones(1))[0]
    assert signals[0] == 65_535 and signals[2] == round(1e4 * 0.9 * 220 / 36)


def test_air_and_saturation_darken_what_is_published():
    clear, bright = seen(0.5, 60)
    hazy, faint = seen(0.5, 60, visibility_km=0.5)
    assert hazy < clear and faint < bright
    full = Noise(detection_range_m=100, saturation=20)  # 0.02, as of white at 71 m
    assert seen(0.5, 60, noise=full) == (clear, bright)
    assert seen(0.5, 10, noise=full) == (2, 200)


def test_models_have_the_scales_of_their_makers():
    for name in model_names():
        maker = name.partition("/")[0]
        scale = read_model(name).optics.reflectivity
        own = {"velodyne/vls128": "vls128"}.get(name, maker if maker in SCALES else "velodyne")
        assert scale == own, name
    assert load_sensor("ouster/os1-64").optics.reflectivity == "ouster"


def test_a_scale_that_is_not_known_is_named(tmp_path):
    with pytest.raises(LidarError, match=r"reflectivity.*velodyne.*ouster.*hesai"):
        replace(beam_along_x().optics, reflectivity="acme")
    model = tmp_path / "mine.yaml"
    model.write_text("{name: Mine, firings_per_turn: 360, optics: {reflectivity: acme}}")
    with pytest.raises(LidarError, match=r"mine\.yaml.*optics\.reflectivity.*'ouster'"):
        read_model(model)
