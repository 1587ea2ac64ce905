"""The trees: each triangle once, every box around what is under it, and none is deep."""

import numpy as np
import pytest

from raybeam import ploc
from raybeam.cuda_tables import max_stack_depth
from raybeam.sah_builder import build_by_sah
from raybeam.tree import build_tree

pytest.importorskip("hypothesis")


@pytest.mark.parametrize("copies", [1000, 1023])
def test_copies_of_one_triangle_make_a_flat_tree(copies):
    corners = np.repeat(np.array([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]]), copies, axis=0)
    low = np.zeros((3, copies), np.float32)
    assert len(ploc.build_binary_tree(low, low + np.float32(1)).rounds) <= 12
    assert max_stack_depth(build_tree(corners, 4, 4)) <= 24


def test_a_row_of_boxes_does_not_take_a_round_each():
    """Gaps that shrink along a line: everybody's best partner is the next one."""
    x = np.cumsum(0.999 ** np.arange(3000)).astype(np.float32) / 1000
    low = np.stack([x, np.zeros_like(x), np.zeros_like(x)])
    assert len(ploc.build_binary_tree(low, low + np.float32(1e-4)).rounds) < 60


def test_boxes_that_shrink_along_a_line_do_not_make_a_deep_tree():
    """By the heuristic each would be split off alone."""
    x = (1.1 ** -np.arange(800.0)).astype(np.float32)
    low = np.stack([np.zeros_like(x)] * 3)
    levels = build_by_sah(low, np.stack([x, x, x]), np.ones(len(x)))
    assert len(levels) <= 32 + 10
