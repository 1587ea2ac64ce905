"""The made-up trees and cars: of the sizes of real ones, the same for the same seed."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from lidarpool.scene.cars import MODELS, all_cars
from lidarpool.scene.mesh import triangle_areas
from lidarpool.scene.plants import SCALES, SPECIES, placed, tree


@pytest.mark.parametrize("species", SPECIES, ids=lambda species: species.name)
def test_a_tree_has_a_trunk_and_leaves_around_it(species):
    made = tree(species, 7, root_m=0.5)
    assert 5_000 < len(made.faces) < 20_000
    low, high = made.vertices.min(axis=0), made.vertices.max(axis=0)
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


def test_same_seed_same_trees():
    one, same, other = tree(SPECIES[0], 1), tree(SPECIES[0], 1), tree(SPECIES[0], 2)
    assert one.vertices.tobytes() == same.vertices.tobytes()
    assert one.vertices.tobytes() != other.vertices.tobytes()


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


def test_they_are_placed_upright():
    places = np.array([[5.0, 0, 1], [0, 9, 2]])
    turns, scales = np.array([np.pi / 2, 0]), np.array([2.0, 1.0])
    cars = all_cars()
    one, other = placed(cars, np.array([0, 2]), places, turns, scales)
    assert (one.name, other.name) == ("Saloon", "Panel van")
    nose = one.mesh.vertices[one.mesh.vertices[:, 0].argmax()]
    moved = one.flat().vertices[one.mesh.vertices[:, 0].argmax()]
    assert moved == pytest.approx([5 - 2 * nose[1], 2 * nose[0], 1 + 2 * nose[2]])
