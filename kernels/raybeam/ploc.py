"""Builder of binary bounding volume hierarchies.

Most of the tree is built by parallel locally-ordered clustering (PLOC), Meister and Bittner (2018).
Boxes are sorted along a space-filling curve. Each box is then compared with its neighbors in this
order, and two boxes are merged if each is the best partner of the other, that is, if their common
box has the smallest surface area. Each step consists of a few operations on whole arrays.

Close to the root, there are only a few clusters left, and the best partners are seldom neighbors on
the curve. In cities, a tree that is built by clustering alone makes rays visit 20 % to 50 % more
nodes. Therefore, the last clusters are combined by a top-down sweep with the surface area heuristic
(sah_builder.py), which takes a tenth of a second.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .arrays import Floats32, Indices, Ints32
from .sah_builder import build_by_sah

_RADIUS = 8  # neighbors on each side; twice as many reduce the cost of the tree by only 1 to 2 %
# The number of clusters that are left for the sweep is an eighth of all boxes, within these limits.
# Four times the maximum does not improve the tree, and a quarter of it makes the tree 5 % worse.
_MAX_CLUSTERS = 1 << 14
_MIN_CLUSTERS = 1 << 10
_GRID_BITS = 21  # bits per coordinate; three coordinates take 63 bits


@dataclass(frozen=True)
class BinaryTree:
    """Binary tree over n bounding boxes.

    Nodes 0 to n-1 are the boxes, nodes n to 2n-2 are inner nodes, and the last node is the root.

    Attributes
    ----------
    lower, upper
        float32 (3, 2n-1): corners of the box of each node.
    first_child, second_child
        int32 (2n-1,): children of each node; -1 for the n boxes.
    rounds
        Ranges of inner nodes that were created together. Children always belong to an earlier range
        than their parent.
    """

    lower: Floats32
    upper: Floats32
    first_child: Ints32
    second_child: Ints32
    rounds: tuple[tuple[int, int], ...]

    @property
    def area(self) -> Floats32:
        """Half the surface area of each node's bounding box. Shape (2n-1,)."""
        return _half_area(self.upper - self.lower)


@dataclass
class _Clusters:
    """Clusters without a parent so far, in the order of the space-filling curve.

    Attributes
    ----------
    lower, upper
        float32 (3, m): corners of the box of each cluster.
    node
        int32 (m,): node of each cluster.
    """

    lower: Floats32
    upper: Floats32
    node: Ints32

    def merge(self, first: Indices, second: Indices) -> None:
        """Enlarge the boxes of clusters `first` to contain the boxes of their partners `second`."""
        self.lower[:, first] = np.minimum(self.lower[:, first], self.lower[:, second])
        self.upper[:, first] = np.maximum(self.upper[:, first], self.upper[:, second])

    def remove(self, position: Indices) -> None:
        remains = np.ones(len(self.node), np.bool_)
        remains[position] = False
        self.lower = self.lower[:, remains]
        self.upper = self.upper[:, remains]
        self.node = self.node[remains]

    def keep_first(self, count: int) -> None:
        """Remove all but the first `count` clusters."""
        self.lower = self.lower[:, :count]
        self.upper = self.upper[:, :count]
        self.node = self.node[:count]


class _Nodes:
    """Arrays that describe all nodes of a `BinaryTree`, and the number of boxes below each node."""

    def __init__(self, lower: Floats32, upper: Floats32) -> None:
        n = lower.shape[1]
        self.lower, self.upper = np.empty((2, 3, 2 * n - 1), np.float32)
        self.lower[:, :n] = lower
        self.upper[:, :n] = upper
        self.first_child, self.second_child = np.full((2, 2 * n - 1), -1, np.int32)
        self.count = np.ones(2 * n - 1, np.int32)

    def merge(self, clusters: _Clusters, next_node: int, first: Indices, second: Indices) -> None:
        """Replace pairs of clusters by new parent nodes, numbered from `next_node`."""
        if loops := _compiled_loops():
            left = loops.merge_pairs(
                (clusters.lower, clusters.upper, clusters.node),
                first,
                second=second,
                next_node=next_node,
                boxes=(self.lower, self.upper),
                children=(self.first_child, self.second_child),
                count=self.count,
            )
            clusters.keep_first(left)
            return
        new = np.arange(next_node, next_node + len(first), dtype=np.int32)
        self.first_child[new] = clusters.node[first]
        self.second_child[new] = clusters.node[second]
        self.count[new] = self.count[self.first_child[new]] + self.count[self.second_child[new]]
        clusters.merge(first, second)
        self.lower[:, new] = clusters.lower[:, first]
        self.upper[:, new] = clusters.upper[:, first]
        clusters.node[first] = new
        clusters.remove(second)

    def fit_boxes(self, start: int, stop: int) -> None:
        """Compute the boxes of nodes `start` to `stop` from those of their children."""
        children = self.first_child[start:stop], self.second_child[start:stop]
        self.lower[:, start:stop] = np.minimum(*(self.lower[:, child] for child in children))
        self.upper[:, start:stop] = np.maximum(*(self.upper[:, child] for child in children))


def build_binary_tree(lower: Floats32, upper: Floats32) -> BinaryTree:
    """Build a binary tree over bounding boxes.

    Parameters
    ----------
    lower, upper
        float32 (3, n): corners of the n > 0 boxes, within [-2, 2].
    """
    n = lower.shape[1]
    order = np.argsort(_morton_codes(lower, upper), kind="stable").astype(np.int32)
    nodes = _Nodes(lower, upper)
    clusters = _Clusters(lower[:, order], upper[:, order], order)
    rounds: list[tuple[int, int]] = []
    next_node = n
    max_clusters = min(_MAX_CLUSTERS, max(_MIN_CLUSTERS, n // 8))
    while len(clusters.node) > max_clusters:
        first, second = _mutual_partners(clusters.lower, clusters.upper)
        nodes.merge(clusters, next_node, first, second)
        rounds.append((next_node, next_node + len(first)))
        next_node += len(first)
    children, crown_rounds = _build_upper_levels(clusters, nodes.count[clusters.node], next_node)
    nodes.first_child[next_node:], nodes.second_child[next_node:] = children.T
    for start, stop in crown_rounds:
        nodes.fit_boxes(start, stop)
    all_rounds = (*rounds, *crown_rounds)
    return BinaryTree(nodes.lower, nodes.upper, nodes.first_child, nodes.second_child, all_rounds)


def _build_upper_levels(
    clusters: _Clusters, count: Ints32, next_node: int
) -> tuple[Ints32, list[tuple[int, int]]]:
    """Build the rest of the tree once only m clusters are left.

    Return the children (m - 1, 2) of the new nodes, with the root last, and the ranges of nodes on
    each level. `count` (m,) is the number of boxes in each cluster, and `next_node` is the index of
    the first new node.
    """
    levels = build_by_sah(clusters.lower, clusters.upper, count.astype(np.float64))
    children = [np.zeros((0, 2), np.int32)]
    rounds: list[tuple[int, int]] = []
    below = next_node  # first node of the level below
    for nodes in reversed(levels):
        number = np.where(nodes >= 0, clusters.node[nodes], below - 1 - nodes)
        children.append(number.astype(np.int32))
        rounds.append((next_node, next_node + len(nodes)))
        below = next_node
        next_node = next_node + len(nodes)
    return np.concatenate(children), rounds


def _mutual_partners(lower: Floats32, upper: Floats32) -> tuple[Indices, Indices]:
    """Return the pairs of clusters that are each other's best partner, the lower position first."""
    n = lower.shape[1]
    position = np.arange(n)
    best = np.empty(n, np.int64)
    if loops := _compiled_loops():
        loops.best_partners(lower, upper, _RADIUS, best)
    else:
        _find_best_partners(lower, upper, best)
    first = np.flatnonzero((best[best] == position) & (position < best))
    # In a long chain of ever better partners, only a single pair would be merged per round.
    if 16 * len(first) < n:
        first = position[: n - 1 : 2]
        return first, first + 1
    return first, best[first]


@cache
def _compiled_loops() -> Any:
    """Return the module with compiled loops, or None if numba is not installed.

    The loops take a tenth of the time of the NumPy code.
    """
    if find_spec("numba") is None:
        return None
    from . import ploc_loops

    return ploc_loops


def _find_best_partners(lower: Floats32, upper: Floats32, best: Indices) -> None:
    """Find the best partner of each cluster, and write its position to `best`."""
    n = lower.shape[1]
    position = np.arange(n)
    # Partners must also match if all candidates are equally good, for example, copies of one
    # triangle. Therefore, start with the pairs (0, 1), (2, 3), ... and accept only better partners.
    best[:] = np.minimum(position ^ 1, n - 1)
    cost = np.full(n, np.inf, np.float32)
    even = position[: n - 1 : 2]
    cost[even] = _half_area(
        np.maximum(upper[:, even], upper[:, even + 1])
        - np.minimum(lower[:, even], lower[:, even + 1])
    )
    cost[even + 1] = cost[even]
    for step in range(1, min(_RADIUS, n - 1) + 1):
        area = _half_area(
            np.maximum(upper[:, :-step], upper[:, step:])
            - np.minimum(lower[:, :-step], lower[:, step:])
        )
        for cluster, neighbor in (
            (position[:-step], position[step:]),
            (position[step:], position[:-step]),
        ):
            cheaper = area < cost[cluster]
            cost[cluster[cheaper]] = area[cheaper]
            best[cluster[cheaper]] = neighbor[cheaper]


def _half_area(size: Floats32) -> Floats32:
    x, y, z = size
    return x * y + y * z + z * x


def _morton_codes(lower: Floats32, upper: Floats32) -> NDArray[np.uint64]:
    """Compute each box center's position on a Z-order curve."""
    center = lower.astype(np.float64) + upper
    start = center.min(axis=1, keepdims=True)
    extent = float((center - start).max()) or 1.0
    cell = ((center - start) * ((2**_GRID_BITS - 1) / extent)).astype(np.uint64)
    return (
        _spread_bits(cell[0]) << np.uint64(2)
        | _spread_bits(cell[1]) << np.uint64(1)
        | _spread_bits(cell[2])
    )


def _spread_bits(bits: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Insert two zero bits after each of the 21 lowest bits of each number."""
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        bits = (bits | bits << np.uint64(shift)) & np.uint64(mask)
    return bits
