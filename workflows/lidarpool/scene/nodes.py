"""Scene graphs of mesh files: nodes that place meshes and other nodes."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass, field
from functools import cache
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..base.allowance import Allowance, bytes_of, memory_share
from .mesh import Mesh

K = TypeVar("K", bound=Hashable)

SMALLER = "export it in parts, or as .ply"  # what helps if a file unpacks to too much
MOST_NODES = 200_000  # most nodes of a scene, counting every instance


class MeshFileError(Exception):
    """An error of a mesh file, as a clause that follows its name."""


@dataclass
class Content:
    """Content of a mesh file.

    `meshes` are in the file's unit and axes.
    """

    meshes: list[Mesh]
    unit_m: float | None = None  # metres in its unit; None if unknown
    up_axis: str | None = None  # 'x', 'y' or 'z'; None if neither it nor its format states one
    generator: str = ""  # the program that wrote it, if known
    skipped: list[str] = field(default_factory=list)  # names of objects that nodes scale to zero


@dataclass
class Node(Generic[K]):
    """A node, which places meshes and other nodes."""

    name: str  # empty where the file has none
    matrix: NDArray[np.float64]  # (4, 4), from its coordinates to those of its parent
    # Makes the node's meshes, in its coordinates; called for each instance.
    meshes: Callable[[], Iterable[Mesh]] = list
    children: Iterable[K] = ()  # keys of the nodes in it


def instances(roots: Iterable[K], node_of: Callable[[K], Node[K]], stem: str) -> Content:
    """Place all meshes of a scene graph.

    A node may be in several others; each instance is an object, named by the nearest node with a
    name.

    Parameters
    ----------
    roots
        Keys of the outermost nodes.
    node_of
        Returns the node of a key.
    stem
        Name for meshes that have none.

    Raises
    ------
    MeshFileError
        If nodes contain each other without end, or some hundred thousand times, or the placed
        objects would take more than a quarter of the memory.
    """
    content = Content([])
    node_of = cache(node_of)
    places = []
    stack = [(key, np.eye(4), "") for key in reversed(list(roots))]
    while stack:
        key, above, name = stack.pop()
        node = node_of(key)
        matrix, name = above @ node.matrix, node.name or name
        places.append((node, matrix, name))
        stack += [(child, matrix, name) for child in reversed(list(node.children))]
        # A few lines can make any number of nodes.
        if len(places) + len(stack) > MOST_NODES:
            raise MeshFileError(
                f"has nodes that contain each other, more than {MOST_NODES:,} in all: export it "
                "again"
            )
    placed = [(mesh, matrix, name) for node, matrix, name in places for mesh in node.meshes()]
    total = sum(mesh.vertices.nbytes + mesh.faces.nbytes for mesh, _, _ in placed)
    if total > memory_share():
        raise MeshFileError(
            f"places {len(placed):,} objects, which would take {bytes_of(total)}, of at most "
            f"{bytes_of(memory_share())}, a quarter of the memory: {SMALLER}"
        )
    for mesh, matrix, name in placed:
        named = name or mesh.name or stem
        if not np.isfinite(matrix).all() or not np.array_equal(matrix[3], [0, 0, 0, 1]):
            raise MeshFileError(
                f"places {named[:80]!r} by a matrix that is none of a place: {matrix.tolist()}"
            )
        if np.linalg.matrix_rank(matrix[:3, :3]) < 2:
            content.skipped.append(named)
        else:
            content.meshes.append(mesh.moved(named, matrix[:3, :3], matrix[:3, 3]))
    return content


def joined(
    name: str,
    parts: Iterable[tuple[NDArray[np.float64], NDArray[np.int64]]],
    allowance: Allowance,
) -> list[Mesh]:
    """Join several (vertices, faces) to one mesh; none without faces.

    Raises
    ------
    ValueError
        If a face refers to a missing vertex; LidarpoolError if it takes more than allowed.
    """
    kept = [_own(vertices, faces, allowance) for vertices, faces in parts if len(faces)]
    if not kept:
        return []
    first = np.cumsum([0] + [len(vertices) for vertices, _ in kept[:-1]])
    vertices = np.concatenate([vertices for vertices, _ in kept])
    faces = [faces + at for (_, faces), at in zip(kept, first, strict=True)]
    return [Mesh(name, vertices, np.concatenate(faces))]


def _own(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], allowance: Allowance
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices and faces, without unused vertices if many parts may share all of them."""
    if not 0 <= faces.min() <= faces.max() < len(vertices):
        raise ValueError(
            f"faces refer to vertices {faces.min()} to {faces.max()}, counted from 0, of "
            f"{len(vertices)}"
        )
    allowance.take(faces.nbytes)
    if faces.size < len(vertices):
        used, faces = np.unique(faces, return_inverse=True)
        vertices, faces = vertices[used], faces.reshape(-1, 3)
    allowance.take(24 * len(vertices))  # in double precision
    return vertices, faces


def unrolled(strip: NDArray[np.int64]) -> NDArray[np.int64]:
    """Triangles (t, 3) of a strip of corners (t + 2,), all facing the same way."""
    faces = np.stack([strip[:-2], strip[1:-1], strip[2:]], axis=1)
    faces[1::2] = faces[1::2, [1, 0, 2]]
    return faces


def fanned(corners: NDArray[np.int64]) -> NDArray[np.int64]:
    """Triangles (t, 3) of a fan of corners (t + 2,)."""
    first = np.broadcast_to(corners[:1], len(corners[2:]))
    return np.stack([first, corners[1:-1], corners[2:]], axis=1)
