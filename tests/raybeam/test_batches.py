"""The same ray has the same bits in every batch, and with every backend that decides exactly."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from raybeam import Pattern, RayCaster, traverse

FIELDS = ("distance", "triangle", "u", "v")


def rays(count, seed):
    """From inside, outside and far away; of any length; some along the axes."""
    rng = np.random.default_rng(seed)
    origins = rng.normal(size=(count, 3)) * 10.0 ** rng.integers(-1, 4, (count, 1))
    directions = (
        rng.normal(size=(count, 3)) - 0.9 * origins / np.linalg.norm(origins, axis=1)[:, None]
    )
    directions[::9] = np.eye(3)[rng.integers(3, size=len(directions[::9]))]
    return origins, directions * 10.0 ** rng.integers(-3, 4, (count, 1))


def same(one, other):
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)


def test_batches_may_be_cut_anywhere(caster, shapes, monkeypatch):
    vase = caster(*shapes["vase"]())
    origins, directions = rays(3000, 1)
    whole = vase.cast(origins, directions)
    assert 0.1 < whole.hit.mean() < 0.9
    for cut in (1, 7, 1000):
        parts = range(0, 300 if cut == 1 else 3000, cut)
        cast = [vase.cast(origins[k : k + cut], directions[k : k + cut]) for k in parts]
        for name in FIELDS:
            joined = np.concatenate([getattr(part, name) for part in cast])
            np.testing.assert_array_equal(joined, getattr(whole, name)[: len(joined)])
    order = np.random.default_rng(2).permutation(3000)
    shuffled = vase.cast(origins[order], directions[order])
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(shuffled, name), getattr(whole, name)[order])
    monkeypatch.setattr(type(vase._engine), "chunk", 97)
    same(vase.cast(origins, directions), whole)


def test_blocks_may_be_of_any_size(shapes, monkeypatch):
    vase = RayCaster(*shapes["vase"](), "numpy")
    origins, directions = rays(2000, 3)
    whole = vase.cast(origins, directions)
    for size in (5, 333, 1 << 20):
        monkeypatch.setattr(traverse, "_BLOCK", size)
        same(vase.cast(origins, directions), whole)


def test_returns_are_the_hits_of_cast(caster, shapes, monkeypatch):
    vase = caster(*shapes["vase"]())
    origins, directions = rays(2000, 4)
    hits = vase.cast(origins, directions, 0.5, 500)
    assert 0.1 < hits.hit.mean() < 0.9
    for chunk in (type(vase._engine).chunk, 77):
        monkeypatch.setattr(type(vase._engine), "chunk", chunk)
        found = vase.returns(origins, directions, 0.5, 500)
        np.testing.assert_array_equal(found.ray, np.flatnonzero(hits.hit))
        np.testing.assert_array_equal(found.distance, hits.distance[hits.hit])
        np.testing.assert_array_equal(found.triangle, hits.triangle[hits.hit])
        assert len(found) == hits.hit.sum()
        assert sum(row.itemsize for row in (found.ray, found.distance, found.triangle)) == 16


@pytest.mark.parametrize("origin", [[0.3, -0.2, 2.9], [0.1, 0.2, 0.3], [9, -7, 5], [4e4, 3e4, 1e4]])
def test_scans_may_be_cut_anywhere(caster, shapes, monkeypatch, origin):
    """Windows and chunks of a pattern, from inside, nearby and far, with and without limits."""
    vase = caster(*shapes["vase"]())
    turn, _ = np.linalg.qr(np.random.default_rng(10).normal(size=(3, 3)))
    spread = np.random.default_rng(11).normal(size=(3000, 3))
    length = np.linalg.norm(origin)
    pattern = Pattern((spread - np.array(origin) * (1.5 if length > 3 else 0.5)) @ turn)
    distance = vase.scan(pattern, origin, turn).distance
    assert 100 < len(distance) <= 3000
    for limits in ((0, np.inf), (np.quantile(distance, 0.3), np.quantile(distance, 0.8))):
        whole = vase.scan(pattern, origin, turn, t_min=limits[0], t_max=limits[1])
        assert len(whole) > 50
        for chunk in (97, 1111, 1 << 17):
            monkeypatch.setattr(type(vase._engine), "chunk", chunk)
            for window in ((0, 3000), (0, 1), (501, 2222)):
                got = vase.scan(
                    pattern, origin, turn, window=window, t_min=limits[0], t_max=limits[1]
                )
                want = (whole.ray >= window[0]) & (whole.ray < window[1])
                np.testing.assert_array_equal(got.ray + window[0], whole.ray[want])
                np.testing.assert_array_equal(got.distance, whole.distance[want])
                np.testing.assert_array_equal(got.triangle, whole.triangle[want])


def test_one_origin_is_the_same_as_many(caster, shapes):
    vase = caster(*shapes["vase"]())
    _, directions = rays(2000, 5)
    for origin in ([0.1, 0.2, 0.3], [30, 40, 50.0]):
        same(vase.cast(origin, directions), vase.cast(np.tile(origin, (2000, 1)), directions))


@pytest.mark.parametrize("kind", ["random", "sliver", "huge", "tiny"])
def test_exact_backends_have_the_same_bits(exact_caster, shapes, kind):
    """Every backend but embree against numpy: distances, weights, and the triangle on a tie."""
    vertices, faces = shapes["soup"](kind)
    origins, directions = rays(5000, 6)
    aim = vertices[faces[np.arange(2500) % len(faces)]].mean(axis=1)
    directions[:2500] = aim - origins[:2500]
    for offset in (0, 5e5):
        reference = RayCaster(vertices + offset, faces, "numpy")
        other = exact_caster(vertices + offset, faces)
        for limits in ((0, np.inf), (1, 100)):
            want = reference.cast(origins + offset, directions, *limits)
            assert want.hit.any()
            same(other.cast(origins + offset, directions, *limits), want)


@pytest.mark.parametrize("name", ["cube", "sphere", "vase", "terrain box"])
def test_exact_backends_have_the_same_bits_at_seams(exact_caster, shapes, name):
    vertices, faces = shapes[name]()
    rng = np.random.default_rng(7)
    directions = vertices[faces[rng.integers(len(faces), size=20_000)]]
    weights = rng.integers(0, 2, (20_000, 3)) + np.array([1e-9, 0, 0])
    directions = (directions * (weights / weights.sum(axis=1, keepdims=True))[..., None]).sum(
        axis=1
    )
    origin = np.array([0.05, 0.1, 0.4])
    want = RayCaster(vertices, faces, "numpy").cast(origin, directions - origin)
    assert want.hit.all()
    same(exact_caster(vertices, faces).cast(origin, directions - origin), want)


def test_embree_and_numpy_agree(shapes):
    from raybeam import available_backends

    if reason := available_backends()["embree"]:
        pytest.skip(f"embree: {reason}")
    vertices, faces = shapes["vase"]()
    origins, directions = rays(20_000, 8)
    one = RayCaster(vertices, faces, "embree").cast(origins, directions)
    two = RayCaster(vertices, faces, "numpy").cast(origins, directions)
    equal = one.triangle == two.triangle
    assert equal.mean() > 0.995
    np.testing.assert_allclose(one.distance[equal], two.distance[equal], rtol=0, atol=1e-6)
    both = one.hit & two.hit
    assert np.abs(one.distance[both] - two.distance[both]).max() < 0.05


RESULT_BYTES = 8 + 4 + 8 + 8  # of a ray: distance, triangle, u, v


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_memory_of_a_cast_is_bounded(shapes, dtype):
    """Beyond its answer, a cast of many rays takes no more than one of a chunk, whatever they are.

    The directions are no unit vectors and, at single precision, not what the caster works with:
    nothing is made of them for all rays at once.
    """
    vase = RayCaster(*shapes["vase"](), "numpy")
    directions = np.random.default_rng(9).normal(size=(1_200_000, 3)).astype(dtype)
    peaks = []
    for count in (300_000, 1_200_000):
        tracemalloc.start()
        hits = vase.cast([0.05, 0.1, 30], directions[:count])
        peaks.append(tracemalloc.get_traced_memory()[1] - RESULT_BYTES * count)
        tracemalloc.stop()
        assert 0 < hits.hit.mean() < 0.5
    assert peaks[1] < 96 * 2**20
    assert peaks[1] - peaks[0] < 8 * 2**20


@pytest.mark.slow
def test_memory_with_two_million_triangles(shapes):
    """As the operating system counts it, of three million rays at a box of terrain."""
    code = (
        "import resource, sys, numpy as np; from raybeam import RayCaster\n"
        "mesh = np.load(sys.argv[1]); caster = RayCaster(mesh['v'], mesh['f'], 'numpy')\n"
        "directions = np.random.default_rng(0).normal(size=(3_000_000, 3))\n"
        "peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "before = peak(); hits = caster.returns([0.05, 0.1, 0.4], directions)\n"
        "print(len(hits), (peak() - before) // 1024)"
    )
    vertices, faces = shapes["terrain box"](700)
    assert len(faces) > 1_950_000
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mesh.npz"
        np.savez(path, v=vertices, f=faces)
        paths = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
        command = [sys.executable, "-c", code, str(path)]
        done = subprocess.run(command, capture_output=True, text=True, env=paths, check=True)
    hits, mebibytes = map(int, done.stdout.split())
    assert hits == 3_000_000
    assert mebibytes < 512
