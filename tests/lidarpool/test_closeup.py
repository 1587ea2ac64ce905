"""The part of a scene that is drawn: around the way of a carrier, and under a roof."""

import numpy as np
import pytest

from lidarpool import Scene
from lidarpool.render.closeup import Part, around_ways, floor_and_cut
from lidarpool.render.cutaway import Cutaway
from lidarpool.render.surface import Surface
from lidarpool.scene.actors import box
from lidarpool.scene.mesh import Mesh
from lidarpool.scene.plants import SPECIES, tree
from lidarpool.scene.terrain import terrain
from raybeam import RayCaster

BOUNDS = np.array([[-200.0, -200, 0], [200, 200, 80]])


def test_a_drive_through_a_city_is_looked_at_from_near_and_a_flight_over_it_is_not():
    drive = np.array([[-40.0, 0, 2], [0, 0, 2]])
    near = around_ways(BOUNDS, [drive])
    assert near is not None
    assert near.tolist() == [[-65, -25, 0], [25, 25, 27]]
    assert around_ways(BOUNDS, [drive + np.array([0, 0, 300])]) is None
    assert around_ways(BOUNDS, []) is None
    assert around_ways(BOUNDS / 10, [drive / 10]) is None  # a yard


def moved(mesh, x, y):
    return Mesh(mesh.name, mesh.vertices + np.array([x, y, 0]), mesh.faces)


def test_what_is_wide_is_cut_and_what_stands_outside_is_left_out():
    """Two triangles of ground, a tower and a hut inside, and a hut outside."""
    corners = np.array([[-200.0, -200, 0], [200, -200, 0], [200, 200, 0], [-200, 200, 0]])
    scene = Scene.from_meshes([
        Mesh("ground", corners, np.array([[0, 1, 2], [0, 2, 3]])),
        moved(box("tower", (10, 10, 80)), 10, 10),
        moved(box("hut", (4, 4, 3)), -10, 10),
        moved(box("other hut", (4, 4, 3)), 100, 10),
    ])  # fmt: skip
    cut = Part.whole(scene).cut(np.array([[-30.0, -20, 0], [30, 20, 27]]))
    part, shares = cut.scene, cut.shares
    there = {scene.names[k] for k in np.unique(part.face_object)}
    assert there == {"ground", "tower", "hut"}
    assert part.bounds == pytest.approx(np.array([[-30, -20, 0], [30, 20, 27]]))
    assert np.array_equal(part.face_object, scene.face_object[cut.parents])
    ground = part.face_object == 0
    a, b, c = (part.vertices[part.faces[ground, k]] for k in range(3))
    assert np.cross(b - a, c - a)[:, 2].sum() / 2 == pytest.approx(60 * 40)  # none turned over
    assert shares[ground].sum() == pytest.approx(2 * 60 * 40 / 400**2)
    assert (shares[part.face_object == 2] == 1).all()


def test_where_nothing_stands_the_scene_stays_whole():
    whole = Part.whole(Scene.seed())
    assert whole.cut(np.array([[900.0, 900, 0], [990, 990, 9]])) is whole


def test_a_roof_is_cut_open_and_a_crown_is_not():
    places = np.array([[0.9, 0, 1], [-0.8, 0.5, 1], [0, 1.1, 1]])
    for over, cut in ((box("hall", (20, 20, 7)), 4.0), (tree(SPECIES[0]), None)):
        scene = Scene.from_meshes([over])
        caster = RayCaster(scene.vertices, scene.faces, "numpy")
        assert floor_and_cut(scene, caster, places)[1] == (cut and pytest.approx(cut))


def test_hills_around_a_sensor_are_no_walls():
    hills, hall = terrain(2_000, 0, 100.0), Scene.from_meshes([box("hall", (20, 20, 7))])
    for scene, is_wall in ((hills, False), (hall, True)):
        around = Cutaway.around(
            Surface.of(scene, "numpy"), np.array([[0.0, 0, 2]]), np.array([90.0, 90, 90])
        )
        assert around.surrounds.tolist() == [is_wall]
