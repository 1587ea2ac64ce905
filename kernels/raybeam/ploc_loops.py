"""Compiled versions of the slowest steps in ploc.py, with the same results.

Clusters are boxes `lower` and `upper`, float32 (3, m), and nodes, int32 (m,).
"""

from __future__ import annotations

import numpy as np

from .compiled import compiled, inlined


@inlined
def _common_area(lower, upper, i, j):  # type: ignore[no-untyped-def]
    """Return half the surface area of the bounding box around boxes `i` and `j`."""
    x = max(upper[0, i], upper[0, j]) - min(lower[0, i], lower[0, j])
    y = max(upper[1, i], upper[1, j]) - min(lower[1, i], lower[1, j])
    z = max(upper[2, i], upper[2, j]) - min(lower[2, i], lower[2, j])
    return x * y + y * z + z * x


@compiled()
def best_partners(lower, upper, radius, best):  # type: ignore[no-untyped-def]
    """Find the best partner of each cluster, and write its position to `best`, int64 (m,).

    The best partner is one of the `radius` neighbors on each side, namely the one with which the
    common box has the smallest area. Ties are resolved as in `ploc._find_best_partners`.
    """
    n = lower.shape[1]
    for i in range(n):
        partner = min(i ^ 1, n - 1)
        least = np.float32(np.inf)
        if partner != i:
            least = _common_area(lower, upper, i, partner)
        for step in range(1, min(radius, n - 1) + 1):
            for j in (i + step, i - step):
                if 0 <= j < n:
                    area = _common_area(lower, upper, i, j)
                    if area < least:
                        least = area
                        partner = j
        best[i] = partner


@compiled()
def merge_pairs(  # type: ignore[no-untyped-def]
    clusters, first, second, next_node, boxes, children, count
):
    """Replace pairs of clusters by new parent nodes, and return how many clusters are left.

    Parameters
    ----------
    clusters
        Lower and upper corners and nodes of the clusters. The remaining clusters are moved to the
        front.
    first, second
        int64 (k,): positions of the clusters of each pair. `first` is in ascending order.
    next_node
        Index of the first new node.
    boxes
        Lower and upper corners of all nodes.
    children
        First and second child of all nodes, int32.
    count
        Number of boxes below each node, int32.
    """
    lower, upper, node = clusters
    all_lower, all_upper = boxes
    first_child, second_child = children
    for k in range(len(first)):
        i = first[k]
        j = second[k]
        new = next_node + k
        first_child[new] = node[i]
        second_child[new] = node[j]
        count[new] = count[node[i]] + count[node[j]]
        for axis in range(3):
            low = min(lower[axis, i], lower[axis, j])
            high = max(upper[axis, i], upper[axis, j])
            lower[axis, i] = low
            upper[axis, i] = high
            all_lower[axis, new] = low
            all_upper[axis, new] = high
        node[i] = new
        node[j] = -1
    left = 0
    for i in range(len(node)):
        if node[i] >= 0:
            node[left] = node[i]
            for axis in range(3):
                lower[axis, left] = lower[axis, i]
                upper[axis, left] = upper[axis, i]
            left += 1
    return left
