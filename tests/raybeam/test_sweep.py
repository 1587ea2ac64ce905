"""The tree's upper part: divided where the surface area heuristic is least, and never deep."""

from __future__ import annotations

import numpy as np
import pytest

from raybeam import ploc
from raybeam.sweep import divide


def boxes(count, seed=0):
    """Boxes of many sizes within [-1, 1]: low and high, (3, count)."""
    rng = np.random.default_rng(seed)
    middle = rng.uniform(-0.9, 0.9, (3, count))
    half = 10.0 ** rng.uniform(-3, -1, (3, count))
    return (middle - half).astype(np.float32), (middle + half).astype(np.float32)


def half_area(low, high):
    x, y, z = high.max(axis=1).astype(float) - low.min(axis=1)
    return x * y + y * z + z * x


def under(levels, depth, node):
    """Boxes below a node of a level."""
    out = []
    for child in levels[depth][node]:
        out += [int(child)] if child >= 0 else under(levels, depth + 1, -1 - child)
    return out


@pytest.mark.parametrize("count", [1, 2, 3, 10, 137])
def test_every_box_is_in_one_place(count):
    levels = divide(*boxes(count), np.ones(count))
    if count == 1:
        assert levels == []
        return
    assert sorted(under(levels, 0, 0)) == list(range(count))
    assert sum(len(level) for level in levels) == count - 1
    for above, below in zip(levels, [*levels[1:], np.zeros((0, 2))], strict=True):
        nodes = -1 - above[above < 0]
        assert nodes.tolist() == list(range(len(below)))


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


@pytest.mark.parametrize("left", [1, 2, 9, 300, 1 << 14])
def test_any_number_of_clusters_may_be_left(monkeypatch, left):
    monkeypatch.setattr(ploc, "_MOST", left)
    monkeypatch.setattr(ploc, "_ENOUGH", left)
    n = 300
    low, high = boxes(n)
    tree = ploc.build(low, high)
    both = np.concatenate([tree.left[n:], tree.right[n:]])
    assert sorted(both.tolist()) == list(range(2 * n - 2))
    assert [start for start, _ in tree.rounds[1:]] == [stop for _, stop in tree.rounds[:-1]]
    for start, stop in tree.rounds:
        assert max(tree.left[start:stop].max(), tree.right[start:stop].max()) < start
    for node in range(n, 2 * n - 1):
        children = [tree.left[node], tree.right[node]]
        np.testing.assert_array_equal(tree.low[:, node], tree.low[:, children].min(axis=1))
        np.testing.assert_array_equal(tree.high[:, node], tree.high[:, children].max(axis=1))
