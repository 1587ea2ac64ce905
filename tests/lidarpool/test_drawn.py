"""Instances as pictures have them: all, or fewer triangles that look like all."""

from __future__ import annotations

import numpy as np
import pytest

from lidarpool import Scene
from lidarpool.scene.drawn import PART_LEAST, Drawn
from lidarpool.scene.mesh import triangle_areas
from lidarpool.scene.plants import SPECIES, placed, tree


@pytest.fixture(scope="module")
def avenue():
    """A row of 40 birches, 10 m apart."""
    x = 10.0 * np.arange(40)
    places = np.column_stack([x, np.zeros((40, 2))])
    kind = np.zeros(40, np.int64)
    return Scene.from_meshes(placed([tree(SPECIES[2])], kind, places, x, np.ones(40)))


def sizes(drawn):
    return np.bincount(drawn.scene.face_object, minlength=len(drawn.scene.names))


def test_few_triangles_are_all_there(avenue):
    drawn = Drawn.of(avenue)
    assert len(drawn.scene.faces) == avenue.triangles
    np.testing.assert_allclose(drawn.scene.object_bounds, avenue.object_bounds, atol=1e-9)


@pytest.mark.parametrize("most", [40_000, 8_000])
def test_fewer_triangles_cover_about_as_much(avenue, most):
    drawn = Drawn.of(avenue, most)
    assert 0.9 * most < len(drawn.scene.faces) <= most
    assert np.ptp(sizes(drawn)) == 0
    area = triangle_areas(drawn.scene.vertices[drawn.scene.faces]).sum()
    part = avenue.instances.parts[0]
    whole = 40 * triangle_areas(part.vertices[part.faces]).sum()
    assert 0.6 * whole < area < 1.5 * whole
    # No branch that was made larger sticks out.
    slack = np.array([[-1.0], [1.0]]) * (0.6 if most == 40_000 else 1.5)
    reach = avenue.object_bounds + slack
    assert (drawn.scene.object_bounds[:, 0] > reach[:, 0]).all()
    assert (drawn.scene.object_bounds[:, 1] < reach[:, 1]).all()


def test_what_is_near_the_sensors_has_more_triangles(avenue):
    place = np.array([[200.0, 3, 2], [205, 3, 2]])
    drawn = Drawn.of(avenue, 40_000, [place])
    some = sizes(drawn)
    assert some[20] == len(avenue.instances.parts[0].faces)
    assert (np.diff(some[:20]) >= 0).all() and (np.diff(some[21:]) <= 0).all()
    assert some.min() == 500 and some.sum() <= 40_000 < 2 * some.sum()
    assert Drawn.of(avenue, 40_000, [np.zeros((0, 3))]).scene.triangles <= 40_000
    assert sizes(Drawn.of(avenue, 100, [place])).min() == PART_LEAST


def test_hits_are_shared_by_area(avenue):
    drawn = Drawn.of(avenue, 40_000, [np.zeros((1, 3))])
    counts = np.arange(40.0)
    hits = drawn.hits(counts)
    assert np.bincount(drawn.scene.face_object, hits) == pytest.approx(counts)
