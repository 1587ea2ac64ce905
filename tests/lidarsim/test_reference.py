"""Compiled loops against plain Python, pulse by pulse: see reference.py."""

from __future__ import annotations

import math

import numpy as np
import pytest
from tests.lidarsim import reference
from tests.lidarsim.reference import Hit
from tests.shapes import quad

from lidarsim import Beams, Material, Noise, Optics, Returns, Scene, Sensor, Spin, Survey
from lidarsim.casting.surfaces import SceneSurfaces, SensorLight
from lidarsim.media.weather import Air, spray_clumps
from lidarsim.numerics.random_numbers import Purpose, named_seed, raw, scan_states
from lidarsim.pulses.returns import NO_SURFACE, Keys, PulseReturns
from lidarsim.pulses.steps import spray_loops
from lidarsim.pulses.steps.detection import is_detected
from lidarsim.pulses.steps.particles import AIR, WeatherStep, exponential_quantiles, seen_by_range
from lidarsim.pulses.steps.pulse_loops import SampledHits
from lidarsim.pulses.steps.random_loops import RandomKeys
from lidarsim.pulses.steps.range_noise import noisy_ranges
from lidarsim.pulses.steps.saturation import apply_saturation
from lidarsim.pulses.steps.separation import Reporting, separate_hits
from lidarsim.pulses.steps.spray import SPRAY_DEPTH, SPRAY_DIAMETER, SPRAY_SUBRAY
from lidarsim.pulses.steps.step_list import setup_of
from lidarsim.pulses.steps.waveform import Digitizer, returns_in
from lidarsim.sensor.disc import Beam
from lidarsim.sensor.optics import FWHM, LIGHT_M_NS

GAP = 0.75
KEYS = Keys(3, np.array([0, 40, 41, 300]))
FIRST = 11  # number of the first pulse, for keys
RETRO = Material("1", 0.8, retro=True)
FOG = {"visibility_km": 0.153, "fog_lidar_ratio_sr": 20.0}
NAMES = "distance", "energy", "velocity"
KINDS = "nothing", "wall", "edge", "grazed", "panes", "clutter"


def key_of(pulse):
    """Scan of a pulse, and its number in the scan."""
    row = sum(pulse >= begin for begin in KEYS.scan_starts.tolist()) - 1
    return KEYS.scan + row, pulse - KEYS.scan_starts.tolist()[row]


def layers_of(rng, kind, ahead):
    """Surfaces that sub-rays meet: of each their ranges, NaN beyond its horizon, and normals."""

    def plane(steepest_deg, at=40.0):
        angle = math.radians(rng.uniform(0, steepest_deg))
        turn = rng.uniform(0, 2 * math.pi)
        across = math.sin(angle) * np.array([math.cos(turn), math.sin(turn)])
        normal = np.array([-math.cos(angle), *across])
        along = ahead @ normal
        far = at * normal[0] / np.where(along < 0, along, np.nan)
        return far, np.tile(normal, (len(far), 1))

    if kind == "edge":
        (near, normals), (far, _) = plane(30), plane(30, 40 + rng.uniform(0, 3))
        return [(np.where(ahead[:, 1] > rng.uniform(-0.01, 0.01), near, far), normals)]
    if kind == "grazed":
        far, normals = plane(90 - 10 ** rng.uniform(-0.2, 1.2))
        return [(far + rng.choice([0, 0.02, 0.3]) * rng.normal(size=len(far)), normals)]
    if kind == "panes":
        return [plane(89, at) for at in (30, 31, 40)[rng.integers(2) :]]
    if kind == "clutter":  # many distances differ by the gap
        places = rng.integers(40, 56, (rng.integers(1, 4), len(ahead))) / 4
        return [(far, rng.normal(size=ahead.shape)) for far in places]
    return [plane(60)] if kind == "wall" else []


def pulses_of(seed, each, airy=False, count=1000):
    """Pulses of so many sub-rays: {number: hits}; half may have some in the air."""
    rng = np.random.default_rng(seed)
    surface = 0
    ahead = np.column_stack([np.ones(each), Beam.from_divergences(each, (0.02, 0.02)).angles])
    ahead /= np.linalg.norm(ahead, axis=1)[:, None]
    pulses = {}
    for pulse in range(count):
        kind = rng.choice(KINDS)
        drops = airy and rng.random() < 0.5
        layers = layers_of(rng, kind, ahead)
        hits = []
        for subray in range(each):
            for _ in range(rng.integers(0, 3) if drops else 0):
                # often equal
                place = rng.integers(8, 56) / 4
                energy = rng.integers(0, 9) / 8
                hits.append(Hit(subray, place, energy, None, velocity=rng.normal()))
            for far, normals in layers:
                if not math.isnan(far[subray]) and rng.random() < 0.95:
                    energy = rng.integers(0, 9) / 8 if kind == "clutter" else rng.uniform(0.1, 2)
                    plane = tuple(normals[subray].tolist()), tuple(ahead[subray].tolist())
                    hit = Hit(subray, float(far[subray]), energy, surface, *plane, rng.normal())
                    hits.append(hit)
                    surface += 1
        pulses[pulse] = hits
    return pulses


def columns_of(pulses, each):
    """Columns of hits, and their planes, as the product takes them."""
    ray = [pulse * each + hit.subray for pulse, hits in pulses.items() for hit in hits]
    every = [hit for hits in pulses.values() for hit in hits]
    columns = {name: np.array([getattr(hit, name) for hit in every]) for name in NAMES}
    planes = tuple(np.array([getattr(hit, n) for hit in every]) for n in ("normal", "direction"))
    surface = [NO_SURFACE if hit.surface is None else hit.surface for hit in every]
    return PulseReturns(np.array(ray), triangle=np.array(surface, np.int32), **columns), planes


def same_returns(found, expected, tolerance=0.0):
    """Compare returns with those of the reference, {pulse: returns}; pulses have so many."""
    rows = [(pulse, one) for pulse, returns in expected.items() for one in returns]
    assert found.ray.tolist() == [pulse for pulse, _ in rows]
    surfaces = [one.strongest.surface for _, one in rows]
    assert found.triangle.tolist() == [NO_SURFACE if s is None else s for s in surfaces]
    for name in (*NAMES, "width"):
        if (column := getattr(found, name)) is not None:
            values = np.array([getattr(one, name) for _, one in rows])
            assert np.allclose(column, values, tolerance, tolerance), name
    return np.array([len(returns) for returns in expected.values()])


def test_random_bits_are_those_of_splitmix64():
    rng = np.random.default_rng(1)
    for purpose in Purpose.declared.values():
        seed, scan, ray, number = (rng.integers(2**n, size=1) for n in (63, 40, 32, 8))
        key = int(scan[0]), int(ray[0])
        mine = reference.bits(int(seed[0]), purpose, key, int(number[0]))
        assert raw(seed[0], purpose, scan, ray, number).tolist() == [mine]


@pytest.mark.slow(every=5)
@pytest.mark.parametrize("planes", [False, True])
@pytest.mark.parametrize("airy", [False, True])
@pytest.mark.parametrize("each", [1, 7, 19])
def test_returns_are_those_of_the_twin(each, airy, planes):
    """All columns to the bit."""
    pulses = pulses_of(each, each, airy)
    hits, normals = columns_of(pulses, each)
    solid = hits.triangle != NO_SURFACE
    ground = hits.take(solid)
    flies = hits.take(~solid)
    given = tuple(one[solid] for one in normals) if planes else None
    air = flies._replace(cause=np.full(len(flies.ray), AIR)) if airy else None
    found = separate_hits(ground, GAP, each, given, air)
    expected = {k: reference.separated(own, GAP, each, planes) for k, own in pulses.items()}
    counts = same_returns(found, expected)
    assert {0, 1, 2} <= {*counts.tolist()}
    if planes and each > 1:  # surfaces that continue are a part of what is compared
        assert counts.sum() < 0.95 * len(separate_hits(ground, GAP, each, None, air).ray)
    if airy:
        assert np.array_equal(found.cause == AIR, found.triangle == NO_SURFACE)


@pytest.mark.slow
@pytest.mark.parametrize("waves", [False, True])
@pytest.mark.parametrize("full", [0.01, 0.1])
def test_saturation_is_that_of_the_twin(full, waves):
    """Within 1e-9: logarithms round. Most pulses are clipped, and some returns joined."""
    pulses = pulses_of(30, 7, airy=True)
    digitizer = Digitizer(2.0, 1.0, decomposes=False)
    hits, planes = columns_of(pulses, 7)
    if waves:
        returns = returns_in(hits, digitizer, 7, planes)
        width_ns = FWHM * digitizer.sigma_ns
        given = {
            k: reference.waveform_returns(own, digitizer, 7, True) for k, own in pulses.items()
        }
    else:
        solid = hits.triangle != NO_SURFACE
        width_ns = 2 * GAP / LIGHT_M_NS
        ground = tuple(one[solid] for one in planes)
        flies = hits.take(~solid)
        flies = flies._replace(cause=np.full(len(flies.ray), AIR))
        returns = separate_hits(hits.take(solid), GAP, 7, ground, flies)
        given = {k: reference.separated(own, GAP, 7, True) for k, own in pulses.items()}
    found = apply_saturation(returns, full, width_ns)
    length = width_ns * LIGHT_M_NS / 2
    expected = {k: reference.saturated(own, full, length, waves) for k, own in given.items()}
    found = found._replace(width=found.width / width_ns, velocity=None)
    same_returns(found, expected, 1e-9)
    assert len(found.ray) < len(returns.ray) - 20 and found.amplitude.max() == full
    assert (found.amplitude == full).mean() > 0.1


@pytest.mark.extended
@pytest.mark.slow(every=4)
@pytest.mark.parametrize("mode", ["all", "first", "last", "strongest", "dual", "two_strongest"])
@pytest.mark.parametrize("losses", [{}, {"dropout": 0.2}, {"detection_range_m": 4.0}])
def test_reported_returns_are_those_of_the_twin(mode, losses):
    """All columns to the bit; equally strong returns are among them."""
    pulses = pulses_of(2, 7)
    noise = Noise(**losses, seed=5)
    hits, planes = columns_of(pulses, 7)
    found = separate_hits(hits, GAP, 7, planes, reporting=Reporting(mode, noise, KEYS, FIRST))
    expected = {}
    for pulse, own in pulses.items():
        key = key_of(FIRST + pulse)
        returns = reference.separated(own, GAP, 7, True)
        seen = [
            one for k, one in enumerate(returns) if reference.detected(one.energy, k, key, noise)
        ]
        expected[FIRST + pulse] = reference.reported(seen, mode)
    counts = same_returns(found, expected)
    assert mode == "all" or counts.max() == (2 if mode in ("dual", "two_strongest") else 1)


@pytest.mark.parametrize(
    ("noise", "tolerance_m"),
    [
        (Noise(0.02, 0.001, dropout=0.1, seed=2**62), 0),
        (Noise(0.02, detection_range_m=50, range_at_threshold_m=0.05), 0),
        (Noise(0.02, 0.001, detection_range_m=50, range_at_threshold_m=0.05, walk_m=0.1), 1e-12),
    ],
)
def test_noise_is_that_of_the_twin(noise, tolerance_m):
    """To the bit but for range walk, whose logarithm is the product's own."""
    rng = np.random.default_rng(4)
    ray = np.arange(2000) // 4
    number = np.arange(2000) % 4
    distance = rng.uniform(0.01, 200, 2000)
    energy = 0.004 * 10 ** rng.uniform(-0.2, 0.2, 2000)
    assert noise.threshold == (
        0.1 * reference.energy_of(1, 50, 0) if noise.detection_range_m else 0
    )
    seen = is_detected(noise, energy, *KEYS.scan_and_number(ray), number)
    ranges = noisy_ranges(noise, distance, energy, *KEYS.scan_and_number(ray), number)
    columns = (column.tolist() for column in (distance, energy, number, ray))
    rows = [(r, e, n, key_of(pulse)) for r, e, n, pulse in zip(*columns, strict=True)]
    assert seen.tolist() == [reference.detected(*row, noise) for _, *row in rows]
    assert 0.2 < seen.mean() < 0.95
    assert np.abs(ranges - [reference.range_of(*row, noise) for row in rows]).max() <= tolerance_m


@pytest.mark.parametrize("extinction", [0.0, 0.02])
def test_energies_are_those_of_the_twin(extinction):
    """For given cosines to the bit, but for the exponential; cosines within 1e-6."""
    rng = np.random.default_rng(6)
    corners = rng.normal(size=(2, 3, 3))
    materials = (Material("0", 0.3), RETRO)
    meshes = [quad(f"{k}", a, b, c, c + a - b) for k, (a, b, c) in enumerate(corners)]
    surfaces = SceneSurfaces(Scene.from_meshes(meshes), materials)
    light = SensorLight(905.0, extinction)
    wall = rng.integers(0, 2, 1000)
    distance = rng.uniform(0.5, 200, 1000)
    ahead = rng.normal(size=(1000, 3))
    normals = np.cross(*np.diff(corners, axis=1).swapaxes(0, 1))
    ahead, normals = (v / np.linalg.norm(v, axis=1)[:, None] for v in (ahead, normals))
    triangle = (2 * wall + rng.integers(0, 2, 1000)).astype(np.int32)
    lit = surfaces.illuminate(triangle, ahead, distance, light, np.zeros(1000), ())
    assert lit.kinds.tolist() == wall.tolist()
    assert np.allclose(lit.cosines, (normals[wall] * ahead).sum(axis=1), 0, 1e-6)
    cosine = np.abs(lit.cosines)
    back = np.where(wall == 1, 0.8 * 220, 0.3 * cosine)
    rows = zip(back.tolist(), distance.tolist(), strict=True)
    expected = [reference.energy_of(*row, extinction) for row in rows]
    tolerance = 1e-14 if extinction else 0
    assert np.allclose(lit.energy, expected, tolerance, 0)
    assert np.allclose(surfaces.energy(triangle, cosine, distance, light), expected, tolerance, 0)


@pytest.mark.extended(every=4)
@pytest.mark.parametrize("each", [1, 7])
@pytest.mark.parametrize("weather", [{"rain_mm_h": 50}, {"rain_mm_h": 20, "snow_mm_h": 1}, FOG])
def test_what_the_air_returns_is_as_in_the_twin(weather, each):
    """Sub-rays and ranges to the bit; energies within 1e-5: tables are in single precision."""
    noise = Noise(detection_range_m=100.0, overlap_m=4.0, seed=9)
    sensor = Sensor(Beams([0.0]), Spin(1, 360), 0.5, 150, optics=Optics(divergence_mrad=3))
    options = {"noise": noise, "returns": Returns("all", subrays=each), **weather}
    materials = Material("Pane", transparent="pass"), Material("*")
    survey = Survey(sensor, poses=[(0, 0, 0)], steps=1, materials=materials, **options)
    corners = (0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)
    scene = Scene.from_meshes([quad(name, *corners) for name in ("Wall", "Pane")])
    surfaces = SceneSurfaces(scene, survey.materials)
    caster = WeatherStep(setup_of(scene, survey, 0), None, surfaces)
    # Sub-rays hit nothing, a wall, a pane, or a pane a meter before a wall.
    rng = np.random.default_rng(7)
    count = 1500
    what = rng.integers(0, 4, count * each)
    place = rng.uniform(1, 60, count * each)
    reach = np.where(what == 1, place, np.where(what == 3, place + 1, np.inf)).reshape(count, each)
    ray = np.repeat(np.arange(count * each), [0, 1, 1, 2] @ (what == np.arange(4)[:, None]))
    second = np.diff(ray, prepend=-1) == 0
    triangle = np.where((what[ray] == 1) | second, 0, 2).astype(np.int32)
    hits = PulseReturns(ray, place[ray] + second, triangle, np.ones(len(ray)))
    found = caster.sample_air_hits(hits, (FIRST, FIRST + count), KEYS, each)
    air = survey.air(0)
    cloud = caster.fog_cells
    expected = []
    for pulse in range(count):
        own = reach[pulse].tolist()
        key = key_of(FIRST + pulse)
        drawn = []
        for number, (kind, seen) in enumerate(
            zip(survey.particles, caster.detectable_kinds, strict=True)
        ):
            precipitation = reference.Precipitation(kind, air, noise.threshold)
            seed = named_seed(9, "kind 1" if number else "")
            tables = seen.counts, seen.by_range[:, 0].astype(float)
            drawn += reference.particles(precipitation, seed, key, own, tables)
        if cloud is not None:
            table = cloud.peaks.reshape(-1, len(cloud.energy))
            peaks = table - np.arange(len(table))[:, None]
            cells = reference.FogCells(0.5, cloud.cell_m, peaks)
            drawn += reference.fog(survey.backscatter_at(905.0), air, 9, key, own, cells)
        drawn.sort(key=lambda one: one.subray)
        expected += [(pulse * each + one.subray, one.distance, one.energy) for one in drawn]
    ray, distance, energy = map(np.array, zip(*expected, strict=True))
    assert np.array_equal(found.ray, ray) and len(ray) > 200
    assert np.array_equal(found.distance, distance)
    assert np.allclose(found.energy, energy, 1e-5, 0)


@pytest.mark.extended
@pytest.mark.parametrize("each", [1, 7])
def test_clumps_of_spray_are_those_of_the_twin(each):
    """Sub-rays and ranges to the bit, energies as those of drops; and what spray takes."""
    rng = np.random.default_rng(8)
    count = 300
    noise = Noise(detection_range_m=100.0, seed=9)
    kind = spray_clumps(50.0)
    air = Air(0.0, 0.01, 0.003, 10.0)
    mean, tables = seen_by_range(air, kind, noise.threshold / 2, 0.5, 150.0)
    beam = np.sort(rng.integers(0, count, 500))
    low = rng.uniform(0, 30, 500)
    crossed = np.stack([low, low + rng.uniform(0, 4, 500), rng.uniform(0, 2, 500)])
    far = np.where(rng.random(count * each) < 0.5, rng.uniform(1, 40, count * each), np.inf)
    hits = np.flatnonzero(far < np.inf)
    place = far[hits]
    light = np.ones(len(hits))
    crossings = spray_loops.BoxCrossings(beam, crossed)
    spray_loops.attenuate(crossings, each, 0.1, far, SampledHits(hits, place, light))
    purposes = SPRAY_DEPTH, SPRAY_SUBRAY, SPRAY_DIAMETER
    states = scan_states(9, purposes, KEYS.scan + np.arange(len(KEYS.scan_starts)))
    keys = RandomKeys(states, KEYS.scan_starts, FIRST)
    out = SampledHits(np.empty(4000, np.int64), *np.empty((2, 4000)))
    clumps = []
    left = []
    precipitation = reference.Precipitation(kind, air, noise.threshold)
    table = spray_loops.ClumpTables(mean, tables, 1 / kind.slope, exponential_quantiles())
    stop, many = spray_loops.sample_clumps(0, crossings, each, table, keys, far, out)
    assert stop == len(beam) and many > 300
    for pulse in range(count):
        boxes = [tuple(one) for one in crossed[:, beam == pulse].T.tolist()]
        own = far[pulse * each : (pulse + 1) * each].tolist()
        key = key_of(FIRST + pulse)
        seen = reference.clumps(
            precipitation, 9, key, own, boxes, (mean, tables[:, 0].astype(float))
        )
        clumps += [(pulse * each + one.subray, one.distance, one.energy) for one in seen]
        left += [reference.veiled(end, boxes, 0.1) for end in own if end < np.inf]
    ray, distance, energy = map(np.array, zip(*clumps, strict=True))
    assert np.array_equal(out[0][:many], ray) and np.array_equal(out[1][:many], distance)
    assert np.allclose(out[2][:many], energy, 1e-5, 0)
    assert np.allclose(light, left, 1e-14, 0) and min(left) < 0.9


@pytest.mark.extended(every=4)
@pytest.mark.parametrize("planes", [False, True])
@pytest.mark.parametrize("each", [1, 7, 19])
def test_peaks_of_waveforms_are_those_of_the_twin(each, planes):
    """Pulses and triangles are the same, other columns within 1e-9: logarithms round."""
    digitizer = Digitizer(2.0, 1.0, decomposes=False)
    pulses = pulses_of(10 + each, each, airy=True, count=300)
    hits, normals = columns_of(pulses, each)
    found = returns_in(hits, digitizer, each, normals if planes else None)
    found = found._replace(width=found.width / (FWHM * digitizer.sigma_ns))
    expected = {
        k: reference.waveform_returns(own, digitizer, each, planes) for k, own in pulses.items()
    }
    same_returns(found, expected, 1e-9)
    assert (found.width > 1.05).sum() > 10


@pytest.mark.extended
@pytest.mark.parametrize("each", [1, 7, 19])
def test_decomposition_gives_pulses_back(each):
    """Energies of pulses within a hundredth; narrow echoes 3 sigma from others within 1 mm."""
    digitizer = Digitizer(2.0, 1.0, decomposes=True)
    compared = 0
    pulses = pulses_of(20 + each, each, airy=True, count=300)
    found = returns_in(columns_of(pulses, each)[0], digitizer, each)
    for pulse, own in pulses.items():
        truth = reference.separated(own, digitizer.sigma_m / 4, each, False)
        places, energies = (np.array([getattr(one, name) for one in truth]) for name in NAMES[:2])
        some = found.take(found.ray == pulse)
        assert some.energy.sum() == pytest.approx(energies.sum(), rel=0.01)
        narrow = (some.width < 1.02 * FWHM * digitizer.sigma_ns).all()
        if len(places) > 1 and np.diff(places).min() > 3 * digitizer.sigma_m and narrow:
            assert np.allclose(some.distance, places, 0, 1e-3)
            assert np.allclose(some.energy, energies, 0, 2e-3)
            compared += 1
    assert compared > 10
