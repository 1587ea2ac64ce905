"""Polygon meshes from .ply files: text and binary of either order, faces of any mixture.

trimesh reads .ply too, but no binary file with triangles and quadrangles in it, which is what
modelling programs write, and no strips; and it fills polygons that are not convex beyond their
outline. Point clouds have no faces, and are read by `ply`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from .mesh import Mesh
from .meshfault import MeshFileError
from .plyrows import Element, Rows, binary_rows, text_rows
from .polygons import triangulated

_HEADER_LIMIT = 1 << 20  # bytes
_LISTS = ("vertex_indices", "vertex_index")
_FORMATS = {b"ascii": "", b"binary_little_endian": "<", b"binary_big_endian": ">"}


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
    ValueError
        If it is no PLY file, holds other than announced, or has no vertices.
    """
    order, elements, body = _header(data)
    if not any(element.count for element in elements if element.name in ("face", "tristrips")):
        raise MeshFileError("is a point cloud, it has no faces: make a mesh of it first")
    rows = {}  # {name of the element: its rows}
    read = binary_rows(body, elements, order) if order else text_rows(body, elements)
    for element, content in zip(elements, read, strict=True):
        rows[element.name] = content
    vertices = _vertices(rows)
    faces = [
        triangulated(vertices, *_list_of(rows["face"])) if "face" in rows else None,
        _unrolled(*_list_of(rows["tristrips"])) if "tristrips" in rows else None,
    ]
    found = np.concatenate([part for part in faces if part is not None])
    return [Mesh(name, vertices, found)] if len(found) else []


def _header(data: bytes) -> tuple[str, list[Element], bytes]:
    """Byte order (empty for text), elements, and what follows the header."""
    head = data[:_HEADER_LIMIT]
    found = re.match(rb"ply[ \t]*\r?\n(.*?\n)??end_header[ \t]*\r?\n", head, re.DOTALL)
    found = found or re.match(rb"ply\r(.*?\r)??end_header\r", head, re.DOTALL)
    if not found:
        raise ValueError("no PLY header, or cut within it")
    order: str | None = None
    elements: list[Element] = []
    for line in (found[1] or b"").splitlines():
        words = line.split()
        if words[:1] == [b"format"] and len(words) > 1 and words[1] in _FORMATS:
            order = _FORMATS[words[1]]
        elif words[:1] == [b"element"] and len(words) == 3:
            elements.append(Element.named(words[1], words[2]))
        elif words[:1] == [b"property"] and elements:
            elements[-1].add(words[1:])
    if order is None:
        raise ValueError("no format in its header that is known")
    names = [element.name for element in elements]
    if len(set(names)) < len(names):
        raise ValueError("an element is announced twice")
    return order, elements, data[found.end() :]


def _vertices(rows: dict[str, Rows]) -> NDArray[np.float64]:
    """Positions (v, 3)."""
    missing = set("xyz") - set(rows["vertex"].single if "vertex" in rows else ())
    if missing:
        raise ValueError(f"its vertices have no {', '.join(sorted(missing))}")
    return np.stack([rows["vertex"].single[axis] for axis in "xyz"], axis=1).astype(np.float64)


def _list_of(rows: Rows) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Numbers of vertices of all rows, and how many each row has."""
    name = next((name for name in _LISTS if name in rows.lists), None)
    if name is None:
        raise ValueError(f"its faces have no {_LISTS[0]}")
    numbers, sizes = rows.lists[name]
    if not np.array_equal(numbers, np.trunc(numbers)):
        raise ValueError("faces name vertices by fractions")
    return numbers.astype(np.int64), sizes


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
