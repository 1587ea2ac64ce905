"""Closed meshes do not leak where it is hardest: at shared edges and corners."""

from __future__ import annotations

import numpy as np
import pytest
from benchmarks import seams

from raybeam import RayCaster, available_backends

CLOSED = ["cube", "sphere", "vase", "terrain box"]


# A point inside each of them, and how far it may be moved.
INSIDE, ROOM = np.array([0.05, 0.1, 0.4]), 0.05


def placed(vertices, seed, offset=0.0):
    """Vertices turned at random, so that no edge is along an axis, and where `INSIDE` comes to."""
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return vertices @ q.T + offset, q @ INSIDE + offset


def escaped(caster, vertices, faces, inside, count, seed):
    """Rays, of `count` from one point inside and `count` from as many, that hit nothing."""
    rng = np.random.default_rng(seed)
    return seams.escaped(caster, (vertices, faces), inside, ROOM, count, rng)


def six_objects(sphere):
    """Six surfaces of revolution, 80 by 80, placed as in the default survey: (mesh, inside)."""
    places = [(-20, -20), (20, -20), (-20, 20), (20, 20), (-10, -5), (5, 5)]
    for number, place in enumerate(places):
        points, faces = sphere(80, 80, 2.0)
        points[:, :2] *= (0.7 + 0.3 * np.cos(number * points[:, 2]))[:, None]
        move = np.array([*place, 2.0])
        yield points + move, faces, INSIDE + move


@pytest.mark.parametrize("name", CLOSED)
def test_no_ray_escapes(exact_caster, shapes, name):
    vertices, faces = shapes[name]()
    assert escaped(exact_caster(vertices, faces), vertices, faces, INSIDE, 10_000, 1) == 0


@pytest.mark.parametrize("offset", [0, 5e5, 4e6])
def test_no_ray_escapes_wherever_it_stands(exact_caster, shapes, offset):
    vertices, faces = shapes["vase"]()
    vertices, inside = placed(vertices, 2, offset)
    assert escaped(exact_caster(vertices, faces), vertices, faces, inside, 10_000, 3) == 0


def test_no_ray_escapes_from_six_objects(exact_caster, shapes):
    objects = list(six_objects(shapes["sphere"]))
    assert len(objects) == 6
    for vertices, faces, inside in objects:
        assert escaped(exact_caster(vertices, faces), vertices, faces, inside, 3_000, 8) == 0


def test_no_ray_comes_through_from_outside(exact_caster, shapes):
    """A ray aimed from outside at a seam of the near side hits there or grazes by."""
    vertices, faces = shapes["sphere"]()
    vertices, _ = placed(vertices, 4)
    origin = np.array([3.0, 1, 2])
    rng = np.random.default_rng(5)
    directions = seams.seam_rays(vertices, faces, origin, 20_000, rng)
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    nearest = -(unit @ origin)
    through = np.linalg.norm(origin + nearest[:, None] * unit, axis=1) < 0.98
    assert through.sum() > 15_000
    hits = exact_caster(vertices, faces).cast(origin, directions[through])
    assert hits.hit.all()
    assert (hits.distance < nearest[through]).all()


def test_embree_leaks_little(shapes):
    """Embree tests the edges around a corner each for itself: its rate is small, not zero."""
    if reason := available_backends()["embree"]:
        pytest.skip(f"embree: {reason}")
    vertices, faces = shapes["vase"]()
    caster = RayCaster(vertices, faces, "embree")
    assert escaped(caster, vertices, faces, INSIDE, 20_000, 6) < 0.005 * 40_000
