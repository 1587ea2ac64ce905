"""The made-up terrain: a height field of the size asked for, rough at every scale."""

from __future__ import annotations

import numpy as np
import pytest

from lidarpool import LidarpoolError
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


@pytest.mark.parametrize(
    "wrong",
    [{"triangles": 1}, {"triangles": 10**9}, {"seed": -1}, {"side_m": 0.0}, {"side_m": 1e8}],
)
def test_out_of_range(wrong):
    with pytest.raises(LidarpoolError):
        terrain(**{"triangles": 1000, **wrong})
