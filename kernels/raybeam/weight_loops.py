"""Compiled loop that computes the barycentric weights of hits."""

from __future__ import annotations

import numpy as np
from numba import types

from . import cast_record as memory
from .cast_record import float64s, int64s
from .compiled import compiled
from .mesh_loops import to_mesh_coordinates, triangle_corners
from .triangle_loops import intersect_plane, shear_ray

f64_1 = types.float64[::1]
f64_2 = types.float64[:, ::1]
i32_1 = types.int32[::1]


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
