"""Compiled functions that concern rays, meshes, instances, and masks.

`mesh` and `instances` are addresses of `MESH` and `INSTANCE` records (cast_record.py).
"""

from __future__ import annotations

import numpy as np
from numba import types

from . import cast_record as memory
from .cast_record import float32s, float64s, int64s, uint8s
from .compiled import compiled, inlined, noinline
from .triangle_loops import intersect_plane, shear_ray

f64_1 = types.float64[::1]
f64_2 = types.float64[:, ::1]
i32_1 = types.int32[::1]


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


@compiled(types.void(memory.CASTS, f64_2, f64_2, i32_1, i32_1, f64_1, f64_1))
def barycentric_weights(  # type: ignore[no-untyped-def]  # noqa: PLR0914 - a compiled loop
    casts, origins, directions, triangle_row, instance, u, v
):
    """Compute the barycentric weights `u` and `v` of the second and third vertex at each hit.

    The rays (m, 3) are in local scene coordinates. `origins` is (1, 3) if all rays share an origin.
    `triangle_row` contains the row of each hit triangle in the corners of all meshes. `cast_rays`
    writes these rows if the cast's field `index` is 0.
    """
    mesh = casts[0].mesh
    instances = casts[0].instances
    for k in range(len(triangle_row)):
        o = origins[k if len(origins) > 1 else 0]
        d = directions[k]
        ox = o[0]
        oy = o[1]
        oz = o[2]
        dx = d[0]
        dy = d[1]
        dz = d[2]
        row = np.int64(triangle_row[k])
        mesh_address = mesh
        if instances != 0:
            address = instances + memory.INSTANCE_BYTES * np.int64(instance[k])
            record = int64s(address)
            mesh_address = record[memory.MESH_FIELD]
            row = row - record[memory.FIRST_ROW_FIELD]
            ox, oy, oz, dx, dy, dz, _ = to_mesh_coordinates(
                float64s(address), ox=ox, oy=oy, oz=oz, dx=dx, dy=dy, dz=dz
            )
        axis, p, q, r, sx, sy, sz = shear_ray(ox, oy, oz, dx, dy, dz)
        corners = triangle_corners(float64s(int64s(mesh_address)[0]), row, axis)
        a, b, c, det, _ = intersect_plane(corners, (p, q, r, sx, sy, sz))
        sign = -1.0 if det < 0 else 1.0  # The areas of a hit have the sign of `det` or are 0.
        a = max(sign * a, 0.0)
        b = max(sign * b, 0.0)
        c = max(sign * c, 0.0)
        total = (a + b) + c
        u[k] = b / total
        v[k] = c / total
