"""The float64 intersection test of triangle.py, for one or four rays in a tile."""

from __future__ import annotations

import numpy as np
from numba import types

from . import tile_memory as memory
from .cast_record import LEAF_CORNERS, MASK_HEIGHT, ORDER, float64s, int32s, int64s
from .compiled import INT64, called_by_address, inlined, noinline
from .mesh_loops import is_opaque
from .tile_memory import AXIS, KEY, LENGTH, SX, T, U, field_index, row_index
from .triangle_loops import PlaneHit, shear_ray
from .vectors import (
    absolute,
    greater_equal,
    load,
    lowest_bit,
    maximum,
    minimum,
    splat,
    splat_bits,
    store,
    store_masked,
)

_T_MIN = field_index("t_min")
_NESTED = field_index("nested")


@called_by_address(types.void(*3 * INT64))
def shear_rays(tile, rays, first_row):  # type: ignore[no-untyped-def]  # noqa: PLR0914, PLR0915 - a compiled loop
    """Compute the shear of every ray in a tile.

    Also write the longest axis that each group of eight rays has in common, or -1 if their longest
    axes differ. `first_row` is the first of six rows with origins and directions.
    """
    numbers = int64s(tile)
    floats = float64s(tile)
    axis_at = row_index(AXIS, rays)
    o = row_index(first_row, rays)
    d = row_index(first_row + 3, rays)
    u_at = row_index(U, rays)
    s_at = row_index(SX, rays)
    eight_at = row_index(memory.AXIS_OF_EIGHT, rays)
    one = splat(1.0)
    for start in range(0, rays, 8):
        common = np.int64(-2)
        for k in range(start, start + 8, 4):
            x = absolute(load(floats, d + k))
            y = absolute(load(floats, d + rays + k))
            z = absolute(load(floats, d + 2 * rays + k))
            along_x = greater_equal(x, y) & greater_equal(x, z)
            along_y = greater_equal(y, z) & (15 ^ along_x)
            axis = np.int64(-1)
            if along_x == 15:
                axis = np.int64(0)
            elif along_y == 15:
                axis = np.int64(1)
            elif (along_x | along_y) == 0:
                axis = np.int64(2)
            if axis < 0:
                common = np.int64(-1)
                for i in range(k, k + 4):
                    longest, p, q, r, sx, sy, sz = shear_ray(
                        floats[o + i],
                        floats[o + rays + i],
                        floats[o + 2 * rays + i],
                        floats[d + i],
                        floats[d + rays + i],
                        floats[d + 2 * rays + i],
                    )
                    numbers[axis_at + i] = longest
                    floats[u_at + i] = p
                    floats[u_at + rays + i] = q
                    floats[u_at + 2 * rays + i] = r
                    floats[s_at + i] = sx
                    floats[s_at + rays + i] = sy
                    floats[s_at + 2 * rays + i] = sz
                continue
            second = axis + 1 if axis < 2 else np.int64(0)
            third = axis + 2 if axis < 1 else axis - 1
            along = load(floats, d + axis * rays + k)
            store(floats, s_at + k, load(floats, d + second * rays + k) / along)
            store(floats, s_at + rays + k, load(floats, d + third * rays + k) / along)
            store(floats, s_at + 2 * rays + k, one / along)
            store(floats, u_at + k, load(floats, o + second * rays + k))
            store(floats, u_at + rays + k, load(floats, o + third * rays + k))
            store(floats, u_at + 2 * rays + k, load(floats, o + axis * rays + k))
            for i in range(k, k + 4):
                numbers[axis_at + i] = axis
            common = axis if common == -2 or common == axis else np.int64(-1)
        numbers[eight_at + start // 8] = common


@inlined
def _ray_shear(floats, rays, ray):  # type: ignore[no-untyped-def]
    """Return six numbers: a ray's origin with the longest axis last, and the ray's shear."""
    k = row_index(U, rays) + ray
    return (
        floats[k],
        floats[k + rays],
        floats[k + 2 * rays],
        floats[k + 3 * rays],
        floats[k + 4 * rays],
        floats[k + 5 * rays],
    )


@noinline
def intersect_ray(tile, rays, ray, mesh, instance, position):  # type: ignore[no-untyped-def]  # noqa: PLR0914 - a compiled loop
    """Test a ray against a triangle in float64, and return whether there is a closer hit.

    A closer hit is recorded in the tile. `instance` is the index of the instance times
    `KEYS_PER_INSTANCE`, and `position` is the position of the triangle in leaf order.
    """
    numbers = int64s(tile)
    floats = float64s(tile)
    record = int64s(mesh)
    corners = float64s(record[LEAF_CORNERS])
    order = int32s(record[ORDER])
    axis = numbers[row_index(AXIS, rays) + ray]
    u, v, w, sx, sy, sz = _ray_shear(floats, rays, ray)
    x = axis + 1 if axis < 2 else 0
    y = x + 1 if x < 2 else 0
    k = 9 * position
    z0 = corners[k + axis] - w
    z1 = corners[k + 3 + axis] - w
    z2 = corners[k + 6 + axis] - w
    x0 = (corners[k + x] - u) - sx * z0
    y0 = (corners[k + y] - v) - sy * z0
    x1 = (corners[k + 3 + x] - u) - sx * z1
    y1 = (corners[k + 3 + y] - v) - sy * z1
    x2 = (corners[k + 6 + x] - u) - sx * z2
    y2 = (corners[k + 6 + y] - v) - sy * z2
    a = x2 * y1 - y2 * x1
    b = x0 * y2 - y0 * x2
    c = x1 * y0 - y1 * x0
    det = (a + b) + c
    t = (((a * z0 + b * z1) + c * z2) / det) * sz
    t = t / floats[row_index(LENGTH, rays) + ray]
    inside = ((a >= 0) & (b >= 0) & (c >= 0)) | ((a <= 0) & (b <= 0) & (c <= 0))
    nearest = floats[row_index(T, rays) + ray]
    if not (inside & (det != 0) & (t >= floats[_T_MIN]) & (t <= nearest)):
        return False
    row = np.int64(order[position])
    key = instance + row
    known = numbers[row_index(KEY, rays) + ray]
    if t == nearest and 0 <= known <= key:
        return False
    if record[MASK_HEIGHT] != 0 and not is_opaque(record, row, PlaneHit(a, b, c, det, t)):
        return False
    floats[row_index(T, rays) + ray] = t
    numbers[row_index(KEY, rays) + ray] = key
    return True


@inlined
def intersect_four_rays(tile, rays, ray, axis, corners, position, key):  # type: ignore[no-untyped-def]  # noqa: PLR0914, PLR0915 - a compiled loop
    """Test four consecutive rays against a triangle, and return a mask of the closer hits.

    The rays must have the same longest axis `axis`, and the mesh must not have a mask. `corners`
    points to the corners of the mesh in leaf order, and `key` is the key of the triangle. Hits are
    recorded as in `intersect_ray`.
    """
    numbers = int64s(tile)
    floats = float64s(tile)
    i = row_index(U, rays) + ray
    u = load(floats, i)
    v = load(floats, i + rays)
    w = load(floats, i + 2 * rays)
    sx = load(floats, i + 3 * rays)
    sy = load(floats, i + 4 * rays)
    sz = load(floats, i + 5 * rays)
    x = axis + 1 if axis < 2 else 0
    y = x + 1 if x < 2 else 0
    k = 9 * position
    z0 = splat(corners[k + axis]) - w
    z1 = splat(corners[k + 3 + axis]) - w
    z2 = splat(corners[k + 6 + axis]) - w
    x0 = (splat(corners[k + x]) - u) - sx * z0
    y0 = (splat(corners[k + y]) - v) - sy * z0
    x1 = (splat(corners[k + 3 + x]) - u) - sx * z1
    y1 = (splat(corners[k + 3 + y]) - v) - sy * z1
    x2 = (splat(corners[k + 6 + x]) - u) - sx * z2
    y2 = (splat(corners[k + 6 + y]) - v) - sy * z2
    a = x2 * y1 - y2 * x1
    b = x0 * y2 - y0 * x2
    c = x1 * y0 - y1 * x0
    det = (a + b) + c
    t = (((a * z0 + b * z1) + c * z2) / det) * sz
    if numbers[_NESTED] != 0:
        t = t / load(floats, row_index(LENGTH, rays) + ray)
    zero = splat(0.0)
    t_at = row_index(T, rays) + ray
    nearest = load(floats, t_at)
    # If all areas have the same sign and det is 0, all areas are 0, so t is NaN and fails the test.
    hit = greater_equal(minimum(minimum(a, b), c), zero) | greater_equal(
        zero, maximum(maximum(a, b), c)
    )
    hit &= greater_equal(t, splat(float64s(tile)[_T_MIN])) & greater_equal(nearest, t)
    key_at = row_index(KEY, rays) + ray
    tie = hit & greater_equal(t, nearest)
    while tie != 0:
        lane = lowest_bit(tie)
        tie &= tie - 1
        known = numbers[key_at + lane]
        if 0 <= known <= key:
            hit &= ~(np.int64(1) << lane)
    store_masked(hit, floats, t_at, t)
    store_masked(hit, floats, key_at, splat_bits(key))
    return hit
