"""Trees that are traversed by tiles of rays.

Nodes have eight children, and leaves contain up to eight triangles.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .arrays import Floats, Floats32, Ints32
from .compiled import compiled
from .cuda_tables import max_stack_depth
from .tree import LEAF_BITS, WideTree, build_instance_tree, build_tree

WIDTH = 8
# Numbers per node: lower x, y, z, upper x, y, z and code of each of the eight children, and
# padding.
NODE = 64
# Numbers per leaf: x, y, z of the first vertex and of two edges of eight triangles each, the
# position of the first triangle, and padding.
BLOCK = 80
_LEAF_SIZE = 8
# Cost of each triangle in a leaf relative to the cost of a leaf. It is low because eight triangles
# are tested at once.
_TRIANGLE_COST = 0.05
# Corner of the inverted box of an empty slot, which no ray intersects. It is finite, because zero
# times infinity would be NaN.
_EMPTY = np.float32(1e37)


@dataclass(frozen=True)
class TileTree:
    """The tree of a single mesh.

    Attributes
    ----------
    nodes
        float32 (m, `NODE`): the nodes, starting with the root. The code of a child is the index of
        a node, 0 for an empty slot, or the bitwise complement of ``leaf << LEAF_BITS | count - 1``.
    blocks
        float32 (leaves, `BLOCK`): the triangles of the leaves. The two edges lead from the first
        vertex to the second and third. The last triangle of a leaf is repeated up to eight
        triangles.
    corners
        float64 (k, 9): vertices of the triangles in leaf order.
    order
        int32 (k,): row of each of these triangles in the corners of the mesh.
    stack
        Maximum number of pending nodes during a traversal.
    """

    nodes: Floats32
    blocks: Floats32
    corners: Floats
    order: Ints32
    stack: int


def build_tile_tree(corners: Floats) -> TileTree:
    """Build a tree over triangles, given in local coordinates."""
    tree = build_tree(corners, WIDTH, _LEAF_SIZE, _TRIANGLE_COST)
    is_leaf = tree.child < 0
    codes = ~tree.child[is_leaf]
    first = (codes >> LEAF_BITS).astype(np.int32)
    count = (codes & ((1 << LEAF_BITS) - 1)) + 1
    child = tree.child.copy()
    leaf = np.arange(len(codes), dtype=np.int32)
    child[is_leaf] = ~(leaf << LEAF_BITS | (count - 1)).astype(np.int32)
    ordered = np.ascontiguousarray(corners[tree.order]).reshape(-1, 9)
    blocks = _aligned(len(codes), BLOCK)
    _fill_blocks(ordered, first, count.astype(np.int32), blocks)
    blocks[:, 72].view(np.int32)[:] = first
    return TileTree(_nodes(tree, child), blocks, ordered, tree.order, _stack(tree))


def build_instance_nodes(boxes: Floats) -> tuple[Floats32, int]:
    """Build the nodes of a tree over boxes, each leaf of which contains the index of one box.

    The boxes have shape (n, 2, 3). Also return the maximum number of pending nodes.
    """
    tree = build_instance_tree(boxes, WIDTH)
    return _nodes(tree, tree.child), _stack(tree)


def _stack(tree: WideTree) -> int:
    """Return the maximum number of pending nodes, including the current node's children."""
    return max_stack_depth(tree) + 2 * WIDTH


def _nodes(tree: WideTree, child: Ints32) -> Floats32:
    nodes = _aligned(len(child), NODE)
    used = tree.lower[:, :1] <= tree.upper[:, :1]
    count = len(child)
    nodes[:, :24] = np.where(used, tree.lower, _EMPTY).reshape(count, -1)
    nodes[:, 24:48] = np.where(used, tree.upper, -_EMPTY).reshape(count, -1)
    nodes[:, 48:56].view(np.int32)[:] = child
    return nodes


def _aligned(row_count: int, columns: int) -> Floats32:
    """Allocate a float32 array of zeros that starts at a multiple of 64 bytes (a cache line)."""
    memory = np.zeros(row_count * columns + 16, np.float32)
    start = -memory.ctypes.data % 64 // 4
    return memory[start : start + row_count * columns].reshape(row_count, columns)


@compiled()
def _fill_blocks(corners, first, count, blocks):  # type: ignore[no-untyped-def]
    """Write the triangles in all leaves.

    Edges are computed in float64 and then rounded, so that short edges are accurate.
    """
    for leaf in range(len(first)):
        for lane in range(8):
            row = first[leaf] + min(lane, count[leaf] - 1)
            for axis in range(3):
                start = corners[row, axis]
                blocks[leaf, 8 * axis + lane] = start
                blocks[leaf, 24 + 8 * axis + lane] = corners[row, 3 + axis] - start
                blocks[leaf, 48 + 8 * axis + lane] = corners[row, 6 + axis] - start
