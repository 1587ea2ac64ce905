"""Leaves within closed surfaces: gap fractions, depths and energies against Beer and Lambert."""

from __future__ import annotations

import math

import numpy as np
import pytest
import trimesh
from tests.lidarpool.casting import Cart, cast_between, tally_of

from lidarpool import (
    Actor,
    Beams,
    Instance,
    LidarpoolError,
    Material,
    Noise,
    Pose,
    Returns,
    Scene,
    Sensor,
    Spin,
    Survey,
    Track,
)
from lidarpool.scene.mesh import Mesh
from lidarpool.sensor.leaves import NAMES, brightness, density, projection
from lidarpool.simulator.media import depths
from lidarpool.simulator.rig import Rig
from raybeam import available_backends

CPU = [name for name in ("numpy", "embree") if not available_backends()[name]]
GROUND = Material("*", 0.3)
MANY = 60_000


def box(name, low, high):
    made = trimesh.creation.box(bounds=[low, high])
    return Mesh(name, np.array(made.vertices), np.array(made.faces))


def ball(name, radius, centre=(0, 0, 0), fineness=4):
    made = trimesh.creation.icosphere(fineness, radius)
    return Mesh(name, np.array(made.vertices) + centre, np.array(made.faces))


def rays(count=MANY, nadir_deg=90.0, **options):
    """A sensor that fires once, so many rays into one direction of the xz plane."""
    return Sensor(Beams(np.full(count, math.radians(nadir_deg - 90))), Spin(1, 360), **options)


def cast(meshes, sensor, at=(0, 0, 0), backend="embree", steps=1, **options):
    """Points of one scan of some meshes, by column."""
    options = {"columns": ("ray", "range", "intensity", "returns"), **options}
    survey = Survey(sensor, poses=[at], steps=steps, **options)
    rig = Rig(Scene.from_meshes(meshes), survey, backend)
    (batch,) = rig.cast(0, steps)
    return {c.name: c.make(batch) for c in survey.stored_columns} | {"batch": batch}


def gap(found, rays=MANY, leaves=0):
    """Share of the rays that no leaf stops."""
    return 1 - (found["object"] == leaves).sum() / rays


# -- leaf angles ---------------------------------------------------------------------------------


@pytest.mark.parametrize("leaf_angle", [*NAMES, 0.1, 0.5, 1, 2.0, 10.0])
def test_densities_are_of_all_leaves_and_projections_of_a_sphere_of_light_are_a_half(leaf_angle):
    """The mean projection of flat leaves over all directions of light is 1/2, however inclined."""
    angle = (np.arange(20_000) + 0.5) * (math.pi / 2 / 20_000)
    assert density(leaf_angle, angle).mean() * math.pi / 2 == pytest.approx(1, rel=1e-6)
    cosine = (np.arange(20_000) + 0.5) / 20_000
    assert projection(leaf_angle, cosine).mean() == pytest.approx(0.5, rel=1e-3)


def test_projections_of_known_leaves():
    cosine = np.linspace(0, 1, 11)
    assert projection("spherical", cosine) == pytest.approx(0.5, rel=1e-5)
    assert brightness("spherical", cosine) == pytest.approx(2 / 3, rel=1e-5)
    # Straight down: the mean cosine of the angles, integrated by hand.
    straight = {"planophile": 8 / 3, "erectophile": 4 / 3, "plagiophile": 32 / 15, "uniform": 2}
    for name, value in straight.items():
        assert projection(name, np.ones(1))[0] == pytest.approx(value / math.pi, rel=1e-4)
    # Campbell's own approximation of his integral is right to 1 %.
    for x in (0.1, 0.5, 1.0, 2.0, 10.0):
        approximate = np.sqrt((x * cosine) ** 2 + 1 - cosine**2) / (
            x + 1.774 * (x + 1.182) ** -0.733
        )
        assert projection(x, cosine) == pytest.approx(approximate, rel=0.01)
    assert projection(20.0, cosine[1:]) == pytest.approx(cosine[1:], rel=0.15), "nearly flat"


def test_optical_depths_are_exponentially_distributed():
    bits = np.arange(2**20, dtype=np.uint64) * np.uint64(2**44) + np.uint64(2**43)
    found = np.sort(depths(bits))
    share = 1 - (np.arange(len(found)) + 0.5) / len(found)
    assert np.abs(np.exp(-found) - share).max() < 2e-5
    assert found.mean() == pytest.approx(1, abs=1e-4)


# -- Beer and Lambert ----------------------------------------------------------------------------


@pytest.mark.parametrize("leaf_angle", ["spherical", "planophile", "erectophile", 2.0])
@pytest.mark.parametrize("nadir_deg", [0.0, 50.0])
def test_gaps_of_a_canopy_are_those_of_its_leaf_area_index(leaf_angle, nadir_deg):
    """Within 1 %: a layer of 3 m with 0.6 m²/m³, a leaf area index of 1.8."""
    canopy, floor = (
        box("Leaves", (-90, -90, 0), (90, 90, 3)),
        box("F", (-99, -99, -2), (99, 99, -1)),
    )
    materials = [GROUND, Material("Leaves", leaf_area_density=0.6, leaf_angle=leaf_angle)]
    found = cast([canopy, floor], rays(nadir_deg=nadir_deg), (0, 0, 10), materials=materials)
    cosine = math.cos(math.radians(nadir_deg))
    tau = projection(leaf_angle, np.array([cosine]))[0] * 1.8 / cosine
    assert gap(found) == pytest.approx(math.exp(-tau), rel=0.01)
    # Depths of the leaves that were met follow the exponential between both surfaces.
    depth = np.sort(found["range"][found["object"] == 0] - 7 / cosine) * cosine / 3
    share = (1 - np.exp(-tau * depth)) / (1 - math.exp(-tau))
    off = np.abs(share - (np.arange(len(depth)) + 0.5) / len(depth)).max()
    assert off < 1.63 / math.sqrt(len(depth)), "99 % of Kolmogorov and Smirnov's test"


def test_a_crown_lets_through_what_its_chords_do():
    """Parallel light on a sphere: 2 (1 - (1 + τ) exp(-τ)) / τ², where τ is that of the middle."""
    places = np.sqrt((np.arange(MANY) + 0.5) / MANY)
    turn = np.pi * (1 + math.sqrt(5)) * np.arange(MANY)
    origin = 2 * np.stack([np.zeros(MANY), places * np.cos(turn), places * np.sin(turn)], axis=1)
    sensor = Sensor(Beams(np.zeros(MANY), origin=origin), Spin(1, 360))
    crown = Material("Crown", leaf_area_density=1.2)
    wall = box("Wall", (9, -9, -9), (10, 9, 9))
    found = cast([ball("Crown", 2.0), wall], sensor, (-5, 0, 0), materials=[GROUND, crown])
    tau = 0.5 * 1.2 * 4
    assert gap(found) == pytest.approx(2 * (1 - (1 + tau) * math.exp(-tau)) / tau**2, rel=0.01)


@pytest.mark.parametrize("backend", CPU)
def test_a_sensor_within_a_crown(backend):
    """From the middle of a sphere all rays go through its radius."""
    sensor = Sensor(Beams(np.radians(np.linspace(-80, 80, 60))), Spin(2000, 360))
    materials = [GROUND, Material("Crown", leaf_area_density=0.7)]
    meshes = [ball("Crown", 3.0), ball("Sky", 30.0, fineness=2)]
    found = cast(meshes, sensor, backend=backend, materials=materials)
    assert len(found["range"]) == 120_000
    assert gap(found, 120_000) == pytest.approx(math.exp(-0.35 * 3), rel=0.015)
    near = Sensor(sensor.beams, sensor.head, min_range_m=2.0, max_range_m=2.5)
    beyond = cast(meshes, near, backend=backend, materials=materials)
    assert 2 <= beyond["range"].min() <= beyond["range"].max() <= 2.5
    assert len(beyond["range"]) / 120_000 == pytest.approx(1 - math.exp(-0.35 * 0.5), rel=0.02)


def test_crowns_that_overlap_and_the_trunk_in_them():
    """Where two media overlap, their leaves add up; a trunk ends light as anywhere."""
    meshes = [
        box("Oak", (5, -9, -9), (9, 9, 9)),
        box("Ivy", (7, -8, -8), (11, 8, 8)),
        box("Trunk", (8, -2, -2), (8.5, 2, 0)),
        box("Wall", (20, -9, -9), (21, 9, 9)),
    ]
    leaves = [Material("Oak", leaf_area_density=0.2), Material("Ivy", leaf_area_density=0.6)]
    up, down = (rays(nadir_deg=90 + tilt) for tilt in (3, -1))
    found = cast(meshes, up, materials=[GROUND, *leaves])
    slant = 1 / math.cos(math.radians(3))
    oak, both, ivy = (np.array([0.1, 0.4, 0.3]) * [2, 2, 2]) * slant
    stops = [
        1 - math.exp(-oak) + math.exp(-oak) * 0.25 * (1 - math.exp(-both)),
        math.exp(-oak) * 0.75 * (1 - math.exp(-both))
        + math.exp(-oak - both) * (1 - math.exp(-ivy)),
    ]
    for number, stop in enumerate(stops):
        assert (found["object"] == number).mean() == pytest.approx(stop, rel=0.015)
    assert gap(found) - stops[1] == pytest.approx(math.exp(-oak - both - ivy), rel=0.02)
    found = cast(meshes, down, materials=[GROUND, *leaves])
    assert {*found["object"].tolist()} == {0, 1, 2}
    slant = 1 / math.cos(math.radians(1))
    assert (found["object"] == 2).mean() == pytest.approx(math.exp(-0.6 * slant), rel=0.01)


def test_leaves_are_as_bright_as_they_face_the_light():
    canopy, floor = box("Leaves", (-9, -9, 0), (9, 9, 3)), box("F", (-9, -9, -2), (9, 9, -1))
    leaves = Material("Leaves", 0.5, leaf_area_density=1.0, leaf_angle="planophile")
    found = cast([canopy, floor], rays(2000, 0.0), (0, 0, 10), materials=[GROUND, leaves])
    on = found["object"] == 0
    bright = brightness("planophile", np.ones(1))[0]
    expected = 0.5 * bright * (10 / found["range"][on]) ** 2
    assert found["intensity"][on] == pytest.approx(expected, rel=1e-5)
    # Of the whole cone, the mean over sub-rays is the gap's: each meets leaves by itself.
    beam = Returns("all", subrays=37, divergence_mrad=1)
    cone = cast(
        [canopy, floor], rays(4000, 0.0), (0, 0, 10), materials=[GROUND, leaves], returns=beam
    )
    tau = projection("planophile", np.ones(1))[0] * 3
    ground = cone["intensity"][cone["object"] == 1].sum() / 4000
    assert ground == pytest.approx(math.exp(-tau) * 0.3 * (10 / 11) ** 2, rel=0.02)
    assert cone["returns"].max() > 2


def test_moved_and_turned_crowns_hold_the_same_leaves():
    """Instances, mirrored ones too, and actors; and meshes whose triangles wind inwards."""
    crown, wall = ball("Crown", 1.0), box("Wall", (9, -9, -9), (10, 9, 9))
    materials = [GROUND, Material("Crown", leaf_area_density=0.8)]
    inwards = Mesh("Crown", crown.vertices * 2 + (4, 0, 0), crown.faces[:, ::-1])
    mirrored = np.diag([2.0, -2, 2, 1])
    mirrored[0, 3] = 4
    for meshes in ([inwards, wall], [Instance(crown, mirrored), wall]):
        found = cast(meshes, rays(), materials=materials)
        number = Scene.from_meshes(meshes).all_names.index("Crown")
        assert gap(found, leaves=number) == pytest.approx(math.exp(-0.4 * 4), rel=0.015)
    way = Track([0.0, 10.0], [(4, 0, 0), (4, 0, 0)])
    scene = Scene.from_meshes([wall]).with_actors(
        [Actor(Mesh("Crown", crown.vertices * 2, crown.faces), way)]
    )
    survey = Survey(rays(), poses=[(0, 0, 0)], steps=1, materials=materials)
    (batch,) = Rig(scene, survey, "embree").cast(0, 1)
    assert (batch.object == 0).mean() == pytest.approx(math.exp(-0.4 * 4), rel=0.015)


def test_a_surface_with_gaps_is_refused():
    open_box = box("Crown", (1, -1, -1), (2, 1, 1))
    gappy = Mesh("Crown", open_box.vertices, open_box.faces[1:])
    with pytest.raises(LidarpoolError, match="'Crown' has a leaf_area_density, but its surface"):
        cast([gappy], rays(1), materials=[Material("*", leaf_area_density=1.0)])


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"leaf_area_density": 1.0, "transparent": "pass"}, "leave out transparent"),
        ({"leaf_area_density": 1.0, "leaf_angle": "flat"}, "leaf_angle is 'flat'; it must be one"),
        ({"leaf_area_density": 0.0}, "leaf_area_density is 0.0; it must be above 0"),
    ],
)
def test_materials_that_mean_nothing_are_refused(fields, says):
    with pytest.raises(LidarpoolError, match=says):
        Material("*", **fields)


def test_a_leaf_angle_without_leaves_is_refused():
    with pytest.raises(LidarpoolError, match="'Crown' has a leaf_angle, which needs a leaf_area"):
        cast([ball("Crown", 1.0)], rays(1), materials=[Material("*", leaf_angle="planophile")])


# -- the same bits -------------------------------------------------------------------------------

WOOD = [
    ball("Crown", 3.0, (4, 1, 1), 2),
    ball("Bush", 1.5, (5, -2, 0.5), 2),
    box("Trunk", (3.8, 0.8, -2), (4.2, 1.2, 2)),
    box("Window", (-3, -2, 0), (-2.9, 2, 2)),
    box("Ground", (-30, -30, -3), (30, 30, -2)),
]
ALL_ON = {
    "materials": [
        Material("*", 0.4),
        Material("Crown", 0.5, leaf_area_density=0.8, leaf_angle=1.7),
        Material("Bush", 0.5, leaf_area_density=2.0, leaf_angle="erectophile"),
        Material("Window", transparent="pass", refractive_index=1.5, attenuation_per_m=0.3),
    ],
    "returns": Returns(
        "all", 7, [9.0, 3.0], beam_profile="gaussian", exit_diameter_m=0.02, pulse_ns=2
    ),
    "noise": Noise(0.02, 0.001, 0.05, 0.1, 40, seed=5),
    "visibility_km": 0.5,
    "columns": ("ray", "range", "intensity", "return_number", "class"),
}


@pytest.mark.parametrize(
    "path", [{"poses": [Pose((0, 0, 1), 10, 5, -3), (4, 0, 1)]}, {"trajectory": Cart()}]
)
def test_batches_chunks_and_backends_leave_no_trace(path, monkeypatch):
    sensor = Sensor(Beams(np.radians([-20, -5, 0, 12])), Spin(360, step_deg=30), 0.5, 20)
    survey = Survey(sensor, steps=12, keep_every=2, **ALL_ON, **path)
    rig = Rig(Scene.from_meshes(WOOD), survey, "numpy")
    whole = cast_between(rig, survey, [0, 24])
    assert len(whole[0]["x"]) > 4000
    monkeypatch.setattr("lidarpool.simulator.echoes.CHUNK_RAYS", 1000)
    assert cast_between(rig, survey, [0, 1, 5, 12, 17, 24]) == whole
    if "embree" in CPU:
        other = Rig(Scene.from_meshes(WOOD), survey, "embree")
        assert cast_between(other, survey, [0, 24]) == whole
    assert tally_of([*rig.cast(0, 24)]).sum() > 0


def test_another_seed_is_another_tree():
    materials = [GROUND, Material("Crown", leaf_area_density=0.8)]
    meshes = [ball("Crown", 2.0, (4, 0, 0)), box("Wall", (9, -9, -9), (10, 9, 9))]
    one, same, other = (
        cast(meshes, rays(500), materials=materials, noise=Noise(seed=seed))["range"]
        for seed in (1, 1, 2)
    )
    assert np.array_equal(one, same)
    assert not np.array_equal(one[:100], other[:100])


@pytest.mark.parametrize("backend", CPU)
@pytest.mark.parametrize("order", [1, -1])
def test_layers_that_touch_each_other(backend, order):
    """As voxels do: six of them side by side are one of six metres."""
    layers = [box(f"Voxel{x}", (x, -9, -9), (x + 1, 9, 9)) for x in range(2, 8)][::order]
    wall = box("Wall", (8, -9, -9), (10, 9, 9))
    materials = [GROUND, Material("Voxel*", leaf_area_density=0.4)]
    found = cast(
        [*layers, wall],
        rays((backend == "embree" and MANY) or 10_000, 91.0),
        backend=backend,
        materials=materials,
    )
    tau = 0.2 * 6 / math.cos(math.radians(1))
    assert (found["object"] == 6).mean() == pytest.approx(math.exp(-tau), rel=0.02)
    counts = np.bincount(found["object"], minlength=7)[:6][::order] / len(found["object"])
    assert counts == pytest.approx(np.exp(-0.2 * np.arange(6)) * (1 - math.exp(-0.2)), rel=0.1)


def test_a_wood_of_crowns_that_overlap_anyhow():
    """From within and outside, gaps are those of the chords of all ellipsoids, added up."""
    rng = np.random.default_rng(3)
    unit = trimesh.creation.icosphere(4, 1.0007)  # of the volume of the sphere
    kinds, meshes, materials, crowns = ("spherical", "planophile", 0.5), [], [Material("*")], []
    for number in range(24):
        centre, radii = rng.uniform(-5, 5, 3), rng.uniform(0.8, 3, 3)
        inwards = np.array(unit.faces)[:, :: -1 if number % 4 == 0 else 1]
        meshes.append(Mesh(f"C{number}", np.array(unit.vertices) * radii + centre, inwards))
        thick, kind = float(rng.uniform(0.05, 0.4)), kinds[number % 3]
        materials.append(Material(f"C{number}", leaf_area_density=thick, leaf_angle=kind))
        crowns.append((centre, radii, thick, kind))
    meshes.append(ball("Sky", 60.0, fineness=2))
    sensor = Sensor(Beams(np.radians(np.linspace(-75, 75, 30))), Spin(100, 360))
    places = rng.uniform(-6, 6, (8, 3))
    survey = Survey(sensor, poses=places.tolist(), steps=1, materials=materials)
    rig = Rig(Scene.from_meshes(meshes), survey, CPU[-1])
    ahead = sensor.directions(np.arange(100)).reshape(-1, 3)
    off, variance = 0.0, 0.0
    for place, batch in zip(places, rig.cast(0, 8), strict=True):
        tau = np.zeros(len(ahead))
        for centre, radii, thick, kind in crowns:
            start, way = (place - centre) / radii, ahead / radii
            a, b, c = (way**2).sum(axis=1), way @ start, start @ start - 1
            root = np.sqrt(np.maximum(b * b - a * c, 0))
            chord = np.maximum((root - b) / a, 0) - np.maximum((-root - b) / a, 0)
            tau += projection(kind, np.abs(ahead[:, 2])) * thick * chord
        gaps = np.exp(-tau)
        assert len(batch.object) == len(ahead)
        off += (batch.object == 24).sum() - gaps.sum()
        variance += (gaps * (1 - gaps)).sum()
    assert abs(off) < 3 * math.sqrt(variance)
    assert any((((place - c) / r) ** 2).sum() < 1 for place in places for c, r, *_ in crowns)
