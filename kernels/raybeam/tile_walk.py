"""Traversal of a tree by the rays in a tile.

For each node, the boxes of its eight children are tested against the tile, and those that remain
are tested against the eight subtiles at once. A box is outside the tile or a subtile if it is
outside one of its four sides.
"""

from __future__ import annotations

import numpy as np
from numba import types

from .cast_record import BLOCKS, NODES, float32s, int32s, int64s, uint8s
from .compiled import INT64, called_by_address, inlined, noinline
from .tile_frame import FAR, ZERO, update_depths
from .tile_leaf import test_leaf
from .tile_memory import ENTRY, field_index
from .tile_sizes import SUBTILES
from .tile_tree import BLOCK, NODE
from .tree import LEAF_BITS
from .vectors import (
    bit_count,
    greater_equal,
    load,
    lowest_bit,
    max_lane,
    minimum,
    multiply_add,
    prefetch,
    splat,
    store,
)

_REACH = field_index("reach")
_PLANES = field_index("planes")
_TILE_PLANES = field_index("tile_planes")
_NEAR = field_index("near")
_SIDES = field_index("sides")
_STACK = field_index("stack")
_MET = field_index("met")


@inlined
def write_entry(stack, codes, k, near, code, mask):  # type: ignore[no-untyped-def]
    """Write entry `k` of a list: its depth, its code, and its mask of subtiles."""
    stack[ENTRY * k] = near
    codes[ENTRY * k + 1] = np.int32(code)
    codes[ENTRY * k + 2] = np.int32(mask)


@inlined
def sort_farthest_first(address, start, stop):  # type: ignore[no-untyped-def]
    """Sort entries `start` to `stop` of a list so that the closest one is last.

    `address` is the address of the list.
    """
    stack = float32s(address)
    codes = int32s(address)
    for k in range(start + 1, stop):
        near = stack[ENTRY * k]
        code = codes[ENTRY * k + 1]
        mask = codes[ENTRY * k + 2]
        j = k
        while j > start and stack[ENTRY * (j - 1)] < near:
            write_entry(
                stack, codes, j, stack[ENTRY * (j - 1)], codes[ENTRY * j - 3], codes[ENTRY * j - 2]
            )
            j -= 1
        write_entry(stack, codes, j, near, code, mask)


@inlined
def _push_children(tile, nodes, blocks, node, mask, deepest, count):  # type: ignore[no-untyped-def]  # noqa: PLR0914, PLR0915 - a compiled loop
    """Push the child nodes that the tile may intersect, the closest one last.

    The stack has `count` entries. Return its new size. `nodes` and `blocks` are addresses.
    """
    singles = float32s(tile)
    numbers = int64s(tile)
    address = numbers[_STACK]
    stack = float32s(address)
    codes = int32s(address)
    boxes = float32s(nodes)
    children = int32s(nodes)
    base = node * NODE
    inside = splat(FAR)
    for plane in range(4):
        k = _TILE_PLANES + 4 * plane
        s = _SIDES + 3 * plane
        side = multiply_add(
            splat(singles[k]), load(boxes, base + numbers[s]), splat(singles[k + 3])
        )
        side = multiply_add(splat(singles[k + 1]), load(boxes, base + numbers[s + 1]), side)
        side = multiply_add(splat(singles[k + 2]), load(boxes, base + numbers[s + 2]), side)
        inside = minimum(side, inside)
    k = _TILE_PLANES + 16
    depth = multiply_add(
        splat(singles[k]), load(boxes, base + numbers[_SIDES + 12]), splat(singles[k + 3])
    )
    depth = multiply_add(splat(singles[k + 1]), load(boxes, base + numbers[_SIDES + 13]), depth)
    depth = multiply_add(splat(singles[k + 2]), load(boxes, base + numbers[_SIDES + 14]), depth)
    zero = splat(ZERO)
    hit = greater_equal(inside, zero) & greater_equal(splat(deepest), depth)
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
        inside = splat(FAR)
        for plane in range(4):
            p = _PLANES + 7 * SUBTILES * plane
            upper = multiply_add(load(singles, p), hx, load(singles, p + 48))
            lower = load(singles, p + 24) * lx
            upper = multiply_add(load(singles, p + 8), hy, upper)
            lower = multiply_add(load(singles, p + 32), ly, lower)
            upper = multiply_add(load(singles, p + 16), hz, upper)
            lower = multiply_add(load(singles, p + 40), lz, lower)
            inside = minimum(upper + lower, inside)
        near = singles[_NEAR + child]
        subtiles = mask & greater_equal(inside, zero) & greater_equal(reach, splat(near))
        code = np.int64(children[k + 48])
        write_entry(stack, codes, count, near, code, subtiles)
        count += np.int64(subtiles != 0)  # without a branch, which would often be mispredicted
        leaf = blocks + 4 * BLOCK * (~code >> LEAF_BITS)
        line = uint8s(nodes + 4 * NODE * code if code >= 0 else leaf)
        for byte in range(0, 4 * BLOCK, 64):
            prefetch(line, byte)
    sort_farthest_first(address, start, count)
    return count


@noinline
def _unfinished_subtiles(tile, count):  # type: ignore[no-untyped-def]
    """Return a mask of the subtiles that reach any of the first `count` pending nodes."""
    reach = load(float32s(tile), _REACH)
    address = int64s(tile)[_STACK]
    stack = float32s(address)
    codes = int32s(address)
    subtiles = np.int64(0)
    for k in range(count):
        subtiles |= codes[ENTRY * k + 2] & greater_equal(reach, splat(stack[ENTRY * k]))
    return subtiles


@called_by_address(types.int64(*5 * INT64))
def walk_tile(tile, rays, mesh, instance, mask):  # type: ignore[no-untyped-def]
    """Cast the rays in selected subtiles at a mesh, and return a mask of unfinished subtiles.

    The traversal stops if the tile visits more leaves than it has rays. In this case, the subtiles
    that may intersect a pending node are unfinished.
    """
    singles = float32s(tile)
    address = int64s(tile)[_STACK]
    stack = float32s(address)
    codes = int32s(address)
    nodes = int64s(mesh)[NODES]
    blocks = int64s(mesh)[BLOCKS]
    deepest = max_lane(load(singles, _REACH))
    leaves = 0
    write_entry(stack, codes, 0, -FAR, 0, mask)
    count = np.int64(1)
    while count > 0:
        count -= 1
        near = stack[ENTRY * count]
        code = np.int64(codes[ENTRY * count + 1])
        subtiles = codes[ENTRY * count + 2] & greater_equal(load(singles, _REACH), splat(near))
        if subtiles == 0:
            continue
        if code >= 0:
            count = _push_children(
                tile, nodes, blocks, node=code, mask=subtiles, deepest=deepest, count=count
            )
            continue
        leaves += 1
        if leaves > rays:
            return _unfinished_subtiles(tile, count + 1)
        changed = test_leaf(tile, rays, mesh, instance, ~code, subtiles, deepest)
        if changed != 0:
            deepest = update_depths(tile, rays, changed)
    return np.int64(0)


@called_by_address(types.int64(*3 * INT64))
def list_instances(tile, nodes, mask):  # type: ignore[no-untyped-def]
    """List the instances that a tile may hit, the closest one last, and return their number.

    `nodes` is the address of the instance tree, and `mask` contains the subtiles to cast.
    """
    singles = float32s(tile)
    numbers = int64s(tile)
    address = numbers[_STACK]
    stack = float32s(address)
    codes = int32s(address)
    met = float32s(numbers[_MET])
    met_codes = int32s(numbers[_MET])
    deepest = max_lane(load(singles, _REACH))
    write_entry(stack, codes, 0, -FAR, 0, mask)
    count = np.int64(1)
    met_count = np.int64(0)
    while count > 0:
        count -= 1
        near = stack[ENTRY * count]
        code = np.int64(codes[ENTRY * count + 1])
        subtiles = codes[ENTRY * count + 2]
        if code >= 0:
            count = _push_children(
                tile, nodes, nodes, node=code, mask=subtiles, deepest=deepest, count=count
            )
        else:
            write_entry(met, met_codes, met_count, near, ~code >> LEAF_BITS, subtiles)
            met_count += 1
    sort_farthest_first(numbers[_MET], 0, met_count)
    return met_count
