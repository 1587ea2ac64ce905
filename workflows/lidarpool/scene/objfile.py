"""Wavefront .obj files: vertices and faces of named objects, whatever else there is.

trimesh reads .obj too, but not the backward numbers of a file with several objects, tabs,
indented lines and comments behind numbers; and it fills polygons that are not convex beyond
their outline.
"""

from __future__ import annotations

import re
from array import array
from dataclasses import dataclass, field

import numpy as np

from .mesh import Mesh
from .polygons import triangulated


@dataclass
class _Part:
    """Faces of one object.

    Parameters
    ----------
    corners
        Numbers of vertices of all faces, from 0.
    sizes
        Corners of each face.
    """

    corners: array[int] = field(default_factory=lambda: array("q"))
    sizes: array[int] = field(default_factory=lambda: array("q"))


def read_obj(data: bytes, name: str) -> list[Mesh]:
    """Read the objects of a file.

    Parameters
    ----------
    data
        The whole file.
    name
        For faces that belong to no named object.

    Returns
    -------
    One mesh for each name, in the order in which they begin: of 'o', or of 'g' where there is
    no 'o'. Materials divide nothing.

    Raises
    ------
    ValueError
        If a vertex has no three numbers, or a face names a vertex that is not there.
    """
    text = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    text = text.replace(b"\\\n", b" ").replace(b"\t", b" ")
    divider = b"o" if re.search(rb"^ *o ", text, re.MULTILINE) else b"g"
    vertices = array("d")
    parts = {name: _Part()}
    part = parts[name]
    for line in text.split(b"\n"):
        key, _, rest = line.lstrip(b" ").partition(b" ")
        if key == b"v":
            numbers = rest.partition(b"#")[0].split()[:3]  # a weight or a colour may follow
            if len(numbers) < 3:
                raise ValueError(f"a vertex has {len(numbers)} numbers, '{_shown(line)}'")
            vertices.extend(map(float, numbers))
        elif key == b"f":
            corners = _corners(rest.partition(b"#")[0], len(vertices) // 3, line)
            part.corners.extend(corners)
            part.sizes.append(len(corners))
        elif key == divider:
            part = parts.setdefault(_text(rest.strip()) or name, _Part())
    return _meshes(np.frombuffer(vertices, dtype=np.float64).reshape(-1, 3), parts)


def _corners(rest: bytes, count: int, line: bytes) -> list[int]:
    """Vertices of a face, from 0; `count` are known so far."""
    words = rest.split()
    if b"/" in rest:
        words = [word.partition(b"/")[0] for word in words]
    numbers = list(map(int, words))
    if numbers and min(numbers) <= 0:  # rare, and told of by this one look
        if 0 in numbers or min(numbers) < -count:
            raise ValueError(f"'{_shown(line)}' names a vertex that is not there")
        return [number - 1 if number > 0 else count + number for number in numbers]
    return [number - 1 for number in numbers]


def _meshes(
    vertices: np.ndarray[tuple[int, ...], np.dtype[np.float64]], parts: dict[str, _Part]
) -> list[Mesh]:
    """Meshes with the vertices that they use."""
    out = []
    for name, part in parts.items():
        faces = triangulated(
            vertices,
            np.frombuffer(part.corners, dtype=np.int64),
            np.frombuffer(part.sizes, dtype=np.int64),
        )
        if len(faces):
            used, own = np.unique(faces, return_inverse=True)
            out.append(Mesh(name, vertices[used], own.reshape(-1, 3)))
    return out


def _text(name: bytes) -> str:
    """Name in UTF-8, or as old programs of the west wrote it."""
    try:
        return name.decode("utf-8")
    except UnicodeDecodeError:
        return name.decode("latin-1")


def _shown(line: bytes) -> str:
    return _text(line.strip()[:60])
