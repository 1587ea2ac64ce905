"""The trees: each triangle once, every box around what is under it, the top divided best."""

from __future__ import annotations

import numpy as np
import pytest

from raybeam import ploc
from raybeam.layout import _stack_need, lay_out
from raybeam.mesh import local_mesh
from raybeam.sweep import divide
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


@settings(max_examples=40, derandomize=True)
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


def boxes(count, seed=0):
    """Boxes of many sizes within [-1, 1]: low and high, (3, count)."""
    rng = np.random.default_rng(seed)
    middle = rng.uniform(-0.9, 0.9, (3, count))
    half = 10.0 ** rng.uniform(-3, -1, (3, count))
    return (middle - half).astype(np.float32), (middle + half).astype(np.float32)


def check_binary(tree, n):
    """All nodes but the root are a child once, of a parent in a later round, and in its box."""
    children = np.concatenate([tree.left[n:], tree.right[n:]])
    assert sorted(children.tolist()) == list(range(2 * n - 2))
    assert (tree.left[:n] == -1).all()
    covered = [n]
    for start, stop in tree.rounds:
        assert start == covered[-1]
        assert max(tree.left[start:stop].max(), tree.right[start:stop].max()) < start
        covered.append(stop)
    assert covered[-1] == 2 * n - 1
    both = np.stack([tree.left[n:], tree.right[n:]])
    np.testing.assert_array_equal(tree.low[:, n:], tree.low[:, both].min(axis=1))
    np.testing.assert_array_equal(tree.high[:, n:], tree.high[:, both].max(axis=1))


@settings(max_examples=40, derandomize=True)
@given(soups)
def test_binary_tree(corners):
    low, high = (
        np.ascontiguousarray(f(corners, axis=1).T.astype(np.float32)) for f in (np.min, np.max)
    )
    check_binary(ploc.build(low, high), len(corners))


@pytest.mark.parametrize("left", [1, 2, 9, 300, 1 << 14])
def test_any_number_of_clusters_may_be_left(monkeypatch, left):
    monkeypatch.setattr(ploc, "_MOST", left)
    monkeypatch.setattr(ploc, "_ENOUGH", left)
    check_binary(ploc.build(*boxes(300)), 300)


@pytest.mark.parametrize("copies", [1000, 1023])
def test_copies_of_one_triangle_make_a_flat_tree(copies):
    corners = np.repeat(np.array([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]]), copies, axis=0)
    low = np.zeros((3, copies), np.float32)
    assert len(ploc.build(low, low + np.float32(1)).rounds) <= 12
    assert _stack_need(build_tree(corners, 4, 4)) <= 24


def test_a_row_of_boxes_does_not_take_a_round_each():
    """Gaps that shrink along a line: everybody's best partner is the next one."""
    x = np.cumsum(0.999 ** np.arange(3000)).astype(np.float32) / 1000
    low = np.stack([x, np.zeros_like(x), np.zeros_like(x)])
    assert len(ploc.build(low, low + np.float32(1e-4)).rounds) < 60


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


# ---- the tree's upper part ----


def half_area(low, high):
    x, y, z = high.max(axis=1).astype(float) - low.min(axis=1)
    return x * y + y * z + z * x


def under(levels, depth, node):
    """Boxes below a node of a level."""
    out = []
    for child in levels[depth][node]:
        out += [int(child)] if child >= 0 else under(levels, depth + 1, -1 - child)
    return out


@pytest.mark.parametrize("seed", range(6))
def test_no_division_of_the_root_is_cheaper(seed):
    count = 40
    low, high = boxes(count, seed)
    weight = np.random.default_rng(seed).integers(1, 50, count).astype(float)
    levels = divide(low, high, weight)

    def cost(first, second):
        return sum(half_area(low[:, p], high[:, p]) * weight[p].sum() for p in (first, second))

    sides = [[int(child)] if child >= 0 else under(levels, 1, -1 - child) for child in levels[0][0]]
    chosen = cost(*sides)
    orders = np.argsort(low.astype(float) + high, axis=1, kind="stable")
    every = [cost(order[:k], order[k:]) for order in orders for k in range(1, count)]
    assert chosen == pytest.approx(min(every), rel=1e-9)
    assert max(every) > 1.5 * chosen


def test_boxes_that_shrink_along_a_line_do_not_make_a_deep_tree():
    """By the heuristic each would be split off alone."""
    x = (1.1 ** -np.arange(800.0)).astype(np.float32)
    low = np.stack([np.zeros_like(x)] * 3)
    levels = divide(low, np.stack([x, x, x]), np.ones(len(x)))
    assert len(levels) <= 32 + 10


def test_copies_are_halved():
    low = np.zeros((3, 1024), np.float32)
    assert len(divide(low, low + np.float32(0.5), np.ones(1024))) == 10
