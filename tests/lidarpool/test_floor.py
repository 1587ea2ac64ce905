"""Where a sensor stands if nobody says where."""

import numpy as np
import pytest
import trimesh

from lidarpool.scene.floor import room_at
from lidarpool.scene.mesh import Mesh
from lidarpool.scene.scene import Scene
from lidarpool.scene.terrain import terrain


def boxes(*sizes_and_middles):
    """Boxes, each of a size and with its middle at a height, over (0, 0)."""
    meshes = []
    for size, height in sizes_and_middles:
        mesh = trimesh.creation.box(size)
        meshes.append(Mesh("box", mesh.vertices + np.array([0, 0, height]), np.asarray(mesh.faces)))
    return Scene.from_meshes(meshes)


def test_on_the_ground_of_a_terrain():
    scene = terrain(2000, 3, 100)
    floor = room_at(scene, 0, 0)[0]
    assert floor > scene.bounds[0, 2] + 0.1
    nearest = np.hypot(*scene.vertices[:, :2].T).argmin()
    assert floor == pytest.approx(scene.vertices[nearest, 2], abs=5)


def test_on_a_slab_and_not_on_the_roof():
    floor_and_roof = boxes(((8, 6, 0.2), -0.1), ((8, 6, 0.2), 3))
    assert room_at(floor_and_roof, 0, 0)[0] == pytest.approx(0)


def test_the_ceiling_is_above_the_furniture():
    room = (((8, 6, 0.2), -0.1), ((1, 1, 0.1), 0.75), ((8, 6, 0.2), 2.6), ((8, 6, 0.2), 5.6))
    assert room_at(boxes(*room), 0, 0) == pytest.approx((0, 2.5))
    assert room_at(boxes(*room[:2]), 0, 0) == (pytest.approx(0), np.inf)


def test_within_a_hall_that_is_one_box():
    assert room_at(boxes(((8, 6, 3), 1.5)), 0, 0)[0] == 0


def test_in_world_coordinates():
    shift = np.array([500_000.0, 4_000_000.0, 20_000.0])
    ground = np.array([[-9, -9, 0], [9, -9, 0], [9, 9, 3.6], [-9, 9, 3.6]])
    scene = Scene.from_meshes([Mesh("g", ground + shift, np.array([[0, 1, 2], [0, 2, 3]]))])
    assert room_at(scene, 500_001, 4_000_000)[0] == pytest.approx(20_001.8)
    assert room_at(scene, 500_001, 4_000_005)[0] == pytest.approx(20_002.8)
