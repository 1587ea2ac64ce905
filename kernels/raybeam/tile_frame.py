"""Set up the coordinate system of a tile, and express the tile's rays and sides in it.

A ray becomes a point (su, sv) on a plane perpendicular to the tile's mean direction m. In the axes
(u, v, m), the direction of the ray is (su, sv, 1), scaled so that its component along m is 1.
tile_loops.py describes the margins and the parameters.
"""

from __future__ import annotations

import numpy as np
from numba import types

from . import tile_memory as memory
from .cast_record import float32s, float64s, int64s
from .compiled import INT64, called_by_address, inlined, noinline
from .tile_memory import LENGTH, T, field_index, row_index
from .tile_sizes import SUBTILES
from .vectors import (
    absolute,
    load,
    max_lane,
    maximum,
    min_lane,
    minimum,
    multiply_add,
    splat,
    store,
    to_float32,
)

_AXES = field_index("axes")
_PADDING = field_index("padding")
_OFFSET = field_index("offset")
_SPREAD = field_index("spread")
_BOUNDS = field_index("bounds")
_TILE_BOUNDS = field_index("tile_bounds")
_REACH = field_index("reach")
_PLANES = field_index("planes")
_TILE_PLANES = field_index("tile_planes")
_SIDES = field_index("sides")
_SUMS = field_index("sums")
ZERO = np.float32(0)
ONE = np.float32(1)
FAR = np.float32(1e30)
_UNIT = 2.0**-24
_SIDE = np.float32(64 * _UNIT)
_REACH_FACTOR = np.float32(1 + 2.0**-19)
_REACH_MARGIN = np.float32(2.0**-19)
_NARROW = np.float32(0.6)  # minimum cosine of the angle between m and the rays of a tile
_MAX_START = 64.0  # Rays that start farther away, in local units, are cast one by one.


@inlined
def dot(ax, ay, az, bx, by, bz):  # type: ignore[no-untyped-def]
    """Return the dot products of two lists of vectors, given as components."""
    return multiply_add(ax, bx, multiply_add(ay, by, az * bz))


@inlined
def cross(a, b):  # type: ignore[no-untyped-def]
    """Return the cross products of two lists of vectors, given as components."""
    ax, ay, az = a
    bx, by, bz = b
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@inlined
def tile_axes(singles):  # type: ignore[no-untyped-def]
    """Return the tile axes u, v, and m. Each component is a vector that repeats one number."""
    k = _AXES
    u = splat(singles[k]), splat(singles[k + 1]), splat(singles[k + 2])
    v = splat(singles[k + 3]), splat(singles[k + 4]), splat(singles[k + 5])
    m = splat(singles[k + 6]), splat(singles[k + 7]), splat(singles[k + 8])
    return u, v, m


@inlined
def to_tile_axes(axes, x, y, z):  # type: ignore[no-untyped-def]
    """Return the components of vectors along the tile axes."""
    u, v, m = axes
    return (
        dot(x, y, z, u[0], u[1], u[2]),
        dot(x, y, z, v[0], v[1], v[2]),
        dot(x, y, z, m[0], m[1], m[2]),
    )


@inlined
def _load_eight(floats, k):  # type: ignore[no-untyped-def]
    return to_float32(load(floats, k), load(floats, k + 4))


@noinline
def _write_axes(tile, rays, first_row):  # type: ignore[no-untyped-def]
    """Write a tile's axes and reference point, and return the point's largest coordinate.

    `first_row` is the first of six rows with origins and directions.
    """
    singles = float32s(tile)
    floats = float64s(tile)
    direction = row_index(first_row + 3, rays)
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
    _set_frame(singles, x, y, z)
    start = 0.0
    for axis in range(3):
        origin = row_index(first_row + axis, rays)
        o = 0.5 * floats[origin] + 0.5 * floats[origin + rays - 1]
        singles[_AXES + 9 + axis] = np.float32(o)
        start = max(start, abs(o))
    return start


@inlined
def _set_frame(singles, x, y, z):  # type: ignore[no-untyped-def]
    """Write three orthonormal axes, the last of which has the given direction."""
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


@noinline
def _project_rays(tile, rays, first_row):  # type: ignore[no-untyped-def]  # noqa: PLR0914, PLR0915 - a compiled loop
    """Project the rays of a tile onto its axes, and write the results and their bounds.

    The results are su, sv, and the depth of each ray. Return the smallest cosine of the angle
    between a ray and the axis m. The field `offset` is also written. To compute it, each ray is
    compared with the ray that has the same (su, sv) but starts at the tile's point. The offset is
    the maximum, over all rays, of the distance between these two rays across m plus the distance
    between their origins along m.
    """
    singles = float32s(tile)
    floats = float64s(tile)
    axes = tile_axes(singles)
    origin = row_index(first_row, rays)
    direction = row_index(first_row + 3, rays)
    su_at = 2 * row_index(memory.SU, rays)
    sv_at = 2 * row_index(memory.SV, rays)
    dm_at = 2 * row_index(memory.DM, rays)
    wm_at = 2 * row_index(memory.WM, rays)
    px = splat(np.float64(singles[_AXES + 9]))
    py = splat(np.float64(singles[_AXES + 10]))
    pz = splat(np.float64(singles[_AXES + 11]))
    one = splat(ONE)
    offset = splat(ZERO)
    cosine = splat(ONE)
    each = rays // SUBTILES
    for subtile in range(SUBTILES):
        low_u = splat(FAR)
        high_u = splat(-FAR)
        low_v = splat(FAR)
        high_v = splat(-FAR)
        for k in range(subtile * each, (subtile + 1) * each, 8):
            i = direction + k
            du, dv, dm = to_tile_axes(
                axes,
                _load_eight(floats, i),
                _load_eight(floats, i + rays),
                _load_eight(floats, i + 2 * rays),
            )
            cosine = minimum(cosine, dm)
            inverse = one / dm
            su = du * inverse
            sv = dv * inverse
            store(singles, su_at + k, su)
            store(singles, sv_at + k, sv)
            store(singles, dm_at + k, dm)
            low_u = minimum(low_u, su)
            high_u = maximum(high_u, su)
            low_v = minimum(low_v, sv)
            high_v = maximum(high_v, sv)
            i = origin + k
            wu, wv, wm = to_tile_axes(
                axes,
                to_float32(load(floats, i) - px, load(floats, i + 4) - px),
                to_float32(load(floats, i + rays) - py, load(floats, i + rays + 4) - py),
                to_float32(load(floats, i + 2 * rays) - pz, load(floats, i + 2 * rays + 4) - pz),
            )
            store(singles, wm_at + k, wm)
            across = absolute(wu - wm * su) + absolute(wv - wm * sv)
            offset = maximum(offset, across + absolute(wm))
        singles[_BOUNDS + subtile] = min_lane(low_u)
        singles[_BOUNDS + SUBTILES + subtile] = max_lane(high_u)
        singles[_BOUNDS + 2 * SUBTILES + subtile] = min_lane(low_v)
        singles[_BOUNDS + 3 * SUBTILES + subtile] = max_lane(high_v)
    singles[_TILE_BOUNDS] = min_lane(load(singles, _BOUNDS))
    singles[_TILE_BOUNDS + 1] = max_lane(load(singles, _BOUNDS + SUBTILES))
    singles[_TILE_BOUNDS + 2] = min_lane(load(singles, _BOUNDS + 2 * SUBTILES))
    singles[_TILE_BOUNDS + 3] = max_lane(load(singles, _BOUNDS + 3 * SUBTILES))
    singles[_OFFSET] = max_lane(offset)
    return min_lane(cosine)


@noinline
def _set_planes(tile):  # type: ignore[no-untyped-def]  # noqa: PLR0914, PLR0915 - a compiled loop
    """Write the side planes of a tile and of its subtiles. Also write the depth margin."""
    singles = float32s(tile)
    numbers = int64s(tile)
    u, v, m = tile_axes(singles)
    ox = splat(singles[_AXES + 9])
    oy = splat(singles[_AXES + 10])
    oz = splat(singles[_AXES + 11])
    zero = splat(ZERO)
    b = _TILE_BOUNDS
    spread = (
        ONE
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
            sign = splat(ONE if plane % 2 == 0 else -ONE)
            bound = load(singles, _BOUNDS + SUBTILES * plane)
            nx = (x - bound * m[0]) * sign
            ny = (y - bound * m[1]) * sign
            nz = (z - bound * m[2]) * sign
            k = _PLANES + 7 * SUBTILES * plane
            store(singles, k, maximum(nx, zero))
            store(singles, k + 8, maximum(ny, zero))
            store(singles, k + 16, maximum(nz, zero))
            store(singles, k + 24, minimum(nx, zero))
            store(singles, k + 32, minimum(ny, zero))
            store(singles, k + 40, minimum(nz, zero))
            store(singles, k + 48, slack - dot(nx, ny, nz, ox, oy, oz))
            bound = splat(singles[_TILE_BOUNDS + plane])
            nx = (x - bound * m[0]) * sign
            ny = (y - bound * m[1]) * sign
            nz = (z - bound * m[2]) * sign
            constant = slack
        constant = constant - dot(nx, ny, nz, ox, oy, oz)
        x1 = min_lane(nx)
        y1 = min_lane(ny)
        z1 = min_lane(nz)
        k = _TILE_PLANES + 4 * plane
        singles[k] = x1
        singles[k + 1] = y1
        singles[k + 2] = z1
        singles[k + 3] = min_lane(constant)
        far = plane < 4  # A side needs the farthest corner of a box, and the depth the nearest.
        numbers[_SIDES + 3 * plane] = 24 if (x1 >= 0) == far else 0
        numbers[_SIDES + 3 * plane + 1] = 32 if (y1 >= 0) == far else 8
        numbers[_SIDES + 3 * plane + 2] = 40 if (z1 >= 0) == far else 16


@called_by_address(types.float32(*3 * INT64))
def update_depths(tile, rays, subtiles):  # type: ignore[no-untyped-def]  # noqa: PLR0914 - a compiled loop
    """Update the maximum depths of subtiles, and return the maximum depth of the tile.

    `subtiles` is the mask of the subtiles to update. Depths are rounded up.
    """
    singles = float32s(tile)
    floats = float64s(tile)
    t_at = row_index(T, rays)
    length_at = row_index(LENGTH, rays)
    dm_at = 2 * row_index(memory.DM, rays)
    wm_at = 2 * row_index(memory.WM, rays)
    depth_at = 2 * row_index(memory.DEPTH, rays)
    far = splat(1e30)
    factor = splat(_REACH_FACTOR)
    margin = splat(_REACH_MARGIN + np.float32(2) * singles[_PADDING])
    each = rays // SUBTILES
    for subtile in range(SUBTILES):
        if (subtiles >> subtile) & 1 == 0:
            continue
        greatest = splat(-FAR)
        for k in range(subtile * each, (subtile + 1) * each, 8):
            first = minimum(load(floats, t_at + k) * load(floats, length_at + k), far)
            second = minimum(load(floats, t_at + k + 4) * load(floats, length_at + k + 4), far)
            along = to_float32(first, second) * load(singles, dm_at + k)
            depth = multiply_add(along, factor, load(singles, wm_at + k) + margin)
            store(singles, depth_at + k, depth)
            greatest = maximum(greatest, depth)
        singles[_REACH + subtile] = max_lane(greatest)
    return max_lane(load(singles, _REACH))


@called_by_address(types.int64(*4 * INT64))
def prepare_tile(tile, rays, first_row, mask):  # type: ignore[no-untyped-def]
    """Set up the coordinate system of a tile and its rays, and return whether it is usable.

    A tile is not usable if its rays diverge too much or start too far away. `first_row` is the
    first of six rows with origins and directions, and `mask` contains the subtiles to cast.
    """
    singles = float32s(tile)
    if _write_axes(tile, rays, first_row) > _MAX_START:
        return False
    if not _project_rays(tile, rays, first_row) > _NARROW:
        return False
    _set_planes(tile)
    for subtile in range(SUBTILES):
        singles[_REACH + subtile] = -FAR
    update_depths(tile, rays, mask)
    return True
