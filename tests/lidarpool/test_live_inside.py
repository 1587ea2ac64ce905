"""What hides the sensors on a page: walls, roofs, what is above a height, and the points there."""

import numpy as np
import pytest
import trimesh

from lidarpool import Scene
from lidarpool.live.height_cut import lines_below, triangles_below
from lidarpool.live.inside import InsideView, Walls, facing_triangles
from lidarpool.scene.mesh import Mesh

LENGTH, WIDTH, HEIGHT, WALL = 40.0, 24.0, 8.0, 0.3
SENSORS = np.array([[0.0, 0.0, 1.0], [5.0, 3.0, 2.0]])


def box(name, extents, centre):
    """Return a box as an object."""
    made = trimesh.creation.box(extents=extents).apply_translation(centre)
    return name, made


def hall(roof=True):
    """Return the parts of a hall: walls with two faces, a floor, shelves."""
    parts = [
        box("floor", (LENGTH, WIDTH, WALL), (0, 0, -WALL / 2)),
        box("north", (LENGTH, WALL, HEIGHT), (0, WIDTH / 2, HEIGHT / 2)),
        box("south", (LENGTH, WALL, HEIGHT), (0, -WIDTH / 2, HEIGHT / 2)),
        box("east", (WALL, WIDTH, HEIGHT), (LENGTH / 2, 0, HEIGHT / 2)),
        box("west", (WALL, WIDTH, HEIGHT), (-LENGTH / 2, 0, HEIGHT / 2)),
        box("shelf", (12, 1.2, 4), (-10, 6, 2)),
        box("crate", (1, 1, 1), (10, -5, 0.5)),
    ]
    if roof:
        parts.append(box("roof", (LENGTH, WIDTH, WALL), (0, 0, HEIGHT + WALL / 2)))
    return parts


def scene_of(parts, turn_deg=0.0):
    """Return a scene of these parts, turned about the vertical."""
    turn = trimesh.transformations.rotation_matrix(np.radians(turn_deg), [0, 0, 1])
    turned = [(name, made.copy().apply_transform(turn)) for name, made in parts]
    return Scene.from_meshes([Mesh(name, made.vertices, made.faces) for name, made in turned])


def shell_names(scene, view):
    """Return for each object the share of its triangles that are of the shell."""
    shares = np.bincount(scene.face_object, view.shell) / np.bincount(scene.face_object)
    return dict(zip(scene.names, shares.tolist(), strict=True))


@pytest.mark.parametrize("turn_deg", [0, 30])
def test_walls_and_roof_of_a_closed_hall_are_its_shell_however_it_stands(turn_deg):
    scene = scene_of(hall(), turn_deg)
    view = InsideView.of(scene, SENSORS)
    shares = shell_names(scene, view)
    assert {name for name, share in shares.items() if share > 0.6} >= {
        "north", "south", "east", "west", "roof",
    }  # fmt: skip
    assert shares["shelf"] == shares["crate"] == shares["floor"] == 0
    assert SENSORS[:, 2].max() < 0.9 * HEIGHT < view.ceiling < HEIGHT


@pytest.mark.parametrize("inverted", [False, True])
def test_both_faces_of_a_wall_are_wound_towards_the_sensors(inverted):
    parts = hall()
    if inverted:
        for _, made in parts:
            made.invert()
    scene = scene_of(parts)
    view = InsideView.of(scene, SENSORS)
    corners = view.wound(scene.vertices[scene.faces].astype(np.float32))[view.shell]
    a, b, c = corners.transpose(1, 0, 2)
    towards = SENSORS.mean(axis=0) - corners.mean(axis=1)
    facing = (np.cross(b - a, c - a) * towards).sum(axis=1)
    # Of a wall's narrow ends there are two to each side: neither way is wrong for them.
    large = np.linalg.norm(np.cross(b - a, c - a), axis=1) > 20
    assert large.sum() == 20  # two triangles for each face of four walls and the roof
    assert (facing[large] > 0).all()


def test_a_hall_that_is_one_object_has_a_shell_too():
    made = trimesh.util.concatenate([made for _, made in hall()])
    scene = scene_of([("hall", made)])
    view = InsideView.of(scene, SENSORS)
    middles = scene.vertices[scene.faces].mean(axis=1)
    inside = (np.abs(middles[:, :2]) < (17, 10)).all(axis=1) & (middles[:, 2] < 4.5)
    assert not view.shell[inside].any()
    assert view.shell[(np.abs(middles[:, 1]) > WIDTH / 2 - WALL) & (middles[:, 2] > 2)].all()
    assert view.ceiling is not None


def test_an_open_field_is_shown_as_it_is():
    view = InsideView.of(Scene.seed(), SENSORS)
    assert not view.shell.any()
    assert view.ceiling is None


def test_without_a_roof_nothing_is_cut():
    assert InsideView.of(scene_of(hall(roof=False)), SENSORS).ceiling is None


def test_a_roof_without_walls_is_cut():
    parts = [part for part in hall() if part[0] in ("floor", "roof", "crate")]
    view = InsideView.of(scene_of(parts), SENSORS)
    assert 6 < view.ceiling < HEIGHT
    assert not view.shell.any()


def test_houses_along_a_street_are_no_walls():
    parts = [box("ground", (200, 200, 0.2), (0, 0, -0.1))]
    for number, (x, y) in enumerate([(0, 15), (0, -15), (60, 0), (-60, 0)]):
        size = (110, 16, 12) if y else (16, 46, 12)
        parts.append(box(f"house {number}", size, (x, y, 6)))
    scene = scene_of(parts)
    view = InsideView.of(scene, SENSORS)
    assert view.ceiling is None
    shares = shell_names(scene, view)
    assert all(shares[name] == 0 for name in shares if name.startswith("house"))


def area_of(corners):
    a, b, c = np.asarray(corners, np.float64).transpose(1, 0, 2)
    return np.cross(b - a, c - a) / 2  # (n, 3), along the normal


def test_clipped_triangles_keep_what_is_below_with_its_normal_and_its_source():
    corners = np.random.default_rng(1).uniform(-1, 1, (500, 3, 3)).astype(np.float32)
    height = 0.2
    below, source = triangles_below(corners, height)
    upside = corners * np.float32([1, 1, -1])
    above, other = triangles_below(upside, -height)
    assert below[:, :, 2].max() <= height + 1e-6
    assert above[:, :, 2].max() <= -height + 1e-6
    whole = area_of(corners)
    parts = np.zeros((500, 3))
    np.add.at(parts, source, area_of(below))
    np.add.at(parts, other, area_of(above * np.float32([1, 1, -1])))
    assert np.allclose(parts, whole, atol=1e-5)  # as vectors: no piece was turned over


def test_clipping_above_or_below_all_keeps_all_or_nothing():
    corners = np.random.default_rng(1).random((9, 3, 3)).astype(np.float32)
    kept, source = triangles_below(corners, 2.0)
    assert np.array_equal(kept, corners)
    assert source.tolist() == list(range(9))
    assert triangles_below(corners, -1.0)[0].shape == (0, 3, 3)


def test_lines_end_at_the_cut():
    lines = np.float32(
        [[[0, 0, 0], [0, 0, 4]], [[2, 0, 4], [0, 0, 0]], [[0, 0, 3], [1, 1, 3]], [[0] * 3, [1] * 3]]
    )
    cut = lines_below(lines, 2.0)
    assert cut.tolist() == [
        [[0, 0, 0], [0, 0, 2]], [[1, 0, 2], [0, 0, 0]], [[0, 0, 0], [1, 1, 1]],
    ]  # fmt: skip


def test_points_on_walls_face_as_their_wall_does_and_others_nowhere():
    scene = scene_of(hall())
    view = InsideView.of(scene, SENSORS)
    corners = view.wound(scene.vertices[scene.faces].astype(np.float32))
    walls = Walls.of(corners[view.shell])
    y = np.float32(WIDTH / 2 - WALL / 2)
    across = np.linspace(-15, 15, 50, dtype=np.float32)
    north = np.column_stack([across, np.full(50, y), np.full(50, 3, np.float32)])
    south = north * np.float32([1, -1, 1])
    assert np.allclose(walls.facing_at(north), [0, -1, 0], atol=1e-6)
    assert np.allclose(walls.facing_at(south), [0, 1, 0], atol=1e-6)
    free = np.float32([[0, 0, 1], [-10, 6, 2], [10, -5, 1], [0, 0, 500], [1e6, 0, 0]])
    assert not walls.facing_at(free).any()


def test_walls_without_area_are_none():
    assert Walls.of(np.zeros((3, 3, 3), np.float32)) is None


def test_triangles_in_place_of_points_are_seen_from_where_they_face():
    random = np.random.default_rng(2)
    facing = random.normal(size=(100, 3)).astype(np.float32)
    facing /= np.linalg.norm(facing, axis=1, keepdims=True)
    positions = random.normal(size=(100, 3)).astype(np.float32)
    corners = facing_triangles(positions, facing, 0.1)
    normal = area_of(corners)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    assert np.allclose(normal, facing, atol=1e-4)
    assert np.linalg.norm(corners.mean(axis=1) - positions, axis=1).max() < 0.05
