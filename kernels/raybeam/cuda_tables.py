"""Meshes, instances and their trees as the tables that intersect.cu reads."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .arrays import AnyArray, Floats, Floats32, Ints, Ints32
from .instances import LocalScene
from .mesh import LocalMesh
from .opacity import MaskTables, join_masks
from .tree import WideTree, build_instance_tree, build_tree, join_trees

_WIDTH = 4  # seven float4 a node: one 128-byte line
_LEAF_SIZE = 4
_UNIT = 2.0**-24  # half the distance from 1 to the next float32
_FLOOR = 1e-35  # products of tiny edges are off by less where float32 underflows to zero


@dataclass(frozen=True)
class MeshTables:
    """Tables of meshes, with the columns that the head of intersect.cu describes.

    Attributes
    ----------
    nodes
        float32 (m, 32): nodes of the trees.
    triangles
        float32 (k, 12): corner, edges and error bounds of each triangle.
    corners
        float64 (k, 9): local corners of each triangle.
    faces
        int32 (k,): row of each triangle in the `faces` of its mesh.
    roots
        int64 (meshes,): root of the tree of each mesh.
    stack
        Maximum nodes that wait during a traversal of a mesh.
    masks
        Opacities of the triangles, in the same order; None if all are opaque.
    """

    nodes: Floats32
    triangles: Floats32
    corners: Floats
    faces: Ints32
    roots: Ints
    stack: int
    masks: MaskTables | None


@dataclass(frozen=True)
class InstanceTables:
    """Tables of the instances of meshes.

    Attributes
    ----------
    top
        float32 (m, 32): nodes over the instances.
    instances
        float64 (n, 20): matrix, box, root and mesh of each instance.
    frame
        float64 (10,): `LocalFrame.table` of the scene.
    stack
        Maximum nodes of `top` that wait.
    """

    top: Floats32
    instances: Floats
    frame: Floats
    stack: int


def build_mesh_tables(meshes: tuple[LocalMesh, ...]) -> MeshTables:
    """Build the trees over meshes, and return all tables of the meshes."""
    trees = [build_tree(mesh.corners, _WIDTH, _LEAF_SIZE) for mesh in meshes]
    tree, roots = join_trees(trees)
    corners = [mesh.corners[t.order] for mesh, t in zip(meshes, trees, strict=True)]
    faces = [mesh.index[t.order] for mesh, t in zip(meshes, trees, strict=True)]
    return MeshTables(
        nodes=_nodes(tree),
        triangles=_joined([_records(table) for table in corners]),
        corners=_joined(corners).reshape(-1, 9),
        faces=_joined(faces),
        roots=roots,
        stack=max(map(max_stack_depth, trees)),
        masks=join_masks([mesh.opacity for mesh in meshes], [tree.order for tree in trees]),
    )


def build_instance_tables(scene: LocalScene, roots: Ints) -> InstanceTables:
    """Build the tree over the instances, and return the tables, or dummies for a plain scene."""
    if scene.matrices is None:
        return InstanceTables(
            np.zeros((1, 32), np.float32), np.zeros((1, 20)), scene.frame.table, 0
        )
    tree = build_instance_tree(scene.boxes, _WIDTH)
    instances = np.zeros((len(scene.mesh), 20))
    instances[:, :12] = scene.matrices
    frames = [mesh.frame for mesh in scene.meshes]
    boxes = np.array([[*frame.lower, *frame.upper] for frame in frames])
    instances[:, 12:18] = boxes[scene.mesh]
    instances[:, 18] = roots[scene.mesh]
    instances[:, 19] = scene.mesh
    # One more for the root of the top.
    return InstanceTables(_nodes(tree), instances, scene.frame.table, max_stack_depth(tree) + 1)


def _joined(tables: list[AnyArray]) -> AnyArray:
    """Return the concatenation of tables, without a copy of a single table."""
    return tables[0] if len(tables) == 1 else np.concatenate(tables)


def _nodes(tree: WideTree) -> Floats32:
    """Return the nodes of a tree as rows of 32 numbers: boxes, children, and padding."""
    table = np.zeros((len(tree.child), 8, _WIDTH), np.float32)
    table[:, 0:3] = tree.lower
    table[:, 3:6] = tree.upper
    table[:, 6] = tree.child.view(np.float32)
    return table.reshape(-1, 32)


def _records(corners: Floats) -> Floats32:
    """Return first corner, two edges, and bounds of the test's rounding errors, by triangle.

    With u = 2**-24, coordinates within [-1, 1], unit directions d, edges e and g, and
    t = origin - corner, with each value rounded to float32 first:

    - ``det = e . (d x g)`` is off by at most 10 u |e| |g|;
    - ``b = t . (d x g)`` by 40 u |g|: |t| reaches 3.5 and is off by 7 u, the cross product is
      off by 6 u |g|, the dot product rounds by another 3 u |t| |g|;
    - ``c = d . (t x e)`` by 45 u |e|, in the same way;
    - ``g . (t x e)`` by 40 u |e| |g|.

    A comparison with `det` adds its error twice (its sign may be wrong as well), times the
    distance, at most 4, for the last one. The numbers below are these with a margin.
    """
    first = corners[:, 0]
    first_edge = corners[:, 1] - first
    second_edge = corners[:, 2] - first
    e, g = (np.sqrt((side * side).sum(axis=1)) for side in (first_edge, second_edge))
    table = np.empty((len(corners), 3, 4), np.float32)
    table[:, 0, :3] = first
    table[:, 1, :3] = first_edge
    table[:, 2, :3] = second_edge
    table[:, 0, 3] = _UNIT * g * (48 + 24 * e) + _FLOOR
    table[:, 1, 3] = _UNIT * e * (56 + 24 * g) + _FLOOR
    table[:, 2, 3] = _UNIT * e * g * 144 + _FLOOR
    return table.reshape(-1, 12)


def max_stack_depth(tree: WideTree) -> int:
    """Return the maximum of waiting nodes on a descent: siblings at each level above."""
    used = (tree.lower[:, 0] <= tree.upper[:, 0]).sum(axis=1)
    waiting = np.zeros(len(tree.child), np.int64)  # one number for each node
    level = np.array([0])
    max_waiting = 0
    while len(level):
        waiting[level] += np.maximum(used[level] - 1, 0)
        max_waiting = max(max_waiting, int(waiting[level].max()))
        child = tree.child[level]
        inner = child > 0
        below = child[inner]
        waiting[below] = np.broadcast_to(waiting[level][:, None], child.shape)[inner]
        level = below
    return max_waiting
