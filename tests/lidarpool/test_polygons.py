"""Polygons are filled exactly: as large as their outline, with the same outside."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidarpool.scene.polygons import MOST_CORNERS, triangulated, with_holes

# A wall with a door in it, an arrow, a comb and a spiral, anticlockwise.
SHAPES = {
    "triangle": [(0, 0), (2, 0), (0, 1)],
    "square": [(0, 0), (1, 0), (1, 1), (0, 1)],
    "arrow": [(0, 0), (2, -1), (0, 3), (-2, -1)],
    "hexagon": [(2, 0), (1, 2), (-1, 2), (-2, 0), (-1, -2), (1, -2)],
    "wall": [(0, 0), (2, 0), (2, 2), (3, 2), (3, 0), (5, 0), (5, 3), (0, 3)],
    "comb": [(0, 0), (9, 0), (9, 5), (8, 1), (7, 5), (6, 1), (5, 5), (4, 1), (3, 5), (2, 1),
             (0, 5)],
    "spiral": [(0, 0), (6, 0), (6, 6), (1, 6), (1, 2), (4, 2), (4, 4), (3, 4), (3, 3), (2, 3),
               (2, 5), (5, 5), (5, 1), (0, 1)],
    "corner on an edge": [(0, 0), (1, 0), (2, 0), (2, 2), (1, 1), (0, 2)],
}  # fmt: skip


def area_vector(points):
    """Area with the direction of the outside (Newell)."""
    points = np.asarray(points, dtype=float) - points[0]
    return np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0) / 2


def placed(shape, turn=0, shift=(0.0, 0.0, 0.0)):
    """A shape in space, standing upright and turned."""
    x, y = np.array(shape, dtype=float).T
    return np.stack([x * np.cos(turn), x * np.sin(turn), y], axis=1) + shift


def cut(vertices, *sizes):
    sizes = sizes or (len(vertices),)
    return triangulated(vertices, np.arange(sum(sizes)), np.array(sizes))


def area_vectors(vertices, faces):
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return np.cross(b - a, c - a) / 2


@pytest.mark.parametrize("name", SHAPES)
def test_a_shape_is_filled_wherever_its_outline_begins(name):
    for begin, direction in itertools.product(range(len(SHAPES[name])), (1, -1)):
        shape = (SHAPES[name][begin:] + SHAPES[name][:begin])[::direction]
        vertices = placed(shape, turn=0.3)
        faces = cut(vertices)
        assert len(faces) == len(shape) - 2
        whole, parts = area_vector(vertices), area_vectors(vertices, faces)
        np.testing.assert_allclose(parts.sum(axis=0), whole, atol=1e-12)
        # No triangle faces the other way, so that none lies outside of the outline.
        assert (parts @ whole > -1e-12).all()


@given(
    st.lists(st.tuples(*[st.integers(-3, 3)] * 3), min_size=3, max_size=9),
    st.sampled_from([1.0, 1e-9, 1e8, float("nan")]),
)
def test_whatever_it_is_each_polygon_gives_triangles(points, scale):
    vertices = np.array(points, dtype=float) * scale
    faces = cut(vertices)
    assert 1 <= len(faces) <= len(points) - 2
    assert all(len(set(face)) == 3 for face in faces.tolist())
    # Its neighbours stay what they are.
    square = placed(SHAPES["square"])
    among = cut(np.concatenate([square, vertices, square]), 4, len(points), 4)
    np.testing.assert_array_equal(among[:2], [[0, 1, 2], [0, 2, 3]])
    np.testing.assert_array_equal(among[2:-2], faces + 4)
    np.testing.assert_array_equal(among[-2:], among[:2] + 4 + len(points))


# What they enclose is filled, each with what it has of area.
UNUSUAL = {
    "slit to a hole": ([(0, 0), (4, 0), (4, 4), (0, 4), (0, 0), (1, 1), (1, 2), (2, 2), (2, 1),
                        (1, 1)], 15),
    "corner twice": ([(0, 0), (2, 0), (2, 0), (2, 2), (1, 1), (0, 2)], 3),
    "there and back": ([(0, 0), (2, 0), (2, 2), (2, 5), (2, 2), (0, 2)], 4),
    "two that touch": ([(0, 0), (2, 0), (2, 2), (4, 2), (4, 4), (2, 4), (2, 2), (0, 2)], 8),
}  # fmt: skip


@pytest.mark.parametrize("name", UNUSUAL)
def test_an_unusual_outline_is_filled(name):
    shape, area = UNUSUAL[name]
    for direction, shift, scale in itertools.product((1, -1), (0.0, 5e6), (1e-6, 1, 1e6)):
        vertices = placed(shape[::direction])[:, [0, 2, 1]] * scale
        faces = cut(vertices + shift * scale)
        whole, parts = area_vector(vertices), area_vectors(vertices, faces)
        np.testing.assert_allclose(np.linalg.norm(parts, axis=1).sum(), area * scale**2)
        assert (parts @ whole >= 0).all()


def test_a_warped_quadrangle_keeps_both_triangles():
    # Seen from above its outline crosses itself.
    vertices = np.array([[0, 0, 0], [2, 0, 0], [0.1, 1, 3], [2, 1, 0]], dtype=float)
    assert len(cut(vertices)) == 2


def all_ways(corners):
    """All triangulations of a polygon."""
    if len(corners) < 3:
        yield []
    for k in range(1, len(corners) - 1):
        for left in all_ways(corners[: k + 1]):
            for right in all_ways(corners[k:]):
                yield [*left, *right, (corners[0], corners[k], corners[-1])]


@pytest.mark.parametrize("count", [5, 6, 7])
def test_warped_polygons_lose_no_triangle(count):
    rng = np.random.default_rng(count)
    lost = 0
    for _ in range(200):
        angles = np.sort(rng.uniform(0, 2 * np.pi, count))
        radii = rng.uniform(0.2, 1, count)
        heights = rng.normal(0, 2, count)
        vertices = np.stack([radii * np.cos(angles), radii * np.sin(angles), heights], axis=1)
        faces = cut(vertices)
        assert len(faces) == count - 2
        parts = area_vectors(vertices, faces)
        np.testing.assert_allclose(parts.sum(axis=0), area_vector(vertices), atol=1e-9)
        ways = [area_vectors(vertices, np.array(way)) for way in all_ways(range(count))]
        areas = [np.linalg.norm(way, axis=1).sum() for way in ways]
        assert min(areas) <= np.linalg.norm(parts, axis=1).sum() * (1 + 1e-9)
        assert np.linalg.norm(parts, axis=1).sum() <= max(areas) * (1 + 1e-9)
        lost += len(with_holes(vertices, [np.arange(count)])) < count - 2
    assert lost > 20, "the clipper alone fills them"


def test_a_plane_polygon_is_clipped_though_its_numbers_are_rounded():
    shape, area = UNUSUAL["slit to a hole"]
    vertices = np.round(placed(np.array(shape) / 3, turn=0.3), 6)
    parts = area_vectors(vertices, cut(vertices))
    np.testing.assert_allclose(np.linalg.norm(parts, axis=1).sum(), area / 9, rtol=1e-4)


def test_corners_that_are_not_there():
    with pytest.raises(ValueError, match="vertices 0 to 3, counted from 0, of 3"):
        triangulated(np.zeros((3, 3)), np.array([0, 1, 3]), np.array([3]))


def test_an_outline_without_end_is_refused_unless_it_is_convex():
    angles = np.linspace(0, 2 * np.pi, MOST_CORNERS + 1, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    assert len(cut(circle)) == MOST_CORNERS - 1
    with pytest.raises(ValueError, match="is not convex: triangulate it"):
        cut(circle * (1 + 0.5 * (np.arange(len(angles)) % 2))[:, None])
