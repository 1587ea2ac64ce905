"""Build binary hierarchies from top to bottom with the surface area heuristic (SAH).

Starting at the root, each node's boxes are sorted along each of the three axes. The node is then
divided at the position between two boxes where the heuristic has its minimum. This full sweep
generally gives the best trees among the builders that only use boxes. Trees from binned builders
are a few percent worse. All nodes of a level are divided together, in tens of operations on whole
arrays.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .arrays import Floats, Floats32, Indices

_NODE_SPACING = 8.0  # offset between consecutive nodes; exceeds the extent of boxes within [-2, 2]
# Number of levels that are divided by the heuristic. On deeper levels, nodes are halved, because
# boxes that shrink along a line would otherwise be split off one by one, which makes the tree very
# deep.
_LEVELS = 32


@dataclass(frozen=True)
class _Level:
    """The nodes on one level of the tree that contain at least two boxes.

    Attributes
    ----------
    orders
        For each axis, the boxes (m,), grouped by node and sorted by their centers along the axis.
    start, stop
        (k,): range of each node's boxes in these arrays.
    """

    orders: list[Indices]
    start: Indices
    stop: Indices


def build_by_sah(lower: Floats32, upper: Floats32, weight: Floats) -> list[Indices]:
    """Divide boxes recursively until each part contains a single box.

    Parameters
    ----------
    lower, upper
        float32 (3, n): corners of the n > 0 boxes, within [-2, 2].
    weight
        (n,): cost of testing the contents of each box, an integer such as the number of triangles.

    Returns
    -------
    levels
        The children (k, 2) of the nodes on each level, starting at the root. A child is the index
        of a box, or ``-1 - j`` for node j of the next level.
    """
    centers = lower.astype(np.float64) + upper
    n = lower.shape[1]
    level = _Level([np.argsort(m, kind="stable") for m in centers], np.array([0]), np.array([n]))
    levels: list[Indices] = []
    while n > 1 and len(level.start):
        node = np.repeat(np.arange(len(level.start)), level.stop - level.start)
        if len(levels) < _LEVELS:
            axis, split = _cheapest_splits(lower, upper, weight, level, node)
        else:
            axis = np.zeros_like(level.start)
            split = (level.start + level.stop) // 2 - 1
        children, level = _split_nodes(level, node, axis, split)
        levels.append(children)
    return levels


def _cheapest_splits(
    lower: Floats32, upper: Floats32, weight: Floats, level: _Level, node: Indices
) -> tuple[Indices, Indices]:
    """Find the axis and position of the cheapest split of each node.

    The position is that of the last box in the first part.
    """
    best = np.full(len(level.start), np.inf)
    axis, split = np.zeros((2, len(level.start)), np.intp)
    for k, order in enumerate(level.orders):
        cost = _split_costs(lower[:, order], upper[:, order], weight[order], level, node)
        min_cost = np.minimum.reduceat(cost, level.start)
        cheapest = np.flatnonzero(cost == min_cost[node])
        position = cheapest[np.searchsorted(cheapest, level.start)]
        # If all splits have the same cost, as for equal boxes, split in the middle.
        max_cost = np.maximum.reduceat(np.where(np.isinf(cost), -np.inf, cost), level.start)
        position = np.where(max_cost <= min_cost, (level.start + level.stop) // 2 - 1, position)
        better = min_cost < best
        best[better] = min_cost[better]
        axis[better] = k
        split[better] = position[better]
    return axis, split


def _split_costs(
    lower: Floats32, upper: Floats32, weight: Floats, level: _Level, node: Indices
) -> Floats:
    """For each position, compute the cost of splitting its node after this position.

    The boxes and weights are sorted along an axis.
    """
    area_before = _prefix_half_areas(lower, upper, node)
    area_after = _prefix_half_areas(lower[:, ::-1], upper[:, ::-1], (node[-1] - node)[::-1])[::-1]
    sums = np.cumsum(weight)
    sums_from_zero = np.concatenate([[0.0], sums])
    cost = np.full(len(node), np.inf)
    cost[:-1] = area_before[:-1] * (sums - sums_from_zero[level.start][node])[:-1]
    cost[:-1] += area_after[1:] * (sums_from_zero[level.stop][node] - sums)[:-1]
    cost[level.stop - 1] = np.inf  # The second part would be empty.
    return cost


def _prefix_half_areas(lower: Floats32, upper: Floats32, node: Indices) -> Floats:
    """For each position, compute half the surface area around a node's boxes up to there."""
    # Each node is shifted by a different offset, so that one pass over all nodes restarts at each
    # node.
    shift = _NODE_SPACING * node
    x, y, z = (
        np.maximum.accumulate(b + shift) - shift - (np.minimum.accumulate(a - shift) + shift)
        for a, b in zip(lower, upper, strict=True)
    )
    return x * y + y * z + z * x


def _split_nodes(
    level: _Level, node: Indices, axis: Indices, split: Indices
) -> tuple[Indices, _Level]:
    """Split each node into two children, and return the children and the next level."""
    right = np.zeros(int(max(order.max() for order in level.orders)) + 1, np.bool_)
    for k, order in enumerate(level.orders):
        split_on_axis = (axis == k)[node]
        right[order[split_on_axis]] = (np.arange(len(order)) > split[node])[split_on_axis]
    orders = [order[np.argsort(2 * node + right[order], kind="stable")] for order in level.orders]
    start = np.stack([level.start, split + 1], axis=1).reshape(-1)
    stop = np.stack([split + 1, level.stop], axis=1).reshape(-1)
    inner = stop - start > 1
    below = np.cumsum(inner)  # j + 1 for node j of the next level
    children = np.where(inner, -1 * below, orders[0][start]).reshape(-1, 2)
    in_inner = np.repeat(inner, stop - start)
    sizes = (stop - start)[inner]
    stops = np.cumsum(sizes)
    return children, _Level([order[in_inner] for order in orders], stops - sizes, stops)
