"""Compiled functions that concern rays, meshes, instances, and masks.

`mesh` and `instances` are addresses of `MESH` and `INSTANCE` records (cast_record.py).
"""

from __future__ import annotations

import numpy as np

from .cast_record import float32s, uint8s
from .compiled import inlined, noinline


@noinline
def to_mesh_coordinates(m, ox, oy, oz, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Transform a ray from scene to mesh coordinates, like `LocalScene.to_mesh_coordinates`.

    `m` points to the (3, 4) matrix of the instance. Return the origin, the unit direction, and the
    length that the direction had before it was normalized.
    """
    x = (m[0] * dx + m[1] * dy) + m[2] * dz
    y = (m[4] * dx + m[5] * dy) + m[6] * dz
    z = (m[8] * dx + m[9] * dy) + m[10] * dz
    length = np.sqrt((x * x + y * y) + z * z)
    u = ((m[0] * ox + m[1] * oy) + m[2] * oz) + m[3]
    v = ((m[4] * ox + m[5] * oy) + m[6] * oz) + m[7]
    w = ((m[8] * ox + m[9] * oy) + m[10] * oz) + m[11]
    return u, v, w, x / length, y / length, z / length, length


@inlined
def triangle_corners(table, triangle, axis):  # type: ignore[no-untyped-def]
    """Return a triangle's three vertices, each as three coordinates with `axis` last.

    `triangle` is the row of the triangle in `table`.
    """
    x = axis + 1 if axis < 2 else 0
    y = x + 1 if x < 2 else 0
    k = 9 * triangle
    return (
        (table[k + x], table[k + y], table[k + axis]),
        (table[k + 3 + x], table[k + 3 + y], table[k + 3 + axis]),
        (table[k + 6 + x], table[k + 6 + y], table[k + 6 + axis]),
    )


@noinline
def is_opaque(mesh, triangle, hit):  # type: ignore[no-untyped-def]
    """Return whether a mesh is opaque at a hit, like `MaskTables.is_opaque`.

    `mesh` points to a `MESH` record, and `triangle` is the row of the triangle in the mesh's
    corners.
    """
    uv = float32s(mesh[1])
    mask = uint8s(mesh[2])
    height = mesh[3]
    width = mesh[4]
    k = 6 * triangle
    p = hit.a / hit.det
    q = hit.b / hit.det
    r = hit.c / hit.det
    u = (p * np.float64(uv[k]) + q * np.float64(uv[k + 2])) + r * np.float64(uv[k + 4])
    v = (p * np.float64(uv[k + 1]) + q * np.float64(uv[k + 3])) + r * np.float64(uv[k + 5])
    column = min(np.int64((u - np.floor(u)) * width), width - 1)
    row = min(np.int64((v - np.floor(v)) * height), height - 1)
    return mask[row * width + column] != 0
