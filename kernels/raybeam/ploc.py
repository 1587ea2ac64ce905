"""A binary bounding volume hierarchy: clustered below, swept at the top.

Parallel locally-ordered clustering, Meister and Bittner (2018): boxes are sorted along a space
filling curve; then each looks at its neighbours in that order, and pairs that are each other's
best partner (least area of the common box) are merged. Every step is a few operations on whole
arrays. Near the root, few clusters are left and neighbours on the curve are seldom the best:
clustering to the end cost rays a fifth to a half more nodes in cities. So the last clusters are
divided from the root down, by a full sweep with the surface area heuristic (sweep.py), which takes
a tenth of a second for them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .arrays import Floats32, Indices, Ints32
from .sweep import divide

_RADIUS = 8  # neighbours looked at on either side; twice as many gain 1 to 2 % of the tree's cost
# Clusters that are left to the sweep: so many, but at most an eighth of all boxes if those are
# enough. Four times as many gain nothing, a quarter loses a twentieth.
_MOST = 1 << 14
_ENOUGH = 1 << 10
_GRID_BITS = 21  # a coordinate; three of them fill 63 bits


@dataclass(frozen=True)
class BinaryTree:
    """Nodes 0 to n-1 are the n boxes given, n to 2n-2 inner ones; the last is the root.

    Attributes
    ----------
    low, high
        float32 (3, 2n-1): boxes.
    left, right
        int32 (2n-1,): children; -1 for the boxes given.
    rounds
        Ranges of inner nodes that were made together: children always belong to an earlier
        range than their parent.
    """

    low: Floats32
    high: Floats32
    left: Ints32
    right: Ints32
    rounds: tuple[tuple[int, int], ...]

    @property
    def area(self) -> Floats32:
        """Half the surface of each node's box: (2n-1,)."""
        return _half_area(self.high - self.low)


def build(low: Floats32, high: Floats32) -> BinaryTree:
    """Build a tree over n boxes, n at least 1.

    Parameters
    ----------
    low, high
        float32 (3, n): least and greatest coordinates, within [-2, 2].
    """
    n = low.shape[1]
    order = np.argsort(_morton(low, high), kind="stable").astype(np.int32)
    all_low, all_high = np.empty((2, 3, 2 * n - 1), np.float32)
    all_low[:, :n] = low
    all_high[:, :n] = high
    left, right = np.full((2, 2 * n - 1), -1, np.int32)
    low = low[:, order]
    high = high[:, order]
    ids = order
    rounds: list[tuple[int, int]] = []
    count = np.ones(2 * n - 1, np.int32)
    made = n
    left_over = min(_MOST, max(_ENOUGH, n // 8))
    while len(ids) > left_over:
        first, second = _partners(low, high)
        new = np.arange(made, made + len(first), dtype=np.int32)
        rounds.append((made, made + len(first)))
        made += len(first)
        left[new] = ids[first]
        right[new] = ids[second]
        count[new] = count[left[new]] + count[right[new]]
        low[:, first] = np.minimum(low[:, first], low[:, second])
        high[:, first] = np.maximum(high[:, first], high[:, second])
        all_low[:, new] = low[:, first]
        all_high[:, new] = high[:, first]
        ids[first] = new
        stay = np.ones(len(ids), np.bool_)
        stay[second] = False
        low = low[:, stay]
        high = high[:, stay]
        ids = ids[stay]
    children, upper = _crown(low, high, count[ids], ids, made)
    left[made:], right[made:] = children.T
    for start, stop in upper:
        both = left[start:stop], right[start:stop]
        all_low[:, start:stop] = np.minimum(*(all_low[:, child] for child in both))
        all_high[:, start:stop] = np.maximum(*(all_high[:, child] for child in both))
    return BinaryTree(all_low, all_high, left, right, (*rounds, *upper))


def _crown(
    low: Floats32,
    high: Floats32,
    count: Ints32,
    ids: Ints32,
    made: int,
) -> tuple[Ints32, list[tuple[int, int]]]:
    """Children (m - 1, 2) of the nodes above the last m clusters, the root last, and rounds.

    `count` and `ids` (m,) say how many boxes are in each cluster, and which node it is; `made` is
    the number of the next node.
    """
    levels = divide(low, high, count.astype(np.float64))
    children = [np.zeros((0, 2), np.int32)]
    rounds: list[tuple[int, int]] = []
    below = made  # start of the level below
    for nodes in reversed(levels):
        number = np.where(nodes >= 0, ids[nodes], below - 1 - nodes)
        children.append(number.astype(np.int32))
        rounds.append((made, made + len(nodes)))
        below = made
        made = made + len(nodes)
    return np.concatenate(children), rounds


def _partners(low: Floats32, high: Floats32) -> tuple[Indices, Indices]:
    """Pairs of positions that are each other's nearest, the lower one first."""
    n = low.shape[1]
    here = np.arange(n)
    # If all candidates are equally good, as among copies of one triangle, partners must still
    # match: start from the pairs (0, 1), (2, 3), ... and replace them only by better ones.
    best = np.minimum(here ^ 1, n - 1)
    cost = np.full(n, np.inf, np.float32)
    even = here[: n - 1 : 2]
    cost[even] = _half_area(
        np.maximum(high[:, even], high[:, even + 1]) - np.minimum(low[:, even], low[:, even + 1])
    )
    cost[even + 1] = cost[even]
    for step in range(1, min(_RADIUS, n - 1) + 1):
        area = _half_area(
            np.maximum(high[:, :-step], high[:, step:]) - np.minimum(low[:, :-step], low[:, step:])
        )
        for mine, other in ((here[:-step], here[step:]), (here[step:], here[:-step])):
            less = area < cost[mine]
            cost[mine[less]] = area[less]
            best[mine[less]] = other[less]
    first = np.flatnonzero((best[best] == here) & (here < best))
    if 16 * len(first) < n:  # long chains of ever better partners: do not merge one by one
        first = even
        return first, first + 1
    return first, best[first]


def _half_area(size: Floats32) -> Floats32:
    x, y, z = size
    return x * y + y * z + z * x


def _morton(low: Floats32, high: Floats32) -> NDArray[np.uint64]:
    """Position of each box's middle along a Z-order curve."""
    middle = low.astype(np.float64) + high
    start = middle.min(axis=1, keepdims=True)
    extent = float((middle - start).max()) or 1.0
    cell = ((middle - start) * ((2**_GRID_BITS - 1) / extent)).astype(np.uint64)
    return _spread(cell[0]) << np.uint64(2) | _spread(cell[1]) << np.uint64(1) | _spread(cell[2])


def _spread(bits: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Two zero bits after each of the 21 lowest bits."""
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        bits = (bits | bits << np.uint64(shift)) & np.uint64(mask)
    return bits
