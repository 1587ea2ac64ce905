"""The made-up terrain: a height field of the size asked for, rough at every scale."""

from __future__ import annotations

import numpy as np
import pytest

from lidarpool import LidarpoolError
from lidarpool.scene.plants import SPECIES
from lidarpool.scene.terrain import terrain
from raybeam import RayCaster


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


def test_trees_stand_on_ground_that_is_not_steep():
    plain, scene = terrain(80_000, 1, 200.0), terrain(80_000, 1, 200.0, trees=400)
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


@pytest.mark.parametrize(("triangles", "side"), [(2, 100.0), (2_000, 1e7)])
def test_trees_on_terrains_of_any_size(triangles, side):
    assert len(terrain(triangles, 0, side, trees=20).names) == 21


@pytest.mark.parametrize(("side", "room"), [(30.0, "0"), (100.0, r"\d+")])
def test_more_trees_than_fit(side, room):
    with pytest.raises(LidarpoolError, match=rf"has room for {room} trees, not 900: make it"):
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
def test_out_of_range(wrong):
    with pytest.raises(LidarpoolError):
        terrain(**{"triangles": 1000, **wrong})
