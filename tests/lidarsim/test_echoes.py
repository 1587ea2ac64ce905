"""What comes back of a pulse: beams of several rays, materials, weather and noise."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from tests.shapes import (
    COLUMNS,
    CPU,
    Cart,
    beam_along_x,
    cast,
    cast_between,
    level,
    quad,
    solid,
    tally_of,
    wall,
)

from lidarsim import (
    Actor,
    Beams,
    LidarError,
    Material,
    Noise,
    Pose,
    Returns,
    Scene,
    SceneMesh,
    Sensor,
    Spin,
    Survey,
    Track,
)
from lidarsim import box as cuboid
from lidarsim.media.materials import extinction, fresnel
from lidarsim.numerics.random_numbers import raw
from lidarsim.pulses.returns import Keys, PulseReturns
from lidarsim.pulses.steps.angle_noise import ACROSS
from lidarsim.pulses.steps.range_noise import RANGE
from lidarsim.pulses.steps.separation import Reporting, reported_mask, separate_hits
from lidarsim.scene.shapes import seed_objects
from lidarsim.simulator.rig import Rig

# -- random numbers ------------------------------------------------------------------------------


def test_random_numbers_follow_from_what_they_are_for_alone():
    rays = np.arange(1000)
    one = RANGE
    other = ACROSS
    whole = raw(7, one, 3, rays)
    assert np.array_equal(whole[500:], raw(7, one, np.full(500, 3), rays[500:]))
    keys = [(8, one, 3, rays), (7, other, 3, rays), (7, one, 4, rays), (7, one, 3, rays, 1)]
    others = [raw(*key) for key in keys]
    assert len(set(np.concatenate([whole, *others]).tolist())) == 5000
    zero = SimpleNamespace(number=0)
    assert raw(0, zero, 0, 0).tolist() == [16294208416658607535], "SplitMix64 of another program"


# -- energies ------------------------------------------------------------------------------------


def test_energy_falls_with_distance_angle_and_reflectance():
    near = cast([wall("W", 5)], materials=[Material("*", reflectance=1.0)])
    assert near["intensity"] == pytest.approx([4.0])
    assert near["reflectance"] == pytest.approx([1.0])
    assert cast([wall("W", 20)])["intensity"] == pytest.approx([0.5 / 4]), "half is scattered"
    slanted = SceneMesh(
        "S", np.array([[4, -9, 9], [4, 9, 9], [22, -9, -9.0]]), np.array([[0, 1, 2]])
    )
    found = cast([slanted], materials=[Material("S", reflectance=0.8, semantic_class=65_535)])
    assert found["reflectance"] == pytest.approx([0.8 * math.sqrt(0.5)], rel=1e-6)
    assert found["class"].tolist() == [65_535]
    retro = cast([slanted], materials=[Material("S", reflectance=0.8, retro=True)])
    assert retro["reflectance"] == pytest.approx([0.8 * 220], rel=1e-6), "from all angles"


@pytest.mark.parametrize(
    ("visibility_km", "nm", "per_km"),
    [
        # ln 20 / V * (wavelength / 0.55 µm)**-q, worked out by hand: over V, 5 % are left
        (60.0, 905, math.log(20) / 60 * (905 / 550) ** -1.6),
        (10.0, 1550, math.log(20) / 10 * (1550 / 550) ** -1.3),
        (1.0, 550, 2.995732),
        # q by Kruse's visibility, at a contrast of 2 %: 6.13 km, and 0.2610 km
        (4.7, 905, 2.995732 / 4.7 * (905 / 550) ** -1.3),
        (0.2, 905, 2.995732 / 0.2 * (905 / 550) ** (-0.585 * 0.261037 ** (1 / 3))),
    ],
)
def test_weather_takes_light_by_kruse(visibility_km, nm, per_km):
    assert 1000 * extinction(visibility_km, nm) == pytest.approx(per_km)
    sensor = beam_along_x(wavelength_nm=nm)
    clear, dull = (cast([wall("W", 40)], sensor, visibility_km=v) for v in (None, visibility_km))
    lost = math.exp(-2 * per_km * 0.040)
    assert dull["intensity"] / clear["intensity"] == pytest.approx([lost], rel=1e-6)
    assert dull["reflectance"] == pytest.approx(clear["reflectance"], rel=1e-6)


def test_the_last_material_that_names_an_object_counts():
    walls = [wall(name, 5, z=(k, k + 1)) for k, name in enumerate(["A", "B[1]", "B1"], -1)]
    up = Sensor(Beams(np.radians([-6, 6, 16])), Spin(1, 360))
    materials = [Material("B?", 0.3), Material(["B[1]", "B1"], 0.2), Material("*", 0.1)]
    found = cast(walls, up, materials=materials)
    assert found["object"].tolist() == [0, 1, 2]
    cosines = np.cos(np.radians([6, 6, 16]))
    assert found["reflectance"] == pytest.approx([0.1, 0.2, 0.3] * cosines, rel=1e-6)


# -- beams ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(("apart_m", "returns"), [(0.74, 1), (0.76, 2)])
def test_what_is_nearer_than_half_a_pulse_is_one_return(apart_m, returns):
    """Half of 5 ns are 0.7495 m."""
    meshes = [wall("Near", 5, y=(0, 50)), wall("Far", 5 + apart_m)]
    beam = Returns("all", subrays=37, divergence_mrad=1, pulse_ns=5)
    found = cast(meshes, returns=beam)
    assert len(found["range"]) == returns
    if returns == 1:  # weighted by energy; which of the two the ray in the middle meets is rounding
        near, far = np.array([[18, 19], [19, 18]]) / [[5**2], [5.74**2]]
        assert np.isclose(found["range"], (5 * near + 5.74 * far) / (near + far), atol=1e-4).any()


MODES = {
    "all": [3.0, 5.0, 7.0, 9.0],
    "first": [3.0],
    "last": [9.0],
    "strongest": [7.0],
    "dual": [7.0, 9.0],
    "two_strongest": [5.0, 7.0],
}


@pytest.mark.parametrize("mode", MODES)
def test_modes(mode):
    hits = PulseReturns(
        np.array([1, 4, 4, 4, 4]),
        np.array([2.0, 9.0, 3.0, 7.0, 5.0]),
        np.arange(5, dtype=np.int32),
        np.array([1.0, 1.0, 2.0, 4.0, 3.0]),
    )
    returns = separate_hits(hits, 0.5)
    found = returns.take(reported_mask(returns, mode))
    assert found.ray.tolist() == [1] + [4] * len(MODES[mode])
    assert found.distance.tolist() == [2.0, *MODES[mode]]
    # Where the strongest is the last, the next strongest is the other one.
    swapped = separate_hits(hits._replace(energy=np.array([1.0, 9.0, 2.0, 4.0, 3.0])), 0.5)
    dual = swapped.take(reported_mask(swapped, "dual"))
    assert dual.distance.tolist() == [2.0, 7.0, 9.0]


@pytest.mark.parametrize("subrays", [1, 3])
@pytest.mark.parametrize("dropout", [0.0, 0.3])
def test_the_strongest_return_is_that_of_all_detected_returns(subrays, dropout):
    """Also for beams whose surface outshines the air, which take a shorter way."""
    rng = np.random.default_rng(4)
    noise = Noise(detection_range_m=100.0, dropout=dropout)

    def hits_of(ray, triangle, farthest_m):
        distance = rng.uniform(1, farthest_m, len(ray))
        energy = noise.threshold * rng.exponential(2.0, len(ray)) ** 2
        return PulseReturns(ray, distance, triangle, energy)

    beams = 3000
    surface_rays = np.flatnonzero(rng.random(beams * subrays) < 0.8)
    surface = hits_of(surface_rays, np.zeros(len(surface_rays), np.int32), 12.0)
    air_rays = np.sort(rng.integers(0, beams * subrays, 2 * beams))
    air = hits_of(air_rays, np.full(2 * beams, -1, np.int32), 10.0)
    air = air._replace(cause=np.ones(2 * beams, np.uint8))
    keys = Keys(3, np.array([0, 1000]))
    every, strongest = (
        separate_hits(surface, 0.5, subrays, air=air, reporting=Reporting(mode, noise, keys))
        for mode in ("all", "strongest")
    )
    expected = every.take(reported_mask(every, "strongest"))
    assert beams / 2 < len(strongest.ray) < len(every.ray)
    for column in ("ray", "distance", "triangle", "energy", "cause"):
        assert np.array_equal(getattr(strongest, column), getattr(expected, column)), column


def test_a_surface_that_continues_takes_hits_between_its_hits():
    """The example of `continue_surfaces`: a drop, ground at three sub-rays, and a post."""
    from lidarsim.pulses.steps.pulse_loops import SubrayNeighbors
    from lidarsim.pulses.steps.random_loops import RandomKeys
    from lidarsim.pulses.steps.separation_loops import (
        ALL,
        Receiver,
        ReturnArrays,
        SubrayHits,
        separate,
    )

    distance = np.array([10.0, 11.0, 12.2, 10.6])
    down = -1 / distance[:3]
    directions = np.array([*np.stack([np.sqrt(1 - down**2), 0 * down, down], axis=1), [1, 0, 0]])
    normals = np.array([[0, 0, 1], [0, 0, 1], [0, 0, 1], [-1, 0, 0]], float)
    pairs = np.array([[0, 1], [1, 2], [2, 3]])
    found = ReturnArrays(*np.zeros((2, 5), np.int64), *np.zeros((3, 5)))
    count = separate(
        hits=SubrayHits(
            np.arange(4), distance, np.array([1.0, 1, 1, 2]), np.zeros(0), np.ones(4, bool)
        ),
        air=SubrayHits(
            np.zeros(1, np.int64), np.array([8.0]), np.array([0.4]), np.zeros(0), np.zeros(0, bool)
        ),
        neighbors=SubrayNeighbors(4, pairs, normals.T.copy(), directions.T.copy()),
        receiver=Receiver(4, 0.3, ALL, False, 0.0, 0.0, 0.0, np.zeros(0)),
        keys=RandomKeys(np.zeros((1, 0), np.uint64), np.zeros(1, np.int64), 0),
        output=found,
    )
    assert count == 2 and found.row[:count].tolist() == [-1, 3]
    assert found.distance[:count].tolist() == pytest.approx([8.0, 10.88])
    assert found.energy[:count].tolist() == pytest.approx([0.1, 1.25])


# -- glass and mirrors ---------------------------------------------------------------------------


@pytest.mark.parametrize("backend", CPU)
def test_light_passes_glass(backend):
    meshes = [wall("Pane", 4), wall("Behind", 9)]
    materials = [Material("Pane", transparent="pass"), Material("*", 0.5)]
    found = cast(meshes, materials=materials, backend=backend)
    assert found["object"].tolist() == [1]
    assert found["range"] == pytest.approx([9], abs=1e-9)
    assert found["reflectance"] == pytest.approx([0.5 * 0.96**2], rel=1e-6), "4 % each way"
    dirty = [Material("Pane", 0.1, transparent="pass"), *materials[-1:]]
    found = cast(meshes, materials=dirty, returns=Returns("all"), backend=backend)
    assert found["object"].tolist() == [0, 1]
    assert found["reflectance"] == pytest.approx([0.1, 0.5 * (0.9 * 0.96) ** 2], rel=1e-6)
    assert not len(cast(meshes, beam_along_x(max_range_m=8), materials=materials)["range"])


@pytest.mark.slow(every=5)
@pytest.mark.parametrize("backend", CPU)
@pytest.mark.parametrize("away_m", [0, 2000])
@pytest.mark.parametrize("angle_deg", [0, 60, 85])
def test_a_pane_has_two_surfaces_from_whatever_side(backend, away_m, angle_deg):
    """4 mm of glass, also far from the origin, where single precision is coarse."""
    pane = trimesh.creation.box((0.004, 300, 20))
    angle = math.radians(angle_deg)
    pane.apply_transform(trimesh.transformations.rotation_matrix(angle, (0, 0, 1)))
    meshes = [solid("Pane", pane, (away_m + 30, 0, 0)), wall("Behind", away_m + 60)]
    materials = [Material("Pane", transparent="pass"), Material("Behind", 0.5)]
    found = cast(meshes, at=(away_m, 0.01, 0.02), backend=backend, materials=materials)
    through = (1 - fresnel(np.array([math.cos(angle)]))) ** 4  # two surfaces, there and back
    assert found["range"] == pytest.approx([60], abs=1e-3)
    assert found["reflectance"] == pytest.approx(0.5 * through, rel=1e-4)


def test_glass_reflects_by_fresnel():
    assert fresnel(np.array([1.0, 0.0])) == pytest.approx([0.04, 1.0])
    brewster = math.atan(1.5)
    along = (math.sin(2 * brewster - math.pi / 2)) ** 2 / 2  # one polarization is not reflected
    assert fresnel(np.array([math.cos(brewster)])) == pytest.approx([along])


@pytest.mark.parametrize("backend", CPU)
@pytest.mark.parametrize("subrays", [1, 19])
def test_a_mirror_shows_what_is_reflected_at_the_unfolded_range(subrays, backend):
    """A mirror at 45 degrees turns the beam up, to a ceiling 3 m above."""
    mirror = quad("Mirror", (2, -9, -2), (2, 9, -2), (6, 9, 2), (6, -9, 2))
    meshes = [mirror, level("Ceiling", 3, 9)]
    materials = [Material("Mirror", specular_reflectance=1), Material("*")]
    beam = Returns(subrays=subrays, divergence_mrad=1)
    found = cast(meshes, materials=materials, returns=beam, backend=backend)
    assert found["object"].tolist() == [1]
    assert found["range"] == pytest.approx([7], abs=1e-4)
    assert found["reflectance"] == pytest.approx([0.5], rel=1e-4)
    assert np.allclose(found["batch"].positions, [[7, 0, 0]], atol=1e-4), "behind the mirror"
    everywhere = [Material("*", specular_reflectance=1)]
    assert not len(cast([wall("A", 4), wall("B", -4)], materials=everywhere)["range"]), "given up"


# -- noise ---------------------------------------------------------------------------------------

MANY = 40_000


@pytest.mark.extended
@pytest.mark.parametrize("distance", [5.0, 80.0])
@pytest.mark.parametrize("beam", [Returns(), Returns(subrays=7, divergence_mrad=0.5)])
def test_ranges_have_the_noise_that_was_asked_for(distance, beam):
    noise = Noise(range_m=0.02, range_per_m=0.001)
    found = cast([wall("W", distance)], beam_along_x(MANY), noise=noise, returns=beam)
    off = found["range"].astype(float) - distance
    sigma = 0.02 + 0.001 * distance
    assert len(off) == MANY
    assert abs(off.mean()) < 4 * sigma / math.sqrt(MANY)
    assert off.std() == pytest.approx(sigma, rel=0.02)
    assert found["batch"].positions[:, 0] == pytest.approx(distance + off, abs=1e-4)
    assert np.ptp(found["intensity"]) < 1e-6, "what came back knows nothing of it"
    other = cast([wall("W", distance)], beam_along_x(MANY), noise=replace(noise, seed=1))
    assert abs(np.corrcoef(found["range"], other["range"])[0, 1]) < 0.03


def test_light_goes_where_a_beam_points_and_its_angle_is_reported_without_noise():
    """On a wall that is met at 45 degrees, ranges tell how far beams point off."""
    slanted = quad("W", (-40, 50, -50), (60, -50, -50), (60, -50, 50), (-40, 50, 50))
    found = cast([slanted], beam_along_x(MANY), noise=Noise(angle_deg=0.1))
    # Along x the wall is at 10 m; turned by a small angle, at 10 (1 - angle).
    off = (10 - found["range"]) / 10
    assert off.std() == pytest.approx(math.radians(0.1), rel=0.03)
    across = found["batch"].positions[:, 1:]
    assert np.abs(across).max() < 1e-2, "reported along the nominal ray"


@pytest.mark.extended
@pytest.mark.parametrize("distance", [80, 95, 100, 105, 130])
def test_weak_returns_are_lost_by_the_model(distance):
    """Threshold detection of a signal in normally distributed noise."""
    noise = Noise(dropout=0.1, detection_range_m=100)
    wall_of_10 = [Material("*", 0.1)]
    found = cast([wall("W", distance)], beam_along_x(MANY), noise=noise, materials=wall_of_10)
    above = 5 * ((100 / distance) ** 2 - 1)
    share = 0.9 * (1 + math.erf(above / math.sqrt(2))) / 2
    sigma = math.sqrt(MANY * share * (1 - share))
    assert abs(len(found["range"]) - MANY * share) < 3 * sigma + 2
    batch = found["batch"]
    assert len(found["range"]) == batch.hit_counts.sum() == tally_of([batch]).sum()


# -- the same bits however it is batched ----------------------------------------------------------

ALL_ON = {
    "materials": [
        Material("Bowl", 0.3, specular_reflectance=0.3),
        Material("Sphere", specular_reflectance=1),
        Material("V*", 0.1, transparent="pass"),
        Material("*", 0.4, semantic_class=1),
    ],
    "wet": 0.6,
    "returns": Returns("dual", subrays=7, divergence_mrad=20, pulse_ns=2),
    "noise": Noise(0.02, 0.001, 0.05, 0.1, 40, seed=5),
    "visibility_km": 0.5,
    "spray_g_m3": 500,
}
NOISE_ONLY = {"noise": Noise(0.02, 0.001, 0.05, seed=5)}
BEAMS = Beams(
    np.radians([-20, -5, 0, 12]),
    time_ns=[0, 50_000, 100_000, 150_000],
    origin=[[0.1, 0, 0], [0.1, 0.02, 0], [0.1, -0.02, 0], [0.1, 0, 0.05]],
)
TURNED = {"poses": (Pose((0, 0, 1), 10, 5, -3), Pose((3, -2, 2)))}


@pytest.mark.slow
@pytest.mark.slow(every=3)
@pytest.mark.parametrize("options", [ALL_ON, NOISE_ONLY], ids=["all on", "noise"])
@pytest.mark.parametrize("path", [TURNED, {"trajectory": Cart()}], ids=["standing", "moving"])
@pytest.mark.parametrize("per_turn", [360, 360.449])
def test_batches_and_chunks_leave_no_trace(options, path, per_turn, monkeypatch):
    sensor = Sensor(BEAMS, Spin(per_turn, step_deg=30, rate_hz=10), 0.5, 40)
    survey = Survey(sensor, steps=14, keep_every=3, columns=COLUMNS, **options, **path)
    way = Track([-1, 9], [(-12, 2, 0), (88, 2, 0)], start_s=0, beyond="hold")
    car = Actor(cuboid("Car", (1, 1, 1)), way)
    scene = Scene.from_meshes(seed_objects(rings=8, segments=12)).with_actors([car])
    rig = Rig(scene, survey, "numpy")
    whole = cast_between(rig, survey, [0, 28])
    assert len(whole[0]["x"]) > 200
    assert cast_between(rig, survey, [0, 1, 5, 14, 17, 28]) == whole
    monkeypatch.setattr("lidarsim.pulses.pulses.CHUNK_RAYS", 100)
    assert cast_between(rig, survey, list(range(29))) == whole


def test_returns_are_thinned_out_scan_by_scan():
    scene = seed_objects(rings=8, segments=12)
    sensor = Sensor(BEAMS, Spin(90, step_deg=360))
    beam = Returns("all", subrays=7, divergence_mrad=150, pulse_ns=1)
    every, third = (cast(scene, sensor, returns=beam, keep_every=n) for n in (1, 3))
    assert every["returns"].max() > 1
    for name in COLUMNS:
        assert np.array_equal(every[name][::3], third[name])
    assert every["batch"].hit_counts.tolist() == third["batch"].hit_counts.tolist()
    assert every["batch"].hit_counts.sum() == len(every["ray"])


def test_one_subray_without_noise_is_the_plain_ray():
    """The way through beams and returns ends where the plain one does."""
    scene = seed_objects(rings=8, segments=12)
    sensor = Sensor(BEAMS, Spin(90, step_deg=360))
    plain = cast(scene, sensor)
    beam = cast(scene, sensor, noise=Noise(dropout=1e-12))
    assert plain["batch"].pulse_returns.energy is None
    assert beam["batch"].pulse_returns.energy is not None
    for name in ("x", "y", "z", "ray", "object", "channel", "class", "returns"):
        assert np.array_equal(plain[name], beam[name])
    assert np.allclose(plain["intensity"], beam["intensity"], rtol=1e-6)
    assert np.allclose(plain["range"], beam["range"], rtol=1e-6)


# -- what is refused ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: Material("*", float("nan")), "reflectance must .* but is nan"),
        (lambda: Material([]), "objects must .* but is"),
        (lambda: Returns(subrays=8), "must be 1, 7, 19, 37"),
        (lambda: Noise(dropout=2), "dropout must be a number from 0 to 1, but is 2"),
        (
            lambda: Survey(poses=[(0, 0, 1)], returns=Returns(subrays=7)),
            "beam divergence of the sensor is unknown",
        ),
    ],
)
def test_numbers_that_mean_nothing_are_refused(make, says):
    with pytest.raises(LidarError, match=says):
        make()
