"""The closest hits of a tile: up to some hundred rays that run close together, or of single rays.

A tile's rays become points (su, sv) of a plane across the tile's mean direction m: a ray's
direction is (su, sv, 1) in the axes (u, v, m), divided by the component along m. There

- a box is outside the tile if it is outside one of four planes, eight children of a node at a time;
  and outside a subtile likewise, eight subtiles at a time, a bit of a mask each;
- a triangle is three linear functions of (su, sv), prepared for eight triangles of a leaf at a
  time; the maximum of each over a range of (su, sv) discards the triangle for a tile or subtile;
- a test of eight rays is six multiply-adds and a comparison with the depth so far.

All of that is float32 with margins, and only discards. What is left is decided in float64 by the
test of triangle.py, in its order of operations, so hits have the bits of the other backends.

A tile that is too wide, too far away, or that meets more leaves than half of its rays, is cast ray
by ray in the same tree. Rays with a negative reach are not cast.

Margins, with u = 2**-24, local coordinates of boxes within [-1, 1], and `spread` =
1 + max |su| + max |sv| of the tile:

- A side of a tile is ``n . (p - o)`` with a normal n of length up to `spread`. Rounding of n, p, o
  and of the sums is at most 16 u spread (2 + |o|). `_SIDE` is four times that.
- The first corner of a triangle, relative to the tile's point, is off by 5 u (1 + |a|), edges by 5 u
  of their length. A cross product of an edge and such a corner is off by 24 u |edge| (1 + |a|),
  and its value at (su, sv) by `spread` times that. `_EDGE` has twice that.
- A ray that starts off the tile's point by w has a moment that differs by w x edge: `offset` is an
  upper bound of w across the ray, and of its share along m.
- Products of edges below 1e-19 underflow: `_FLOOR` covers them.

Parameters of the functions below: `tile` is the address of the memory that tile_memory.py
describes, `rays` the number of rays of the tile; `singles`, `integers`, `numbers` and `floats`
point to this memory as float32, int32, int64 and float64. `mesh` is the address of a `MESH` record.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import types

from . import tile_memory as memory
from .cast_memory import (
    INSTANCE_BYTES,
    KEYS_PER_INSTANCE,
    MESH_FIELD,
    float32s,
    float64s,
    int32s,
    int64s,
    uint8s,
)
from .compiled import inlined, part, stage
from .mesh_loops import enter_instance, is_opaque
from .ray_loops import entry_distance
from .tile_memory import AXIS, ENTRY, IX, KEY, LENGTH, OX, SUBTILES, SX, T, U, at, row_at
from .tile_tree import BLOCK, NODE
from .tree import LEAF_BITS
from .triangle_loops import PlaneHit, shear
from .vectors import (
    absolute,
    at_least,
    bit_count,
    copy_sign,
    higher_of,
    highest,
    load,
    lower_of,
    lowest,
    lowest_bit,
    multiply_add,
    narrow,
    prefetch,
    splat,
    splat_bits,
    square_root,
    store,
    write_where,
    write_word,
)

_AXES = at("axes")
_PADDING = at("padding")
_OFFSET = at("offset")
_SPREAD = at("spread")
_BOUNDS = at("bounds")
_TILE_BOUNDS = at("tile_bounds")
_REACH = at("reach")
_PLANES = at("planes")
_TILE_PLANES = at("tile_planes")
_EDGES = at("edges")
_NEAR = at("near")
_SIDES = at("sides")
_SKIPS = at("skips")
_PATIENCE = at("patience")
_SUMS = at("sums")
_PAIRS = at("pairs")
_BITS = at("bits")
_STACK = at("stack")
_MET = at("met")

_ZERO = np.float32(0)
_ONE = np.float32(1)
_FAR = np.float32(1e30)
_UNIT = 2.0**-24
_SIDE = np.float32(64 * _UNIT)
_EDGE = np.float32(48 * _UNIT)
_FLOOR = np.float32(1e-35)
_REACH_FACTOR = np.float32(1 + 2.0**-19)
_REACH_MARGIN = np.float32(2.0**-19)
_NARROW = np.float32(0.6)  # least cosine between m and a ray of a tile
_MAX_START = 64.0  # local: rays that start farther away are cast one by one, from the scene's box
_TINY = np.float32(2.0**-60)
_ACROSS = 4.0
_SLACK = 2.0**-20
_MAX_SKIPS = 31  # tiles that are cast one by one before another trial
_MAX_ENTRY = 1e9
_FEW = 6  # rays that are cast one by one
_LEAF_MASK = (1 << LEAF_BITS) - 1


@inlined
def _dot(ax, ay, az, bx, by, bz):  # type: ignore[no-untyped-def]
    return multiply_add(ax, bx, multiply_add(ay, by, az * bz))


@inlined
def _cross(a, b):  # type: ignore[no-untyped-def]
    ax, ay, az = a
    bx, by, bz = b
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@inlined
def _axes(singles):  # type: ignore[no-untyped-def]
    """Return the tile's axes u, v, m as vectors of equal numbers: three components each."""
    k = _AXES
    u = splat(singles[k]), splat(singles[k + 1]), splat(singles[k + 2])
    v = splat(singles[k + 3]), splat(singles[k + 4]), splat(singles[k + 5])
    m = splat(singles[k + 6]), splat(singles[k + 7]), splat(singles[k + 8])
    return u, v, m


@inlined
def _turned(axes, x, y, z):  # type: ignore[no-untyped-def]
    """Return the components of vectors along the axes of the tile."""
    u, v, m = axes
    return (
        _dot(x, y, z, u[0], u[1], u[2]),
        _dot(x, y, z, v[0], v[1], v[2]),
        _dot(x, y, z, m[0], m[1], m[2]),
    )


@inlined
def _narrowed(floats, k):  # type: ignore[no-untyped-def]
    """Return eight float64 as float32."""
    return narrow(load(floats, k), load(floats, k + 4))


@stage
def _set_axes(tile, rays, first_row):  # type: ignore[no-untyped-def]
    """Write the axes of a tile and the point that they start from; return its largest coordinate.

    `first_row` is the first of six rows with origins and directions.
    """
    singles = float32s(tile)
    floats = float64s(tile)
    direction = row_at(first_row + 3, rays)
    for axis in range(3):
        total = splat(0.0)
        for k in range(0, rays, 4):
            total = total + load(floats, direction + axis * rays + k)
        store(floats, _SUMS, total)
        singles[_AXES + 6 + axis] = np.float32(
            (floats[_SUMS] + floats[_SUMS + 1]) + (floats[_SUMS + 2] + floats[_SUMS + 3])
        )
    x = np.float64(singles[_AXES + 6])
    y = np.float64(singles[_AXES + 7])
    z = np.float64(singles[_AXES + 8])
    start = _set_frame(singles, x, y, z)
    for axis in range(3):
        origin = row_at(first_row + axis, rays)
        o = 0.5 * floats[origin] + 0.5 * floats[origin + rays - 1]
        singles[_AXES + 9 + axis] = np.float32(o)
        start = max(start, abs(o))
    return start


@inlined
def _set_frame(singles, x, y, z):  # type: ignore[no-untyped-def]
    """Write the three axes about a direction of any length but zero; return 0."""
    norm = 1 / np.sqrt((x * x + y * y) + z * z)
    x *= norm
    y *= norm
    z *= norm
    a, b, c = 0.0, -z, y
    if abs(z) < 0.9:
        a, b, c = -y, x, 0.0
    norm = 1 / np.sqrt((a * a + b * b) + c * c)
    a *= norm
    b *= norm
    c *= norm
    singles[_AXES] = np.float32(a)
    singles[_AXES + 1] = np.float32(b)
    singles[_AXES + 2] = np.float32(c)
    singles[_AXES + 3] = np.float32(y * c - z * b)
    singles[_AXES + 4] = np.float32(z * a - x * c)
    singles[_AXES + 5] = np.float32(x * b - y * a)
    singles[_AXES + 6] = np.float32(x)
    singles[_AXES + 7] = np.float32(y)
    singles[_AXES + 8] = np.float32(z)
    return 0.0


@stage
def _flatten(tile, rays, first_row):  # type: ignore[no-untyped-def]  # noqa: PLR0914 - a compiled loop
    """Write su, sv and the depths of a tile's rays, and their bounds; return the least cosine to m.

    `offset` becomes the maximum, over all rays, of the distance between the ray and the ray from the
    tile's point with the same (su, sv), across m, and of the distance along m.
    """
    singles = float32s(tile)
    floats = float64s(tile)
    axes = _axes(singles)
    origin = row_at(first_row, rays)
    direction = row_at(first_row + 3, rays)
    su_at = 2 * row_at(memory.SU, rays)
    sv_at = 2 * row_at(memory.SV, rays)
    dm_at = 2 * row_at(memory.DM, rays)
    wm_at = 2 * row_at(memory.WM, rays)
    px = splat(np.float64(singles[_AXES + 9]))
    py = splat(np.float64(singles[_AXES + 10]))
    pz = splat(np.float64(singles[_AXES + 11]))
    one = splat(_ONE)
    offset = splat(_ZERO)
    cosine = splat(_ONE)
    each = rays // SUBTILES
    for subtile in range(SUBTILES):
        low_u = splat(_FAR)
        high_u = splat(-_FAR)
        low_v = splat(_FAR)
        high_v = splat(-_FAR)
        for k in range(subtile * each, (subtile + 1) * each, 8):
            i = direction + k
            du, dv, dm = _turned(
                axes,
                _narrowed(floats, i),
                _narrowed(floats, i + rays),
                _narrowed(floats, i + 2 * rays),
            )
            cosine = lower_of(cosine, dm)
            inverse = one / dm
            su = du * inverse
            sv = dv * inverse
            store(singles, su_at + k, su)
            store(singles, sv_at + k, sv)
            store(singles, dm_at + k, dm)
            low_u = lower_of(low_u, su)
            high_u = higher_of(high_u, su)
            low_v = lower_of(low_v, sv)
            high_v = higher_of(high_v, sv)
            i = origin + k
            wu, wv, wm = _turned(
                axes,
                narrow(load(floats, i) - px, load(floats, i + 4) - px),
                narrow(load(floats, i + rays) - py, load(floats, i + rays + 4) - py),
                narrow(load(floats, i + 2 * rays) - pz, load(floats, i + 2 * rays + 4) - pz),
            )
            store(singles, wm_at + k, wm)
            across = absolute(wu - wm * su) + absolute(wv - wm * sv)
            offset = higher_of(offset, across + absolute(wm))
        singles[_BOUNDS + subtile] = lowest(low_u)
        singles[_BOUNDS + SUBTILES + subtile] = highest(high_u)
        singles[_BOUNDS + 2 * SUBTILES + subtile] = lowest(low_v)
        singles[_BOUNDS + 3 * SUBTILES + subtile] = highest(high_v)
    singles[_TILE_BOUNDS] = lowest(load(singles, _BOUNDS))
    singles[_TILE_BOUNDS + 1] = highest(load(singles, _BOUNDS + SUBTILES))
    singles[_TILE_BOUNDS + 2] = lowest(load(singles, _BOUNDS + 2 * SUBTILES))
    singles[_TILE_BOUNDS + 3] = highest(load(singles, _BOUNDS + 3 * SUBTILES))
    singles[_OFFSET] = highest(offset)
    return lowest(cosine)


@stage
def _set_planes(tile):  # type: ignore[no-untyped-def]  # noqa: PLR0914 - a compiled loop
    """Write the sides of the tile and of its subtiles, with margins, and the padding of depths."""
    singles = float32s(tile)
    numbers = int64s(tile)
    u, v, m = _axes(singles)
    ox = splat(singles[_AXES + 9])
    oy = splat(singles[_AXES + 10])
    oz = splat(singles[_AXES + 11])
    zero = splat(_ZERO)
    b = _TILE_BOUNDS
    spread = (
        _ONE
        + max(abs(singles[b]), abs(singles[b + 1]))
        + max(abs(singles[b + 2]), abs(singles[b + 3]))
    )
    start = abs(singles[_AXES + 9]) + abs(singles[_AXES + 10]) + abs(singles[_AXES + 11])
    padding = _SIDE * spread * (np.float32(2) + start)
    singles[_SPREAD] = spread
    singles[_PADDING] = padding
    offset = singles[_OFFSET]
    slack = splat(padding + np.float32(4) * offset)
    for plane in range(5):
        nx, ny, nz = m
        constant = splat(-padding - np.float32(2) * offset)
        if plane < 4:
            x, y, z = u if plane < 2 else v
            sign = splat(_ONE if plane % 2 == 0 else -_ONE)
            bound = load(singles, _BOUNDS + SUBTILES * plane)
            nx = (x - bound * m[0]) * sign
            ny = (y - bound * m[1]) * sign
            nz = (z - bound * m[2]) * sign
            k = _PLANES + 7 * SUBTILES * plane
            store(singles, k, higher_of(nx, zero))
            store(singles, k + 8, higher_of(ny, zero))
            store(singles, k + 16, higher_of(nz, zero))
            store(singles, k + 24, lower_of(nx, zero))
            store(singles, k + 32, lower_of(ny, zero))
            store(singles, k + 40, lower_of(nz, zero))
            store(singles, k + 48, slack - _dot(nx, ny, nz, ox, oy, oz))
            bound = splat(singles[_TILE_BOUNDS + plane])
            nx = (x - bound * m[0]) * sign
            ny = (y - bound * m[1]) * sign
            nz = (z - bound * m[2]) * sign
            constant = slack
        constant = constant - _dot(nx, ny, nz, ox, oy, oz)
        x1 = lowest(nx)
        y1 = lowest(ny)
        z1 = lowest(nz)
        k = _TILE_PLANES + 4 * plane
        singles[k] = x1
        singles[k + 1] = y1
        singles[k + 2] = z1
        singles[k + 3] = lowest(constant)
        far = plane < 4  # of a side the farthest corner of a box counts, of the depth the nearest
        numbers[_SIDES + 3 * plane] = 24 if (x1 >= 0) == far else 0
        numbers[_SIDES + 3 * plane + 1] = 32 if (y1 >= 0) == far else 8
        numbers[_SIDES + 3 * plane + 2] = 40 if (z1 >= 0) == far else 16


@part(types.float32(types.int64, types.int64, types.int64))
def _limit_depths(tile, rays, subtiles):  # type: ignore[no-untyped-def]
    """Write the greatest depth, rounded up, of the rays of subtiles (a mask), and of each subtile.

    Returns the greatest depth of all subtiles.
    """
    singles = float32s(tile)
    floats = float64s(tile)
    t_at = row_at(T, rays)
    length_at = row_at(LENGTH, rays)
    dm_at = 2 * row_at(memory.DM, rays)
    wm_at = 2 * row_at(memory.WM, rays)
    depth_at = 2 * row_at(memory.DEPTH, rays)
    far = splat(1e30)
    factor = splat(_REACH_FACTOR)
    margin = splat(_REACH_MARGIN + np.float32(2) * singles[_PADDING])
    each = rays // SUBTILES
    for subtile in range(SUBTILES):
        if (subtiles >> subtile) & 1 == 0:
            continue
        greatest = splat(-_FAR)
        for k in range(subtile * each, (subtile + 1) * each, 8):
            first = lower_of(load(floats, t_at + k) * load(floats, length_at + k), far)
            second = lower_of(load(floats, t_at + k + 4) * load(floats, length_at + k + 4), far)
            along = narrow(first, second) * load(singles, dm_at + k)
            depth = multiply_add(along, factor, load(singles, wm_at + k) + margin)
            store(singles, depth_at + k, depth)
            greatest = higher_of(greatest, depth)
        singles[_REACH + subtile] = highest(greatest)
    return highest(load(singles, _REACH))


@part(types.void(types.int64, types.int64, types.int64))
def _shear_rays(tile, rays, first_row):  # type: ignore[no-untyped-def]  # noqa: PLR0914 - a compiled loop
    """Write the shear of rays, and the common longest axis of each eight rays, -1 if they differ.

    `first_row` is the first of six rows with origins and directions.
    """
    numbers = int64s(tile)
    floats = float64s(tile)
    axis_at = row_at(AXIS, rays)
    o = row_at(first_row, rays)
    d = row_at(first_row + 3, rays)
    u_at = row_at(U, rays)
    s_at = row_at(SX, rays)
    eight_at = row_at(memory.AXIS_OF_EIGHT, rays)
    one = splat(1.0)
    for start in range(0, rays, 8):
        common = np.int64(-2)
        for k in range(start, start + 8, 4):
            x = absolute(load(floats, d + k))
            y = absolute(load(floats, d + rays + k))
            z = absolute(load(floats, d + 2 * rays + k))
            along_x = at_least(x, y) & at_least(x, z)
            along_y = at_least(y, z) & (15 ^ along_x)
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
                    longest, p, q, r, sx, sy, sz = shear(
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
    """Return the shear of a ray without the axis: 6 numbers."""
    k = row_at(U, rays) + ray
    return (
        floats[k],
        floats[k + rays],
        floats[k + 2 * rays],
        floats[k + 3 * rays],
        floats[k + 4 * rays],
        floats[k + 5 * rays],
    )


@stage
def _decide_one(tile, rays, ray, mesh, instance, position, t_min):  # type: ignore[no-untyped-def]  # noqa: PLR0914 - a compiled loop
    """Test a ray and a triangle in float64, and keep a closer hit; return whether it is kept.

    `instance` is the instance's number times `KEYS_PER_INSTANCE`, `position` of the triangle in
    leaf order.
    """
    numbers = int64s(tile)
    floats = float64s(tile)
    record = int64s(mesh)
    corners = float64s(record[7])
    order = int32s(record[8])
    axis = numbers[row_at(AXIS, rays) + ray]
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
    t = t / floats[row_at(LENGTH, rays) + ray]
    inside = ((a >= 0) & (b >= 0) & (c >= 0)) | ((a <= 0) & (b <= 0) & (c <= 0))
    nearest = floats[row_at(T, rays) + ray]
    if not (inside & (det != 0) & (t >= t_min) & (t <= nearest)):
        return False
    row = np.int64(order[position])
    key = instance + row
    known = numbers[row_at(KEY, rays) + ray]
    if t == nearest and 0 <= known <= key:
        return False
    if record[3] != 0 and not is_opaque(record, row, PlaneHit(a, b, c, det, t)):
        return False
    floats[row_at(T, rays) + ray] = t
    numbers[row_at(KEY, rays) + ray] = key
    return True


@inlined
def _decide_four(tile, rays, ray, axis, corners, position, key, nested, t_min):  # type: ignore[no-untyped-def]  # noqa: PLR0914 - a compiled loop
    """Test four rays from a number on as `_decide_one`; return the mask of those that hit.

    The rays have the longest axis `axis`, and the mesh has no mask. `corners` points to the corners
    of the mesh in leaf order, `key` is of the triangle, `nested` whether it is of an instance.
    """
    numbers = int64s(tile)
    floats = float64s(tile)
    i = row_at(U, rays) + ray
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
    if nested:
        t = t / load(floats, row_at(LENGTH, rays) + ray)
    zero = splat(0.0)
    t_at = row_at(T, rays) + ray
    nearest = load(floats, t_at)
    # Where det is 0, all areas are 0, so t is NaN and not at least t_min.
    hit = at_least(lower_of(lower_of(a, b), c), zero) | at_least(
        zero, higher_of(higher_of(a, b), c)
    )
    hit &= at_least(t, splat(t_min)) & at_least(nearest, t)
    key_at = row_at(KEY, rays) + ray
    tie = hit & at_least(t, nearest)
    while tie != 0:
        lane = lowest_bit(tie)
        tie &= tie - 1
        known = numbers[key_at + lane]
        if 0 <= known <= key:
            hit &= ~(np.int64(1) << lane)
    write_where(hit, floats, t_at, t)
    write_where(hit, floats, key_at, splat_bits(key))
    return hit


@inlined
def _leaf_edges(singles, blocks, block):  # type: ignore[no-untyped-def]
    """Return first corners, relative to the tile's point, and edges of a leaf in the tile's axes."""
    axes = _axes(singles)
    x = load(blocks, block) - splat(singles[_AXES + 9])
    y = load(blocks, block + 8) - splat(singles[_AXES + 10])
    z = load(blocks, block + 16) - splat(singles[_AXES + 11])
    a = _turned(axes, x, y, z)
    e = _turned(axes, load(blocks, block + 24), load(blocks, block + 32), load(blocks, block + 40))
    f = _turned(axes, load(blocks, block + 48), load(blocks, block + 56), load(blocks, block + 64))
    return a, e, f


@inlined
def _norm(a):  # type: ignore[no-untyped-def]
    """Return the sums of the sizes of the components of vectors."""
    return (absolute(a[0]) + absolute(a[1])) + absolute(a[2])


@inlined
def _maximum(normal, bounds):  # type: ignore[no-untyped-def]
    """Return the maximum of a linear function over ranges of (su, sv)."""
    nu, nv, nm = normal
    low_u, high_u, low_v, high_v = bounds
    return (nm + higher_of(nu * low_u, nu * high_u)) + higher_of(nv * low_v, nv * high_v)


@inlined
def _splat_three(singles, k):  # type: ignore[no-untyped-def]
    return splat(singles[k]), splat(singles[k + 8]), splat(singles[k + 16])


@part(
    types.int64(
        types.int64,
        types.int64,
        types.int64,
        types.int64,
        types.int64,
        types.int64,
        types.float32,
        types.float64,
    )
)
def _test_leaf(tile, rays, mesh, nested_key, code, mask, deepest, t_min):  # type: ignore[no-untyped-def]  # noqa: PLR0914, PLR0915 - a compiled loop
    """Test the triangles of a leaf and the rays of the subtiles of a mask; return those with hits.

    `code` is of the leaf, `deepest` the greatest depth that a ray reaches, `nested_key` the instance
    times `KEYS_PER_INSTANCE`, or -1 for a mesh without a transform.
    """
    singles = float32s(tile)
    numbers = int64s(tile)
    pairs = uint8s(tile)
    record = int64s(mesh)
    blocks = float32s(record[6])
    block = (code >> LEAF_BITS) * BLOCK
    a, e, f = _leaf_edges(singles, blocks, block)
    n1 = _cross(f, a)
    n2 = _cross(a, e)
    n = _cross(e, f)
    zero = splat(_ZERO)
    volume = _dot(n[0], n[1], n[2], a[0], a[1], a[2])
    size = _norm(e) + _norm(f)
    floor = splat(_FLOOR)
    rounding = multiply_add(splat(_EDGE * singles[_SPREAD]) * (splat(_ONE) + _norm(a)), size, floor)
    offset = splat(singles[_OFFSET] * singles[_SPREAD])
    margin = multiply_add(offset, size, rounding)
    volume_margin = multiply_add(rounding, size, multiply_add(offset, _norm(n), floor))
    undecided = at_least(volume_margin, absolute(volume))
    sign = copy_sign(splat(_ONE), volume)  # so that rays ahead see positive areas
    n1 = n1[0] * sign, n1[1] * sign, n1[2] * sign
    n2 = n2[0] * sign, n2[1] * sign, n2[2] * sign
    n = n[0] * sign, n[1] * sign, n[2] * sign
    n0 = n[0] - n1[0] - n2[0], n[1] - n1[1] - n2[1], n[2] - n1[2] - n2[2]
    depth = lower_of(lower_of(a[2], a[2] + e[2]), a[2] + f[2])
    depth = depth - splat(singles[_PADDING] + np.float32(2) * singles[_OFFSET])
    k = _TILE_BOUNDS
    bounds = (
        splat(singles[k]),
        splat(singles[k + 1]),
        splat(singles[k + 2]),
        splat(singles[k + 3]),
    )
    least = lower_of(lower_of(_maximum(n0, bounds), _maximum(n1, bounds)), _maximum(n2, bounds))
    hit = at_least(least + margin, zero) | undecided
    hit &= at_least(splat(deepest), depth) & ((2 << (code & _LEAF_MASK)) - 1)
    if hit == 0:
        return np.int64(0)
    k = _EDGES
    for normal in (n1, n2, n0):
        store(singles, k, normal[0])
        store(singles, k + 8, normal[1])
        store(singles, k + 16, normal[2])
        k += 24
    store(singles, k, margin)
    store(singles, k + 8, volume_margin - absolute(volume))
    store(singles, k + 16, depth)
    store(singles, k + 24, rounding * splat(np.float32(4)))
    first = np.int64(int32s(record[6])[block + 72])
    corners = float64s(record[7])
    # Three loops over lists, not one nest with branches: a branch that is mispredicted costs as
    # much as the test of 24 rays. First, pairs of a triangle and a subtile.
    bounds = (
        load(singles, _BOUNDS),
        load(singles, _BOUNDS + SUBTILES),
        load(singles, _BOUNDS + 2 * SUBTILES),
        load(singles, _BOUNDS + 3 * SUBTILES),
    )
    reach = load(singles, _REACH)
    pair_count = np.int64(0)
    for _ in range(bit_count(hit)):
        lane = lowest_bit(hit)
        hit &= hit - 1
        k = _EDGES + lane
        least = lower_of(
            lower_of(
                _maximum(_splat_three(singles, k), bounds),
                _maximum(_splat_three(singles, k + 24), bounds),
            ),
            _maximum(_splat_three(singles, k + 48), bounds),
        )
        chosen = at_least(least + splat(singles[k + 72]), zero) | -((undecided >> lane) & 1)
        chosen &= mask & at_least(reach, splat(singles[k + 88]))
        write_word(
            pairs, _PAIRS + pair_count, numbers[_BITS + chosen] | (0x0808080808080808 * lane)
        )
        pair_count += bit_count(chosen)
        prefetch(corners, 9 * (first + lane))
        prefetch(corners, 9 * (first + lane) + 8)
    # Then halves of vectors whose rays may hit the triangle.
    su_at = 2 * row_at(memory.SU, rays)
    sv_at = 2 * row_at(memory.SV, rays)
    depth_at = 2 * row_at(memory.DEPTH, rays)
    survivors = row_at(memory.SURVIVORS, rays)
    each = rays // SUBTILES
    survivor_count = np.int64(0)
    for pair in range(pair_count):
        subtile = np.int64(pairs[_PAIRS + pair]) & 7
        lane = np.int64(pairs[_PAIRS + pair]) >> 3
        k = _EDGES + lane
        n1 = _splat_three(singles, k)
        n2 = _splat_three(singles, k + 24)
        n0 = _splat_three(singles, k + 48)
        limit = splat(singles[k + 72])
        bias = splat(singles[k + 80])
        rounding = splat(singles[k + 96])
        every = -((undecided >> lane) & 1) & 255
        for i in range(subtile * each, (subtile + 1) * each, 8):
            su = load(singles, su_at + i)
            sv = load(singles, sv_at + i)
            e1 = multiply_add(su, n1[0], multiply_add(sv, n1[1], n1[2]))
            e2 = multiply_add(su, n2[0], multiply_add(sv, n2[1], n2[2]))
            e0 = multiply_add(su, n0[0], multiply_add(sv, n0[1], n0[2]))
            before = multiply_add(load(singles, depth_at + i), (e0 + e1) + (e2 + rounding), bias)
            passing = at_least(lower_of(lower_of(lower_of(e0, e1), e2) + limit, before), zero)
            passing |= every
            numbers[survivors + survivor_count] = i << 8 | lane << 4 | (passing & 15)
            survivor_count += np.int64((passing & 15) != 0)
            numbers[survivors + survivor_count] = (i + 4) << 8 | lane << 4 | passing >> 4
            survivor_count += np.int64(passing > 15)
    # Last, the test in float64 of these.
    eight_at = row_at(memory.AXIS_OF_EIGHT, rays)
    order = int32s(record[8])
    opaque = record[3] == 0
    nested = nested_key >= 0
    instance = max(nested_key, 0)
    changed = np.int64(0)
    for number in range(survivor_count):
        survivor = numbers[survivors + number]
        ray = survivor >> 8
        position = first + ((survivor >> 4) & 15)
        axis = numbers[eight_at + (ray >> 3)]
        if axis >= 0 and opaque:
            key = instance + np.int64(order[position])
            hits = _decide_four(tile, rays, ray, axis, corners, position, key, nested, t_min)
        else:
            hits = np.int64(0)
            left = survivor & 15
            while left != 0:
                lane = lowest_bit(left)
                left &= left - 1
                if _decide_one(tile, rays, ray + lane, mesh, instance, position, t_min):
                    hits = np.int64(1)
        changed |= np.int64(hits != 0) << (ray // each)
    return changed


@inlined
def _put(stack, codes, k, near, code, mask):  # type: ignore[no-untyped-def]
    """Write entry k of a list: depth, code and mask of subtiles."""
    stack[ENTRY * k] = near
    codes[ENTRY * k + 1] = np.int32(code)
    codes[ENTRY * k + 2] = np.int32(mask)


@inlined
def _sort_farthest_first(address, start, stop):  # type: ignore[no-untyped-def]
    """Sort entries `start` to `stop` of a list at an address, the nearest last."""
    stack = float32s(address)
    codes = int32s(address)
    for k in range(start + 1, stop):
        near = stack[ENTRY * k]
        code = codes[ENTRY * k + 1]
        mask = codes[ENTRY * k + 2]
        j = k
        while j > start and stack[ENTRY * (j - 1)] < near:
            _put(
                stack, codes, j, stack[ENTRY * (j - 1)], codes[ENTRY * j - 3], codes[ENTRY * j - 2]
            )
            j -= 1
        _put(stack, codes, j, near, code, mask)


@inlined
def _open_node(tile, address, nodes, blocks, node, mask, deepest, count):  # type: ignore[no-untyped-def]  # noqa: PLR0914 - a compiled loop
    """Add the children of a node that the tile meets to a list, nearest last; return its length.

    `address` is of the list, which has `count` entries; `nodes` and `blocks` of nodes and leaves.
    """
    singles = float32s(tile)
    numbers = int64s(tile)
    stack = float32s(address)
    codes = int32s(address)
    boxes = float32s(nodes)
    children = int32s(nodes)
    base = node * NODE
    inside = splat(_FAR)
    for plane in range(4):
        k = _TILE_PLANES + 4 * plane
        s = _SIDES + 3 * plane
        side = multiply_add(
            splat(singles[k]), load(boxes, base + numbers[s]), splat(singles[k + 3])
        )
        side = multiply_add(splat(singles[k + 1]), load(boxes, base + numbers[s + 1]), side)
        side = multiply_add(splat(singles[k + 2]), load(boxes, base + numbers[s + 2]), side)
        inside = lower_of(side, inside)
    k = _TILE_PLANES + 16
    depth = multiply_add(
        splat(singles[k]), load(boxes, base + numbers[_SIDES + 12]), splat(singles[k + 3])
    )
    depth = multiply_add(splat(singles[k + 1]), load(boxes, base + numbers[_SIDES + 13]), depth)
    depth = multiply_add(splat(singles[k + 2]), load(boxes, base + numbers[_SIDES + 14]), depth)
    zero = splat(_ZERO)
    hit = at_least(inside, zero) & at_least(splat(deepest), depth)
    store(singles, _NEAR, depth)
    reach = load(singles, _REACH)
    start = count
    for _ in range(bit_count(hit)):
        child = lowest_bit(hit)
        hit &= hit - 1
        k = base + child
        lx = splat(boxes[k])
        ly = splat(boxes[k + 8])
        lz = splat(boxes[k + 16])
        hx = splat(boxes[k + 24])
        hy = splat(boxes[k + 32])
        hz = splat(boxes[k + 40])
        inside = splat(_FAR)
        for plane in range(4):
            p = _PLANES + 7 * SUBTILES * plane
            upper = multiply_add(load(singles, p), hx, load(singles, p + 48))
            lower = load(singles, p + 24) * lx
            upper = multiply_add(load(singles, p + 8), hy, upper)
            lower = multiply_add(load(singles, p + 32), ly, lower)
            upper = multiply_add(load(singles, p + 16), hz, upper)
            lower = multiply_add(load(singles, p + 40), lz, lower)
            inside = lower_of(upper + lower, inside)
        near = singles[_NEAR + child]
        subtiles = mask & at_least(inside, zero) & at_least(reach, splat(near))
        code = np.int64(children[k + 48])
        _put(stack, codes, count, near, code, subtiles)
        count += np.int64(subtiles != 0)  # no branch: it would often be mispredicted
        leaf = blocks + 4 * BLOCK * (~code >> LEAF_BITS)
        line = uint8s(nodes + 4 * NODE * code if code >= 0 else leaf)
        for byte in range(0, 4 * BLOCK, 64):
            prefetch(line, byte)
    _sort_farthest_first(address, start, count)
    return count


@part(types.int64(types.int64, types.int64, types.int64, types.int64, types.int64, types.float64))
def _walk(tile, rays, mesh, instance, mask, t_min):  # type: ignore[no-untyped-def]
    """Cast the rays of the subtiles of a mask in a mesh; return whether that was done.

    It is not done if the tile meets more leaves than half of its rays.
    """
    singles = float32s(tile)
    address = int64s(tile)[_STACK]
    stack = float32s(address)
    codes = int32s(address)
    nodes = int64s(mesh)[5]
    blocks = int64s(mesh)[6]
    deepest = highest(load(singles, _REACH))
    leaves = 0
    _put(stack, codes, 0, -_FAR, 0, mask)
    count = np.int64(1)
    while count > 0:
        count -= 1
        near = stack[ENTRY * count]
        code = np.int64(codes[ENTRY * count + 1])
        subtiles = codes[ENTRY * count + 2] & at_least(load(singles, _REACH), splat(near))
        if subtiles == 0:
            continue
        if code >= 0:
            count = _open_node(tile, address, nodes, blocks, code, subtiles, deepest, count)
            continue
        leaves += 1
        if leaves > rays // 2:
            return False
        changed = _test_leaf(tile, rays, mesh, instance, ~code, subtiles, deepest, t_min)
        if changed != 0:
            deepest = _limit_depths(tile, rays, changed)
    return True


@part(types.int64(types.int64, types.int64, types.int64))
def _list_instances(tile, nodes, mask):  # type: ignore[no-untyped-def]
    """Write the instances that a tile may meet, nearest last; return their number.

    `nodes` is the address of the tree over the instances, `mask` of the subtiles to cast.
    """
    singles = float32s(tile)
    numbers = int64s(tile)
    address = numbers[_STACK]
    stack = float32s(address)
    codes = int32s(address)
    met = float32s(numbers[_MET])
    met_codes = int32s(numbers[_MET])
    deepest = highest(load(singles, _REACH))
    _put(stack, codes, 0, -_FAR, 0, mask)
    count = np.int64(1)
    met_count = np.int64(0)
    while count > 0:
        count -= 1
        near = stack[ENTRY * count]
        code = np.int64(codes[ENTRY * count + 1])
        subtiles = codes[ENTRY * count + 2]
        if code >= 0:
            count = _open_node(tile, address, nodes, nodes, code, subtiles, deepest, count)
        else:
            _put(met, met_codes, met_count, near, ~code >> LEAF_BITS, subtiles)
            met_count += 1
    _sort_farthest_first(numbers[_MET], 0, met_count)
    return met_count


@part(types.int64(types.int64, types.int64, types.int64, types.int64))
def _aim(tile, rays, first_row, mask):  # type: ignore[no-untyped-def]
    """Prepare a tile for a traversal in the coordinates of its rays; return whether it is narrow.

    `first_row` is the first of six rows with origins and directions, `mask` of subtiles to cast.
    """
    singles = float32s(tile)
    if _set_axes(tile, rays, first_row) > _MAX_START:
        return False
    if not _flatten(tile, rays, first_row) > _NARROW:
        return False
    _set_planes(tile)
    for subtile in range(SUBTILES):
        singles[_REACH + subtile] = -_FAR
    _limit_depths(tile, rays, mask)
    return True


class _Start(NamedTuple):
    """A ray in float32, from where it enters the box of a scene or mesh.

    Attributes
    ----------
    entry
        Distance of the start from the ray's origin, float64; 0 unless the origin is remote.
    x, y, z, dx, dy, dz
        Start and direction.
    ix, iy, iz
        Reciprocals of the direction.
    near_x, near_y, near_z
        Where in a node the coordinates of its children's nearer sides are.
    undecided
        Whether the start is too inexact to discard triangles: -1 if so, else 0.
    """

    entry: float
    x: float
    y: float
    z: float
    dx: float
    dy: float
    dz: float
    ix: float
    iy: float
    iz: float
    near_x: int
    near_y: int
    near_z: int
    undecided: int


@inlined
def _start_of_ray(floats, k, rays):  # type: ignore[no-untyped-def]
    """Return the `_Start` of a ray, the first of whose six numbers has index k.

    The box of a scene or mesh is within [-1, 1] and its padding.
    """
    ox, oy, oz = floats[k], floats[k + rays], floats[k + 2 * rays]
    dx, dy, dz = floats[k + 3 * rays], floats[k + 4 * rays], floats[k + 5 * rays]
    entry = entry_distance(1 + 2.0**-16, (ox, oy, oz), (dx, dy, dz))
    x = np.float32(min(max(ox + entry * dx, -2.0), 2.0))
    y = np.float32(min(max(oy + entry * dy, -2.0), 2.0))
    z = np.float32(min(max(oz + entry * dz, -2.0), 2.0))
    ix = _ONE / _not_zero(np.float32(dx))
    iy = _ONE / _not_zero(np.float32(dy))
    iz = _ONE / _not_zero(np.float32(dz))
    near_x = np.int64(0 if ix >= 0 else 24)
    near_y = np.int64(8 if iy >= 0 else 32)
    near_z = np.int64(16 if iz >= 0 else 40)
    # So far away, the start is off by more than the margins of the test in float32.
    undecided = np.int64(-1 if entry > _MAX_ENTRY else 0)
    d = np.float32(dx), np.float32(dy), np.float32(dz)
    return _Start(entry, x, y, z, *d, ix, iy, iz, near_x, near_y, near_z, undecided)


@inlined
def _not_zero(component):  # type: ignore[no-untyped-def]
    if abs(component) < _TINY:
        return -_TINY if component < 0 else _TINY
    return component


@inlined
def _limit_of(t, entry):  # type: ignore[no-untyped-def]
    """Return a distance after the entry as float32, never less than the exact distance."""
    return np.float32(min(max((t - entry) * (1 + _SLACK) + _SLACK, -_ACROSS), _ACROSS))


@inlined
def _slab(boxes, base, near_at, axis, inverse, start):  # type: ignore[no-untyped-def]
    """Return the distances at which a ray meets the nearer and the farther side of eight boxes."""
    far_at = (24 + 16 * axis) - near_at
    factor = splat(inverse)
    shift = splat(start * inverse)
    return (
        load(boxes, base + near_at) * factor - shift,
        load(boxes, base + far_at) * factor - shift,
    )


@inlined
def _open_node_for_one(tile, address, nodes, node, start, limit, count):  # type: ignore[no-untyped-def]  # noqa: PLR0914 - a compiled loop
    """Add the children of a node that a ray meets to a list, nearest last; return its length.

    `address` is of the list, which has `count` entries, `nodes` of the nodes, `limit` the distance
    at which the ray ends.
    """
    singles = float32s(tile)
    stack = float32s(address)
    codes = int32s(address)
    boxes = float32s(nodes)
    children = int32s(nodes)
    base = node * NODE
    near_x, far_x = _slab(boxes, base, start.near_x, 0, start.ix, start.x)
    near_y, far_y = _slab(boxes, base, start.near_y, 1, start.iy, start.y)
    near_z, far_z = _slab(boxes, base, start.near_z, 2, start.iz, start.z)
    near = higher_of(higher_of(near_x, near_y), higher_of(near_z, splat(_ZERO)))
    far = lower_of(lower_of(far_x, far_y), lower_of(far_z, splat(limit)))
    hit = at_least(far, near)
    store(singles, _NEAR, near)
    first = count
    while hit != 0:
        child = lowest_bit(hit)
        hit &= hit - 1
        stack[ENTRY * count] = singles[_NEAR + child]
        codes[ENTRY * count + 1] = children[base + 48 + child]
        count += 1
    if count == first + 2:
        # Mostly there are one or two, and which is nearer cannot be predicted.
        k = ENTRY * first
        here, there = stack[k], stack[k + ENTRY]
        one, other = codes[k + 1], codes[k + ENTRY + 1]
        swap = here < there
        stack[k] = there if swap else here
        stack[k + ENTRY] = here if swap else there
        codes[k + 1] = other if swap else one
        codes[k + ENTRY + 1] = one if swap else other
    elif count > first + 2:
        _sort_farthest_first(address, first, count)
    return count


@inlined
def _test_leaf_by_one(tile, rays, ray, mesh, instance, code, start, t_min):  # type: ignore[no-untyped-def]  # noqa: PLR0914 - a compiled loop
    """Test the triangles of a leaf and a ray; return whether it has a closer hit."""
    record = int64s(mesh)
    blocks = float32s(record[6])
    block = (code >> LEAF_BITS) * BLOCK
    ax = load(blocks, block) - splat(start.x)
    ay = load(blocks, block + 8) - splat(start.y)
    az = load(blocks, block + 16) - splat(start.z)
    e = load(blocks, block + 24), load(blocks, block + 32), load(blocks, block + 40)
    f = load(blocks, block + 48), load(blocks, block + 56), load(blocks, block + 64)
    d = splat(start.dx), splat(start.dy), splat(start.dz)
    moment = _cross((ax, ay, az), d)
    normal = _cross(e, f)
    n1 = _dot(f[0], f[1], f[2], moment[0], moment[1], moment[2])
    n2 = splat(_ZERO) - _dot(e[0], e[1], e[2], moment[0], moment[1], moment[2])
    n0 = (_dot(normal[0], normal[1], normal[2], d[0], d[1], d[2]) - n1) - n2
    size = _norm(e) + _norm(f)
    distance = splat(_ONE) + _norm((ax, ay, az))
    margin = multiply_add(splat(_EDGE) * distance, size, splat(_FLOOR))
    positive = at_least(lower_of(lower_of(n0, n1), n2) + margin, splat(_ZERO))
    negative = at_least(margin, higher_of(higher_of(n0, n1), n2))
    left = (positive | negative | start.undecided) & ((2 << (code & _LEAF_MASK)) - 1)
    first = np.int64(int32s(record[6])[block + 72])
    closer = np.int64(0)
    while left != 0:
        lane = lowest_bit(left)
        left &= left - 1
        closer |= np.int64(_decide_one(tile, rays, ray, mesh, instance, first + lane, t_min))
    return closer


@part(
    types.void(
        types.int64,
        types.int64,
        types.int64,
        types.int64,
        types.int64,
        types.int64,
        types.int64,
        types.float64,
    )
)
def _walk_by_one(tile, rays, ray, first_row, mesh, instance, waiting, t_min):  # type: ignore[no-untyped-def]
    """Cast a ray in a mesh; the list of nodes has `waiting` entries of the tree above."""
    floats = float64s(tile)
    address = int64s(tile)[_STACK]
    stack = float32s(address)
    codes = int32s(address)
    nodes = int64s(mesh)[5]
    start = _start_of_ray(floats, row_at(first_row, rays) + ray, rays)
    entry = start.entry
    t_at = row_at(T, rays) + ray
    length = floats[row_at(LENGTH, rays) + ray]
    limit = _limit_of(floats[t_at] * length, entry)
    _put(stack, codes, waiting, _ZERO, 0, 0)
    count = waiting + 1
    while count > waiting:
        count -= 1
        if stack[ENTRY * count] > limit:
            continue
        code = np.int64(codes[ENTRY * count + 1])
        if code >= 0:
            count = _open_node_for_one(tile, address, nodes, code, start, limit, count)
        elif _test_leaf_by_one(tile, rays, ray, mesh, instance, ~code, start, t_min):
            limit = _limit_of(floats[t_at] * length, entry)


@stage
def _enter(tile, rays, ray, instance):  # type: ignore[no-untyped-def]
    """Write a ray in the coordinates of the mesh of an instance, whose record is at an address."""
    floats = float64s(tile)
    numbers = int64s(tile)
    k = row_at(OX, rays) + ray
    i = row_at(IX, rays) + ray
    ox, oy, oz, dx, dy, dz, length = enter_instance(
        float64s(instance),
        floats[k],
        floats[k + rays],
        floats[k + 2 * rays],
        floats[k + 3 * rays],
        floats[k + 4 * rays],
        floats[k + 5 * rays],
    )
    floats[i] = ox
    floats[i + rays] = oy
    floats[i + 2 * rays] = oz
    floats[i + 3 * rays] = dx
    floats[i + 4 * rays] = dy
    floats[i + 5 * rays] = dz
    floats[row_at(LENGTH, rays) + ray] = length
    axis, u, v, w, sx, sy, sz = shear(ox, oy, oz, dx, dy, dz)
    numbers[row_at(AXIS, rays) + ray] = axis
    i = row_at(U, rays) + ray
    floats[i] = u
    floats[i + rays] = v
    floats[i + 2 * rays] = w
    floats[i + 3 * rays] = sx
    floats[i + 4 * rays] = sy
    floats[i + 5 * rays] = sz


@part(types.void(types.int64, types.int64, types.int64, types.int64, types.int64, types.float64))
def _walk_instances_by_one(tile, rays, ray, nodes, instances, t_min):  # type: ignore[no-untyped-def]
    """Cast a ray at all instances; `nodes` is the address of the tree over these."""
    floats = float64s(tile)
    numbers = int64s(tile)
    address = numbers[_STACK]
    stack = float32s(address)
    codes = int32s(address)
    start = _start_of_ray(floats, row_at(OX, rays) + ray, rays)
    t_at = row_at(T, rays) + ray
    _put(stack, codes, 0, _ZERO, 0, 0)
    count = np.int64(1)
    while count > 0:
        count -= 1
        limit = _limit_of(floats[t_at], start.entry)
        if stack[ENTRY * count] > limit:
            continue
        code = np.int64(codes[ENTRY * count + 1])
        if code >= 0:
            count = _open_node_for_one(tile, address, nodes, code, start, limit, count)
            continue
        number = ~code >> LEAF_BITS
        record = instances + INSTANCE_BYTES * number
        _enter(tile, rays, ray, record)
        mesh = int64s(record)[MESH_FIELD]
        key = KEYS_PER_INSTANCE * number
        _walk_by_one(tile, rays, ray, IX, mesh, key, count, t_min)


@stage
def _cast_in_mesh(tile, rays, first_row, mesh, instance, mask, t_min):  # type: ignore[no-untyped-def]
    """Cast the rays of the subtiles of a mask in a mesh, as a tile or one by one.

    After a tile that was too wide or met too many leaves, its neighbours are cast one by one; then
    tiles are tried again. The shear of the rays is written. `first_row` is the first row of the rays in the mesh's
    coordinates.
    """
    numbers = int64s(tile)
    if numbers[_SKIPS] > 0:
        numbers[_SKIPS] -= 1
    elif (
        _aim(tile, rays, first_row, mask) != 0
        and _walk(tile, rays, mesh, instance, mask, t_min) != 0
    ):
        numbers[_PATIENCE] = 0
        return
    else:
        numbers[_PATIENCE] = min(2 * numbers[_PATIENCE] + 1, _MAX_SKIPS)
        numbers[_SKIPS] = numbers[_PATIENCE]
    floats = float64s(tile)
    each = rays // SUBTILES
    t_at = row_at(T, rays)
    for ray in range(rays):
        if (mask >> (ray // each)) & 1 and floats[t_at + ray] >= 0:
            _walk_by_one(tile, rays, ray, first_row, mesh, max(instance, 0), 0, t_min)


@part(types.void(types.int64, types.int64, types.int64))
def _enter_all(tile, rays, instance):  # type: ignore[no-untyped-def]  # noqa: PLR0914 - a compiled loop
    """Write all rays in the coordinates of the mesh of an instance, as `enter_instance`."""
    floats = float64s(tile)
    m = float64s(instance)
    k = row_at(OX, rays)
    i = row_at(IX, rays)
    length_at = row_at(LENGTH, rays)
    for ray in range(0, rays, 4):
        dx = load(floats, k + 3 * rays + ray)
        dy = load(floats, k + 4 * rays + ray)
        dz = load(floats, k + 5 * rays + ray)
        x = (splat(m[0]) * dx + splat(m[1]) * dy) + splat(m[2]) * dz
        y = (splat(m[4]) * dx + splat(m[5]) * dy) + splat(m[6]) * dz
        z = (splat(m[8]) * dx + splat(m[9]) * dy) + splat(m[10]) * dz
        length = square_root((x * x + y * y) + z * z)
        store(floats, length_at + ray, length)
        store(floats, i + 3 * rays + ray, x / length)
        store(floats, i + 4 * rays + ray, y / length)
        store(floats, i + 5 * rays + ray, z / length)
        ox = load(floats, k + ray)
        oy = load(floats, k + rays + ray)
        oz = load(floats, k + 2 * rays + ray)
        u = ((splat(m[0]) * ox + splat(m[1]) * oy) + splat(m[2]) * oz) + splat(m[3])
        v = ((splat(m[4]) * ox + splat(m[5]) * oy) + splat(m[6]) * oz) + splat(m[7])
        w = ((splat(m[8]) * ox + splat(m[9]) * oy) + splat(m[10]) * oz) + splat(m[11])
        store(floats, i + ray, u)
        store(floats, i + rays + ray, v)
        store(floats, i + 2 * rays + ray, w)


@stage
def _before(tile, rays, near, mask):  # type: ignore[no-untyped-def]
    """Return the subtiles of a mask with a ray that reaches a depth along the scene's axis m."""
    floats = float64s(tile)
    t_at = row_at(T, rays)
    each = rays // SUBTILES
    left = np.int64(0)
    for subtile in range(SUBTILES):
        farthest = splat(-1e30)
        for k in range(subtile * each, (subtile + 1) * each, 4):
            farthest = higher_of(farthest, load(floats, t_at + k))
        left |= np.int64(highest(farthest) * (1 + _SLACK) + _SLACK >= near) << subtile
    return mask & left


@part(
    types.void(
        types.int64, types.int64, types.int64, types.int64, types.int64, types.int64, types.float64
    )
)
def cast_tile(tile, rays, mesh, instances, top, last, t_min):  # type: ignore[no-untyped-def]
    """Write the closest hits of a tile to its rows `T` and `KEY`, which have reaches and -1.

    `instances` and `top` are addresses of the `INSTANCE` records and of the tree over these, 0 for
    a single mesh without a transform. Rays from number `last` on are copies.
    """
    numbers = int64s(tile)
    singles = float32s(tile)
    each = rays // SUBTILES
    mask = (np.int64(1) << ((last + each - 1) // each)) - 1
    few = last <= _FEW
    if instances == 0:
        _shear_rays(tile, rays, OX)
        if few:
            for ray in range(last):
                _walk_by_one(tile, rays, ray, OX, mesh, 0, 0, t_min)
        else:
            _cast_in_mesh(tile, rays, OX, mesh, -1, mask, t_min)
        return
    if few or _aim(tile, rays, OX, mask) == 0:
        for ray in range(last):
            if float64s(tile)[row_at(T, rays) + ray] >= 0:
                _walk_instances_by_one(tile, rays, ray, top, instances, t_min)
        return
    slack = np.float64(singles[_OFFSET] + singles[_OFFSET] + singles[_PADDING])
    count = _list_instances(tile, top, mask)
    met = float32s(numbers[_MET])
    codes = int32s(numbers[_MET])
    while count > 0:
        count -= 1
        subtiles = _before(
            tile, rays, np.float64(met[ENTRY * count]) - slack, np.int64(codes[ENTRY * count + 2])
        )
        if subtiles == 0:
            continue
        number = np.int64(codes[ENTRY * count + 1])
        record = instances + INSTANCE_BYTES * number
        _enter_all(tile, rays, record)
        _shear_rays(tile, rays, IX)
        mesh = int64s(record)[MESH_FIELD]
        _cast_in_mesh(tile, rays, IX, mesh, KEYS_PER_INSTANCE * number, subtiles, t_min)
