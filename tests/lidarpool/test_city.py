"""The made-up city: as large as asked, closed things on the ground, streets between them."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import trimesh

from lidarpool import LidarpoolError
from lidarpool.scene.cars import MODELS
from lidarpool.scene.city import city
from lidarpool.scene.city_kinds import all_kinds
from lidarpool.scene.plants import SPECIES
from lidarpool.scene.scene_file import write_scene

TREES, CARS = [species.name for species in SPECIES], [model.name for model in MODELS]


@pytest.mark.parametrize("triangles", [1_000, 20_000, 1_000_000])
def test_as_many_triangles_as_asked(triangles):
    scene = city(triangles)
    assert 0.98 * triangles <= len(scene.faces) <= triangles
    if triangles >= 100_000:
        assert len(scene.faces) >= 0.999 * triangles


def test_same_seed_same_city():
    one, other, third = city(20_000, 3), city(20_000, 3), city(20_000, 4)
    assert one.vertices.tobytes() == other.vertices.tobytes()
    assert one.faces.tobytes() == other.faces.tobytes()
    assert one.names == other.names
    assert third.vertices.tobytes() != one.vertices.tobytes()


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


def apart(bounds, others, slack=0.0):
    """Whether no box (n, 2, 3) overlaps one of others, seen from above."""
    low, high = bounds[:, None, 0, :2], bounds[:, None, 1, :2]
    beside = (low >= others[:, 1, :2] - slack) | (high <= others[:, 0, :2] + slack)
    return beside.any(axis=2)


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
    assert len(furnished.instances) == 450 and len(furnished.instances.parts) == 8
    scales = np.cbrt(np.linalg.det(furnished.instances.transforms[:, :, :3]))
    assert (scales > 0.69).all() and (scales < 1.31).all()
    assert furnished.kept_triangles < 200_000 < furnished.triangles


def test_trees_touch_no_building_and_cars_stand_on_the_carriageway(furnished):
    _, trees = stripped(furnished, TREES)
    _, cars = stripped(furnished, CARS)
    names = np.array([name.partition("-")[0] for name in furnished.names])
    assert apart(trees, furnished.object_bounds[names == "building"]).all()
    trunks = trees.mean(axis=1, keepdims=True).repeat(2, axis=1)
    pavement = pavements(furnished)
    assert not apart(trunks, pavement).all(axis=1).any()  # each stands on one
    assert apart(cars, pavement).all()
    assert (~apart(cars, cars)).sum() == len(cars)  # each is only where it is itself
    np.testing.assert_allclose(cars[:, 0, 2], 0, atol=1e-6)
    sides = np.sort(cars[:, 1, :2] - cars[:, 0, :2], axis=1)
    assert (sides[:, 1] <= 5).all() and (sides[:, 0] < 2.1).all()  # along a street
    # The crossing in the middle, where a sensor stands, is free.
    everything = np.concatenate([trees, cars])
    assert apart(everything, np.array([[[-6, -6, 0], [6, 6, 0]]])).all()


def pavements(scene):
    """Bounds of the slabs, (b, 2, 3), each a box of 8 corners."""
    (part,) = [mesh for mesh in scene.meshes() if mesh.name == "pavement"]
    corners = part.vertices.reshape(-1, 8, 3)
    return np.stack([corners.min(axis=1), corners.max(axis=1)], axis=1)


def test_same_seed_same_trees_and_cars(tmp_path):
    files = [
        write_scene(tmp_path / f"{seed}{n}.glb", city(20_000, seed, trees=50, cars=30))
        for n, seed in enumerate((3, 3, 4))
    ]
    one, same, other = (file.read_bytes() for file in files)
    assert one == same != other
    assert len(one) < 2_500_000
    assert len(city(20_000, 3, trees=50).instances.parts) == 5
    assert any(name.startswith("tree-") for name in city(20_000, 3, cars=5).names)


@pytest.mark.parametrize("more", [{"trees": 5_000}, {"cars": 5_000}])
def test_more_than_fit(more):
    with pytest.raises(
        LidarpoolError, match=r"city has room for \d+ (trees|cars), not 5,000: give"
    ):
        city(20_000, **more)


@pytest.mark.parametrize(("triangles", "seed"), [(0, 0), (999, 0), (10**9, 0), (10_000, -1)])
def test_out_of_range(triangles, seed):
    with pytest.raises(LidarpoolError, match=r"triangles is|seed is"):
        city(triangles, seed)
