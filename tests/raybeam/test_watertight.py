"""Closed meshes do not leak where it is hardest: at shared edges and corners."""

import numpy as np
import pytest
from benchmarks import seams

# A point inside each of the meshes, and how far it may be moved.
INSIDE = np.array([0.05, 0.1, 0.4])
ROOM = 0.05


def turned(points):
    """Points turned, so that no edge is along an axis."""
    return points @ np.linalg.qr(np.random.default_rng(7).normal(size=(3, 3)))[0].T


def escaped(caster, mesh, inside, count):
    """Rays, of `count` from one point inside and `count` from as many, that hit nothing."""
    return seams.escaped(caster, mesh, inside, ROOM, count, np.random.default_rng(1))


def meshes(shapes, name):
    """Vertices, faces and a point inside; the objects as in the default survey, 80 by 80."""
    if name != "six objects":
        yield (*shapes[name](), INSIDE)
        return
    places = [(-20, -20), (20, -20), (-20, 20), (20, 20), (-10, -5), (5, 5)]
    for number, place in enumerate(places):
        points, faces = shapes["sphere"](80, 80, 2.0)
        points[:, :2] *= (0.7 + 0.3 * np.cos(number * points[:, 2]))[:, None]
        move = np.array([*place, 2.0])
        yield points + move, faces, INSIDE + move


@pytest.mark.extended(every=5)
@pytest.mark.parametrize("count", [3_000, pytest.param(100_000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", ["cube", "sphere", "vase", "terrain box", "six objects"])
def test_no_ray_escapes(caster, shapes, name, count):
    """Where the mesh stands and far from zero; of ten million tells benchmarks.leaks."""
    closed = list(meshes(shapes, name))
    count //= len(closed)
    for vertices, faces, inside in closed:
        assert escaped(caster(vertices, faces), (vertices, faces), inside, count) == 0
        for offset in (0, 5e5, 4e6):
            mesh = turned(vertices) + offset, faces
            assert escaped(caster(*mesh), mesh, turned(inside) + offset, count) == 0


def test_no_ray_comes_through_from_outside(caster, shapes):
    """A ray aimed from outside at a seam of the near side hits there or grazes by."""
    vertices, faces = shapes["sphere"]()
    vertices = turned(vertices)
    origin = np.array([3.0, 1, 2])
    rng = np.random.default_rng(5)
    directions = seams.seam_rays(vertices, faces, origin, 20_000, rng)
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    nearest = -(unit @ origin)
    through = np.linalg.norm(origin + nearest[:, None] * unit, axis=1) < 0.98
    assert through.sum() > 15_000
    hits = caster(vertices, faces).cast(origin, directions[through])
    assert hits.hit.all()
    assert (hits.distance < nearest[through]).all()
