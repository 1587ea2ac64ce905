"""The tree that tiles of rays descend: nodes of eight children, leaves of up to eight triangles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .arrays import Floats, Floats32, Ints32
from .compiled import compiled
from .cuda_tables import max_stack_depth
from .tree import LEAF_BITS, WideTree, build_instance_tree, build_tree

WIDTH = 8
NODE = 64  # numbers of a node: lower x, y, z, upper x, y, z and the child, of eight children each
BLOCK = (
    80  # numbers of a leaf: corner, two edges, x, y, z of eight triangles; position of the first
)
_LEAF_SIZE = 8
# Cost of a further triangle in a leaf, as a share of the cost of a node: eight are tested at once.
_TRIANGLE_COST = 0.05
# Corner of the box of an empty slot, which no ray meets. Not infinite: zero times it is zero.
_NOWHERE = np.float32(1e37)


@dataclass(frozen=True)
class TileTree:
    """A tree of a mesh.

    Attributes
    ----------
    nodes
        float32 (m, `NODE`): the root first. A child is the number of a node, 0 in an empty slot; or
        the bitwise complement of ``leaf << LEAF_BITS | count - 1``.
    blocks
        float32 (leaves, `BLOCK`): edges lead from the first corner to the second and to the third.
        Lanes after the last triangle repeat it.
    corners
        float64 (k, 9): corners of the triangles in the order of the leaves.
    order
        int32 (k,): row of each of these triangles in the corners of the mesh.
    stack
        Maximum nodes that wait during a traversal.
    """

    nodes: Floats32
    blocks: Floats32
    corners: Floats
    order: Ints32
    stack: int


def build_tile_tree(corners: Floats) -> TileTree:
    """Build the tree of triangles (k, 3, 3), local."""
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
    """Return the nodes of a tree over boxes (n, 2, 3), and the maximum of nodes that wait.

    Its leaves have the number of a box.
    """
    tree = build_instance_tree(boxes, WIDTH)
    return _nodes(tree, tree.child), _stack(tree)


def _stack(tree: WideTree) -> int:
    """Return the maximum of nodes that wait during a traversal, with a node's children."""
    return max_stack_depth(tree) + 2 * WIDTH


def _nodes(tree: WideTree, child: Ints32) -> Floats32:
    nodes = _aligned(len(child), NODE)
    used = tree.lower[:, :1] <= tree.upper[:, :1]
    count = len(child)
    nodes[:, :24] = np.where(used, tree.lower, _NOWHERE).reshape(count, -1)
    nodes[:, 24:48] = np.where(used, tree.upper, -_NOWHERE).reshape(count, -1)
    nodes[:, 48:56].view(np.int32)[:] = child
    return nodes


def _aligned(row_count: int, columns: int) -> Floats32:
    """Return float32 zeros (rows, columns) that start at a line of the cache."""
    memory = np.zeros(row_count * columns + 16, np.float32)
    start = -memory.ctypes.data % 64 // 4
    return memory[start : start + row_count * columns].reshape(row_count, columns)


@compiled()
def _fill_blocks(corners, first, count, blocks):  # type: ignore[no-untyped-def]
    """Write the triangles of leaves: edges are rounded from float64, so tiny ones stay exact."""
    for leaf in range(len(first)):
        for lane in range(8):
            row = first[leaf] + min(lane, count[leaf] - 1)
            for axis in range(3):
                start = corners[row, axis]
                blocks[leaf, 8 * axis + lane] = start
                blocks[leaf, 24 + 8 * axis + lane] = corners[row, 3 + axis] - start
                blocks[leaf, 48 + 8 * axis + lane] = corners[row, 6 + axis] - start
