import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidarpool.render.hits import hit_density
from lidarpool.scene.mesh import Mesh
from lidarpool.scene.scene import Scene


def sheet(n):
    """A square of n x n cells, one metre wide."""
    x, y = np.meshgrid(np.linspace(0, 1, n + 1), np.linspace(0, 1, n + 1))
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    number = np.arange(x.size).reshape(n + 1, n + 1)
    a, b, c, d = (
        q.ravel() for q in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1])
    )
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return Scene.from_meshes([Mesh("Sheet", vertices, faces)])


SHEET = sheet(6)
AREA = 1 / len(SHEET.faces)


@given(st.lists(st.integers(0, 40), min_size=72, max_size=72))
def test_sharing_hits_keeps_their_number(counts):
    density = hit_density(SHEET, np.array(counts))
    assert (density >= 0).all()
    assert (density * AREA).sum() == pytest.approx(sum(counts))


def test_many_hits_a_triangle_are_not_smeared():
    hits = np.zeros(72)
    hits[10] = 500
    density = hit_density(SHEET, hits)
    assert density[10] == pytest.approx(500 / AREA)
    assert not density[np.arange(72) != 10].any()


def test_triangles_without_area_have_no_density():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0]], dtype=float)
    scene = Scene.from_meshes([Mesh("Odd", vertices, np.array([[0, 1, 2], [0, 1, 3]]))])
    density = hit_density(scene, np.array([4.0, 3.0]))
    assert np.isfinite(density).all() and density[1] == 0
