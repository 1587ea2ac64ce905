"""The trees: each triangle once, every box around what is under it, and none is deep."""

import numpy as np
import pytest

from raybeam import ploc
from raybeam.layout import _stack_need
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


def test_boxes_that_shrink_along_a_line_do_not_make_a_deep_tree():
    """By the heuristic each would be split off alone."""
    x = (1.1 ** -np.arange(800.0)).astype(np.float32)
    low = np.stack([np.zeros_like(x)] * 3)
    levels = divide(low, np.stack([x, x, x]), np.ones(len(x)))
    assert len(levels) <= 32 + 10
