"""Meshes, instances and their trees as the tables that intersect.cu reads."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .arrays import AnyArray, Floats, Floats32, Ints, Ints32
from .instances import Scene
from .mesh import LocalMesh
from .opacity import Masks, join_masks
from .tree import WideTree, build_top, build_tree, join

_WIDTH = 4  # seven float4 a node: one 128-byte line
_LEAF_SIZE = 4
_UNIT = 2.0**-24  # half the distance from 1 to the next float32
_FLOOR = 1e-35  # products of tiny edges are off by less where float32 underflows to zero


@dataclass(frozen=True)
class Layout:
    """Tables of meshes; see the head of intersect.cu for what their columns hold.

    Attributes
    ----------
    nodes
        float32 (m, 32).
    triangles
        float32 (k, 12).
    corners
        float64 (k, 9).
    faces
        int32 (k,).
    roots
        int64 (meshes,): the node at which the tree of each mesh begins.
    stack
        Most nodes that can wait during a traversal of a mesh.
    masks
        Opacities of the triangles, in the same order; None if all are opaque.
    """

    nodes: Floats32
    triangles: Floats32
    corners: Floats
    faces: Ints32
    roots: Ints
    stack: int
    masks: Masks | None


@dataclass(frozen=True)
class Places:
    """Tables that say where the meshes are.

    Attributes
    ----------
    top
        float32 (m, 32): nodes over the instances.
    instances
        float64 (n, 20).
    frame
        float64 (10,), of the scene.
    stack
        Most nodes of `top` that can wait.
    """

    top: Floats32
    instances: Floats
    frame: Floats
    stack: int


def lay_out(meshes: tuple[LocalMesh, ...]) -> Layout:
    """Build the trees over meshes and flatten all."""
    trees = [build_tree(mesh.corners, _WIDTH, _LEAF_SIZE) for mesh in meshes]
    tree, roots = join(trees)
    corners = [mesh.corners[t.order] for mesh, t in zip(meshes, trees, strict=True)]
    faces = [mesh.index[t.order] for mesh, t in zip(meshes, trees, strict=True)]
    return Layout(
        _nodes(tree),
        _joined([_records(table) for table in corners]),
        _joined(corners).reshape(-1, 9),
        _joined(faces),
        roots,
        max(map(_stack_need, trees)),
        join_masks([mesh.opacity for mesh in meshes], [tree.order for tree in trees]),
    )


def lay_out_places(scene: Scene, roots: Ints) -> Places:
    """Build the tree over the instances; a plain scene has none, and tables that are not read."""
    if scene.matrices is None:
        return Places(np.zeros((1, 32), np.float32), np.zeros((1, 20)), scene.frame.table, 0)
    tree = build_top(scene.boxes, _WIDTH)
    instances = np.zeros((len(scene.mesh), 20))
    instances[:, :12] = scene.matrices
    frames = [mesh.frame for mesh in scene.meshes]
    boxes = np.array([[*frame.low, *frame.high] for frame in frames])
    instances[:, 12:18] = boxes[scene.mesh]
    instances[:, 18] = roots[scene.mesh]
    instances[:, 19] = scene.mesh
    # One more: the top's root waits like the others.
    return Places(_nodes(tree), instances, scene.frame.table, _stack_need(tree) + 1)


def _joined(tables: list[AnyArray]) -> AnyArray:
    return tables[0] if len(tables) == 1 else np.concatenate(tables)


def _nodes(tree: WideTree) -> Floats32:
    out = np.zeros((len(tree.child), 8, _WIDTH), np.float32)
    out[:, 0:3] = tree.low
    out[:, 3:6] = tree.high
    out[:, 6] = tree.child.view(np.float32)
    return out.reshape(-1, 32)


def _records(corners: Floats) -> Floats32:
    """First corner, two edges, and bounds of the test's rounding errors.

    With u = 2**-24, coordinates within [-1, 1], unit directions d, edges e and g, and
    t = origin - corner, each of which is rounded to float32 first:

    - ``det = e . (d x g)`` is off by at most 10 u |e| |g|;
    - ``b = t . (d x g)`` by 40 u |g|: |t| reaches 3.5 and is off by 7 u, the cross product is
      off by 6 u |g|, the dot product rounds by another 3 u |t| |g|;
    - ``c = d . (t x e)`` by 45 u |e|, in the same way;
    - ``g . (t x e)`` by 40 u |e| |g|.

    A comparison with `det` adds its error twice (its sign may be wrong as well), times the
    distance, at most 4, for the last one. The numbers below are these with some margin.
    """
    first = corners[:, 0]
    edge = corners[:, 1] - first
    other = corners[:, 2] - first
    e, g = (np.sqrt((side * side).sum(axis=1)) for side in (edge, other))
    out = np.empty((len(corners), 3, 4), np.float32)
    out[:, 0, :3] = first
    out[:, 1, :3] = edge
    out[:, 2, :3] = other
    out[:, 0, 3] = _UNIT * g * (48 + 24 * e) + _FLOOR
    out[:, 1, 3] = _UNIT * e * (56 + 24 * g) + _FLOOR
    out[:, 2, 3] = _UNIT * e * g * 144 + _FLOOR
    return out.reshape(-1, 12)


def _stack_need(tree: WideTree) -> int:
    """Most nodes that wait on any descent: all children but one of each node above."""
    used = (tree.low[:, 0] <= tree.high[:, 0]).sum(axis=1)
    waiting = np.zeros(len(tree.child), np.int64)  # in the order of processing
    level = np.array([0])
    most = 0
    while len(level):
        waiting[level] += np.maximum(used[level] - 1, 0)
        most = max(most, int(waiting[level].max()))
        child = tree.child[level]
        inner = child > 0
        below = child[inner]
        waiting[below] = np.broadcast_to(waiting[level][:, None], child.shape)[inner]
        level = below
    return most
