"""Closed meshes do not leak where it is hardest: at shared edges and corners."""

from __future__ import annotations

import numpy as np
import pytest

from raybeam import RayCaster, available_backends

CLOSED = ["cube", "sphere", "vase", "terrain box"]


# A point inside each of them, and how far it may be moved.
INSIDE, ROOM = np.array([0.05, 0.1, 0.4]), 0.05


def placed(vertices, seed, offset=0.0):
    """Vertices turned at random, so that no edge is along an axis, and where `INSIDE` comes to."""
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return vertices @ q.T + offset, q @ INSIDE + offset


def aimed_at_seams(vertices, faces, origins, count, rng):
    """Directions to points of edges: corners, middles, and anywhere between."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edge = vertices[edges[rng.integers(len(edges), size=count)]]
    part = rng.choice([0.0, 0.5, 1.0, np.nan], count)
    part = np.where(np.isnan(part), rng.random(count), part)[:, None]
    return edge[:, 0] * (1 - part) + edge[:, 1] * part - origins


def escaped(caster, vertices, faces, inside, count, seed):
    """Rays, of `count` from one point inside and `count` from as many, that hit nothing."""
    rng = np.random.default_rng(seed)
    leaks = 0
    for origins in (inside, inside + ROOM * rng.uniform(-1, 1, (count, 3))):
        directions = aimed_at_seams(vertices, faces, origins, count, rng)
        leaks += count - len(caster.returns(origins, directions))
    return leaks


@pytest.mark.parametrize("name", CLOSED)
def test_no_ray_escapes(exact_caster, shapes, name):
    vertices, faces = shapes[name]()
    assert escaped(exact_caster(vertices, faces), vertices, faces, INSIDE, 10_000, 1) == 0


@pytest.mark.parametrize("offset", [0, 5e5, 4e6])
def test_no_ray_escapes_wherever_it_stands(exact_caster, shapes, offset):
    vertices, faces = shapes["vase"]()
    vertices, inside = placed(vertices, 2, offset)
    assert escaped(exact_caster(vertices, faces), vertices, faces, inside, 10_000, 3) == 0


def test_no_ray_comes_through_from_outside(exact_caster, shapes):
    """A ray aimed from outside at a seam of the near side hits there or grazes by."""
    vertices, faces = shapes["sphere"]()
    vertices, _ = placed(vertices, 4)
    origin = np.array([3.0, 1, 2])
    rng = np.random.default_rng(5)
    directions = aimed_at_seams(vertices, faces, origin, 20_000, rng)
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


@pytest.mark.slow
@pytest.mark.parametrize("name", CLOSED)
def test_no_ray_of_ten_million_escapes(exact_caster, shapes, name):
    vertices, faces = shapes[name](700) if name == "terrain box" else shapes[name]()
    for offset in (0, 5e5):
        moved, inside = placed(vertices, 7, offset)
        caster = exact_caster(moved, faces)
        for part in range(5):
            assert escaped(caster, moved, faces, inside, 125_000, part) == 0
