"""Object File Format, .off: one mesh of polygons, with or without colours."""

from __future__ import annotations

import re
from array import array

import numpy as np

from .mesh import Mesh
from .polygons import triangulated

# Normals (N), colours (C) and texture coordinates (ST) may follow the position of a vertex.
_HEADER = re.compile(rb"(?:ST)?C?N?OFF\b(?:[ \t]+BINARY)?", re.IGNORECASE)


def read_off(data: bytes, name: str) -> list[Mesh]:
    """Read the mesh of a file.

    Parameters
    ----------
    data
        The whole file.
    name
        What it is called.

    Raises
    ------
    ValueError
        If it has no header, is binary, or has fewer or more lines than that announces.
    """
    text = re.sub(rb"#[^\r\n]*", b"", data)
    found = _HEADER.match(text.lstrip())
    if not found:
        raise ValueError("no OFF header with the numbers of vertices and faces")
    if found[0].upper().endswith(b"BINARY"):
        raise ValueError("binary OFF: export it as text, or as .ply")
    lines = [line for line in text.lstrip()[found.end() :].splitlines() if line.strip()]
    counts = lines[0].split() if lines else []
    if len(counts) < 2 or not all(count.isdigit() for count in counts[:2]):
        raise ValueError("no OFF header with the numbers of vertices and faces")
    points, polygons = map(int, counts[:2])
    if len(lines) - 1 != points + polygons:
        raise ValueError(
            f"{points:,} vertices and {polygons:,} faces announced, {len(lines) - 1:,} lines there"
        )
    vertices, corners, sizes = array("d"), array("q"), array("q")
    for line in lines[1 : points + 1]:
        numbers = line.split()[:3]
        if len(numbers) < 3:
            raise ValueError(f"a vertex has {len(numbers)} numbers")
        vertices.extend(map(float, numbers))
    for line in lines[points + 1 :]:
        words = line.split()
        size = int(words[0])
        if not 0 <= size < len(words):
            raise ValueError(f"a face of {size} corners has {len(words) - 1}")
        corners.extend(map(int, words[1 : size + 1]))  # a colour may follow
        sizes.append(size)
    places = np.frombuffer(vertices, dtype=np.float64).reshape(-1, 3)
    faces = triangulated(
        places, np.frombuffer(corners, dtype=np.int64), np.frombuffer(sizes, dtype=np.int64)
    )
    return [Mesh(name, places, faces)] if len(faces) else []
