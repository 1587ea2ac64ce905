"""Scene graphs of mesh files: nodes that place meshes and other nodes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base.allowance import Allowance, bytes_of, memory_share
from .instances import Instance
from .mesh import Mesh, stacked
from .polygons import check_corners

SMALLER = "export it in parts, or as .ply"  # what helps if a file unpacks to too much
# A mesh becomes one of instances if that saves so many triangles; single triangles are cast faster.
SHARED_TRIANGLES = 100_000
MOST_NODES = 200_000  # most nodes of a scene, counting every instance


class MeshFileError(Exception):
    """An error of a mesh file, as a clause that follows its name."""


@dataclass
class Content:
    """Content of a mesh file.

    `meshes` are in the file's unit and axes.
    """

    meshes: Sequence[Mesh | Instance]
    unit_m: float | None = None  # metres in its unit; None if unknown
    up_axis: str | None = None  # 'x', 'y' or 'z'; None if neither it nor its format states one
    generator: str = ""  # the program that wrote it, if known
    skipped: list[str] = field(default_factory=list)  # names of objects that nodes scale to zero


@dataclass
class Node:
    """A node, which places meshes and other nodes."""

    name: str  # empty where the file has none
    matrix: NDArray[np.float64]  # (4, 4), from its coordinates to those of its parent
    meshes: Sequence[Mesh] = ()  # in its coordinates; the same objects wherever a mesh is used
    children: Iterable[Hashable] = ()  # keys of the nodes in it


class Place(NamedTuple):
    """A mesh in its own coordinates, and where a scene graph places it."""

    mesh: Mesh
    matrix: NDArray[np.float64]  # (4, 4), to the coordinates of the file
    name: str


def instances(roots: Iterable[Any], node_of: Callable[[Any], Node], stem: str) -> list[Place]:
    """Find all places of meshes in a scene graph; a node may be in several others.

    `roots` are keys of the outermost nodes, and `node_of` returns the node of a key. An instance is
    named by the nearest node with a name, else by its mesh, else it gets `stem`.

    Raises
    ------
    MeshFileError
        If nodes contain each other without end, or some hundred thousand times.
    """
    node_of = cache(node_of)
    placed, begun = [], 0
    stack = [(key, np.eye(4), "") for key in reversed(list(roots))]
    while stack:
        key, above, name = stack.pop()
        begun += 1
        node = node_of(key)
        matrix, name = above @ node.matrix, node.name or name
        placed += [Place(mesh, matrix, name or mesh.name or stem) for mesh in node.meshes]
        stack += [(child, matrix, name) for child in reversed(list(node.children))]
        # A few lines can make any number of nodes.
        if begun + len(stack) > MOST_NODES:
            raise MeshFileError(
                f"has nodes that contain each other, more than {MOST_NODES:,} in all: export it "
                "again"
            )
    return placed


def settled(placed: Sequence[Place]) -> Content:
    """Make instances of meshes that many places share, and copy the others to their places.

    Raises
    ------
    MeshFileError
        If a matrix is none of a place, or the copies would take more than a quarter of the memory.
    """
    objects: list[Mesh | Instance] = []
    content = Content(objects)
    uses = Counter(mesh for mesh, _, _ in placed)
    shared = {mesh for mesh, n in uses.items() if (n - 1) * len(mesh.faces) >= SHARED_TRIANGLES}
    own = [mesh.vertices.nbytes + mesh.faces.nbytes for mesh, _, _ in placed if mesh not in shared]
    if sum(own) > memory_share():
        raise MeshFileError(
            f"places {len(own):,} objects, which would take {bytes_of(sum(own))}, of at most "
            f"{bytes_of(memory_share())}, a quarter of the memory: {SMALLER}"
        )
    for mesh, matrix, name in placed:
        if not np.isfinite(matrix).all() or not np.array_equal(matrix[3], [0, 0, 0, 1]):
            raise MeshFileError(
                f"places {name[:80]!r} by a matrix that is none of a place: {matrix.tolist()}"
            )
        rank = np.linalg.matrix_rank(matrix[:3, :3])
        if rank < 2:
            content.skipped.append(name)
        elif mesh in shared and rank == 3:
            objects.append(Instance(mesh, matrix, name))
        else:
            objects.append(mesh.moved(name, matrix[:3, :3], matrix[:3, 3]))
    return content


def joined(
    name: str, parts: Iterable[tuple[NDArray[np.float64], NDArray[np.int64]]], allowance: Allowance
) -> list[Mesh]:
    """Join several (vertices, faces) to one mesh; none without faces.

    Raises
    ------
    ValueError
        If a face refers to a missing vertex; LidarpoolError if it takes more than allowed.
    """
    kept = [_own(vertices, faces, allowance) for vertices, faces in parts if len(faces)]
    return [Mesh(name, *stacked(kept))] if kept else []


def _own(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], allowance: Allowance
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices and faces, without unused vertices if many parts may share all of them."""
    check_corners(faces, len(vertices))
    allowance.take(faces.nbytes)
    if faces.size < len(vertices):
        used, faces = np.unique(faces, return_inverse=True)
        vertices, faces = vertices[used], faces.reshape(-1, 3)
    allowance.take(24 * len(vertices))  # in double precision
    return vertices, faces
