"""Counting hits by triangle: the closest, and all along a ray."""

from __future__ import annotations

import numpy as np
import pytest

from raybeam import RayCaster, rays
from raybeam import triangle as exact
from raybeam.mesh import local_mesh


def everything(vertices, faces, origins, directions, t_min=0.0, t_max=np.inf):
    """Count every triangle of every ray, one by one and without a tree."""
    mesh = local_mesh(vertices, faces)
    given = rays.check_rays(origins, directions, t_min, t_max).part(0, len(directions))
    n, k = len(given), len(mesh.corners)
    starts = np.broadcast_to(mesh.to_local(given.origins), (n, 3))
    sheared = exact.shear(starts, given.directions)
    ray, place = np.divmod(np.arange(n * k), k)
    a, b, c, det, t = exact.intersect(sheared, ray, mesh.corners, place)
    with np.errstate(invalid="ignore"):
        far = (t >= t_min * mesh.scale) & (t <= t_max * mesh.scale)
    met = exact.inside(a, b, c, det) & far
    return np.bincount(mesh.index[place[met]], minlength=len(faces))


def generic_rays(seed=0, count=2000):
    """Rays between random points: none of them meets an edge."""
    rng = np.random.default_rng(seed)
    origins, ends = rng.uniform(-1.5, 1.5, (2, count, 3))
    return origins, ends - origins


@pytest.mark.parametrize("shape", ["cube", "sphere", "terrain box"])
@pytest.mark.parametrize("limits", [(0, np.inf), (0.5, 2.5)])
def test_all_along_the_ray(caster, shapes, shape, limits):
    vertices, faces = shapes[shape]() if shape != "sphere" else shapes["sphere"](12, 16)
    origins, directions = generic_rays(count=500)
    got = caster(vertices, faces).count(origins, directions, *limits, every=True)
    assert got.dtype == np.int64
    want = everything(vertices, faces, origins, directions, *limits)
    assert want.sum() > 200
    np.testing.assert_array_equal(got, want)


def test_soup(exact_caster, shapes):
    vertices, faces = shapes["soup"]("random")
    origins, directions = generic_rays(seed=1)
    got = exact_caster(vertices, faces).count(10 * origins, directions, every=True)
    np.testing.assert_array_equal(got, everything(vertices, faces, 10 * origins, directions))


def test_closest_only(caster, shapes):
    vertices, faces = shapes["vase"]()
    origins, directions = generic_rays(seed=2)
    engine = caster(vertices, faces)
    hits = engine.cast(origins, directions, 0.25, 4.0)
    got = engine.count(origins, directions, 0.25, 4.0)
    assert got.sum() == hits.hit.sum() > 100
    np.testing.assert_array_equal(got, np.bincount(hits.triangle[hits.hit], minlength=len(faces)))


def test_edges_count_for_all_triangles_there(exact_caster, shapes):
    """Every ray at a corner of a closed mesh meets all of the corner's triangles."""
    vertices, faces = shapes["sphere"](10, 14)
    engine = exact_caster(vertices, faces)
    for vertex in range(1, len(vertices), 17):
        at = vertices[vertex][None]
        counts = engine.count([0.0, 0.0, 0.0], at, every=True)
        np.testing.assert_array_equal(counts, everything(vertices, faces, [0.0, 0.0, 0.0], at))
        assert counts.sum() >= 1


def test_copies_are_all_counted(exact_caster):
    triangle = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    engine = exact_caster(triangle, [[0, 1, 2]] * 20)
    down = [[0, 0, -1]] * 3
    assert engine.count([0.2, 0.2, 1], down, every=True).tolist() == [3] * 20
    assert engine.count([0.2, 0.2, 1], down).tolist() == [3] + [0] * 19


@pytest.mark.parametrize("every", [False, True])
def test_nothing_to_count(caster, shapes, every):
    vertices, faces = shapes["cube"]()
    engine = caster(vertices, faces)
    away = engine.count([5, 5, 5], [[1, 1, 1]] * 4, every=every)
    none = engine.count([5, 5, 5], np.zeros((0, 3)), every=every)
    np.testing.assert_array_equal(away, np.zeros(12, np.int64))
    np.testing.assert_array_equal(none, away)
    flat = caster(np.zeros((3, 3)), [[0, 1, 2]])
    assert flat.count([0, 0, 1], [[0, 0, -1]], every=every).tolist() == [0]


def test_chunks_do_not_matter(caster, backend, shapes, monkeypatch):
    vertices, faces = shapes["vase"](20, 20)
    engine = caster(vertices, faces)
    origins, directions = generic_rays(seed=5)
    want = engine.count(origins, directions, every=True)
    monkeypatch.setattr(type(engine._engine), "chunk", 77)
    np.testing.assert_array_equal(engine.count(origins, directions, every=True), want)


def test_bad_arguments():
    engine = RayCaster([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], "numpy")
    with pytest.raises(ValueError, match="Direction 0"):
        engine.count([0, 0, 1], [[0, 0, 0]])
