"""The trees: each triangle once, every box around what is under it, and no worse than a sort."""

from __future__ import annotations

import numpy as np
import pytest

from raybeam import ploc
from raybeam.layout import _stack_need, lay_out
from raybeam.mesh import local_mesh
from raybeam.tree import LEAF_BITS, PAD, build_tree

pytest.importorskip("hypothesis")
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

soups = st.integers(1, 60).flatmap(
    lambda n: hnp.arrays(np.float64, (n, 3, 3), elements=st.floats(-1, 1, width=32))
)


def leaves(tree):
    """Walk the tree: yield each leaf's triangles and all boxes above it."""
    todo = [(0, [])]
    while todo:
        node, above = todo.pop()
        for place in range(tree.child.shape[1]):
            low, high = tree.low[node, :, place], tree.high[node, :, place]
            if (low > high).any():
                assert (low == np.inf).all()
                assert (high == -np.inf).all()
                continue
            code = int(tree.child[node, place])
            boxes = [*above, (low, high)]
            if code >= 0:
                assert code > node
                todo.append((code, boxes))
            else:
                first, count = ~code >> LEAF_BITS, (~code & ((1 << LEAF_BITS) - 1)) + 1
                yield tree.order[first : first + count], boxes


@settings(max_examples=60, derandomize=True)
@given(soups, st.sampled_from([(2, 1), (4, 4), (8, 4), (8, 8)]))
def test_every_triangle_is_in_one_leaf_and_its_boxes(corners, shape):
    width, leaf_size = shape
    tree = build_tree(corners, width, leaf_size)
    seen = []
    for triangles, boxes in leaves(tree):
        assert 1 <= len(triangles) <= leaf_size
        seen.extend(triangles.tolist())
        inside = corners[triangles].reshape(-1, 3)
        for low, high in boxes:
            assert (low <= inside - 0.9 * PAD).all()
            assert (high >= inside + 0.9 * PAD).all()
    assert sorted(seen) == list(range(len(corners)))


@settings(max_examples=60, derandomize=True)
@given(soups)
def test_binary_tree(corners):
    n = len(corners)
    low = np.ascontiguousarray(corners.min(axis=1).T.astype(np.float32))
    high = np.ascontiguousarray(corners.max(axis=1).T.astype(np.float32))
    tree = ploc.build(low, high)
    children = np.concatenate([tree.left[n:], tree.right[n:]])
    assert sorted(children.tolist()) == list(range(2 * n - 2))  # all but the root, once
    assert (tree.left[:n] == -1).all()
    covered = [n]
    for start, stop in tree.rounds:
        assert start == covered[-1]
        assert (tree.left[start:stop] < start).all()
        assert (tree.right[start:stop] < start).all()
        covered.append(stop)
    assert covered[-1] == 2 * n - 1
    for node in range(n, 2 * n - 1):
        both = [tree.left[node], tree.right[node]]
        np.testing.assert_array_equal(tree.low[:, node], tree.low[:, both].min(axis=1))
        np.testing.assert_array_equal(tree.high[:, node], tree.high[:, both].max(axis=1))


@pytest.mark.parametrize("copies", [1000, 1023])
def test_copies_of_one_triangle_make_a_flat_tree(copies):
    corners = np.repeat(np.array([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]]), copies, axis=0)
    low = np.ascontiguousarray(corners.min(axis=1).T.astype(np.float32))
    high = np.ascontiguousarray(corners.max(axis=1).T.astype(np.float32))
    assert len(ploc.build(low, high).rounds) <= 12
    assert _stack_need(build_tree(corners, 4, 4)) <= 24


def test_a_row_of_boxes_does_not_take_a_round_each():
    """Gaps that shrink along a line: everybody's best partner is the next one."""
    x = np.cumsum(0.999 ** np.arange(3000)).astype(np.float32) / 1000
    low = np.stack([x, np.zeros_like(x), np.zeros_like(x)])
    assert len(ploc.build(low, low + np.float32(1e-4)).rounds) < 60


def test_tree_is_better_than_halves_of_a_sorted_list(shapes):
    """Expected box tests of a random ray, by the surface area heuristic."""
    mesh = local_mesh(*shapes["soup"]("random", 2000))
    n = len(mesh.corners)

    def cost(low, high):
        size = high - low
        area = size[0] * size[1] + size[1] * size[2] + size[2] * size[0]
        return float(area[n:].sum() / area.max())

    order = np.argsort(mesh.corners.mean(axis=1)[:, 0])
    low, high = mesh.corners.min(axis=1).T[:, order], mesh.corners.max(axis=1).T[:, order]
    tree = ploc.build(low.astype(np.float32), high.astype(np.float32))
    halves_low, halves_high = [low], [high]
    while halves_low[-1].shape[1] > 1:
        m = halves_low[-1].shape[1] // 2 * 2
        halves_low.append(np.minimum(halves_low[-1][:, :m:2], halves_low[-1][:, 1:m:2]))
        halves_high.append(np.maximum(halves_high[-1][:, :m:2], halves_high[-1][:, 1:m:2]))
    halved = cost(np.concatenate(halves_low, axis=1), np.concatenate(halves_high, axis=1))
    assert cost(tree.low, tree.high) < 0.6 * halved


def test_layout_for_the_device(shapes):
    mesh = local_mesh(*shapes["vase"]())
    layout = lay_out(mesh)
    k = len(mesh.corners)
    assert layout.nodes.shape[1] * layout.nodes.itemsize == 128
    assert layout.triangles.shape == (k, 12)
    assert sorted(layout.faces.tolist()) == mesh.index.tolist()
    np.testing.assert_array_equal(
        layout.triangles.reshape(k, 3, 4)[:, 0, :3], layout.corners[:, :3].astype(np.float32)
    )
    assert 0 < layout.stack < 64
