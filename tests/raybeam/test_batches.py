"""The same ray has the same bits in every batch, and with every backend that decides exactly."""

import tracemalloc

import numpy as np
import pytest
from benchmarks import seams

from raybeam import RayCaster

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


@pytest.mark.extended
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
    monkeypatch.setattr(type(vase.engine), "chunk", 97)
    same(vase.cast(origins, directions), whole)


def test_one_origin_is_the_same_as_many(caster, shapes):
    vase = caster(*shapes["vase"]())
    _, directions = rays(2000, 5)
    for origin in ([0.1, 0.2, 0.3], [30, 40, 50.0]):
        same(vase.cast(origin, directions), vase.cast(np.tile(origin, (2000, 1)), directions))


@pytest.mark.parametrize("kind", ["random", "sliver", "huge", "tiny"])
def test_kernels_have_the_bits_of_numpy(kernels, shapes, kind):
    """Distances, weights, and the triangle on a tie."""
    vertices, faces = shapes["soup"](kind)
    origins, directions = rays(2000, 6)
    aim = vertices[faces[np.arange(1000) % len(faces)]].mean(axis=1)
    directions[:1000] = aim - origins[:1000]
    for offset in (0, 5e5):
        reference = RayCaster(vertices + offset, faces, "numpy")
        other = RayCaster(vertices + offset, faces, kernels)
        for limits in ((0, np.inf), (1, 100)):
            want = reference.cast(origins + offset, directions, *limits)
            assert want.hit.any()
            same(other.cast(origins + offset, directions, *limits), want)


@pytest.mark.parametrize("name", ["cube", "sphere", "vase", "terrain box"])
def test_kernels_have_the_bits_of_numpy_at_seams(kernels, shapes, name):
    vertices, faces = shapes[name]()
    origin = np.array([0.05, 0.1, 0.4])
    directions = seams.seam_rays(vertices, faces, origin, 10_000, np.random.default_rng(7))
    want = RayCaster(vertices, faces, "numpy").cast(origin, directions)
    assert want.hit.all()
    same(RayCaster(vertices, faces, kernels).cast(origin, directions), want)


RESULT_BYTES = 8 + 4 + 8 + 8  # of a ray: distance, triangle, u, v


@pytest.mark.extended
def test_memory_of_a_cast_is_bounded(shapes):
    """Beyond its answer, a cast of many rays takes no more than one of a chunk, whatever they are.

    The directions are no unit vectors and, at single precision, not what the caster works with:
    nothing is made of them for all rays at once.
    """
    vase = RayCaster(*shapes["vase"](), "numpy")
    directions = np.random.default_rng(9).normal(size=(900_000, 3)).astype(np.float32)
    peaks = []
    for count in (300_000, 900_000):
        tracemalloc.start()
        hits = vase.cast([0.05, 0.1, 30], directions[:count])
        peaks.append(tracemalloc.get_traced_memory()[1] - RESULT_BYTES * count)
        tracemalloc.stop()
        assert 0 < hits.hit.mean() < 0.5
    assert peaks[1] < 96 * 2**20
    assert peaks[1] - peaks[0] < 8 * 2**20
