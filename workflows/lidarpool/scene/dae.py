"""COLLADA (.dae) files: object names, unit, up axis and all digits of the coordinates.

trimesh reads .dae too, through the same pycollada, but names objects by their geometry instead
of their node, drops the up axis, and keeps the single precision in which pycollada parses
numbers, which moves georeferenced vertices by centimetres. Here the numbers are taken from the
XML again, in double precision.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import IO, Any

import collada  # type: ignore[import-untyped]
import numpy as np
from numpy.typing import NDArray

from .mesh import Mesh
from .polygons import triangulated
from .transform import Transform

# What may be missing without changing the shape: textures, materials, lights, cameras.
_HARMLESS = ("image", "surface", "material", "effect", "shading", "profile", "light", "camera")

MOST_NODES = 100_000  # of a scene, each counted in each place where it stands


def read_dae(file: IO[bytes]) -> tuple[list[Mesh], float | None, str | None]:
    """Read the default scene of a COLLADA file.

    Returns
    -------
    meshes
        One for each node that has geometry, named by the node, in the file's unit and axes.
    unit_m
        Metres in the file's unit; None where it states none.
    up_axis
        'x', 'y' or 'z'; None where the file states none.

    Raises
    ------
    Exception
        What pycollada raises on a broken file; ValueError for missing or unknown geometry.
    """
    document = collada.Collada(
        file,
        ignore=[collada.common.DaeUnsupportedError, collada.common.DaeBrokenRefError],
        aux_file_loader=lambda name: None,  # no picture is read, wherever it is
    )
    for error in document.errors:
        text = str(error)
        if not any(word in text.lower() for word in _HARMLESS):
            raise ValueError(text)
    meshes: list[Mesh] = []
    if document.scene is not None:
        meshes += _meshes(document.scene)
    axis = document.assetInfo.upaxis
    return meshes, _unit_m(document), axis[0].lower() if axis else None


def _unit_m(document: Any) -> float | None:
    """Metres in the file's unit; ValueError for one that pycollada would pass over in silence."""
    unit = document.xmlnode.find("{*}asset/{*}unit")
    stated = None if unit is None else unit.get("meter")
    if stated is None:
        return None
    try:
        metres = float(stated)
    except ValueError:
        metres = 0.0
    if not 0 < metres < np.inf:
        raise ValueError(f"its unit is {stated!r} metres")
    return metres


def _meshes(scene: Any) -> Iterator[Mesh]:
    """Meshes of a scene, one for each place where there is a geometry."""
    # A node of a library may stand in several others: a few lines can make any number of nodes.
    visits = (visit for node in scene.nodes for visit in _walk(node, np.eye(4), ""))
    for count, (node, matrix, name) in enumerate(visits):
        if count >= MOST_NODES:
            raise ValueError(f"its nodes contain each other more than {MOST_NODES:,} times")
        if isinstance(node, collada.scene.GeometryNode):
            yield from _geometry(node.geometry, Transform.from_matrix(matrix), name)


def _walk(
    node: Any, above: NDArray[np.float64], name: str
) -> Iterator[tuple[Any, NDArray[np.float64], str]]:
    """Yield a node and those under it, each with the matrix (4, 4) of its place and its name.

    `above` is the matrix of the parent, `name` that of the nearest node that has one.
    """
    if isinstance(node, collada.scene.NodeNode):  # <instance_node>: one of another place
        node = node.node
    if not isinstance(node, collada.scene.Node):
        yield node, above, name
        return
    matrix = above
    for step in node.transforms:
        matrix = matrix @ _matrix(step)
    yield node, matrix, node.name or name
    for child in node.children:
        yield from _walk(child, matrix, node.name or name)


def _geometry(geometry: Any, transform: Transform, name: str) -> Iterator[Mesh]:
    """One mesh of all primitives, which differ by material only."""
    vertices: list[NDArray[np.float64]] = []
    faces: list[NDArray[np.int64]] = []
    count = 0
    for primitive in geometry.primitives:
        points = _numbers(primitive.sources["VERTEX"][0][4].xmlnode.find("{*}float_array"))
        index = _triangles(primitive, points.reshape(-1, 3))
        if index is None:
            continue
        vertices.append(points.reshape(-1, 3))
        faces.append(index + count)
        count += len(vertices[-1])
    if faces:
        rows = np.concatenate(faces)
        yield Mesh(
            name or geometry.name or geometry.id or "geometry",
            transform.apply(np.concatenate(vertices)),
            rows[:, ::-1] if transform.mirrors else rows,
        )


def _triangles(primitive: Any, points: NDArray[np.float64]) -> NDArray[np.int64] | None:
    """Triangles (t, 3) of a primitive; None of lines and points, which reflect no light."""
    index = getattr(primitive, "vertex_index", None)
    if index is not None and isinstance(primitive, collada.polylist.Polylist):
        # pycollada's own triangles of polygons that are not convex reach beyond their outline.
        sizes = np.asarray(primitive.vcounts, dtype=np.int64)
        return triangulated(points, np.asarray(index, dtype=np.int64), sizes)
    if index is None or index.ndim != 2 or index.shape[1] != 3:
        return None
    return np.asarray(index, dtype=np.int64)


def _matrix(step: Any) -> NDArray[np.float64]:
    """Matrix (4, 4) of one <translate>, <scale>, <rotate>, <matrix> or <lookat>."""
    out = np.eye(4)
    if isinstance(step, collada.scene.TranslateTransform):
        out[:3, 3] = _numbers(step.xmlnode)
    elif isinstance(step, collada.scene.MatrixTransform):
        out = _numbers(step.xmlnode).reshape(4, 4)
    elif isinstance(step, collada.scene.ScaleTransform):
        out[:3, :3] = np.diag(_numbers(step.xmlnode))
    elif isinstance(step, collada.scene.RotateTransform):
        x, y, z, degrees = _numbers(step.xmlnode)
        axis = np.array([x, y, z]) / np.linalg.norm([x, y, z])
        cross = np.cross(np.eye(3), axis)
        angle = np.radians(degrees)
        # Rodrigues (1840)
        out[:3, :3] += np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    else:
        out = np.asarray(step.matrix, dtype=np.float64)
    return out


def _numbers(node: Any) -> NDArray[np.float64]:
    """Text of an XML element as double precision numbers."""
    return np.array((node.text or "").split(), dtype=np.float64)
