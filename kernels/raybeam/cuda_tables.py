"""Tables of meshes, instances, and trees for the kernels in intersect.cu."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .arrays import AnyArray, Floats, Floats32, Ints, Ints32
from .instances import LocalScene
from .mesh import LocalMesh
from .opacity import MaskTables, join_masks
from .tree import WideTree, build_instance_tree, build_tree, join_trees

_WIDTH = 4  # children per node, so that a node fills one cache line of 128 bytes
_LEAF_SIZE = 4
_UNIT = 2.0**-24  # unit roundoff of float32
_FLOOR = 1e-35  # more than the error of products of tiny edges that underflow in float32


@dataclass(frozen=True)
class MeshTables:
    """Tables of all meshes of a scene.

    The comment at the top of intersect.cu describes the columns.

    Attributes
    ----------
    nodes
        float32 (m, 32): nodes of the trees.
    triangles
        float32 (k, 12): first vertex, edges and error bounds of each triangle.
    corners
        float64 (k, 9): local coordinates of the vertices of each triangle.
    faces
        int32 (k,): index of each triangle in the `faces` of its mesh.
    roots
        int64 (meshes,): root of the tree of each mesh.
    stack
        Maximum number of pending nodes during the traversal of a mesh.
    masks
        Opacities of the triangles in the same order. None if all triangles are opaque.
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
    """Tables of all instances of a scene.

    Attributes
    ----------
    top
        float32 (m, 32): nodes of the tree over the instances.
    instances
        float64 (n, 20): matrix, bounding box, root and mesh of each instance.
    frame
        float64 (10,): `LocalFrame.table` of the scene.
    stack
        Maximum number of pending nodes during the traversal of `top`.
    """

    top: Floats32
    instances: Floats
    frame: Floats
    stack: int


def build_mesh_tables(meshes: tuple[LocalMesh, ...]) -> MeshTables:
    """Build a tree for each mesh, and return the tables of all meshes."""
    trees = [build_tree(mesh.corners, _WIDTH, _LEAF_SIZE) for mesh in meshes]
    tree, roots = join_trees(trees)
    corners = [mesh.corners[t.order] for mesh, t in zip(meshes, trees, strict=True)]
    faces = [mesh.index[t.order] for mesh, t in zip(meshes, trees, strict=True)]
    return MeshTables(
        nodes=_node_rows(tree),
        triangles=_concatenate([_triangle_rows(table) for table in corners]),
        corners=_concatenate(corners).reshape(-1, 9),
        faces=_concatenate(faces),
        roots=roots,
        stack=max(map(max_stack_depth, trees)),
        masks=join_masks([mesh.opacity for mesh in meshes], [tree.order for tree in trees]),
    )


def build_instance_tables(scene: LocalScene, roots: Ints) -> InstanceTables:
    """Build the tree over the instances, or return placeholders for a single mesh.

    `roots` contains the root of each mesh's tree.
    """
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
    # The root of the instance tree also takes an entry of the stack.
    return InstanceTables(_node_rows(tree), instances, scene.frame.table, max_stack_depth(tree) + 1)


def _concatenate(tables: list[AnyArray]) -> AnyArray:
    return tables[0] if len(tables) == 1 else np.concatenate(tables)


def _node_rows(tree: WideTree) -> Floats32:
    """Return each tree node as a row of 32 numbers: boxes, children, and padding."""
    table = np.zeros((len(tree.child), 8, _WIDTH), np.float32)
    table[:, 0:3] = tree.lower
    table[:, 3:6] = tree.upper
    table[:, 6] = tree.child.view(np.float32)
    return table.reshape(-1, 32)


def _triangle_rows(corners: Floats) -> Floats32:
    """Return each triangle's first vertex, two edges, and bounds of the rounding errors.

    The bounds are those of the float32 test in intersect.cu. In the following, u = 2**-24,
    coordinates are within [-1, 1], d is a unit direction, e and g are the edges, t = origin -
    vertex, and each value is first rounded to float32.

    - The error of ``det = e . (d x g)`` is at most 10 u |e| |g|.
    - The error of ``b = t . (d x g)`` is at most 40 u |g|. |t| is at most 3.5 with an error of 7 u,
      the cross product has an error of 6 u |g|, and the dot product adds rounding errors of 3 u |t|
      |g|.
    - The error of ``c = d . (t x e)`` is at most 45 u |e|, for the same reasons.
    - The error of ``g . (t x e)`` is at most 40 u |e| |g|.

    A comparison with `det` adds its error twice, because its sign may also be wrong. For the last
    value, this error is multiplied by the distance, which is at most 4. The constants below include
    a margin.
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
    """Return the maximum number of pending nodes during a traversal.

    On each level of the tree, the siblings of the current node are pending.
    """
    used = (tree.lower[:, 0] <= tree.upper[:, 0]).sum(axis=1)
    waiting = np.zeros(len(tree.child), np.int64)  # pending nodes when each node is visited
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
