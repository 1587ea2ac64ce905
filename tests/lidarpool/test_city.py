"""The made-up city: as large as asked, closed things on the ground, streets between them."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import trimesh

from lidarpool import LidarpoolError
from lidarpool.scene.city import city
from lidarpool.scene.city_kinds import all_kinds


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


@pytest.mark.parametrize(("triangles", "seed"), [(0, 0), (999, 0), (10**9, 0), (10_000, -1)])
def test_out_of_range(triangles, seed):
    with pytest.raises(LidarpoolError, match=r"triangles is|seed is"):
        city(triangles, seed)
