"""Rain, snow, fog and dust: what they take, and what they send back, against closed forms."""

import math
from dataclasses import replace
from itertools import pairwise
from statistics import NormalDist

import numpy as np
import pytest
from tests.shapes import box, made, quad, wall

from lidarsim import (
    Actor,
    Beams,
    LidarError,
    Material,
    Mounted,
    Noise,
    Optics,
    Returns,
    Scene,
    SceneMesh,
    Sensor,
    Spin,
    Survey,
    Track,
)
from lidarsim import box as cuboid
from lidarsim.columns.table import CAUSES
from lidarsim.media.materials import extinction
from lidarsim.media.weather import EXIT_M, dust_coefficients, raindrops, snowflakes, spray_clumps
from lidarsim.pulses.steps.particles import highest_probabilities
from lidarsim.simulator.rig import Rig

SEEN = Noise(detection_range_m=100)
THRESHOLD = 0.1 * (10 / 100) ** 2
DIVERGENCE = 0.003
ALL = Returns("all", divergence_mrad=1000 * DIVERGENCE, pulse_ns=0)
NOTHING = SceneMesh(
    "Nothing", np.array([[0, 0, -9], [1, 0, -9], [0, 1, -9.0]]), np.array([[0, 1, 2]])
)
COLUMNS = ("ray", "range", "intensity", "reflectance", "return_number", "cause", "class")
AIR = CAUSES.index("air")
OPTICS = Optics(divergence_mrad=1000 * DIVERGENCE)


def beams(rays=20_000, max_range_m=200.0, min_range_m=0.5, **optics):
    """A sensor that fires so many beams along x, or all around if they are many."""
    optics = {"divergence_mrad": 1000 * DIVERGENCE, **optics}
    firings = -(-rays // 50_000)
    return Sensor(
        Beams(np.zeros(rays // firings)), Spin(firings, 360), min_range_m, max_range_m,
        optics=Optics(**optics),
    )  # fmt: skip


def survey_of(sensor=None, **options):
    """One scan from the origin, with all returns."""
    options = {"noise": SEEN, "returns": ALL, "columns": COLUMNS, "steps": 1, **options}
    return Survey(sensor or beams(), poses=[(0, 0, 0)], **options)


def cast(meshes=(NOTHING,), sensor=None, backend="numpy", **options):
    return made(survey_of(sensor, **options), Scene.from_meshes(meshes), backend)


def same(one, other):
    return all(np.array_equal(one[name], other[name]) for name in one)


# -- what is taken ---------------------------------------------------------------------------------


@pytest.mark.parametrize("mm_h", [1.0, 5.0, 20.0, 50.0])
def test_rain_takes_what_was_published(mm_h):
    """Of Marshall and Palmer's drops: 1.45 R^0.64 dB/km by Ulbrich and Atlas (1985)."""
    published = 1.45 * mm_h**0.64 * math.log(10) / 10  # 1/km
    assert 1000 * raindrops(mm_h).extinction == pytest.approx(published, rel=0.1)
    by_hand = math.pi * 8000e-6 / (4.1 * mm_h**-0.21) ** 3  # 2 · π/4 · N0 · 2/Λ³
    # By hand it is that of drops of all sizes; the largest drop has 6 mm.
    assert raindrops(mm_h).extinction == pytest.approx(by_hand, rel=3e-3)


@pytest.mark.parametrize("mm_h", [0.5, 1.0, 3.0])
def test_snow_falls_as_fast_as_flakes_do(mm_h):
    """The water in the air of Gunn and Marshall, and what reaches the ground: 1 m/s."""
    kind = snowflakes(mm_h)
    density = 0.1
    water = density * math.pi / 6 * kind.number * 6 / kind.slope**4 * 1e-9  # m³ in m³
    assert mm_h / 1000 / 3600 / water == pytest.approx(1.0, rel=0.08)


def test_dust_takes_and_returns_in_proportion_to_its_mass():
    assert dust_coefficients(10.0) == pytest.approx((0.006, 0.006 / 60))
    found = cast([wall("W", 60)], dust_mg_m3=2, noise=Noise(detection_range_m=50))
    assert found["intensity"][0] == pytest.approx(0.5 / 36 * math.exp(-2 * 0.0012 * 60))


@pytest.mark.extended
def test_what_the_air_takes_is_not_in_the_reflectance():
    weather = {"visibility_km": 0.5, "rain_mm_h": 10, "snow_mm_h": 0.1, "dust_mg_m3": 1}
    # What returns from less than half of the range is too little to be detected.
    noise = Noise(detection_range_m=20)
    clear, dull = (cast([wall("W", 12)], noise=noise, **some) for some in ({}, weather))
    wet = [one.extinction for one in (raindrops(10), snowflakes(0.1))]
    alpha = extinction(0.5, 905) + sum(wet) + dust_coefficients(1)[0]
    assert dull["reflectance"][0] == pytest.approx(clear["reflectance"][0])
    assert clear["intensity"][0] * math.exp(-24 * alpha) == pytest.approx(dull["intensity"][0])


# -- drops and flakes ------------------------------------------------------------------------------


def expected(number, slope, largest_mm, reflectance, alpha, edges, brighter=0.0):
    """Returns of a pulse in ranges, by integration over size and range, written out.

    Of those `brighter` times as strong as the threshold.
    """
    detected = np.vectorize(NormalDist().cdf, otypes=[float])
    size = np.linspace(0, largest_mm, 3001)[1:]
    counts = []
    for begin, end in pairwise(edges):
        rates = []
        for r in np.linspace(begin, end, 9):
            wide = math.hypot(EXIT_M, DIVERGENCE * r)
            energy = reflectance * (10 / max(r, 10)) ** 2 * math.exp(-2 * alpha * r)
            energy = energy * np.minimum(size / 1000 / wide, 1) ** 2
            drawn = energy >= max(0.5, brighter) * THRESHOLD
            seen = number * np.exp(-slope * size[drawn])
            seen = seen * detected(5 * (energy[drawn] / THRESHOLD - 1))
            rates.append(math.pi / 4 * wide**2 * seen.sum() * (size[1] - size[0]))
        counts.append(np.trapezoid(rates, dx=(end - begin) / 8))
    return np.array(counts)


@pytest.mark.extended
@pytest.mark.parametrize(
    ("weather", "rays", "given"),
    [
        ({"rain_mm_h": 50.0}, 200_000, (8000, 4.1 * 50**-0.21, 6, 0.02358)),
        (
            {"snow_mm_h": 0.4},
            20_000,
            (3800 * 0.4**-0.87 / 10 ** (1 / 3), 2.55 * 0.4**-0.48 / 10 ** (1 / 3), 20, 0.2513),
        ),
    ],
    ids=["rain", "snow"],
)
@pytest.mark.parametrize("brighter", [0.0, 1.5])
def test_numbers_of_returns_against_range(weather, rays, given, brighter):
    """Within four standard deviations in each range, and in all of them together."""
    kind = raindrops(50) if "rain_mm_h" in weather else snowflakes(0.4)
    edges = np.array([0.5, 2, 4, 6, 8, 10, 12, 16, 24])
    found = cast(sensor=beams(rays), **weather)
    assert (found["cause"] == AIR).all() and (found["object"] == -1).all()
    strong = found["intensity"] >= brighter * THRESHOLD
    counts, _ = np.histogram(found["range"][strong], edges)
    means = rays * expected(*given, kind.extinction, edges, brighter)
    assert means.sum() > 150
    assert (np.abs(counts - means) <= 4 * np.sqrt(means) + 1).all(), (counts, means)
    assert abs(counts.sum() - means.sum()) <= 3 * math.sqrt(means.sum())
    assert found["range"].max() < 40


def test_pulses_meet_a_number_of_flakes_that_is_poissons():
    found = cast(snow_mm_h=1.0, noise=Noise(detection_range_m=200))
    each = np.bincount(found["ray"], minlength=20_000)
    mean = each.mean()
    assert 3 < mean < 8
    assert each.var() == pytest.approx(mean, rel=0.05)
    none = math.exp(-mean)
    assert (each == 0).mean() == pytest.approx(none, abs=4 * math.sqrt(none / 20_000))
    assert found["return_number"].max() == each.max(), "all of them are reported"


def test_what_falls_behind_a_surface_does_not_return_and_before_it_is_the_same():
    free = cast(snow_mm_h=1.0)
    blocked = cast([wall("W", 5)], snow_mm_h=1.0, materials=[Material("*", 0.5)])
    air = blocked["cause"] == AIR
    near = free["range"] < 5
    assert 2000 < near.sum() < len(near) - 2000
    for name in ("ray", "range", "intensity", "x"):
        assert np.array_equal(blocked[name][air], free[name][near])
    assert (blocked["object"][air] == -1).all() and (blocked["object"][~air] == 0).all()
    pane = cast([wall("W", 5)], snow_mm_h=1.0, materials=[Material("*", transparent="pass")])
    assert same(pane, free), "snow falls behind a pane as well"


@pytest.mark.extended
def test_each_sub_ray_is_blocked_by_its_own_surface():
    beam = Returns("all", subrays=19, divergence_mrad=1000 * DIVERGENCE, pulse_ns=0)
    free, half = (
        cast([mesh], snow_mm_h=1.0, returns=beam) for mesh in (NOTHING, wall("W", 4, (0, 50)))
    )
    behind = [((one["cause"] == AIR) & (one["range"] > 4)).sum() for one in (free, half)]
    # The middle sub-ray and half of the others, which hit the edge, or not.
    assert behind[1] / behind[0] == pytest.approx(0.5, abs=0.06)
    before = [((one["cause"] == AIR) & (one["range"] < 4)).sum() for one in (free, half)]
    assert before[0] == before[1]
    alone = cast(snow_mm_h=1.0)
    assert len(alone["range"]) == len(free["range"]), "as many as of a beam of one ray"
    assert np.array_equal(alone["intensity"], free["intensity"])


def test_a_road_in_the_snow_is_one_return_of_a_beam_that_grazes_it():
    road = quad("Road", (0, -9, -1), (300, -9, -1), (300, 9, -1), (0, 9, -1))
    down = Sensor(
        Beams(np.radians(np.full(2000, -2.0))), Spin(1, 360), 0.5, 200,
        optics=Optics(divergence_mrad=3.0),
    )  # fmt: skip
    beam = Returns("all", subrays=19, pulse_ns=5)
    noise = Noise(detection_range_m=300)
    found = cast([road], down, snow_mm_h=1.0, returns=beam, noise=noise)
    on_road = found["ray"][found["cause"] == 0]
    assert (found["cause"] == AIR).sum() > 2000
    assert len(np.unique(on_road)) > 1900, "of the others a flake in the light on the road is"
    assert len(on_road) == len(np.unique(on_road))


# -- spray -----------------------------------------------------------------------------------------

SPRAY = CAUSES.index("spray")
WET = {"wet": 0.5, "spray_g_m3": 200.0}
SPEED = 20.0


def car(way=None, spray=True, place=(8.0, 5.0, -0.7), speed=SPEED, size=(4, 2, 1.5)):
    """A car whose rear is 3 m to the left of the sensor's beams, and that drives to the left."""
    if way is None:
        turn = [0, 0, math.sqrt(0.5), math.sqrt(0.5)]
        ends = [place, (place[0], place[1] + 2 * speed, place[2])]
        way = Track([0, 2], ends, [turn, turn], beyond="hold")
    return Actor(cuboid("Car", size), way, spray=spray)


def sprayed(actor, meshes=(NOTHING,), backend="numpy", sensor=None, **options):
    scene = Scene.from_meshes(meshes).with_actors([actor])
    return made(survey_of(sensor, **{**WET, **options}), scene, backend)


@pytest.mark.slow
def test_numbers_of_returns_from_spray():
    """Two boxes of a tenth of a second behind the car, 2 m wide, are crossed in one of them."""
    count = 25_000
    found = sprayed(car(), sensor=beams(count))
    assert (found["cause"] == SPRAY).all() and (found["object"] == -1).all()
    kind = spray_clumps(200.0)
    dense = 0.5 * (SPEED / 25) ** 2 * math.exp(-0.2 / 0.4)  # it left what is 3 m behind 0.2 s ago
    edges = np.linspace(7, 9, 5)
    given = kind.number * dense, kind.slope, kind.largest, kind.reflectance
    means = count * expected(*given, 0, edges)
    counts, _ = np.histogram(found["range"], edges)
    assert counts.sum() > len(found["range"]) - 20, "in the box, but for rounding"
    assert (np.abs(counts - means) <= 4 * np.sqrt(means)).all(), (counts, means)
    assert means.sum() > 1000
    each = np.bincount(found["ray"], minlength=count)
    assert each.var() == pytest.approx(each.mean(), rel=0.05), "Poisson's"


@pytest.mark.extended
def test_spray_takes_light_from_what_is_behind_it():
    dense = 0.5 * (SPEED / 25) ** 2 * math.exp(-0.2 / 0.4)
    with_spray, without = (sprayed(car(spray=on), [wall("W", 20)]) for on in (True, False))
    behind = with_spray["intensity"][with_spray["cause"] == 0]
    alpha = 3 * 0.2 / 0.2 * dense  # 3 M / (1000 kg/m³ d), 0.2 kg/m³, d in mm
    assert behind / without["intensity"][0] == pytest.approx(math.exp(-2 * alpha * 2), rel=1e-5)
    assert (without["cause"] == 0).all()
    before = sprayed(car(), [wall("W", 6)])
    assert same(before, sprayed(car(spray=False), [wall("W", 6)])), "nor does any return"


def test_a_wall_before_one_beam_leaves_spray_to_the_others():
    upper = beams(2000)
    meshes = [wall("W", 3, z=(-2.2, -1.2))]  # the tilted beams meet it 1.73 m below the sensor
    lone = sprayed(car(), sensor=upper)
    mixed_beams = Beams(np.repeat(np.radians([0.0, -30.0]), 2000))
    both = sprayed(car(), meshes, sensor=replace(upper, beams=mixed_beams))
    hits = both["object"] == 0
    assert hits.sum() > 1000 and both["range"][hits].max() < 4
    assert np.count_nonzero(both["cause"] == SPRAY) > 0.5 * len(lone["cause"]) > 20


def test_spray_lies_where_the_car_was():
    """On a circle of 10 m around the sensor, behind the car and within its width."""
    turns = np.radians(np.arange(0, 181, 3.0))
    places = 10 * np.column_stack([np.cos(turns), np.sin(turns), 0 * turns - 0.07])
    facing = [[0, 0, math.sin(a / 2), math.cos(a / 2)] for a in turns + math.pi / 2]
    way = Track(turns, places, facing, smooth=True, beyond="hold")  # 10 m/s
    around = Sensor(
        Beams(np.radians([0, 3])), Spin(3600, 360), 0.5, 60, optics=OPTICS, start_ns=1.5e9
    )
    found = sprayed(car(way), sensor=around, spray_g_m3=1000.0, columns=(*COLUMNS, "azimuth"))
    some = found["cause"] == SPRAY
    angle = np.radians(found["azimuth"][some])
    far = found["range"][some]
    assert some.sum() > 100 and (np.abs(far - 10) < 1.2).all()
    assert angle.max() < 1.5 and angle.min() < 0.8, "the car is at 1.5 rad and later"


def test_spray_outlasts_a_car_that_left_the_scene():
    """The car leaves 0.1 s before the beams: its last box is older."""
    turn = [0, 0, math.sqrt(0.5), math.sqrt(0.5)]
    ends = [(8.0, 5.0, -0.7), (8.0, 5.0 + 0.15 * SPEED, -0.7)]
    gone = car(Track([0, 0.15], ends, [turn, turn], beyond="absent"))
    found = sprayed(gone, sensor=replace(beams(20_000), start_ns=0.25e9))
    assert (found["cause"] == SPRAY).sum() > 100


@pytest.mark.parametrize("options", [{"speed": 2.0}, {"spray": False}])
def test_no_spray_behind_who_walks_or_raises_none(options):
    dry = sprayed(car(**options), [wall("W", 20)], spray_g_m3=0.0)
    assert same(sprayed(car(**options), [wall("W", 20)]), dry)


def test_a_flat_actor_raises_no_spray():
    with pytest.raises(LidarError, match=r"is flat, .* Use a mesh"):
        sprayed(car(size=(4, 2, 0)))


# -- fog and dust ----------------------------------------------------------------------------------


def test_fog_returns_what_hahner_et_al_have():
    """β = 0.046 / MOR; the pulse receives half of its length of it, less what the fog takes."""
    visibility_km = 0.1
    length = 0.299792458 * 10 / 2
    sensor = beams(wavelength_nm=550, min_range_m=1.0, pulse_ns=10)
    found = cast(
        sensor=sensor,
        visibility_km=visibility_km,
        fog_lidar_ratio_sr=math.log(20) / 0.046,  # 65.1, by default 65
        returns=Returns("all"),
    )
    mor = 1000 * visibility_km
    alpha = math.log(20) / mor
    beta = 0.046 / mor
    begin = 1.0
    end = 1.0 + length
    energy = math.pi * beta * (math.exp(-2 * alpha * begin) - math.exp(-2 * alpha * end))
    energy /= 2 * alpha
    first = found["range"] < end
    assert energy > 1.5 * THRESHOLD and first.mean() > 0.5
    assert found["intensity"][first] == pytest.approx(energy, rel=1e-5)
    assert (found["cause"] == AIR).all() and len(np.unique(found["ray"])) == len(found["ray"])


def test_the_peak_of_fog_is_where_signal_and_noise_are_highest():
    signals = np.array([4.0, 3.5, 3.0, 1.0])
    rng = np.random.default_rng(1)
    noisy = signals + rng.normal(size=(400_000, 4))
    table = highest_probabilities(signals)
    for count in range(1, 5):
        share = np.bincount(noisy[:, :count].argmax(axis=1), minlength=4)[:count] / 400_000
        assert np.diff(table[count, :count], prepend=0) == pytest.approx(share, abs=0.004)


def test_fog_ends_at_surfaces_and_competes_with_them():
    dense = {"visibility_km": 0.04, "fog_lidar_ratio_sr": 65.0}
    strongest = Returns("strongest", pulse_ns=5)
    near, far = (cast([wall("W", x)], returns=strongest, **dense)["cause"].mean() for x in (8, 60))
    assert near == 0 and far == 1, "the wall is stronger from near, the fog from far away"
    pairs = cast([wall("W", 3)], returns=Returns("all", pulse_ns=5), **dense)
    air = pairs["cause"] == AIR
    assert air.any() and pairs["range"][air].max() < 3
    thin = cast([wall("W", 8)], visibility_km=1.0, fog_lidar_ratio_sr=65.0, returns=strongest)
    assert (thin["cause"] == 0).all()


def test_fog_returns_light_by_default():
    dense = {"visibility_km": 0.04, "returns": Returns("all", pulse_ns=5)}
    fog = cast(**dense)
    assert len(fog["range"]) and (fog["cause"] == AIR).all()
    assert same(fog, cast(fog_lidar_ratio_sr=65.0, **dense))


def test_fog_that_is_switched_off_only_attenuates():
    dense = {"visibility_km": 0.04, "returns": Returns("all", pulse_ns=5)}
    off = dense | {"fog_lidar_ratio_sr": None}
    assert len(cast(**off)["range"]) == 0
    assert (cast([wall("W", 9)], **off)["cause"] != AIR).all()
    # Without a detection range nothing decides which light the sensor detects.
    blind = {"noise": Noise()}
    assert same(cast([wall("W", 9)], **dense, **blind), cast([wall("W", 9)], **off, **blind))
    lost = cast([wall("W", 9)], **dense, **blind)["intensity"]
    whole = cast([wall("W", 9)], returns=off["returns"], **blind)["intensity"]
    per_m = math.log(20) / 40 * (905 / 550) ** (-0.585 * (0.04 * 3.91 / math.log(20)) ** (1 / 3))
    assert lost / whole == pytest.approx(math.exp(-2 * per_m * 9), rel=0.01)


def test_a_lidar_ratio_without_fog_changes_nothing():
    walls = [wall("W", 9)]
    clear = [cast(walls, fog_lidar_ratio_sr=ratio) for ratio in (None, 18.8, 65.0)]
    assert same(clear[0], clear[1]) and same(clear[0], clear[2])


@pytest.mark.parametrize("weather", [{"snow_mm_h": 1.0}, {"dust_mg_m3": 40.0}])
def test_nothing_falls_within_water(weather):
    water = [
        Material("Water", transparent="pass", refractive_index=1.33),
        Material("*", reflectance=0.2),
    ]
    pulse_ns = 5 if "dust_mg_m3" in weather else 0
    some = {"materials": water, "returns": replace(ALL, pulse_ns=pulse_ns), **weather}
    behind = wall("Water", 3)
    facing = SceneMesh("Water", behind.vertices, behind.faces[:, ::-1])
    found = cast([facing, wall("Floor", 9)], **some)
    ranges = found["range"][found["cause"] == AIR]
    assert len(ranges) > 1000
    assert ranges.max() < 3
    open_air = cast([wall("Floor", 9)], **some | {"materials": [water[-1]]})
    alone = open_air["range"][open_air["cause"] == AIR]
    assert alone.max() > 6
    if "snow_mm_h" in weather:
        assert np.array_equal(ranges, alone[alone < 3])


@pytest.mark.extended
def test_flakes_behind_a_thick_pane_return():
    pane = box("Pane", (3, -50, -50), (3.02, 50, 50))
    glass = [
        Material("Pane", transparent="pass", refractive_index=1.5),
        Material("*", reflectance=0.2),
    ]
    for weather in ({"snow_mm_h": 1.0}, {"dust_mg_m3": 40.0}):
        some = {"materials": glass, "returns": replace(ALL, pulse_ns=5), **weather}
        found = cast([pane, wall("Floor", 9)], **some)
        assert found["range"][found["cause"] == AIR].max() > 6


def test_reflectivities_in_the_thickest_dust_are_finite():
    noise = Noise(detection_range_m=100, false_alarm_hz=1e6)
    with np.errstate(all="raise", under="ignore"):
        found = cast([wall("W", 9)], beams(200), dust_mg_m3=1e5, noise=noise)
    assert len(found["range"]) > 100
    assert np.isfinite(found["reflectance"]).all()


# -- bytes -----------------------------------------------------------------------------------------


def test_what_is_no_surface_is_gray_and_of_no_class():
    material = [Material("*", reflectance=0.2, semantic_class=7)]
    found = cast(
        [wall("W", 9)], snow_mm_h=1.0, materials=material, columns=(*COLUMNS, "red", "triangle")
    )
    air = found["cause"] == AIR
    assert {*found["class"][air].tolist()} == {0} and {*found["class"][~air].tolist()} == {7}
    assert {*found["red"].tolist()} == {188}
    assert (found["triangle"][air] == -1).all() and (found["triangle"][~air] >= 0).all()


# -- what fits together ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rain_mm_h": 5, "noise": Noise()}, r"require noise\.detection_range_m"),
        ({"dust_mg_m3": 5, "noise": Noise()}, r"require noise\.detection_range_m"),
        ({"snow_mm_h": -1}, "snow_mm_h"),
        ({"spray_g_m3": 5}, "Set wet"),
        ({**WET, "noise": Noise()}, r"require noise\.detection_range_m"),
        ({"wet": 2}, "wet"),
        (
            {"rain_mm_h": 5, "sensor": beams(divergence_mrad=None), "returns": Returns()},
            r"returns\.divergence_mrad",
        ),
        (
            {"snow_mm_h": 5, "noise": Noise(detection_range_m=1e5)},
            "drops or flakes, but the limit is",
        ),
    ],
)
def test_what_does_not_fit_is_said(options, message):
    with pytest.raises(LidarError, match=message) as refused:
        survey_of(**options)
    assert len(str(refused.value).splitlines()) == 1


def test_each_sensor_has_its_own_air():
    sensors = [Mounted(beams(5000), name=name, noise=noise) for name, noise in (
        ("far", Noise(detection_range_m=200)), ("near", Noise(detection_range_m=50)),
    )]  # fmt: skip
    survey = Survey(sensors=sensors, poses=[(0, 0, 0)], steps=1, snow_mm_h=1.0, returns=ALL)
    batches = list(Rig(Scene.from_meshes([NOTHING]), survey, "numpy").cast(0, 2))
    counts = {batch.carried.name: len(batch) for batch in batches}
    assert counts["far"] > 5 * counts["near"] > 0
    with pytest.raises(LidarError, match="of near"):
        Survey(
            sensors=[sensors[0], Mounted(beams(), name="near", noise=Noise())],
            poses=[(0, 0, 0)],
            snow_mm_h=1.0,
        )
