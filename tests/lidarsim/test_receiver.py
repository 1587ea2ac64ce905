"""What a receiver does: noise and walk of ranges by energy, false alarms, stray light."""

from __future__ import annotations

import math
from dataclasses import replace
from statistics import NormalDist

import numpy as np
import pytest
from tests.shapes import Cart, beam_along_x, cast, cast_between, made, wall

from lidarsim import (
    Actor,
    Beams,
    LidarError,
    Material,
    Mounted,
    Noise,
    Optics,
    Pose,
    Returns,
    Scene,
    SceneInstance,
    SceneMesh,
    Sensor,
    Spin,
    Survey,
)
from lidarsim.columns.table import AXES, SCAN
from lidarsim.columns.waveforms import WAVEFORM
from lidarsim.pulses.returns import SURFACE
from lidarsim.pulses.steps.crosstalk import CROSSTALK
from lidarsim.pulses.steps.false_alarms import FALSE_ALARM
from lidarsim.pulses.steps.stray_light import BLOOMING
from lidarsim.sensor.noise import THRESHOLD_SIGMAS
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.rig import Rig
from raybeam import available_backends

WHITE = [Material("*", reflectance=1.0)]
FAR = 100.0  # detection range: a threshold of 0.001
THRESHOLD = 0.1 * (10 / FAR) ** 2
LIGHT_M_S = 299_792_458.0
COLUMNS = ("ray", "range", "intensity", "return_number", "returns", "cause", "object", "class")


def within(count, expected, spread=None):
    """Whether a count is within 4 standard deviations of what is expected."""
    return abs(count - expected) <= 4 * math.sqrt(expected if spread is None else spread)


# -- ranges by energy ----------------------------------------------------------------------------


def ranges_at(distance, noise, count=20_000):
    """Ranges of a white wall, in so many rays."""
    sensor = beam_along_x(count)
    found = cast([wall("W", distance)], sensor, noise=noise, materials=WHITE, columns=COLUMNS)
    return found["range"]


def test_weak_returns_are_noisier_by_the_threshold_over_their_energy():
    noise = Noise(0.01, detection_range_m=FAR, range_at_threshold_m=0.08)
    for distance in (20.0, 100.0, 200.0):
        energy = (10 / distance) ** 2
        expected = math.hypot(0.01, 0.08 * THRESHOLD / energy)
        found = ranges_at(distance, noise)
        # The standard deviation of n normal deviates has a standard error of 1 / sqrt(2 n).
        assert np.std(found) == pytest.approx(expected, rel=4 / math.sqrt(2 * len(found)))
        assert np.mean(found) == pytest.approx(distance, abs=4 * expected / len(found) ** 0.5)


def test_strong_returns_appear_nearer_as_of_a_gaussian_pulse_over_a_threshold():
    noise = Noise(detection_range_m=FAR, walk_m=0.1)
    for distance in (5.0, 100.0, 250.0):
        ratio = (10 / distance) ** 2 / THRESHOLD
        found = ranges_at(distance, noise, 10)
        # exp(-x² / 2) · ratio = 1 where the pulse crosses the threshold
        x = (distance - found) / 0.1
        assert ratio * np.exp(-(x**2) / 2) == pytest.approx(1, rel=1e-4)
    sign = [Material("*", reflectance=1.0, retro=True)]
    sign_at = cast([wall("W", 50)], noise=noise, materials=sign, columns=COLUMNS)["range"][0]
    plain = cast([wall("W", 50)], noise=noise, materials=WHITE, columns=COLUMNS)["range"][0]
    assert 0.1 < plain - sign_at < 0.3, "a sign appears nearer than a wall beside it"


@pytest.mark.parametrize(
    "field", ["range_at_threshold_m", "walk_m", "false_alarm_hz", "stray_light", "saturation"]
)
def test_what_is_measured_by_the_threshold_needs_one(field):
    with pytest.raises(LidarError, match=rf"noise\.{field} .*requires noise\.detection_range_m"):
        Noise(**{field: 1 if field == "saturation" else 0.1})


# -- saturation ----------------------------------------------------------------------------------

FULL = Noise(detection_range_m=FAR, saturation=50)  # as by a white wall at 44.7 m
QUARTER = LIGHT_M_S * 1e-9 / 4  # meters of range by which an edge is off, for each ns of width
PULSES = ("ray", "range", "intensity", "amplitude", "pulse_width", "object")


def width_ns(over):
    """Width of a Gaussian pulse of 5 ns that is so many times as high as what is recorded."""
    sigma = 5 / math.sqrt(8 * math.log(2))
    return 2 * sigma * math.sqrt(2 * math.log(2 * over))  # over · exp(-t² / 2σ²) = 1 / 2


def full(meshes, noise=FULL, retro="none", **options):
    """Returns of one pulse; an object may be retro-reflective."""
    materials = [Material(retro, 1.0, retro=True), *WHITE] if retro != "none" else WHITE
    return cast(meshes, noise=noise, materials=materials, columns=PULSES, **options)


@pytest.mark.slow(every=4)
@pytest.mark.parametrize("waveform", ["none", "peaks", "gaussian"])
@pytest.mark.parametrize("distance", [2.0, 10.0, 40.0, 44.8, 90.0])
def test_a_full_receiver_clips_and_widens(distance, waveform):
    found = full([wall("W", distance)], returns=Returns(waveform=waveform))
    energy = (10 / distance) ** 2
    over = max(energy / (50 * THRESHOLD), 1)
    assert found["intensity"] == pytest.approx([energy])
    assert found["amplitude"] == pytest.approx([min(energy, 50 * THRESHOLD)])
    assert found["pulse_width"] == pytest.approx([width_ns(over)])
    early = 0 if waveform == "none" else QUARTER * (width_ns(over) - 5)  # leading edge
    assert found["range"] == pytest.approx([distance - early])


@pytest.mark.extended
@pytest.mark.parametrize("apart", [0.99, 1.01])
@pytest.mark.parametrize("waveform", ["none", "peaks"])
def test_returns_within_a_full_pulse_are_one(apart, waveform):
    """Half of a beam hits each wall: twice as far apart as without saturation, and farther."""
    over = [0.5 * (10 / distance) ** 2 / 0.05 for distance in (10, 11.4)]
    gap = QUARTER * sum(map(width_ns, over))
    assert gap > 1.4
    meshes = [wall("Near", 10, y=(0, 50)), wall("Far", 10 + apart * gap)]
    beam = Returns("all", subrays=217, divergence_mrad=1, waveform=waveform)
    found = full(meshes, returns=beam, precision_m=1e-4)
    plain = full(meshes, Noise(detection_range_m=FAR), returns=beam)
    assert len(plain["range"]) == 2
    assert found["intensity"].sum() == pytest.approx(plain["intensity"].sum())
    if apart > 1:
        assert len(found["range"]) == 2
        return
    early = 0 if waveform == "none" else QUARTER * (width_ns(over[0]) - 5)
    assert found["object"].tolist() == [0], "the stronger is reported"
    assert found["range"] == pytest.approx([10 - early], abs=0.01)
    assert found["pulse_width"] == pytest.approx([gap / QUARTER], rel=0.02)


def test_a_sign_hides_what_is_weak_before_and_behind():
    """A wire, and a wall, 1.5 m from a sign; where the sign is a plain board, both are there."""
    meshes = [
        wall("Wire", 18.5, y=(-0.001, 0.001)), wall("Sign", 20, y=(-50, 0.003)), wall("W", 21.5),
    ]  # fmt: skip
    beam = Returns("all", subrays=217, divergence_mrad=1)
    assert full(meshes, returns=beam)["object"].tolist() == [0, 1, 2]
    assert full(meshes, retro="Sign", returns=beam)["object"].tolist() == [1]
    far = replace(FULL, saturation=1e9)
    assert full(meshes, far, retro="Sign", returns=beam)["object"].tolist() == [0, 1, 2]


def test_of_two_clipped_returns_the_nearest_is_the_strongest():
    meshes = [wall("Near", 10, y=(0.002, 50)), wall("Far", 20)]
    beam = Returns("strongest", subrays=217, divergence_mrad=1)
    assert full(meshes, Noise(detection_range_m=FAR), returns=beam, retro="Far")["object"] == [1]
    assert full(meshes, returns=beam, retro="Far")["object"] == [0]


def test_walk_is_that_of_the_whole_pulse():
    walks = replace(FULL, walk_m=0.1)
    plain = replace(walks, saturation=None)
    ranges = [full([wall("W", 2)], noise)["range"] for noise in (walks, plain)]
    assert np.array_equal(*ranges) and ranges[0] < 1.7


def test_recorded_samples_are_clipped():
    options = {"columns": PULSES, "waveform_samples": 60, "materials": WHITE, "poses": [(0, 0, 0)]}
    scene = Scene.from_meshes([wall("W", 10)])
    beam = Returns(waveform="peaks")
    survey = Survey(beam_along_x(), noise=FULL, returns=beam, steps=1, **options)
    part = columns_of(list(Rig(scene, survey, "numpy").cast(0, 1)))
    table = (SCAN, *(c for c in survey.stored_columns if c not in AXES and c.name != WAVEFORM))
    waves = part.cloud(table, survey.precision_m, np.zeros(3)).waveforms
    samples = waves.samples[0]
    full_at = 50 * THRESHOLD
    assert samples.max() == pytest.approx(full_at, rel=1e-3)
    above = np.flatnonzero(samples > full_at / 2)
    assert abs(len(above) - width_ns(1 / full_at)) < 1.5, "samples are 1 ns apart"
    edge = waves.times_ns[0][above[0]] * LIGHT_M_S / 2e9
    assert part.columns["range"] == pytest.approx([edge + 5 * QUARTER], abs=0.15), "calibrated"
    assert np.count_nonzero(samples > 0.99 * full_at) >= 8, "a plateau, with noise below"


# -- false alarms --------------------------------------------------------------------------------

GATE = 150.0  # meters
RATE = 1e5  # a second: 0.1 in a gate of 1 µs


def alarmed(meshes=(), rays=20_000, mode="all", **noise):
    """Points of one firing with false alarms; by default of a scene that no ray hits."""
    noise = Noise(detection_range_m=FAR, false_alarm_hz=RATE, **noise)
    meshes = meshes or [wall("B", -10)]
    returns = Returns(mode)
    return cast(
        meshes,
        beam_along_x(rays, GATE),
        noise=noise,
        returns=returns,
        materials=WHITE,
        columns=COLUMNS,
    )


def test_false_alarms_come_at_their_rate_where_nothing_is():
    found = alarmed()
    mean = RATE * 2 * GATE / LIGHT_M_S
    assert within(len(found["range"]), 20_000 * mean), "a Poisson count"
    assert set(found["cause"].tolist()) == {FALSE_ALARM}
    assert set(found["object"].tolist()) == {-1}
    assert set(found["class"].tolist()) == {0}
    several = np.bincount(np.bincount(found["ray"], minlength=20_000), minlength=3)
    for number in range(3):  # of a pulse, Poisson's shares
        share = math.exp(-mean) * mean**number / math.factorial(number)
        assert within(several[number], 20_000 * share, 20_000 * share * (1 - share))
    spread = np.histogram(found["range"], bins=10, range=(0, GATE))[0]
    assert np.all(np.abs(spread - spread.mean()) < 4 * spread.mean() ** 0.5), "at all ranges alike"


def test_false_alarms_are_just_above_the_threshold():
    energy = alarmed(rays=60_000)["intensity"] / THRESHOLD
    assert energy.min() >= 1 - 1e-6
    # Rayleigh's distribution above five standard deviations
    for above in (1.02, 1.05, 1.1):
        share = math.exp(-(THRESHOLD_SIGMAS**2) / 2 * (above**2 - 1))
        count = len(energy)
        assert within((energy > above).sum(), count * share, count * share * (1 - share))


def test_false_alarms_before_a_wall_are_first_returns():
    found = alarmed([wall("W", 75)], mode="first")
    mean = RATE * 2 * 75 / LIGHT_M_S
    expected = 20_000 * (1 - math.exp(-mean))
    assert within((found["cause"] == FALSE_ALARM).sum(), expected)
    assert len(found["ray"]) == 20_000, "each ray has one return"
    assert found["range"][found["cause"] == SURFACE] == pytest.approx(75)


def test_a_strong_wall_wins_over_false_alarms():
    strongest = alarmed([wall("W", 75)], mode="strongest")
    assert set(strongest["cause"].tolist()) == {SURFACE}
    both = alarmed([wall("W", 75)], mode="all")
    assert both["returns"].max() >= 2
    assert (both["cause"] == SURFACE).sum() == 20_000


def test_false_alarms_need_a_greatest_range():
    noise = Noise(detection_range_m=FAR, false_alarm_hz=100)
    with pytest.raises(LidarError, match=r"has none. Set max_range_m"):
        Survey(beam_along_x(), poses=[(0, 0, 0)], steps=1, noise=noise)
    with pytest.raises(LidarError, match="667 false alarms per pulse, but the limit is 20"):
        Survey(
            beam_along_x(1, 100.0),
            poses=[(0, 0, 0)],
            steps=1,
            noise=replace(noise, false_alarm_hz=1e9),
        )


# -- blooming ------------------------------------------------------------------------------------

SIGN = [Material("S", reflectance=1.0, retro=True), Material("*", reflectance=0.5)]


def sign(x=20.0, half=0.25, y=0.0):
    """A square sign across the x axis."""
    return wall("S", x, (y - half, y + half), (-half, half))


def window(step_deg=0.1, half_deg=4.0, max_range_m=200.0):
    """A sensor whose rays are a grid of directions around x, and those directions."""
    angles = np.radians(np.arange(-half_deg, half_deg + step_deg / 2, step_deg))
    up, across = (grid.reshape(-1) for grid in np.meshgrid(angles, angles, indexing="ij"))
    sensor = Sensor(Beams(up, across), Spin(1, 360), 0.0, max_range_m)
    ahead = np.stack([np.cos(up) * np.cos(across), np.cos(up) * np.sin(across), np.sin(up)], 1)
    return sensor, ahead


def off_square(ahead, x, half):
    """Angles in degrees between directions and the nearest point of a square across x."""
    y = ahead[:, 1] / ahead[:, 0] * x
    z = ahead[:, 2] / ahead[:, 0] * x
    off = np.full(len(ahead), np.inf)
    edge = np.linspace(-half, half, 401)
    for side in (-half, half):
        for ends in ((edge, np.full(401, side)), (np.full(401, side), edge)):
            points = np.stack([np.full(401, x), *ends], axis=1)
            points /= np.linalg.norm(points, axis=1, keepdims=True)
            cosine = (ahead @ points.T).max(axis=1)
            off = np.minimum(off, np.degrees(np.arccos(np.minimum(cosine, 1))))
    off[(np.abs(y) <= half) & (np.abs(z) <= half)] = 0
    return off


@pytest.mark.parametrize("backend", [name for name, why in available_backends().items() if not why])
def test_a_sign_blooms_over_the_angle_where_its_stray_light_passes_the_threshold(backend):
    stray = 3e-6
    noise = Noise(detection_range_m=FAR, stray_light=stray)
    sensor, ahead = window()
    found = cast([sign()], sensor, backend=backend, noise=noise, materials=SIGN, columns=COLUMNS)
    bloom = found["cause"] == BLOOMING
    off = off_square(ahead, 20.0, 0.25)
    strong = 220 * (10 / 20) ** 2 / THRESHOLD  # of the sign, in thresholds
    with np.errstate(divide="ignore"):
        share = np.array([NormalDist().cdf(5 * (strong * stray / a**2 - 1)) for a in off + 1e-9])
    share[off == 0] = 0  # hits the sign itself
    assert within(bloom.sum(), share.sum(), (share * (1 - share)).sum() + 0.005 * share.sum())
    radius = math.sqrt(strong * stray)
    assert radius == pytest.approx(0.406, abs=0.001)
    seen = np.zeros(len(ahead), bool)
    seen[found["ray"][bloom]] = True
    assert seen[(off > 0) & (off < 0.75 * radius)].all(), "all rays well within"
    assert not seen[off > 2 * radius].any()
    assert found["range"][bloom] == pytest.approx(20.0, rel=0.001), "at the sign's range"
    assert set(found["object"][bloom].tolist()) == {-1}
    assert (found["cause"] == SURFACE).sum() == (off == 0).sum()


def test_stray_light_comes_from_the_nearest_point_of_a_slanted_sign():
    corners = np.array([[20, -3, -0.5], [26, 3, -0.5], [26, 3, 0.5], [20, -3, 0.5]], float)
    slanted = SceneMesh("S", corners, [[0, 1, 2], [0, 2, 3]])
    noise = Noise(detection_range_m=FAR, stray_light=3e-5)
    sensor, ahead = window(step_deg=0.2)
    found = cast([slanted], sensor, noise=noise, materials=SIGN, columns=COLUMNS)
    bloom = found["cause"] == BLOOMING
    assert bloom.sum() > 200
    share = np.linspace(0, 1, 4001)[:, None]
    ends = zip(corners, np.roll(corners, -1, axis=0), strict=True)
    edges = np.concatenate([start + share * (stop - start) for start, stop in ends])
    distance = np.linalg.norm(edges, axis=1)
    nearest = (ahead[found["ray"][bloom]] @ (edges / distance[:, None]).T).argmax(axis=1)
    assert np.ptp(distance[nearest]) > 3, "from many points of the edges"
    # The light starts a little inside of the edge.
    assert found["range"][bloom] == pytest.approx(distance[nearest], abs=0.08)


def test_a_sign_that_is_hidden_does_not_bloom():
    noise = Noise(detection_range_m=FAR, stray_light=3e-6)
    sensor, _ = window()
    hidden = [sign(), wall("W", 10)]
    found = cast(hidden, sensor, noise=noise, materials=SIGN, columns=COLUMNS)
    assert set(found["cause"].tolist()) == {SURFACE}


def test_a_wall_as_far_away_as_the_sign_hides_the_stray_light():
    noise = Noise(detection_range_m=FAR, stray_light=3e-5)
    sensor, _ = window()
    behind = cast([sign(), wall("W", 20.3)], sensor, noise=noise, materials=SIGN, columns=COLUMNS)
    assert set(behind["cause"].tolist()) == {SURFACE}, "within half of the pulse: one return"
    far = cast([sign(), wall("W", 40)], sensor, noise=noise, materials=SIGN, columns=COLUMNS)
    # A wall at 40 m returns 0.03; the stray light is as strong within 0.23 degrees.
    assert (far["cause"] == BLOOMING).sum() > 0, "the strongest return near the sign"
    both = cast(
        [sign(), wall("W", 40)],
        sensor,
        noise=noise,
        materials=SIGN,
        columns=COLUMNS,
        returns=Returns("all"),
    )
    assert (both["cause"] == BLOOMING).sum() > (far["cause"] == BLOOMING).sum()


def test_instances_and_actors_bloom_like_meshes():
    noise = Noise(detection_range_m=FAR, stray_light=3e-6)
    sensor, _ = window()
    here = sign()
    ground = wall("W", -50)
    alone = SceneMesh("S", here.vertices - [20, 0, 0], here.faces)
    survey = Survey(
        sensor, [(0, 0, 0)], 1, noise=noise, materials=SIGN, columns=COLUMNS, keep_every=1
    )
    plain, *others = (
        np.bincount(made(survey, scene)["cause"], minlength=5).tolist()
        for scene in (
            Scene.from_meshes([here, ground]),
            Scene.from_meshes([ground, SceneInstance(alone, Pose((20, 0, 0)), "S")]),
            Scene.from_meshes([ground]).with_actors((Actor(here),)),
        )
    )
    assert plain[BLOOMING] > 50
    assert others == [plain, plain]


# -- crosstalk -----------------------------------------------------------------------------------

HEARS = Noise(detection_range_m=FAR, crosstalk=True)


def spinning(start_ns=0.0, firings=400, rate_hz=10.0, max_range_m=150.0, nm=905.0):
    """A beam that turns about z, 10 mrad wide."""
    optics = Optics(wavelength_nm=nm, divergence_mrad=10.0)
    head = Spin(firings, 360, rate_hz)
    return Sensor(Beams(np.zeros(1)), head, 0.0, max_range_m, optics=optics, start_ns=start_ns)


def two(one, other, meshes, mounts=((0, 0, 0), (0, 0, 0)), steps=1, noise=HEARS, **options):
    """Points of two sensors by column, and the rig and the survey; only the first hears."""
    survey = Survey(
        sensors=[
            Mounted(one, Pose(mounts[0]), "one", noise=noise),
            Mounted(other, Pose(mounts[1]), "other", noise=Noise()),
        ],
        poses=[(0, 0, 0)],
        steps=steps,
        materials=WHITE,
        columns=("ray", "range", "intensity", "cause", "object"),
        returns=Returns("all"),
        keep_every=1,
        **options,
    )
    rig = Rig(Scene.from_meshes(meshes), survey, "numpy")
    batches = list(rig.cast(0, steps))
    found = {
        c.name: np.concatenate([c.make(batch) for batch in batches]) for c in survey.stored_columns
    }
    return found, rig, survey


def ring(radius=30.0, sides=720):
    """A wall around the z axis."""
    angle = np.arange(sides + 1) * 2 * np.pi / sides
    low = np.stack([np.cos(angle), np.sin(angle), np.full(sides + 1, -1)], axis=1)
    high = low * [1, 1, -1]
    vertices = np.concatenate([low, high]) * [radius, radius, 20.0]
    a = np.arange(sides)
    b = np.arange(sides) + 1
    faces = [np.stack([a, b, a + sides + 1], 1), np.stack([b, b + sides + 1, a + sides + 1], 1)]
    return SceneMesh("R", vertices, np.concatenate(faces))


@pytest.mark.extended
def test_a_sensor_that_turns_alike_is_seen_by_each_ray_its_delay_farther_away():
    delay = 200.0  # ns: the light comes so much later, as if 30 m farther away
    found, *_ = two(spinning(), spinning(delay), [ring()])
    there = found["cause"] == CROSSTALK
    assert there.sum() == 400, "one of each pulse"
    assert found["range"][there] == pytest.approx(30 + delay * 0.299792458 / 2, abs=0.01)
    assert found["intensity"][there] == pytest.approx(1 / 9, rel=0.01), "of a wall at 30 m"
    assert set(found["object"][there].tolist()) == {-1}
    assert (found["cause"] == SURFACE).sum() == 400


@pytest.mark.parametrize("elevation", [0.3, -0.5])
def test_light_is_seen_by_beams_that_look_up_and_down(elevation):
    beams = Beams(np.array([elevation]))
    one, other = (replace(spinning(start), beams=beams) for start in (0.0, 200.0))
    found, *_ = two(one, other, [ring()])
    there = found["cause"] == CROSSTALK
    assert there.sum() == 400, "one of each pulse"
    delay_m = 200 * 0.299792458 / 2
    assert found["range"][there] == pytest.approx(30 / math.cos(elevation) + delay_m, abs=0.01)


@pytest.mark.parametrize("delay", [1000.0, 100_000.0])
def test_what_arrives_outside_the_gate_is_not_seen(delay):
    # The gate of 150 m ends after 1001 ns; light from 30 m away arrives after 200 ns and the delay.
    # After 100 µs the other sensor looks 0.36 degrees elsewhere, which is more than the beam.
    found, *_ = two(spinning(), spinning(delay), [ring()])
    assert set(found["cause"].tolist()) == {SURFACE}


def test_other_wavelengths_and_hidden_spots_are_not_seen():
    found, *_ = two(spinning(), spinning(200.0, nm=1550.0), [ring()])
    assert set(found["cause"].tolist()) == {SURFACE}
    # The other sensor stands on the far side of a wall, and lights the ring there.
    between = wall("W", 5.0)
    there = two(spinning(), spinning(200.0), [ring(), between], ((0, 0, 0), (6.0, 0, 0)))[0]
    spots = there["cause"] == CROSSTALK
    assert spots.sum() < 400
    ahead = two(spinning(), spinning(200.0), [ring()], ((0, 0, 0), (0.05, 0, 0)))[0]
    assert (ahead["cause"] == CROSSTALK).sum() > 200, "a little apart, most spots are in view"


@pytest.mark.slow
def test_counts_of_sensors_that_turn_against_each_other_are_those_of_all_pairs():
    turns = 7
    f = 20_000
    g = 19_700
    one = spinning(firings=f)
    other = replace(spinning(), head=Spin(g, 360, 9.63, clockwise=True))
    found, rig, survey = two(one, other, [ring()], steps=turns)
    count = int((found["cause"] == CROSSTALK).sum())
    # All pairs of pulses: light of the other arrives while the receiver waits, from what it sees.
    i = np.arange(f * turns)
    j = np.arange(g * turns)
    fired = one.head.times_ns(i)
    arrives = other.head.times_ns(j) + 60 / 0.299792458
    first = np.searchsorted(arrives, fired)
    stop = np.searchsorted(arrives, fired + 300 / 0.299792458)
    row = np.repeat(i, stop - first)
    place = np.arange(len(row)) - np.repeat(np.cumsum(stop - first) - (stop - first), stop - first)
    off = one.head.azimuths(row) - other.head.azimuths(first[row] + place)
    expected = int((np.abs(np.angle(np.exp(1j * off))) < 0.005).sum())
    assert abs(count - expected) <= 2
    rays = len(i) * 0.010 / (2 * np.pi)  # that look where the other does
    open_for = 300 / 0.299792458 * 9.63 * g / 1e9  # pulses of the other while a receiver waits
    assert within(count, rays * open_for)
    whole = cast_between(rig, survey, [0, turns])
    assert cast_between(rig, survey, range(turns + 1)) == whole
    assert cast_between(rig, survey, [0, 2, 5, turns]) == whole


@pytest.mark.parametrize(
    ("one", "says"),
    [
        (spinning(max_range_m=float("inf")), "requires a maximum range"),
        (beam_along_x(1, 100.0), "requires the beam divergence"),
    ],
)
def test_crosstalk_needs_a_gate_and_a_field_of_view(one, says):
    with pytest.raises(LidarError, match=says):
        two(one, spinning(), [ring()])


def test_crosstalk_needs_another_sensor():
    with pytest.raises(LidarError, match="requires at least two sensors"):
        Survey(spinning(), poses=[(0, 0, 0)], steps=1, noise=HEARS)


# -- all of it -----------------------------------------------------------------------------------


ALL = Noise(
    0.01,
    angle_deg=0.02,
    detection_range_m=FAR,
    range_at_threshold_m=0.05,
    walk_m=0.02,
    false_alarm_hz=1e5,
    stray_light=1e-5,
)


def drive(subrays=1, backend="numpy", **noise):
    """A rig with two sensors on a cart that passes a sign, and its survey."""
    beams = Beams(np.radians([-2.0, 0, 2.0]), time_ns=[0.0, 300.0, 600.0])
    optics = Optics(divergence_mrad=30.0)
    one = Sensor(beams, Spin(2000, 30), 0.5, 120.0, optics=optics)
    other = replace(one, start_ns=300.0)
    survey = Survey(
        sensors=[Mounted(one, name="one"), Mounted(other, Pose((0.05, 0.1, 0)), name="other")],
        trajectory=Cart(stations=1),
        steps=12,
        noise=replace(ALL, **noise),
        returns=Returns("dual", subrays=subrays),
        materials=SIGN,
        columns=("range", "intensity", "cause"),
        keep_every=1,
    )
    return Rig(
        Scene.from_meshes([sign(15), wall("W", 30), wall("V", -30)]), survey, backend
    ), survey


@pytest.mark.slow
@pytest.mark.slow(keep=("7",))
@pytest.mark.parametrize("subrays", (1, 7))
def test_batches_do_not_matter(subrays, monkeypatch):
    rig, survey = drive(subrays, crosstalk=True)
    whole = cast_between(rig, survey, [0, 24])
    assert cast_between(rig, survey, range(25)) == whole
    assert cast_between(rig, survey, [0, 5, 6, 12, 17, 24]) == whole
    causes = np.frombuffer(whole[0]["cause"], np.uint8)
    assert set(causes.tolist()) == {SURFACE, FALSE_ALARM, CROSSTALK, BLOOMING}
    first = cast_between(rig, survey, [0, 2])
    monkeypatch.setattr("lidarsim.pulses.pulses.CHUNK_RAYS", 500)
    assert cast_between(rig, survey, [0, 2]) == first


@pytest.mark.extended
def test_what_a_receiver_adds_leaves_surfaces_as_they_are():
    rig, survey = drive(range_at_threshold_m=0.0, walk_m=0.0, false_alarm_hz=0.0, stray_light=0.0)
    on, same = drive(crosstalk=True)
    off = cast_between(rig, survey, [0, 24])[0]
    with_all = cast_between(on, same, [0, 24])[0]
    causes = np.frombuffer(off["cause"], np.uint8)
    assert set(causes.tolist()) == {SURFACE}
    # Energies of surfaces are the same, whatever else is there; some are no longer reported.
    energies = np.frombuffer(off["intensity"], np.float32)
    surface = np.frombuffer(with_all["cause"], np.uint8) == SURFACE
    among = np.frombuffer(with_all["intensity"], np.float32)[surface]
    assert {*among.tolist()} <= {*energies.tolist()}
