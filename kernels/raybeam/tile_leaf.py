"""Intersect a tile's rays with the triangles in a leaf.

In the coordinates of a tile, a triangle consists of three linear functions of (su, sv), which are
computed for the eight triangles of a leaf at a time. If the maximum of one of these functions over
a range of (su, sv) is negative, the triangle is discarded for a tile or a subtile. The float32 test
for eight rays takes six multiply-adds and a comparison with the depth so far. The remaining
candidates are tested in float64.
"""

from __future__ import annotations

import numpy as np
from numba import types

from . import tile_memory as memory
from .cast_record import (
    BLOCKS,
    LEAF_CORNERS,
    MASK_HEIGHT,
    ORDER,
    float32s,
    float64s,
    int32s,
    int64s,
    uint8s,
)
from .compiled import INT64, called_by_address, inlined
from .tile_exact import intersect_four_rays, intersect_ray
from .tile_frame import ONE, ZERO, cross, dot, tile_axes, to_tile_axes
from .tile_memory import field_index, row_index
from .tile_sizes import SUBTILES
from .tile_tree import BLOCK
from .tree import LEAF_BITS
from .vectors import (
    absolute,
    bit_count,
    copy_sign,
    greater_equal,
    load,
    lowest_bit,
    maximum,
    minimum,
    multiply_add,
    prefetch,
    splat,
    store,
    store_int64,
)

_AXES = field_index("axes")
_PADDING = field_index("padding")
_OFFSET = field_index("offset")
_SPREAD = field_index("spread")
_BOUNDS = field_index("bounds")
_TILE_BOUNDS = field_index("tile_bounds")
_REACH = field_index("reach")
_EDGES = field_index("edges")
_PAIRS = field_index("pairs")
_BITS = field_index("bits")
EDGE = np.float32(48 * 2.0**-24)
FLOOR = np.float32(1e-35)
LEAF_MASK = (1 << LEAF_BITS) - 1


@inlined
def _leaf_edges(singles, blocks, block):  # type: ignore[no-untyped-def]
    """Return the first vertex of each triangle relative to the tile's point, and two edges.

    All vectors are in the axes of the tile.
    """
    axes = tile_axes(singles)
    x = load(blocks, block) - splat(singles[_AXES + 9])
    y = load(blocks, block + 8) - splat(singles[_AXES + 10])
    z = load(blocks, block + 16) - splat(singles[_AXES + 11])
    a = to_tile_axes(axes, x, y, z)
    e = to_tile_axes(
        axes, load(blocks, block + 24), load(blocks, block + 32), load(blocks, block + 40)
    )
    f = to_tile_axes(
        axes, load(blocks, block + 48), load(blocks, block + 56), load(blocks, block + 64)
    )
    return a, e, f


@inlined
def l1_norm(a):  # type: ignore[no-untyped-def]
    """Return the L1 norm of each vector, given as components."""
    return (absolute(a[0]) + absolute(a[1])) + absolute(a[2])


@inlined
def _max_over_bounds(normal, bounds):  # type: ignore[no-untyped-def]
    """Return the maximum of a linear function of su and sv over a rectangle."""
    nu, nv, nm = normal
    low_u, high_u, low_v, high_v = bounds
    return (nm + maximum(nu * low_u, nu * high_u)) + maximum(nv * low_v, nv * high_v)


@inlined
def _splat_three(singles, k):  # type: ignore[no-untyped-def]
    return splat(singles[k]), splat(singles[k + 8]), splat(singles[k + 16])


@called_by_address(types.int64(*6 * INT64, types.float32))
def test_leaf(tile, rays, mesh, instance, code, mask, deepest):  # type: ignore[no-untyped-def]  # noqa: PLR0914, PLR0915 - a compiled loop
    """Test the rays in selected subtiles against the triangles in a leaf.

    Return the mask of subtiles with closer hits. `code` is the code of the leaf, `deepest` is the
    maximum depth that a ray reaches, and `instance` is the index of the instance times
    `KEYS_PER_INSTANCE`.
    """
    singles = float32s(tile)
    numbers = int64s(tile)
    pairs = uint8s(tile)
    record = int64s(mesh)
    blocks = float32s(record[BLOCKS])
    block = (code >> LEAF_BITS) * BLOCK
    a, e, f = _leaf_edges(singles, blocks, block)
    n1 = cross(f, a)
    n2 = cross(a, e)
    n = cross(e, f)
    zero = splat(ZERO)
    volume = dot(n[0], n[1], n[2], a[0], a[1], a[2])
    size = l1_norm(e) + l1_norm(f)
    floor = splat(FLOOR)
    rounding = multiply_add(splat(EDGE * singles[_SPREAD]) * (splat(ONE) + l1_norm(a)), size, floor)
    offset = splat(singles[_OFFSET] * singles[_SPREAD])
    margin = multiply_add(offset, size, rounding)
    volume_margin = multiply_add(rounding, size, multiply_add(offset, l1_norm(n), floor))
    undecided = greater_equal(volume_margin, absolute(volume))
    sign = copy_sign(splat(ONE), volume)  # so that areas are positive for rays in front
    n1 = n1[0] * sign, n1[1] * sign, n1[2] * sign
    n2 = n2[0] * sign, n2[1] * sign, n2[2] * sign
    n = n[0] * sign, n[1] * sign, n[2] * sign
    n0 = n[0] - n1[0] - n2[0], n[1] - n1[1] - n2[1], n[2] - n1[2] - n2[2]
    depth = minimum(minimum(a[2], a[2] + e[2]), a[2] + f[2])
    depth = depth - splat(singles[_PADDING] + np.float32(2) * singles[_OFFSET])
    k = _TILE_BOUNDS
    bounds = (
        splat(singles[k]),
        splat(singles[k + 1]),
        splat(singles[k + 2]),
        splat(singles[k + 3]),
    )
    least = minimum(
        minimum(_max_over_bounds(n0, bounds), _max_over_bounds(n1, bounds)),
        _max_over_bounds(n2, bounds),
    )
    hit = greater_equal(least + margin, zero) | undecided
    hit &= greater_equal(splat(deepest), depth) & ((2 << (code & LEAF_MASK)) - 1)
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
    first = np.int64(int32s(record[BLOCKS])[block + 72])
    corners = float64s(record[LEAF_CORNERS])
    # Three loops over lists are faster than nested loops with branches, because a mispredicted
    # branch costs as much as the test of 24 rays. The first loop lists pairs of a triangle and a
    # subtile.
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
        least = minimum(
            minimum(
                _max_over_bounds(_splat_three(singles, k), bounds),
                _max_over_bounds(_splat_three(singles, k + 24), bounds),
            ),
            _max_over_bounds(_splat_three(singles, k + 48), bounds),
        )
        chosen = greater_equal(least + splat(singles[k + 72]), zero) | -((undecided >> lane) & 1)
        chosen &= mask & greater_equal(reach, splat(singles[k + 88]))
        store_int64(
            pairs, _PAIRS + pair_count, numbers[_BITS + chosen] | (0x0808080808080808 * lane)
        )
        pair_count += bit_count(chosen)
        prefetch(corners, 9 * (first + lane))
        prefetch(corners, 9 * (first + lane) + 8)
    # The second loop lists groups of four rays that may hit a triangle.
    su_at = 2 * row_index(memory.SU, rays)
    sv_at = 2 * row_index(memory.SV, rays)
    depth_at = 2 * row_index(memory.DEPTH, rays)
    survivors = row_index(memory.SURVIVORS, rays)
    each = rays // SUBTILES
    survivor_count = np.int64(0)
    for number in range(pair_count):
        pair = np.int64(pairs[_PAIRS + number])
        subtile = pair & 7
        triangle = pair >> 3
        edges = _EDGES + triangle
        n1 = _splat_three(singles, edges)
        n2 = _splat_three(singles, edges + 24)
        n0 = _splat_three(singles, edges + 48)
        limit = splat(singles[edges + 72])
        bias = splat(singles[edges + 80])
        rounding = splat(singles[edges + 96])
        every = -((undecided >> triangle) & 1) & 255
        for i in range(subtile * each, (subtile + 1) * each, 8):
            su = load(singles, su_at + i)
            sv = load(singles, sv_at + i)
            e1 = multiply_add(su, n1[0], multiply_add(sv, n1[1], n1[2]))
            e2 = multiply_add(su, n2[0], multiply_add(sv, n2[1], n2[2]))
            e0 = multiply_add(su, n0[0], multiply_add(sv, n0[1], n0[2]))
            before = multiply_add(load(singles, depth_at + i), (e0 + e1) + (e2 + rounding), bias)
            passing = greater_equal(minimum(minimum(minimum(e0, e1), e2) + limit, before), zero)
            passing |= every
            numbers[survivors + survivor_count] = i << 8 | triangle << 4 | (passing & 15)
            survivor_count += np.int64((passing & 15) != 0)
            numbers[survivors + survivor_count] = (i + 4) << 8 | triangle << 4 | passing >> 4
            survivor_count += np.int64(passing > 15)
    # The third loop tests these rays in float64.
    eight_at = row_index(memory.AXIS_OF_EIGHT, rays)
    order = int32s(record[ORDER])
    opaque = record[MASK_HEIGHT] == 0
    changed = np.int64(0)
    for number in range(survivor_count):
        survivor = numbers[survivors + number]
        ray = survivor >> 8
        position = first + ((survivor >> 4) & 15)
        axis = numbers[eight_at + (ray >> 3)]
        if axis >= 0 and opaque:
            key = instance + np.int64(order[position])
            hits = intersect_four_rays(
                tile, rays, ray, axis=axis, corners=corners, position=position, key=key
            )
        else:
            hits = np.int64(0)
            left = survivor & 15
            while left != 0:
                lane = lowest_bit(left)
                left &= left - 1
                if intersect_ray(tile, rays, ray + lane, mesh, instance, position):
                    hits = np.int64(1)
        changed |= np.int64(hits != 0) << (ray // each)
    return changed
