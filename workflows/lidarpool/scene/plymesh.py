"""Polygon meshes from .ply files: text and binary of either order, faces of any mixture.

trimesh reads .ply too, but no binary file with triangles and quadrangles in it, which is what
modelling programs write, and no strips; and it fills polygons that are not convex beyond their
outline. Point clouds have no faces, and are read by `ply`.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement, PlyListProperty

from .mesh import Mesh
from .meshfault import MeshFileError
from .plyrows import announced_rows, numbers_of, read_rows
from .polygons import triangulated

_LISTS = ("vertex_indices", "vertex_index")


def read_ply_mesh(data: bytes, name: str) -> list[Mesh]:
    """Read the mesh of a file.

    Parameters
    ----------
    data
        The whole file.
    name
        What it is called.

    Raises
    ------
    MeshFileError
        If there are no faces.
    ValueError, PlyParseError
        If it is no PLY file, holds other than announced, or has no vertices.
    """
    announced = announced_rows(data)
    if not announced.get("face") and not announced.get("tristrips"):
        raise MeshFileError("is a point cloud, it has no faces: make a mesh of it first")
    content = read_rows(data)
    vertices = _vertices(content)
    faces = []
    if "face" in content:
        faces.append(triangulated(vertices, *_corners(content["face"])))
    if "tristrips" in content:
        faces.append(_unrolled(*_corners(content["tristrips"])))
    found = np.concatenate(faces)
    return [Mesh(name, vertices, found)] if len(found) else []


def _vertices(content: PlyData) -> NDArray[np.float64]:
    """Positions (v, 3)."""
    there = _properties(content["vertex"], listed=False) if "vertex" in content else []
    if missing := set("xyz").difference(there):
        raise ValueError(f"its vertices have no {', '.join(sorted(missing))}")
    return np.stack([content["vertex"][axis] for axis in "xyz"], axis=1).astype(np.float64)


def _corners(element: PlyElement) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Numbers of vertices of all rows, and how many each row has."""
    there = _properties(element, listed=True)
    name = next((name for name in _LISTS if name in there), None)
    if name is None:
        raise ValueError(f"its faces have no {_LISTS[0]}")
    numbers, sizes = numbers_of(element, name)
    if not np.array_equal(numbers, np.trunc(numbers)):
        raise ValueError("faces name vertices by fractions")
    return numbers.astype(np.int64), sizes


def _properties(element: PlyElement, *, listed: bool) -> list[str]:
    """Names of the properties that are lists, or of those that are single numbers."""
    return [p.name for p in element.properties if isinstance(p, PlyListProperty) == listed]


def _unrolled(numbers: NDArray[np.int64], sizes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Triangles (t, 3) of strips, which end with each row and at each -1 in it."""
    strips = _strips(numbers, sizes)
    faces = []
    for strip in strips:
        rows = np.stack([strip[:-2], strip[1:-1], strip[2:]], axis=1)
        rows[1::2] = rows[1::2, [1, 0, 2]]  # every other one would face inward
        faces.append(rows)
    return np.concatenate(faces) if faces else np.empty((0, 3), dtype=np.int64)


def _strips(numbers: NDArray[np.int64], sizes: NDArray[np.int64]) -> Iterator[NDArray[np.int64]]:
    for row in np.split(numbers, np.cumsum(sizes)[:-1]):
        for strip in np.split(row, np.flatnonzero(row < 0)):
            if len(kept := strip[strip >= 0]) > 2:
                yield kept
