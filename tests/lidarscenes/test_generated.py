"""Made-up cities, terrains, trees and cars: as large as asked, and the same for a seed."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from lidarscenes.procedural.cars import MODELS, all_cars
from lidarscenes.procedural.city import city
from lidarscenes.procedural.city_kinds import all_kinds
from lidarscenes.procedural.plants import SCALES, SPECIES, tree
from lidarscenes.procedural.terrain import terrain
from lidarscenes.writers.scene_file import write_scene
from lidarsim import LidarError
from lidarsim.scene.scene_mesh import triangle_areas
from lidarsim.scene.shapes import SEED_POSITIONS, revolve, seed_objects
from raybeam import RayCaster

TREES = [species.name for species in SPECIES]
CARS = [model.name for model in MODELS]


@pytest.mark.parametrize("triangles", [1_000, 20_000, 1_000_000])
def test_as_many_triangles_as_asked(triangles):
    scene = city(triangles)
    assert 0.98 * triangles <= len(scene.faces) <= triangles
    if triangles >= 100_000:
        assert len(scene.faces) >= 0.999 * triangles


def test_everything_stands_on_the_ground():
    scene = city(100_000)
    bounds = scene.object_bounds
    assert scene.names[0] == "ground"
    assert np.ptp(bounds[0, :, 2]) == 0
    things = bounds[2:]
    np.testing.assert_array_less(-0.2, things[:, 0, 2])
    np.testing.assert_array_less(things[:, 0, 2], 0.2)
    assert (things[:, 0, :2] > bounds[0, 0, :2]).all()
    assert (things[:, 1, :2] < bounds[0, 1, :2]).all()
    assert things[:, 1, 2].max() > 30  # there are towers
    # their sizes are those of what they are called
    height = dict(zip(scene.names[2:], things[:, 1, 2], strict=True))
    assert all(1 < height[name] < 3 for name in height if name.startswith("car"))
    assert all(3 < height[name] < 15 for name in height if name.startswith("tree"))
    assert all(height[name] > 3 for name in height if name.startswith("building"))


def test_every_kind_is_made_of_closed_solids_that_face_outward():
    for kind in itertools.chain(*all_kinds().values()):
        solid = trimesh.Trimesh(kind.vertices, kind.faces, process=False)
        assert solid.is_volume
        assert solid.area_faces.min() > 0
        assert kind.vertices[:, 2].min() > -0.05


def stripped(scene, words):
    """Objects whose names begin with one of some words: {name: bounds}, by instance."""
    names = [name.partition(".")[0] for name in scene.names]
    rows = [row for row, name in enumerate(names) if name in words]
    return [names[row] for row in rows], scene.object_bounds[rows]


@pytest.fixture(scope="module")
def furnished():
    return city(100_000, 2, trees=300, cars=150)


def test_detailed_trees_and_cars_are_instances(furnished):
    plain = city(100_000, 2)
    kept = [name for name in plain.names if not name.startswith(("tree", "car"))]
    assert list(furnished.names[: len(kept)]) == kept
    rows = [plain.names.index(name) for name in kept]
    assert (furnished.object_bounds[: len(kept)] == plain.object_bounds[rows]).all()
    kinds, _ = stripped(furnished, TREES)
    assert len(kinds) == 300 and set(kinds) == set(TREES)
    assert {"Oak", "Oak.2"} <= set(furnished.names)
    kinds, _ = stripped(furnished, CARS)
    assert len(kinds) == 150 and set(kinds) == set(CARS)
    assert len(furnished.instances) == 450 and len(furnished.instances.mesh_parts) == 8
    scales = np.cbrt(np.linalg.det(furnished.instances.transforms[:, :, :3]))
    assert (scales > 0.69).all() and (scales < 1.31).all()
    assert furnished.kept_triangles < 200_000 < furnished.triangles


@pytest.mark.extended
def test_same_seed_same_trees_and_cars(tmp_path):
    files = [
        write_scene(tmp_path / f"{seed}{n}.glb", city(20_000, seed, trees=50, cars=30))
        for n, seed in enumerate((3, 3, 4))
    ]
    one, same, other = (file.read_bytes() for file in files)
    assert one == same != other
    assert len(one) < 2_500_000
    assert len(city(20_000, 3, trees=50).instances.mesh_parts) == 5
    assert any(name.startswith("tree-") for name in city(20_000, 3, cars=5).names)


@pytest.mark.parametrize("more", [{"trees": 5_000}, {"cars": 5_000}])
def test_more_than_fit(more):
    with pytest.raises(
        LidarError, match=r"city has room for \d+ (trees|cars), but 5,000 were requested"
    ):
        city(20_000, **more)


@pytest.mark.parametrize(("triangles", "seed"), [(0, 0), (999, 0), (10**9, 0), (10_000, -1)])
def test_out_of_range(triangles, seed):
    with pytest.raises(LidarError, match=r"(triangles|seed) must be a whole number from"):
        city(triangles, seed)


@pytest.mark.parametrize("triangles", [2, 7, 1999, 20_000])
def test_as_many_triangles_as_fit_a_grid(triangles):
    scene = terrain(triangles)
    assert triangles - 2 * np.sqrt(triangles) <= len(scene.faces) <= triangles
    assert scene.names == ("terrain",)


def test_same_seed_same_terrain():
    one, other, third = (terrain(5000, seed) for seed in (1, 1, 2))
    assert one.vertices.tobytes() == other.vertices.tobytes()
    assert np.abs(one.vertices - third.vertices).max() > 1


def test_it_is_a_height_field_without_holes():
    scene = terrain(20_000)
    rng = np.random.default_rng(0)
    above = np.column_stack([rng.uniform(-500, 500, (2000, 2)), np.full(2000, 500)])
    hits = RayCaster(scene.vertices, scene.faces, "numpy").cast(above, [[0, 0, -1]] * 2000)
    assert hits.hit.all()
    a, b, c = (scene.vertices[scene.faces[:, k]] for k in range(3))
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()


@pytest.mark.extended
def test_trees_stand_on_ground_that_is_not_steep():
    plain = terrain(80_000, 1, 200.0)
    scene = terrain(80_000, 1, 200.0, trees=400)
    assert scene.vertices.tobytes() == plain.vertices.tobytes()
    kinds = {name.partition(".")[0] for name in scene.names[1:]}
    assert len(scene.names) == 401 and kinds == {species.name for species in SPECIES}
    roots = scene.instances.transforms[:, :, 3]
    caster = RayCaster(plain.vertices, plain.faces, "numpy")
    above = np.column_stack([roots[:, :2], np.full(400, 500)])
    hits = caster.cast(above, [[0, 0, -1]] * 400)
    np.testing.assert_allclose(500 - hits.distance, roots[:, 2], atol=1e-6)
    a, b, c = plain.vertices[plain.faces[hits.triangle]].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    assert (normals[:, 2] / np.linalg.norm(normals, axis=1) > np.cos(np.radians(40.1))).all()
    apart = np.linalg.norm(roots[:, None, :2] - roots[None, :, :2], axis=2)
    assert apart[~np.eye(400, dtype=bool)].min() > 2.9
    assert np.hypot(*roots[:, :2].T).min() > 12
    # Trunks go on below the ground, and nothing stands over the edge.
    assert (scene.object_bounds[1:, 0, 2] < roots[:, 2]).all()
    again = terrain(80_000, 1, 200.0, trees=400)
    assert again.instances.transforms.tobytes() == scene.instances.transforms.tobytes()


@pytest.mark.parametrize(("side", "room"), [(30.0, "0"), (100.0, r"\d+")])
def test_more_trees_than_fit(side, room):
    with pytest.raises(LidarError, match=rf"has room for {room} trees, but 900 were requested"):
        terrain(20_000, 0, side, trees=900)


@pytest.mark.parametrize(
    "wrong",
    [
        {"triangles": 1},
        {"triangles": 10**9},
        {"seed": -1},
        {"side_m": 0.0},
        {"side_m": 1e8},
        {"trees": -1},
    ],
)
def test_terrains_out_of_range(wrong):
    with pytest.raises(LidarError):
        terrain(**{"triangles": 1000, **wrong})


@pytest.mark.parametrize("species", SPECIES, ids=lambda species: species.name)
def test_a_tree_has_a_trunk_and_leaves_around_it(species):
    made = tree(species, 7, root_m=0.5)
    assert 5_000 < len(made.faces) < 20_000
    low = made.vertices.min(axis=0)
    high = made.vertices.max(axis=0)
    assert low[2] == pytest.approx(-0.5, abs=0.1)
    assert SCALES[0] * high[2] > 6 and SCALES[1] * high[2] < 21
    root = made.vertices[made.vertices[:, 2] < 0]
    assert np.hypot(*root[:, :2].T).max() < 2 * species.trunk_m
    areas = triangle_areas(made.vertices[made.faces])
    assert areas.min() > 0
    # Leaves are triangles by themselves, and have most of the surface.
    used = np.bincount(made.faces.ravel())
    leaves = (used[made.faces] == 1).all(axis=1)
    assert leaves.sum() == species.branches * species.twigs * species.leaves
    assert areas[leaves].sum() > areas[~leaves].sum()


def test_cars_are_closed_bodies_on_wheels():
    assert [car.name for car in all_cars()] == [model.name for model in MODELS]
    for car in all_cars():
        body = trimesh.Trimesh(car.vertices, car.faces)
        assert body.is_watertight and body.is_winding_consistent
        length, width, height = body.extents
        assert 4 < length <= 5 and 1.7 < width < 2.1 and 1.4 < height < 2.2
        assert 5 < body.volume < 20  # its sides face outward
        assert car.vertices[:, 2].min() == pytest.approx(0)
        assert 300 < len(car.faces) < 1_000


def solid(mesh):
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


@pytest.mark.parametrize("index", range(6))
def test_each_seed_object(index):
    mesh = seed_objects()[index]
    assert len(mesh.faces) == 12_800
    assert len(mesh.vertices) == 80 * 80 + 2
    assert solid(mesh).is_volume, "closed, faces outward"
    assert solid(mesh).area_faces.min() > 1e-5
    assert len(np.unique(mesh.vertices.round(9), axis=0)) == len(mesh.vertices)
    local = mesh.vertices - [*SEED_POSITIONS[index], 0]
    assert np.hypot(local[:, 0], local[:, 1]).max() == pytest.approx(2.0, abs=1e-12)
    assert local[:, 2].min() == 0.0
    assert 2.0 <= local[:, 2].max() <= 5.2
    if mesh.name == "Sphere":
        assert solid(mesh).volume == pytest.approx(4 / 3 * np.pi * 8, rel=3e-3)


@settings(max_examples=40)
@given(
    st.lists(st.tuples(st.floats(0.01, 10), st.floats(0.01, 5)), min_size=1, max_size=12),
    st.integers(3, 40),
)
def test_revolved_profiles_are_watertight(steps, segments):
    heights = np.cumsum([0.0] + [step for _, step in steps] + [1.0])
    radii = [0.0, *(radius for radius, _ in steps), 0.0]
    mesh = revolve(np.column_stack([radii, heights]), segments)
    assert len(mesh.faces) == 2 * len(steps) * segments
    assert solid(mesh).is_volume
