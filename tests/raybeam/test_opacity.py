"""Masks: a ray passes where they are false, and is stopped elsewhere as without a mask."""

import numpy as np
import pytest

from raybeam import Instance, Mesh, Opacity, RayCaster, available_backends
from raybeam.opacity import check_opacity, join_masks

FIELDS = ("distance", "triangle", "u", "v", "instance")
SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
HALVES = np.array([[0, 1, 2], [0, 2, 3]])


def same(one, other):
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)


def soup(shapes, kind, seed):
    """A mesh of unconnected triangles with a random mask and coordinates far beyond it."""
    rng = np.random.default_rng(seed)
    vertices, faces = shapes["soup"](kind, 200, seed)
    uv = 3 * rng.normal(size=(200, 3, 2))
    return Mesh(vertices, faces, Opacity(rng.random((5, 7)) < 0.5, uv))


def casters(shapes, kind, backends):
    """Of each backend: a plain masked mesh, and instances of masked meshes and of an opaque one."""
    mesh = soup(shapes, kind, 1)
    meshes = [mesh, Mesh(*shapes["vase"](20, 20)), soup(shapes, "random", 2)]
    rng = np.random.default_rng(3)
    turns = np.linalg.qr(rng.normal(size=(30, 3, 3)))[0] * rng.uniform(0.5, 2, (30, 1, 3))
    places = np.concatenate([turns, rng.uniform(-20, 20, (30, 3, 1))], axis=2)
    forest = [Instance(meshes[k % 3], place) for k, place in enumerate(places)]
    for instances in ([Instance(mesh)], forest):
        yield [RayCaster.from_instances(instances, name) for name in backends]


def rays(count):
    rng = np.random.default_rng(4)
    origins = rng.uniform(-40, 40, (count, 3))
    return origins, rng.uniform(-20, 20, (count, 3)) - origins


@pytest.mark.extended(every=15)
@pytest.mark.slow(every=3)
@pytest.mark.parametrize("place", [None, np.diag([2.0, -3, 1, 1])])
@pytest.mark.parametrize("repeats", [1, 3])
def test_a_ray_passes_where_the_mask_is_false(backend, place, repeats):
    """A grid of rays onto a square with a mask of 4 by 5; what passes hits the floor."""
    rng = np.random.default_rng(0)
    mask = rng.random((4, 5)) < 0.5
    uv = repeats * SQUARE[HALVES][:, :, :2] - [7, 2]
    leaf = Mesh(SQUARE, HALVES, Opacity(mask, uv))
    floor = Instance(Mesh(SQUARE * 40 - [20, 20, 1], HALVES))
    caster = RayCaster.from_instances([floor, Instance(leaf, place)], backend)
    across, down = (np.arange(k * repeats) for k in (5, 4))
    x, y = np.meshgrid((across + 0.4) / (5 * repeats), (down + 0.7) / (4 * repeats))
    size = [1, 1] if place is None else [2, -3]
    origins = np.column_stack([x.ravel() * size[0], y.ravel() * size[1], np.full(x.size, 5.0)])
    hits = caster.cast(origins, np.broadcast_to([0, 0, -1.0], origins.shape))
    stopped = mask[np.ix_(down % 4, across % 5)].ravel()
    assert 0 < stopped.sum() < stopped.size
    np.testing.assert_array_equal(hits.instance, stopped)
    np.testing.assert_allclose(hits.distance, np.where(stopped, 5, 6), rtol=1e-12)


@pytest.mark.extended
@pytest.mark.parametrize("kind", ["random", "sliver", "tiny"])
def test_kernels_have_the_bits_of_numpy(kernels, shapes, kind):
    origins, directions = rays(4_000)
    for numpy, other in casters(shapes, kind, ("numpy", kernels)):
        want = numpy.cast(origins, directions)
        assert want.hit.sum() > 300 or kind != "random"
        same(other.cast(origins, directions), want)


def test_tiles_have_the_bits_of_numpy(shapes):
    if reason := available_backends()["tiles"]:
        pytest.skip(f"tiles: {reason}")
    origins, directions = rays(20_000)
    for numpy, tiles in casters(shapes, "random", ("numpy", "tiles")):
        want, got = (caster.cast(origins, directions) for caster in (numpy, tiles))
        differ = np.any([getattr(got, name) != getattr(want, name) for name in FIELDS], axis=0)
        assert want.hit.sum() > 2_000
        assert differ.sum() <= 2


@pytest.mark.extended
def test_a_mask_that_is_true_everywhere_changes_no_bit(backend, shapes):
    vertices, faces = shapes["vase"](20, 20)
    uv = np.random.default_rng(5).normal(size=(len(faces), 3, 2))
    origins, directions = rays(3_000)
    origins /= 20
    directions = -origins + 0.02 * directions
    want = RayCaster(vertices, faces, backend).cast(origins, directions)
    assert want.hit.sum() > 1_000
    for opaque in (True, False):
        mesh = Mesh(vertices, faces, Opacity(np.full((3, 4), opaque), uv))
        hits = RayCaster.from_instances([Instance(mesh)], backend).cast(origins, directions)
        if opaque:
            same(hits, want)
        else:
            assert not hits.hit.any()


@pytest.mark.extended(every=3)
def test_meshes_that_share_a_mask_keep_it_once(backend):
    mask = np.random.default_rng(6).random((64, 64)) < 0.5
    uv = SQUARE[HALVES][:, :, :2]
    places = [np.eye(4), np.diag([2.0, 2, 1, 1])]
    places[1][:3, 3] = 3, 0, 1

    def caster(masks):
        order = np.arange(2, dtype=np.int32)
        opacities = [Opacity(one, uv) for one in masks]
        joined = join_masks([check_opacity(one, 2, order) for one in opacities], [order] * 2)
        meshes = [Mesh(SQUARE, HALVES, one) for one in opacities]
        return joined.mask.size, RayCaster.from_instances(
            list(map(Instance, meshes, places)), backend
        )

    (once, shared), (twice, copied) = caster([mask, mask]), caster([mask, mask.copy()])
    assert (once, twice) == (mask.size, 2 * mask.size)
    origins = np.random.default_rng(7).uniform([0, 0, 5], [5, 2, 5], (1000, 3))
    down = np.broadcast_to([0, 0, -1.0], origins.shape)
    same(shared.cast(origins, down), copied.cast(origins, down))


@pytest.mark.parametrize(
    ("mask", "uv", "words"),
    [
        (
            np.ones((2, 2)),
            np.zeros((2, 3, 2)),
            r"mask must be a non-empty bool .*float64 .* \(2, 2\)",
        ),
        (np.ones((0, 2), bool), np.zeros((2, 3, 2)), r"mask must be .*\(0, 2\)"),
        (np.ones((2, 2), bool), np.zeros((3, 3, 2)), r"uv must be .*\(2, 3, 2\).*\(3, 3, 2\)"),
        (np.ones((2, 2), bool), np.full((2, 3, 2), np.nan), "uv of face 0 must .*nan"),
        (np.ones((2, 2), bool), np.full((2, 3, 2), -3e9), "uv of face 0 must be finite"),
    ],
)
def test_refused(mask, uv, words):
    with pytest.raises(ValueError, match=words):
        Mesh(SQUARE, HALVES, Opacity(mask, uv))


def test_at_an_edge_the_opaque_neighbor_stops_a_ray(backend, shapes):
    """Rays at the edges of triangles whose masks differ."""
    vertices, faces = shapes["sphere"](12, 16)
    rng = np.random.default_rng(6)
    opacity = Opacity(np.array([[True, False]]), rng.random((len(faces), 3, 2)))
    corners = vertices[faces[::3]]
    share = rng.random((len(corners), 1))
    directions = share * corners[:, 1] + (1 - share) * corners[:, 2]
    want, got = (
        RayCaster.from_instances([Instance(Mesh(vertices, faces, opacity))], name).cast(
            [0, 0, 0], directions
        )
        for name in ("numpy", backend)
    )
    assert 0.3 < want.hit.mean() < 0.95
    same(got, want)
