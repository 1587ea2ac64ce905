"""Surfaces with gaps, such as hedges and fences: which returns they and the walls behind have."""

import numpy as np
import pytest
from tests.shapes import CPU, beam_along_x, cast, cast_between, wall

from lidarsim import LidarError, Material, Noise, Returns, Scene, Sensor, Survey
from lidarsim.simulator.rig import Rig

RAYS = 40_000
SIGMA = 5.0  # allowed standard errors
HEDGE = wall("Hedge", 4)
FENCE = wall("Fence", 6)
HOUSE = wall("House", 9)
FIRST_FOUR = [wall(f"Layer {x}", x) for x in (3, 4, 5, 6)]


def share(mask):
    return float(np.mean(mask))


def standard_error(probability):
    return np.sqrt(probability * (1 - probability) / RAYS)


@pytest.mark.parametrize("backend", CPU)
def test_the_gap_fraction_of_the_pulses_passes_each_surface(backend):
    materials = [
        Material("Hedge", 0.4, gap_fraction=0.3, semantic_class=1),
        Material("Fence", 0.2, gap_fraction=0.6, semantic_class=2),
        Material("House", 0.5, semantic_class=3),
    ]
    found = cast([HEDGE, FENCE, HOUSE], beam_along_x(RAYS), backend=backend, materials=materials)
    assert len(found["range"]) == RAYS, "each pulse has one return"
    expected = {4: 0.7, 6: 0.3 * 0.4, 9: 0.3 * 0.6}
    reflectances = {4: 0.4, 6: 0.2, 9: 0.5}
    for number, (range_m, probability) in enumerate(expected.items(), 1):
        here = found["class"] == number
        assert found["range"][here] == pytest.approx(range_m, abs=1e-4)
        assert found["reflectance"][here] == pytest.approx(reflectances[range_m], abs=1e-5), (
            "light that passes through a gap is not attenuated"
        )
        assert abs(share(here) - probability) < SIGMA * standard_error(probability)


def test_subrays_pass_gaps_independently():
    """With 19 sub-rays, the energies of both returns add up to the energy of one beam."""
    materials = [Material("Hedge", 0.5, gap_fraction=0.4), Material("House", 0.5)]
    beams = {"returns": Returns("all", 19, 1.0), "materials": materials}
    found = cast([HEDGE, HOUSE], beam_along_x(2000), **beams)
    near = found["range"] < 6
    assert share(near) == pytest.approx(0.5, abs=0.01), "nearly all beams hit both"
    assert found["reflectance"][near].mean() == pytest.approx(0.5 * 0.6, rel=0.02)
    assert found["reflectance"][~near].mean() == pytest.approx(0.5 * 0.4, rel=0.02)


def test_ranges_of_a_layer_are_normally_distributed():
    materials = [Material("Hedge", 0.5, range_spread_m=0.2)]
    found = cast([HEDGE], beam_along_x(RAYS), materials=materials)
    assert len(found["range"]) == RAYS
    assert found["range"].mean() == pytest.approx(4, abs=SIGMA * 0.2 / np.sqrt(RAYS))
    assert found["range"].std() == pytest.approx(0.2, rel=SIGMA / np.sqrt(2 * RAYS))
    batch = found["batch"]
    assert np.allclose(batch.positions[:, 0], found["range"]), "points lie on their rays"
    assert np.allclose(batch.positions[:, 1:], 0, atol=1e-6)


def test_a_layer_beyond_the_range_of_the_sensor_has_no_returns():
    materials = [Material("*", 0.5, range_spread_m=0.2)]
    found = cast([HEDGE], beam_along_x(RAYS, max_range_m=4.0), materials=materials)
    assert share(found["range"] <= 4.0) == 1
    assert len(found["range"]) / RAYS == pytest.approx(0.5, abs=SIGMA * standard_error(0.5))


@pytest.mark.parametrize("backend", CPU)
def test_reflectances_have_the_mean_and_the_spread_of_the_material(backend):
    """The reflectances are normally distributed."""
    spread = 0.3
    materials = [Material("Hedge", 0.5, reflectance_spread=spread)]
    columns = ("range", "reflectance", "intensity", "reflectivity")
    found = cast([HEDGE], beam_along_x(RAYS), backend=backend, materials=materials, columns=columns)
    assert len(found["range"]) == RAYS
    assert found["range"] == pytest.approx(4, abs=1e-4)
    factor = found["reflectance"] / 0.5
    assert factor.mean() == pytest.approx(1, abs=SIGMA * spread / np.sqrt(RAYS))
    assert factor.std() == pytest.approx(spread, rel=0.01)
    for sigmas, probability in ((-1, 0.1587), (0, 0.5), (2, 0.9772)):
        below = factor < 1 + sigmas * spread
        assert abs(share(below) - probability) < SIGMA * standard_error(probability)
    assert factor.min() >= 0.019 and factor.max() <= 1.981
    assert found["intensity"] / found["intensity"].mean() == pytest.approx(
        factor / factor.mean(), rel=1e-3
    )
    assert np.corrcoef(found["reflectivity"], factor)[0, 1] > 0.98


def test_the_largest_spread_keeps_the_mean_and_all_returns():
    materials = [Material("Hedge", 0.5, reflectance_spread=0.5)]
    found = cast([HEDGE], beam_along_x(RAYS), materials=materials)
    assert len(found["range"]) == RAYS
    factor = found["reflectance"] / 0.5
    assert factor.mean() == pytest.approx(1, abs=SIGMA * 0.5 / np.sqrt(RAYS))
    assert factor.std() == pytest.approx(0.5, rel=0.06)


def test_subrays_average_the_spread():
    materials = [Material("Hedge", 0.5, reflectance_spread=0.4)]
    found = cast(
        [HEDGE], beam_along_x(4000), returns=Returns(subrays=7, divergence_mrad=1.0),
        materials=materials,
    )  # fmt: skip
    assert found["reflectance"].mean() == pytest.approx(0.5, rel=0.02)
    assert found["reflectance"].std() == pytest.approx(0.5 * 0.4 / np.sqrt(7), rel=0.1)


def test_the_detection_threshold_applies_to_the_varied_reflectances():
    materials = [Material("Hedge", 0.1, reflectance_spread=0.4)]
    noise = Noise(detection_range_m=4.0)
    found = cast([HEDGE], beam_along_x(RAYS), materials=materials, noise=noise)
    assert 0.2 < len(found["range"]) / RAYS < 0.8


def test_gaps_and_spread_depend_only_on_the_scan_and_the_beam():
    survey = Survey(
        Sensor.grid(90, 16, vertical_fov_deg=40),
        poses=[(0, 0, 0)],
        steps=6,
        columns=("ray", "range", "class", "intensity"),
        materials=[
            Material("Layer*", 0.5, gap_fraction=0.5, range_spread_m=0.05, reflectance_spread=0.3),
            Material("*", 0.5, reflectance_spread=0.2),
        ],
        noise=Noise(seed=3),
    )
    scene = Scene.from_meshes([*FIRST_FOUR, HOUSE])
    rig = Rig(scene, survey, "tiles")
    whole = cast_between(rig, survey, (0, survey.scan_count))
    assert whole == cast_between(rig, survey, (0, 1, 4, survey.scan_count))
    assert whole == cast_between(Rig(scene, survey, "numpy"), survey, (0, 2, survey.scan_count))


def test_other_seeds_and_scans_pass_other_gaps():
    def ranges(seed, steps):
        materials = [Material("Hedge", 0.5, gap_fraction=0.5), Material("*", 0.5)]
        options = {"materials": materials, "noise": Noise(seed=seed), "steps": steps}
        return cast([HEDGE, HOUSE], beam_along_x(1000), **options)["range"].reshape(steps, -1)

    first, second = ranges(1, 2)
    assert 0.4 < share(first != second) < 0.6
    assert 0.4 < share(first != ranges(2, 1)[0]) < 0.6
    assert np.array_equal(first, ranges(1, 1)[0])


def test_glass_behind_a_hedge_still_transmits_light():
    materials = [
        Material("Hedge", 0.4, gap_fraction=0.5),
        Material("Fence", transparent="pass"),
        Material("House", 0.5),
    ]
    found = cast([HEDGE, FENCE, HOUSE], beam_along_x(RAYS), materials=materials)
    assert set(found["range"].round(3)) == {4.0, 9.0}
    assert abs(share(found["range"] > 5) - 0.5) < SIGMA * standard_error(0.5)


def test_materials_without_gaps_are_unchanged():
    plain = cast([HEDGE, HOUSE], beam_along_x(100), materials=[Material("*", 0.5)])
    closed = cast(
        [HEDGE, HOUSE],
        beam_along_x(100),
        materials=[Material("House", 0.5, gap_fraction=0.5), Material("*", 0.5)],
    )
    for name in ("range", "reflectance", "returns"):
        assert np.array_equal(plain[name], closed[name])


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"gap_fraction": 1.0}, "gap_fraction"),
        ({"gap_fraction": -0.1}, "gap_fraction"),
        ({"range_spread_m": -1}, "range_spread_m"),
        ({"gap_fraction": 0.3, "transparent": "pass"}, "cannot be combined with transparent"),
        ({"range_spread_m": 0.1, "leaf_area_density": 1.0}, "leaf_area_density"),
        ({"reflectance_spread": -0.1}, "reflectance_spread"),
        ({"reflectance_spread": 0.6}, "reflectance_spread"),
        ({"reflectance_spread": 0.1, "transparent": "pass"}, "reflectance_spread cannot be"),
        ({"reflectance_spread": 0.1, "leaf_area_density": 1.0}, "leaf_area_density"),
    ],
)
def test_values_without_a_meaning_are_rejected(fields, words):
    with pytest.raises(LidarError, match=words):
        Material("*", **fields)
