"""Instances as pictures have them: all, or fewer triangles that look like all."""

from __future__ import annotations

import numpy as np
import pytest
from tests.shapes import block, level

from lidarscenes.procedural.plants import SPECIES, place_instances, tree
from lidarsim import Scene, SceneMesh, box
from lidarsim.scene.scene_mesh import Cutout, triangle_areas
from lidarsim.scene.simplified import MIN_PART_TRIANGLES, SimplifiedScene, cut_masks
from lidarview.render.closeup import ScenePart, floor_and_cut_heights
from raybeam import RayCaster


@pytest.fixture(scope="module")
def avenue():
    """A row of 40 birches, 10 m apart."""
    x = 10.0 * np.arange(40)
    places = np.column_stack([x, np.zeros((40, 2))])
    kind = np.zeros(40, np.int64)
    return Scene.from_meshes(place_instances([tree(SPECIES[2])], kind, places, x, np.ones(40)))


def sizes(drawn):
    return np.bincount(drawn.scene.face_object, minlength=len(drawn.scene.names))


@pytest.mark.parametrize("most", [40_000, 8_000])
def test_fewer_triangles_cover_about_as_much(avenue, most):
    drawn = SimplifiedScene.from_scene(avenue, most)
    assert 0.9 * most < len(drawn.scene.faces) <= most
    assert np.ptp(sizes(drawn)) == 0
    area = triangle_areas(drawn.scene.vertices[drawn.scene.faces]).sum()
    part = avenue.instances.mesh_parts[0]
    whole = 40 * triangle_areas(part.vertices[part.faces]).sum()
    assert 0.6 * whole < area < 1.5 * whole
    # No branch that was made larger sticks out.
    slack = np.array([[-1.0], [1.0]]) * (0.6 if most == 40_000 else 1.5)
    reach = avenue.object_bounds + slack
    assert (drawn.scene.object_bounds[:, 0] > reach[:, 0]).all()
    assert (drawn.scene.object_bounds[:, 1] < reach[:, 1]).all()


def test_what_is_near_the_sensors_has_more_triangles(avenue):
    place = np.array([[200.0, 3, 2], [205, 3, 2]])
    drawn = SimplifiedScene.from_scene(avenue, 40_000, [place])
    some = sizes(drawn)
    assert some[20] == len(avenue.instances.mesh_parts[0].faces)
    assert (np.diff(some[:20]) >= 0).all() and (np.diff(some[21:]) <= 0).all()
    assert some.min() == 500 and some.sum() <= 40_000 < 2 * some.sum()
    assert SimplifiedScene.from_scene(avenue, 40_000, [np.zeros((0, 3))]).scene.triangles <= 40_000
    assert sizes(SimplifiedScene.from_scene(avenue, 100, [place])).min() == MIN_PART_TRIANGLES


def test_hits_are_shared_by_area(avenue):
    drawn = SimplifiedScene.from_scene(avenue, 40_000, [np.zeros((1, 3))])
    counts = np.arange(40.0)
    hits = drawn.triangle_hit_counts(counts)
    assert np.bincount(drawn.scene.face_object, hits) == pytest.approx(counts)


@pytest.mark.parametrize("repeats", [1, 300], ids=["coarse", "finer than the pieces"])
def test_what_masks_leave_is_drawn(repeats):
    """A wall, and a card of 2 by 1 m whose mask is opaque in three quarters of its left half."""
    mask = np.zeros((4, 4), bool)
    mask[:3, :2] = True
    corners = np.array([[0.0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    uv = (corners[faces, :2] / [2, 1] * repeats).astype(np.float32)
    wall = SceneMesh("Wall", corners, faces)
    card = SceneMesh("Card", corners, faces, (Cutout(mask, uv),))
    scene = Scene.from_meshes([wall, card])
    drawn = SimplifiedScene.from_scene(cut_masks(scene))
    before = SimplifiedScene.from_scene(scene)
    own = drawn.scene.faces[drawn.scene.face_object == 1]
    a, b, c = drawn.scene.vertices[own].transpose(1, 0, 2)
    areas = np.cross(b - a, c - a) / 2
    assert (areas[:, 2] > 0).all() and areas[:, 2].sum() == pytest.approx(2 * 3 / 8, rel=0.05)
    middle = (a + b + c) / 3
    assert (middle[:, 2] == 0).all() and (middle >= 0).all() and (middle[:, :2] <= [2, 1]).all()
    if repeats == 1:
        assert np.mean((middle[:, 0] < 1.01) & (middle[:, 1] < 0.76)) == 1
    counts = np.array([3.0, 4, 5])
    shared = np.bincount(drawn.counter, drawn.triangle_hit_counts(counts))
    assert np.allclose(shared, np.bincount(before.counter, before.triangle_hit_counts(counts)))
    assert cut_masks(Scene.from_meshes([wall])).faces.shape == (2, 3)


def test_a_card_that_is_transparent_everywhere_stays_a_speck():
    uv = np.zeros((1, 3, 2), np.float32)
    cutout = Cutout(np.zeros((2, 2), bool), uv)
    scene = Scene.from_meshes([SceneMesh("Card", np.eye(3), np.arange(3)[None], (cutout,))])
    drawn = SimplifiedScene.from_scene(cut_masks(scene)).scene
    assert len(drawn.faces) == 1 and np.ptp(drawn.vertices, axis=0).max() < 0.1


def test_what_is_wide_is_cut_and_what_stands_outside_is_left_out():
    """Two triangles of ground, a tower and a hut inside, and a hut outside."""
    scene = Scene.from_meshes([
        level("ground", 0, 200),
        block("tower", (10, 10, 80), (10, 10, 40)),
        block("hut", (4, 4, 3), (-10, 10, 1.5)),
        block("other hut", (4, 4, 3), (100, 10, 1.5)),
    ])  # fmt: skip
    cut = ScenePart.from_scene(scene).cut(np.array([[-30.0, -20, 0], [30, 20, 27]]))
    part = cut.scene
    shares = cut.shares
    there = {scene.names[k] for k in np.unique(part.face_object)}
    assert there == {"ground", "tower", "hut"}
    assert part.bounds == pytest.approx(np.array([[-30, -20, 0], [30, 20, 27]]))
    assert np.array_equal(part.face_object, scene.face_object[cut.parents])
    ground = part.face_object == 0
    a, b, c = (part.vertices[part.faces[ground, k]] for k in range(3))
    assert np.cross(b - a, c - a)[:, 2].sum() / 2 == pytest.approx(60 * 40)  # none turned over
    assert shares[ground].sum() == pytest.approx(2 * 60 * 40 / 400**2)
    assert (shares[part.face_object == 2] == 1).all()


def test_a_roof_is_cut_open_and_a_crown_is_not():
    places = np.array([[0.9, 0, 1], [-0.8, 0.5, 1], [0, 1.1, 1]])
    for over, height in ((box("hall", (20, 20, 7)), 4.0), (tree(SPECIES[0]), None)):
        scene = Scene.from_meshes([over])
        caster = RayCaster(scene.vertices, scene.faces, "numpy")
        assert floor_and_cut_heights(scene, caster, places)[1] == (height and pytest.approx(height))
