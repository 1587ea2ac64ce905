"""Leaves within closed surfaces: gap fractions, depths and energies against Beer and Lambert."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import pytest
import trimesh
from tests import shapes
from tests.shapes import CPU, ball, box

from lidarsim import (
    Actor,
    Beams,
    LidarError,
    Material,
    Noise,
    Returns,
    Scene,
    SceneInstance,
    SceneMesh,
    Sensor,
    Spin,
    Survey,
    Track,
)
from lidarsim.media.leaves import NAMES, leaf_angle_density, mean_brightness, mean_projection
from lidarsim.pulses.steps.light_in_media import random_depths
from lidarsim.simulator.rig import Rig

GROUND = Material("*", 0.3)
cast = partial(shapes.cast, backend="tiles")
MANY = 60_000
AT = (0, 0.02, 0.01)  # rays that meet an edge exactly take long


def rays(count=MANY, nadir_deg=90.0, **options):
    """A sensor that fires once, so many rays into one direction of the xz plane."""
    return Sensor(Beams(np.full(count, math.radians(nadir_deg - 90))), Spin(1, 360), **options)


def gap(found, rays=MANY, leaves=0):
    """Share of the rays that no leaf stops."""
    return 1 - (found["object"] == leaves).sum() / rays


def test_leaves_that_no_ray_meets_change_nothing():
    """Neither where surfaces continue from sub-ray to sub-ray, some beyond the sensor's range."""
    scene = [box("F", (-500, -500, -2), (500, 500, -1.5)), box("Leaves", (-20, 0, -1), (-19, 1, 1))]
    beams = Beams(np.radians(np.linspace(-0.6, -4, 200)))
    sensor = Sensor(beams, Spin(1, 360), max_range_m=60)
    options = {"returns": Returns("all", subrays=19, divergence_mrad=20)}
    leaves = Material("Leaves", leaf_area_density=1.0)
    bare = cast(scene[:1], sensor, (0, 0, 0), materials=[GROUND], **options)
    found = cast(scene, sensor, (0, 0, 0), materials=[leaves, GROUND], **options)
    assert len(bare["range"]) > 150
    for column in ("range", "intensity", "ray"):
        assert np.array_equal(bare[column], found[column])


# -- leaf angles ---------------------------------------------------------------------------------


@pytest.mark.parametrize("leaf_angle", [*NAMES, 0.1, 0.5, 1, 2.0, 10.0])
def test_densities_are_of_all_leaves_and_projections_of_a_sphere_of_light_are_a_half(leaf_angle):
    """The mean projection of flat leaves over all directions of light is 1/2, however inclined."""
    angle = (np.arange(20_000) + 0.5) * (math.pi / 2 / 20_000)
    assert leaf_angle_density(leaf_angle, angle).mean() * math.pi / 2 == pytest.approx(1, rel=1e-6)
    cosine = (np.arange(20_000) + 0.5) / 20_000
    assert mean_projection(leaf_angle, cosine).mean() == pytest.approx(0.5, rel=1e-3)


def test_projections_of_known_leaves():
    cosine = np.linspace(0, 1, 11)
    assert mean_projection("spherical", cosine) == pytest.approx(0.5, rel=1e-5)
    assert mean_brightness("spherical", cosine) == pytest.approx(2 / 3, rel=1e-5)
    # Straight down: the mean cosine of the angles, integrated by hand.
    straight = {"planophile": 8 / 3, "erectophile": 4 / 3, "plagiophile": 32 / 15, "uniform": 2}
    for name, value in straight.items():
        assert mean_projection(name, np.ones(1))[0] == pytest.approx(value / math.pi, rel=1e-4)
    # Campbell's own approximation of his integral is right to 1 %.
    for x in (0.1, 0.5, 1.0, 2.0, 10.0):
        approximate = np.sqrt((x * cosine) ** 2 + 1 - cosine**2) / (
            x + 1.774 * (x + 1.182) ** -0.733
        )
        assert mean_projection(x, cosine) == pytest.approx(approximate, rel=0.01)
    assert mean_projection(20.0, cosine[1:]) == pytest.approx(cosine[1:], rel=0.15), "nearly flat"


# -- Beer and Lambert ----------------------------------------------------------------------------


@pytest.mark.extended
@pytest.mark.slow(every=3)
@pytest.mark.parametrize("leaf_angle", ["spherical", "planophile", "erectophile", 2.0])
@pytest.mark.parametrize("nadir_deg", [0.0, 50.0])
def test_gaps_of_a_canopy_are_those_of_its_leaf_area_index(leaf_angle, nadir_deg):
    """Within 1 %: a layer of 3 m with 0.6 m²/m³, a leaf area index of 1.8."""
    canopy = box("Leaves", (-90, -90, 0), (90, 90, 3))
    floor = box("F", (-99, -99, -2), (99, 99, -1))
    materials = [Material("Leaves", leaf_area_density=0.6, leaf_angle=leaf_angle), GROUND]
    found = cast([canopy, floor], rays(nadir_deg=nadir_deg), (0.3, 0.1, 10), materials=materials)
    cosine = math.cos(math.radians(nadir_deg))
    tau = mean_projection(leaf_angle, np.array([cosine]))[0] * 1.8 / cosine
    assert gap(found) == pytest.approx(math.exp(-tau), rel=0.01)
    # Depths of the leaves that were met follow the exponential between both surfaces.
    depth = np.sort(found["range"][found["object"] == 0] - 7 / cosine) * cosine / 3
    share = (1 - np.exp(-tau * depth)) / (1 - math.exp(-tau))
    off = np.abs(share - (np.arange(len(depth)) + 0.5) / len(depth)).max()
    assert off < 1.63 / math.sqrt(len(depth)), "99 % of Kolmogorov and Smirnov's test"


def test_depths_are_negative_logarithms_of_random_numbers():
    """From a table whose steps are 1.5e-5 of its numbers, for numbers close to 0 and 1, too."""
    bits = np.random.default_rng(2).integers(0, 2**64, 2000, np.uint64)
    bits = np.concatenate([bits >> np.uint64(k) for k in (0, 1, 20)] + [[0], ~(bits >> 40)])
    bits = bits.astype(np.uint64)
    expected = -np.log(((bits >> np.uint64(11)).astype(float) + 0.5) * 2.0**-53)
    assert np.abs(random_depths(bits) - expected).max() < 1.6e-5


def test_leaves_of_crowns_that_overlap_are_met_in_proportion_to_their_density():
    """The middle crown is of leaves that do not face the light, which count less."""
    kinds = ("planophile", "erectophile", "spherical")
    meshes = [box(f"Crown{k}", (-9, -9, 0), (9, 9, 3 + k / 1e3)) for k in range(3)]
    materials = [
        Material(f"Crown{k}", 0.5, leaf_area_density=0.5 + k, leaf_angle=kind)
        for k, kind in enumerate(kinds)
    ]
    found = cast(meshes, rays(10_000, 0.0), (0, 0, 10), materials=materials)
    shares = np.array([mean_projection(kind, np.ones(1))[0] for kind in kinds]) * [0.5, 1.5, 2.5]
    shares /= shares.sum()
    count = len(found["object"])
    off = np.bincount(found["object"], minlength=3) - count * shares
    assert (np.abs(off) < 4 * np.sqrt(count * shares * (1 - shares))).all()
    bright = np.array([mean_brightness(kind, np.ones(1))[0] for kind in kinds])[found["object"]]
    assert np.allclose(found["intensity"], 0.5 * bright * (10 / found["range"]) ** 2, 1e-5, 0)


def test_leaves_are_as_bright_as_they_face_the_light():
    canopy = box("Leaves", (-9, -9, 0), (9, 9, 3))
    floor = box("F", (-9, -9, -2), (9, 9, -1))
    leaves = Material("Leaves", 0.5, leaf_area_density=1.0, leaf_angle="planophile")
    found = cast([canopy, floor], rays(2000, 0.0), (0, 0, 10), materials=[leaves, GROUND])
    on = found["object"] == 0
    bright = mean_brightness("planophile", np.ones(1))[0]
    expected = 0.5 * bright * (10 / found["range"][on]) ** 2
    assert found["intensity"][on] == pytest.approx(expected, rel=1e-5)
    # Of the whole cone, the mean over sub-rays is the gap's: each meets leaves by itself.
    beam = Returns("all", subrays=37, divergence_mrad=1)
    cone = cast(
        [canopy, floor], rays(4000, 0.0), (0, 0, 10), materials=[leaves, GROUND], returns=beam
    )
    tau = mean_projection("planophile", np.ones(1))[0] * 3
    ground = cone["intensity"][cone["object"] == 1].sum() / 4000
    assert ground == pytest.approx(math.exp(-tau) * 0.3 * (10 / 11) ** 2, rel=0.02)
    assert cone["returns"].max() > 2


@pytest.mark.slow
def test_moved_and_turned_crowns_hold_the_same_leaves():
    """Instances, mirrored ones too, and actors; and meshes whose triangles wind inwards."""
    crown = ball("Crown", 1.0)
    wall = box("Wall", (9, -9, -9), (10, 9, 9))
    materials = [Material("Crown", leaf_area_density=0.8), GROUND]
    inwards = SceneMesh("Crown", crown.vertices * 2 + (4, 0, 0), crown.faces[:, ::-1])
    mirrored = np.diag([2.0, -2, 2, 1])
    mirrored[0, 3] = 4
    for meshes in ([inwards, wall], [SceneInstance(crown, mirrored), wall]):
        found = cast(meshes, rays(), AT, materials=materials)
        number = Scene.from_meshes(meshes).object_names.index("Crown")
        assert gap(found, leaves=number) == pytest.approx(math.exp(-0.4 * 4), rel=0.015)
    way = Track([0.0, 10.0], [(4, 0, 0), (4, 0, 0)])
    scene = Scene.from_meshes([wall]).with_actors(
        [Actor(SceneMesh("Crown", crown.vertices * 2, crown.faces), way)]
    )
    survey = Survey(rays(), poses=[AT], steps=1, materials=materials)
    (batch,) = Rig(scene, survey, "tiles").cast(0, 1)
    assert (batch.object == 0).mean() == pytest.approx(math.exp(-0.4 * 4), rel=0.015)


def test_a_surface_with_gaps_is_refused():
    open_box = box("Crown", (1, -1, -1), (2, 1, 1))
    gappy = SceneMesh("Crown", open_box.vertices, open_box.faces[1:])
    with pytest.raises(LidarError, match="'Crown' has a leaf_area_density, but its surface"):
        cast([gappy], rays(1), materials=[Material("*", leaf_area_density=1.0)])


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"leaf_area_density": 1.0, "transparent": "pass"}, "cannot be combined with transparent"),
        (
            {"leaf_area_density": 1.0, "leaf_angle": "flat"},
            "leaf_angle must be 'spherical', .* but is 'flat'",
        ),
        ({"leaf_area_density": 0.0}, "leaf_area_density must be a number above 0 .* but is 0.0"),
    ],
)
def test_materials_that_mean_nothing_are_refused(fields, says):
    with pytest.raises(LidarError, match=says):
        Material("*", **fields)


def test_a_leaf_angle_without_leaves_is_refused():
    with pytest.raises(LidarError, match=r"'Crown' contains no voxels .*requires leaf_area"):
        cast([ball("Crown", 1.0)], rays(1), materials=[Material("*", leaf_angle="planophile")])


# -- the same bits -------------------------------------------------------------------------------

ALL_ON = {
    "materials": [
        Material("Window", transparent="pass", refractive_index=1.5, attenuation_per_m=0.3),
        Material("Bush", 0.5, leaf_area_density=2.0, leaf_angle="erectophile"),
        Material("Crown", 0.5, leaf_area_density=0.8, leaf_angle=1.7),
        Material("*", 0.4),
    ],
    "returns": Returns(
        "all", 7, [9.0, 3.0], beam_profile="gaussian", exit_diameter_m=0.02, pulse_ns=2
    ),
    "noise": Noise(0.02, 0.001, 0.05, 0.1, 40, seed=5),
    "visibility_km": 0.5,
    "columns": ("ray", "range", "intensity", "return_number", "class"),
}


@pytest.mark.extended
@pytest.mark.parametrize("backend", CPU)
@pytest.mark.parametrize("order", [1, -1])
def test_layers_that_touch_each_other(backend, order):
    """As voxels do: six of them side by side are one of six meters."""
    layers = [box(f"Voxel{x}", (x, -9, -9), (x + 1, 9, 9)) for x in range(2, 8)][::order]
    wall = box("Wall", (8, -9, -9), (10, 9, 9))
    materials = [Material("Voxel*", leaf_area_density=0.4), GROUND]
    found = cast(
        [*layers, wall],
        rays((backend == "tiles" and MANY) or 10_000, 91.0),
        backend=backend,
        materials=materials,
    )
    tau = 0.2 * 6 / math.cos(math.radians(1))
    assert (found["object"] == 6).mean() == pytest.approx(math.exp(-tau), rel=0.02)
    counts = np.bincount(found["object"], minlength=7)[:6][::order] / len(found["object"])
    assert counts == pytest.approx(np.exp(-0.2 * np.arange(6)) * (1 - math.exp(-0.2)), rel=0.1)


@pytest.mark.extended
def test_a_wood_of_crowns_that_overlap_anyhow():
    """From within and outside, gaps are those of the chords of all ellipsoids, added up."""
    rng = np.random.default_rng(3)
    unit = trimesh.creation.icosphere(4, 1.0007)  # of the volume of the sphere
    kinds = ("spherical", "planophile", 0.5)
    meshes = []
    materials = []
    crowns = []
    for number in range(24):
        center = rng.uniform(-5, 5, 3)
        radii = rng.uniform(0.8, 3, 3)
        inwards = np.array(unit.faces)[:, :: -1 if number % 4 == 0 else 1]
        meshes.append(SceneMesh(f"C{number}", np.array(unit.vertices) * radii + center, inwards))
        thick = float(rng.uniform(0.05, 0.4))
        kind = kinds[number % 3]
        materials.append(Material(f"C{number}", leaf_area_density=thick, leaf_angle=kind))
        crowns.append((center, radii, thick, kind))
    meshes.append(ball("Sky", 60.0, fineness=2))
    sensor = Sensor(Beams(np.radians(np.linspace(-75, 75, 30))), Spin(100, 360))
    places = rng.uniform(-6, 6, (8, 3))
    survey = Survey(sensor, poses=places.tolist(), steps=1, materials=[*materials, Material("*")])
    rig = Rig(Scene.from_meshes(meshes), survey, CPU[-1])
    ahead = sensor.directions(np.arange(100)).reshape(-1, 3)
    off = 0.0
    variance = 0.0
    for place, batch in zip(places, rig.cast(0, 8), strict=True):
        tau = np.zeros(len(ahead))
        for center, radii, thick, kind in crowns:
            start = (place - center) / radii
            way = ahead / radii
            a = (way**2).sum(axis=1)
            b = way @ start
            c = start @ start - 1
            root = np.sqrt(np.maximum(b * b - a * c, 0))
            chord = np.maximum((root - b) / a, 0) - np.maximum((-root - b) / a, 0)
            tau += mean_projection(kind, np.abs(ahead[:, 2])) * thick * chord
        gaps = np.exp(-tau)
        assert len(batch.object) == len(ahead)
        off += (batch.object == 24).sum() - gaps.sum()
        variance += (gaps * (1 - gaps)).sum()
    assert abs(off) < 3 * math.sqrt(variance)
    assert any((((place - c) / r) ** 2).sum() < 1 for place in places for c, r, *_ in crowns)
