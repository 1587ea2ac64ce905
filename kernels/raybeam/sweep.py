"""A binary hierarchy by a full sweep with the surface area heuristic.

From the root down, every node is divided where the heuristic is least, over all positions between
its boxes sorted along each of the three axes. No builder that uses only boxes gives better trees in
general; bins, as in Embree, are a few per cent worse. All nodes of a level are divided together, in
some tens of operations on whole arrays.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .arrays import Floats, Floats32, Indices

_APART = 8.0  # more than the distance of boxes within [-2, 2]
# Levels that are divided by the heuristic; deeper ones are halved. Boxes that shrink along a line
# would be split off one by one, and as many nodes would wait in a traversal.
_LEVELS = 32


@dataclass(frozen=True)
class _Level:
    """Nodes of two boxes and more, all as far from the root.

    Attributes
    ----------
    orders
        Three times (m,): the boxes, node by node, sorted by their middles along each axis.
    start, stop
        (k,): range of each node's boxes in them.
    """

    orders: list[Indices]
    start: Indices
    stop: Indices


def divide(low: Floats32, high: Floats32, weight: Floats) -> list[Indices]:
    """Divide boxes into two and two and so on, until each is alone.

    Parameters
    ----------
    low, high
        float32 (3, n): least and greatest coordinates, within [-2, 2]; n at least 1.
    weight
        (n,): cost to test a box's contents, a whole number such as that of triangles.

    Returns
    -------
    levels
        The nodes of each level, from the root down: (k, 2), two children each. A child is the
        number of a box or, for node j of the next level, ``-1 - j``.
    """
    middles = low.astype(np.float64) + high
    n = low.shape[1]
    level = _Level([np.argsort(m, kind="stable") for m in middles], np.array([0]), np.array([n]))
    levels: list[Indices] = []
    while n > 1 and len(level.start):
        node = np.repeat(np.arange(len(level.start)), level.stop - level.start)
        if len(levels) < _LEVELS:
            axis, split = _cheapest(low, high, weight, level, node)
        else:
            axis = np.zeros_like(level.start)
            split = (level.start + level.stop) // 2 - 1
        children, level = _divided(level, node, axis, split)
        levels.append(children)
    return levels


def _cheapest(
    low: Floats32, high: Floats32, weight: Floats, level: _Level, node: Indices
) -> tuple[Indices, Indices]:
    """Find the best division of each node: its axis, and the last place of the first part."""
    best = np.full(len(level.start), np.inf)
    axis, split = np.zeros((2, len(level.start)), np.intp)
    for k, order in enumerate(level.orders):
        cost = _costs(low[:, order], high[:, order], weight[order], level, node)
        least = np.minimum.reduceat(cost, level.start)
        found = np.flatnonzero(cost == least[node])
        place = found[np.searchsorted(found, level.start)]
        # Equal boxes cost the same wherever they are divided: halve them.
        dearest = np.maximum.reduceat(np.where(np.isinf(cost), -np.inf, cost), level.start)
        place = np.where(dearest <= least, (level.start + level.stop) // 2 - 1, place)
        better = least < best
        best[better] = least[better]
        axis[better] = k
        split[better] = place[better]
    return axis, split


def _costs(low: Floats32, high: Floats32, weight: Floats, level: _Level, node: Indices) -> Floats:
    """Cost of dividing each place's node behind it, boxes and weights in order along an axis."""
    before = _areas(low, high, node)
    after = _areas(low[:, ::-1], high[:, ::-1], (node[-1] - node)[::-1])[::-1]
    sums = np.cumsum(weight)
    nothing = np.concatenate([[0.0], sums])
    cost = np.full(len(node), np.inf)
    cost[:-1] = before[:-1] * (sums - nothing[level.start][node])[:-1]
    cost[:-1] += after[1:] * (nothing[level.stop][node] - sums)[:-1]
    cost[level.stop - 1] = np.inf  # nothing would be left for the second part
    return cost


def _areas(low: Floats32, high: Floats32, node: Indices) -> Floats:
    """Half the surface of the box around each place's box and those of its node before it."""
    # Shifted apart node by node, so that one pass over all nodes restarts at each.
    shift = _APART * node
    x, y, z = (
        np.maximum.accumulate(b + shift) - shift - (np.minimum.accumulate(a - shift) + shift)
        for a, b in zip(low, high, strict=True)
    )
    return x * y + y * z + z * x


def _divided(level: _Level, node: Indices, axis: Indices, split: Indices) -> tuple[Indices, _Level]:
    """Children of each node, and the level below."""
    right = np.zeros(int(max(order.max() for order in level.orders)) + 1, np.bool_)
    for k, order in enumerate(level.orders):
        mine = (axis == k)[node]
        right[order[mine]] = (np.arange(len(order)) > split[node])[mine]
    orders = [order[np.argsort(2 * node + right[order], kind="stable")] for order in level.orders]
    start = np.stack([level.start, split + 1], axis=1).reshape(-1)
    stop = np.stack([split + 1, level.stop], axis=1).reshape(-1)
    inner = stop - start > 1
    below = np.cumsum(inner)  # node j of the next level is counted as j + 1
    children = np.where(inner, -1 * below, orders[0][start]).reshape(-1, 2)
    kept = np.repeat(inner, stop - start)
    sizes = (stop - start)[inner]
    ends = np.cumsum(sizes)
    return children, _Level([order[kept] for order in orders], ends - sizes, ends)
