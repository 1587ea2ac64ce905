"""Traversal of the tile backend's trees by a single ray."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import types

from .cast_record import (
    BLOCKS,
    INSTANCE_BYTES,
    KEYS_PER_INSTANCE,
    MESH_FIELD,
    NODES,
    float32s,
    float64s,
    int32s,
    int64s,
)
from .compiled import INT64, called_by_address, inlined, noinline
from .mesh import MAX_DIAGONAL
from .mesh_loops import to_mesh_coordinates
from .ray_loops import entry_distance
from .tile_exact import intersect_ray
from .tile_frame import ONE, ZERO, cross, dot
from .tile_leaf import EDGE, FLOOR, LEAF_MASK, l1_norm
from .tile_memory import AXIS, ENTRY, IX, LENGTH, OX, T, U, field_index, row_index
from .tile_tree import BLOCK, NODE
from .tile_walk import sort_farthest_first, write_entry
from .tree import LEAF_BITS
from .triangle_loops import shear_ray
from .vectors import greater_equal, load, lowest_bit, maximum, minimum, multiply_add, splat, store

_NEAR = field_index("near")
_STACK = field_index("stack")
_TINY = np.float32(2.0**-60)
SLACK = 2.0**-20
_MAX_ENTRY = 1e9  # local distance that the padding in tree.py allows for


class _Start(NamedTuple):
    """A ray in float32 that starts where it enters the box of a scene or mesh.

    Attributes
    ----------
    entry
        Distance of the start from the origin of the ray, float64; 0 if the origin is inside the
        box.
    x, y, z, dx, dy, dz
        Start and direction.
    ix, iy, iz
        Reciprocals of the direction components.
    near_x, near_y, near_z
        Positions, within a node, of the coordinates of the children's closer sides.
    undecided
        -1 if the start is too inaccurate to discard triangles, otherwise 0.
    """

    entry: float
    x: np.float32
    y: np.float32
    z: np.float32
    dx: np.float32
    dy: np.float32
    dz: np.float32
    ix: np.float32
    iy: np.float32
    iz: np.float32
    near_x: int
    near_y: int
    near_z: int
    undecided: int


@inlined
def _make_start(floats, k, rays):  # type: ignore[no-untyped-def]  # noqa: PLR0914 - a compiled loop
    """Return the `_Start` of a ray.

    The origin and the direction of the ray are six numbers, which start at index `k` and are `rays`
    elements apart. The box of a scene or mesh is within [-1, 1], plus padding.
    """
    ox = floats[k]
    oy = floats[k + rays]
    oz = floats[k + 2 * rays]
    dx = floats[k + 3 * rays]
    dy = floats[k + 4 * rays]
    dz = floats[k + 5 * rays]
    entry = entry_distance(1 + 2.0**-16, (ox, oy, oz), (dx, dy, dz))
    x = np.float32(min(max(ox + entry * dx, -2.0), 2.0))
    y = np.float32(min(max(oy + entry * dy, -2.0), 2.0))
    z = np.float32(min(max(oz + entry * dz, -2.0), 2.0))
    ix = ONE / _not_zero(np.float32(dx))
    iy = ONE / _not_zero(np.float32(dy))
    iz = ONE / _not_zero(np.float32(dz))
    near_x = 0 if ix >= 0 else 24
    near_y = 8 if iy >= 0 else 32
    near_z = 16 if iz >= 0 else 40
    # Beyond this distance, the error of the start exceeds the margins of the test in float32.
    undecided = -1 if entry > _MAX_ENTRY else 0
    return _Start(
        entry=entry,
        x=x,
        y=y,
        z=z,
        dx=np.float32(dx),
        dy=np.float32(dy),
        dz=np.float32(dz),
        ix=ix,
        iy=iy,
        iz=iz,
        near_x=near_x,
        near_y=near_y,
        near_z=near_z,
        undecided=undecided,
    )


@inlined
def _not_zero(component):  # type: ignore[no-untyped-def]
    if abs(component) < _TINY:
        return -_TINY if component < 0 else _TINY
    return component


@inlined
def _limit_of(t, entry):  # type: ignore[no-untyped-def]
    """Subtract `entry` from a distance. Convert the result to float32, but never round it down."""
    return np.float32(min(max((t - entry) * (1 + SLACK) + SLACK, -MAX_DIAGONAL), MAX_DIAGONAL))


@inlined
def _slab(boxes, base, near_at, axis, inverse, start):  # type: ignore[no-untyped-def]
    """Compute the distances at which a ray crosses both sides of eight boxes along an axis.

    The first vector contains the closer sides.
    """
    far_at = (24 + 16 * axis) - near_at
    factor = splat(inverse)
    shift = splat(start * inverse)
    return (
        load(boxes, base + near_at) * factor - shift,
        load(boxes, base + far_at) * factor - shift,
    )


@inlined
def _push_children(tile, address, nodes, node, start, limit, count):  # type: ignore[no-untyped-def]  # noqa: PLR0914 - a compiled loop
    """Push the child nodes that a ray intersects, and return the new stack size.

    The closest child is pushed last. `address` is the stack, which has `count` entries, `nodes` is
    the address of the nodes, and `limit` is the distance at which the ray ends.
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
    near = maximum(maximum(near_x, near_y), maximum(near_z, splat(ZERO)))
    far = minimum(minimum(far_x, far_y), minimum(far_z, splat(limit)))
    hit = greater_equal(far, near)
    store(singles, _NEAR, near)
    first = count
    while hit != 0:
        child = lowest_bit(hit)
        hit &= hit - 1
        stack[ENTRY * count] = singles[_NEAR + child]
        codes[ENTRY * count + 1] = children[base + 48 + child]
        count += 1
    if count == first + 2:
        # This common case is handled without a branch, which would often be mispredicted.
        k = ENTRY * first
        here = stack[k]
        there = stack[k + ENTRY]
        one = codes[k + 1]
        other = codes[k + ENTRY + 1]
        swap = here < there
        stack[k] = there if swap else here
        stack[k + ENTRY] = here if swap else there
        codes[k + 1] = other if swap else one
        codes[k + ENTRY + 1] = one if swap else other
    elif count > first + 2:
        sort_farthest_first(address, first, count)
    return count


@inlined
def _test_leaf(tile, rays, ray, mesh, instance, code, start):  # type: ignore[no-untyped-def]  # noqa: PLR0914 - a compiled loop
    """Test a ray against the triangles in a leaf, and return whether a closer hit was found."""
    record = int64s(mesh)
    blocks = float32s(record[BLOCKS])
    block = (code >> LEAF_BITS) * BLOCK
    ax = load(blocks, block) - splat(start.x)
    ay = load(blocks, block + 8) - splat(start.y)
    az = load(blocks, block + 16) - splat(start.z)
    e = load(blocks, block + 24), load(blocks, block + 32), load(blocks, block + 40)
    f = load(blocks, block + 48), load(blocks, block + 56), load(blocks, block + 64)
    d = splat(start.dx), splat(start.dy), splat(start.dz)
    moment = cross((ax, ay, az), d)
    normal = cross(e, f)
    n1 = dot(f[0], f[1], f[2], moment[0], moment[1], moment[2])
    n2 = splat(ZERO) - dot(e[0], e[1], e[2], moment[0], moment[1], moment[2])
    n0 = (dot(normal[0], normal[1], normal[2], d[0], d[1], d[2]) - n1) - n2
    size = l1_norm(e) + l1_norm(f)
    distance = splat(ONE) + l1_norm((ax, ay, az))
    margin = multiply_add(splat(EDGE) * distance, size, splat(FLOOR))
    positive = greater_equal(minimum(minimum(n0, n1), n2) + margin, splat(ZERO))
    negative = greater_equal(margin, maximum(maximum(n0, n1), n2))
    left = (positive | negative | start.undecided) & ((2 << (code & LEAF_MASK)) - 1)
    first = np.int64(int32s(record[BLOCKS])[block + 72])
    closer = np.int64(0)
    while left != 0:
        lane = lowest_bit(left)
        left &= left - 1
        closer |= np.int64(intersect_ray(tile, rays, ray, mesh, instance, first + lane))
    return closer


@called_by_address(types.void(*7 * INT64))
def walk_ray(tile, rays, ray, first_row, mesh, instance, pending):  # type: ignore[no-untyped-def]
    """Cast a ray at a mesh.

    `pending` is the number of instance tree entries on the stack.
    """
    floats = float64s(tile)
    address = int64s(tile)[_STACK]
    stack = float32s(address)
    codes = int32s(address)
    nodes = int64s(mesh)[NODES]
    start = _make_start(floats, row_index(first_row, rays) + ray, rays)
    entry = start.entry
    t_at = row_index(T, rays) + ray
    length = floats[row_index(LENGTH, rays) + ray]
    limit = _limit_of(floats[t_at] * length, entry)
    write_entry(stack, codes, pending, ZERO, 0, 0)
    count = pending + 1
    while count > pending:
        count -= 1
        if stack[ENTRY * count] > limit:
            continue
        code = np.int64(codes[ENTRY * count + 1])
        if code >= 0:
            count = _push_children(
                tile, address, nodes, node=code, start=start, limit=limit, count=count
            )
        elif _test_leaf(tile, rays, ray, mesh, instance, code=~code, start=start):
            limit = _limit_of(floats[t_at] * length, entry)


@noinline
def _transform_ray(tile, rays, ray, instance):  # type: ignore[no-untyped-def]  # noqa: PLR0914 - a compiled loop
    """Transform a ray to the mesh coordinates of an instance, given its record's address."""
    floats = float64s(tile)
    numbers = int64s(tile)
    k = row_index(OX, rays) + ray
    i = row_index(IX, rays) + ray
    ox, oy, oz, dx, dy, dz, length = to_mesh_coordinates(
        float64s(instance),
        ox=floats[k],
        oy=floats[k + rays],
        oz=floats[k + 2 * rays],
        dx=floats[k + 3 * rays],
        dy=floats[k + 4 * rays],
        dz=floats[k + 5 * rays],
    )
    floats[i] = ox
    floats[i + rays] = oy
    floats[i + 2 * rays] = oz
    floats[i + 3 * rays] = dx
    floats[i + 4 * rays] = dy
    floats[i + 5 * rays] = dz
    floats[row_index(LENGTH, rays) + ray] = length
    axis, u, v, w, sx, sy, sz = shear_ray(ox, oy, oz, dx, dy, dz)
    numbers[row_index(AXIS, rays) + ray] = axis
    i = row_index(U, rays) + ray
    floats[i] = u
    floats[i + rays] = v
    floats[i + 2 * rays] = w
    floats[i + 3 * rays] = sx
    floats[i + 4 * rays] = sy
    floats[i + 5 * rays] = sz


@called_by_address(types.void(*5 * INT64))
def walk_ray_over_instances(tile, rays, ray, nodes, instances):  # type: ignore[no-untyped-def]
    """Cast a ray at all instances, given the address `nodes` of the instance tree's nodes."""
    floats = float64s(tile)
    numbers = int64s(tile)
    address = numbers[_STACK]
    stack = float32s(address)
    codes = int32s(address)
    start = _make_start(floats, row_index(OX, rays) + ray, rays)
    t_at = row_index(T, rays) + ray
    write_entry(stack, codes, 0, ZERO, 0, 0)
    count = np.int64(1)
    while count > 0:
        count -= 1
        limit = _limit_of(floats[t_at], start.entry)
        if stack[ENTRY * count] > limit:
            continue
        code = np.int64(codes[ENTRY * count + 1])
        if code >= 0:
            count = _push_children(
                tile, address, nodes, node=code, start=start, limit=limit, count=count
            )
            continue
        number = ~code >> LEAF_BITS
        record = instances + INSTANCE_BYTES * number
        _transform_ray(tile, rays, ray, record)
        mesh = int64s(record)[MESH_FIELD]
        key = KEYS_PER_INSTANCE * number
        walk_ray(tile, rays, ray, IX, mesh, key, count)
