"""Wide, flat bounding volume hierarchies for fast traversal.

The boxes are padded and rounded outward, so that a float32 test of a ray and a box never misses a
box whose triangle the ray hits in exact arithmetic. In the following, u = 2**-24, and the local
coordinates of boxes and ray starts are within [-1, 1].

The distance to a plane is computed from a start with an error of u and a reciprocal direction with
a relative error of 2 u, and there are up to three further roundings of values up to 2. Expressed as
a shift of the plane, the error is at most 12 u. Advancing a distant ray to the box in float64 adds
up to 6 u at a distance of 1e9 local units. Beyond this distance, every triangle is tested in
float64. Storing the boxes in float32 adds at most u. The boxes are padded by 20 u.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce

import numpy as np

from . import ploc
from .arrays import Bools, Floats, Floats32, Indices, Ints, Ints32

PAD = 20 * 2.0**-24  # local units
LEAF_BITS = 3


@dataclass(frozen=True)
class WideTree:
    """Tree nodes with up to `width` children each. Node 0 is the root.

    Attributes
    ----------
    lower, upper
        float32 (m, 3, width): boxes of the children, padded by `PAD`. An empty slot has an inverted
        box, which no ray intersects.
    child
        int32 (m, width): index of a node, or ``~(first << LEAF_BITS | count - 1)`` for a leaf with
        the triangles ``order[first : first + count]``, or 0 in an empty slot.
    order
        int32 (k,): triangles in leaf order.
    """

    lower: Floats32
    upper: Floats32
    child: Ints32
    order: Ints32


def build_tree(
    corners: Floats, width: int, leaf_size: int, triangle_cost: float | None = None
) -> WideTree:
    """Build a tree over triangles or boxes.

    Parameters
    ----------
    corners
        float64 (k, c, 3): vertices of the triangles, or lower and upper corners of the boxes, in
        local coordinates.
    width
        Maximum number of children per node.
    leaf_size
        Maximum number of triangles per leaf, at most ``1 << LEAF_BITS``.
    triangle_cost
        Cost of each triangle in a leaf relative to the fixed cost of a leaf. The cost of a node is
        half the cost of a leaf. If None, leaves have no fixed cost, and each triangle costs as much
        as a node.
    """
    each = corners.transpose(1, 0, 2)  # reducing corner by corner is ten times as fast
    lower = np.ascontiguousarray((reduce(np.minimum, each) - PAD).T, dtype=np.float32)
    upper = np.ascontiguousarray((reduce(np.maximum, each) + PAD).T, dtype=np.float32)
    binary = ploc.build_binary_tree(lower, upper)
    count, leaf = _choose_leaves(binary, leaf_size, triangle_cost)
    first = _positions(binary, count)
    n = len(corners)
    order = np.empty(n, np.int32)
    order[first[:n]] = np.arange(n, dtype=np.int32)
    code = np.where(leaf, ~(first << LEAF_BITS | (count - 1)), 0).astype(np.int32)
    return _widen(binary, leaf, code, order, width)


def build_instance_tree(boxes: Floats, width: int) -> WideTree:
    """Build a tree over the boxes of instances, with one box per leaf.

    Leaves contain the index of an instance instead of a position in `order`.
    """
    tree = build_tree(boxes, width, 1)
    number = tree.order[np.maximum(~tree.child, 0) >> LEAF_BITS]
    child = np.where(tree.child < 0, ~(number << LEAF_BITS), tree.child)
    return WideTree(tree.lower, tree.upper, child, np.arange(len(boxes), dtype=np.int32))


def join_trees(trees: list[WideTree]) -> tuple[WideTree, Ints]:
    """Join several trees into one, and return it together with the root of each tree.

    Triangles are numbered consecutively over all trees. Empty slots, which have an inverted box,
    contain the root of their tree instead of 0.
    """
    roots = np.cumsum([0, *(len(tree.child) for tree in trees)])
    if len(trees) == 1:
        return trees[0], roots[:1]
    children = []
    orders = []
    first = 0
    for tree, root in zip(trees, roots[:-1], strict=True):
        leaves = tree.child - (first << LEAF_BITS)
        children.append(np.where(tree.child < 0, leaves, tree.child + root))
        orders.append(tree.order + first)
        first += len(tree.order)
    return WideTree(
        np.concatenate([tree.lower for tree in trees]),
        np.concatenate([tree.upper for tree in trees]),
        np.concatenate(children).astype(np.int32),
        np.concatenate(orders).astype(np.int32),
    ), roots[:-1]


def _choose_leaves(
    tree: ploc.BinaryTree, leaf_size: int, triangle_cost: float | None
) -> tuple[Ints32, Bools]:
    """Return the number of triangles below each node, and whether the node should become a leaf.

    The decision is based on the surface area heuristic with the costs that `build_tree` describes.
    """
    area = tree.area
    fixed, slope, opened = (0.0, 1.0, 1.0) if triangle_cost is None else (1.0, triangle_cost, 0.5)
    count = np.ones(len(area), np.int32)
    cost = area * np.float32(fixed + slope)
    leaf = np.ones(len(area), np.bool_)
    for start, stop in tree.rounds:
        first_child = tree.first_child[start:stop]
        second_child = tree.second_child[start:stop]
        count[start:stop] = count[first_child] + count[second_child]
        leaf_cost = area[start:stop] * (fixed + slope * count[start:stop]).astype(np.float32)
        split_cost = area[start:stop] * np.float32(opened) + cost[first_child] + cost[second_child]
        is_cheaper = (count[start:stop] <= leaf_size) & (leaf_cost <= split_cost)
        leaf[start:stop] = is_cheaper
        cost[start:stop] = np.where(is_cheaper, leaf_cost, split_cost)
    return count, leaf


def _positions(tree: ploc.BinaryTree, count: Ints32) -> Ints32:
    """For each node, return the position of its first triangle in leaf order."""
    first = np.zeros(len(count), np.int32)
    for start, stop in reversed(tree.rounds):
        first_child = tree.first_child[start:stop]
        second_child = tree.second_child[start:stop]
        first[first_child] = first[start:stop]
        first[second_child] = first[start:stop] + count[first_child]
    return first


def _widen(
    tree: ploc.BinaryTree,
    leaf: Bools,
    code: Ints32,
    order: Ints32,
    width: int,
) -> WideTree:
    """Combine binary nodes to nodes with up to `width` children, one level at a time.

    In each node, the child with the largest surface area is replaced by its own children until all
    slots are used.
    """
    area = np.where(leaf, -1, tree.area)
    lowers = []
    uppers = []
    children = []
    roots = np.array([len(leaf) - 1])
    total = 1
    while len(roots):
        slots = _wide_children(tree, area, roots, width)
        used = slots >= 0
        lowers.append(np.where(used, tree.lower[:, slots], np.inf).astype(np.float32))
        uppers.append(np.where(used, tree.upper[:, slots], -np.inf).astype(np.float32))
        inner = used & ~leaf[slots]
        child = np.where(used, code[slots], 0).astype(np.int32)
        roots = slots[inner]
        child[inner] = np.arange(total, total + len(roots), dtype=np.int32)
        total += len(roots)
        children.append(child)
    lower = np.concatenate(lowers, axis=1).transpose(1, 0, 2)
    upper = np.concatenate(uppers, axis=1).transpose(1, 0, 2)
    return WideTree(
        np.ascontiguousarray(lower), np.ascontiguousarray(upper), np.concatenate(children), order
    )


def _wide_children(tree: ploc.BinaryTree, area: Floats32, roots: Indices, width: int) -> Indices:
    """Choose up to `width` descendants of each binary node in `roots`.

    The result has shape (len(roots), width) and is padded with -1.
    """
    children = np.full((len(roots), width), -1)
    children[:, 0] = roots
    row = np.arange(len(roots))
    for free in range(1, width):
        size = np.where(children >= 0, area[children], -1)
        widest = np.argmax(size, axis=1)
        can_open = size[row, widest] > 0
        rows = row[can_open]
        opened_slots = widest[can_open]
        opened = children[rows, opened_slots]
        children[rows, opened_slots] = tree.first_child[opened]
        children[rows, free] = tree.second_child[opened]
    return children
