"""What hides what: the reason why these pictures are not left to matplotlib."""

import numpy as np
import pytest
import trimesh

from lidarpool.render.pictures import with_points
from lidarpool.render.shot import GROUND, SKY, take_shot
from lidarpool.scene.mesh import Mesh
from lidarpool.scene.scene import Scene

SIZE = (320, 200)


def box(name, size, centre):
    solid = trimesh.creation.box(size)
    return Mesh(name, np.array(solid.vertices) + centre, np.array(solid.faces))


@pytest.fixture(scope="module")
def row():
    """A near, a middle and a far box, one behind the other along the camera's view."""
    towards = np.array([np.cos(np.radians(-62)), np.sin(np.radians(-62)), 0.0])
    return Scene.from_meshes(
        [
            box(name, (2, 2, 2), k * 2.2 * towards)
            for name, k in (("near", 1), ("middle", 0), ("far", -1))
        ]
    )


@pytest.fixture(scope="module")
def shot(row):
    return take_shot(row, [], size=SIZE, backend="numpy")


def closest_hit(scene, eye, ray):
    """Distance and triangle by the textbook: every triangle's plane, then three half-planes."""
    best = (np.inf, -1)
    for number, (a, b, c) in enumerate(scene.vertices[scene.faces]):
        normal = np.cross(b - a, c - a)
        if abs(normal @ ray) < 1e-12:
            continue
        t = normal @ (a - eye) / (normal @ ray)
        p = eye + t * ray
        inside = all(np.cross(q - o, p - o) @ normal >= -1e-9 for o, q in ((a, b), (b, c), (c, a)))
        if t > 0 and inside and t < best[0]:
            best = (t, number)
    return best


def test_each_pixel_shows_the_nearest_thing(row, shot):
    camera, stage = shot.camera, shot.stage
    rng = np.random.default_rng(3)
    columns, rows = rng.integers(0, SIZE[0], 150), rng.integers(0, SIZE[1], 150)
    kinds = set()
    for column, line in zip(columns, rows, strict=True):
        ray = camera.rays([[column + 0.5, line + 0.5]])[0]
        distance, triangle = closest_hit(row, camera.eye, ray)
        flat = (stage.level - camera.eye[2]) / ray[2]
        place = camera.eye[:2] + flat * ray[:2]
        if flat < distance and ((place > stage.ground[0]) & (place < stage.ground[1])).all():
            distance, triangle = flat, GROUND
        kinds.add(row.face_object[triangle] if triangle >= 0 else int(triangle))
        assert shot.depth[line, column] == pytest.approx(distance, rel=1e-5)
    assert kinds == {0, 1, 2, GROUND, SKY}


def test_points_behind_a_box_are_hidden_and_before_it_seen(row, shot):
    near = row.object_bounds[0].mean(axis=0)
    back = -shot.camera.axes[2]
    _, seen = shot.visible(np.stack([near + 3 * back, near - 3 * back, near]))
    assert seen.tolist() == [True, False, False]


def drawn(shot, points):
    """Whether points, each by itself, leave something in the picture."""
    blank = np.ones((*SIZE[::-1], 4), np.float32)
    return np.array(
        [(with_points(blank, shot, p[None], np.zeros((1, 3))) < 1).any() for p in points]
    )


def room():
    """A closed hall with thick walls and a roof, a crate and a lamp in it."""
    shell = [
        box("Hall outside", (12, 20, 4), (0, 0, 2)),
        box("Hall inside", (11.4, 19.4, 3.4), (0, 0, 2)),
    ]
    return [*shell, box("Crate", (1.5, 1.5, 1.5), (2, -4, 1.05))]


def test_triangles_that_share_no_vertices_do_not_come_apart():
    """A block as .stl files have it, turned inside out: no ray of the camera gets into it."""
    block = box("Block", (12, 20, 4), (0, 0, 2))
    block = Mesh("Block", block.vertices, block.faces[:, ::-1])
    corners = block.vertices[block.faces].reshape(-1, 3)
    loose = Mesh("Block", corners, np.arange(len(corners)).reshape(-1, 3))
    depths = [
        take_shot(Scene.from_meshes([one]), [], size=SIZE, backend="numpy").depth
        for one in (block, loose)
    ]
    inside = np.isfinite(depths[0])
    assert np.allclose(depths[0][inside], depths[1][inside], rtol=1e-4)


def test_the_inside_of_a_closed_hall_is_shown():
    scene = Scene.from_meshes(room())
    poses = np.array([[0, 0.5, 1.5], [1, 6, 1.5]])
    shot = take_shot(scene, poses, size=SIZE, backend="numpy")
    _, seen = shot.visible(np.concatenate([poses, [[2, -4, 1.85], [-3, -5, 0.35]]]))
    assert seen.all(), "sensors, the crate's top and the floor"
    far_wall, near_wall = shot.camera.axes[2] * 5, -shot.camera.axes[2] * 5
    wall = (
        np.array([np.sign(far_wall[0]) * 5.69, 3.0, 1.5]),
        np.array([np.sign(near_wall[0]) * 5.69, 3.0, 1.5]),
    )
    assert drawn(shot, np.array(wall)).tolist() == [True, False]


def test_the_hall_stays_closed_where_the_sensor_is_outside():
    scene = Scene.from_meshes(room())
    shot = take_shot(scene, [[0, 30, 1.5]], size=SIZE, backend="numpy")
    roof_seen = shot.visible([[0, 0, 4.0]])[1]
    floor_seen = shot.visible([[-3, -5, 0.3]])[1]
    assert roof_seen.all() and not floor_seen.any()
