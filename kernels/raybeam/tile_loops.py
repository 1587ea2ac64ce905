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

A tile that is too wide or too far away is cast ray by ray in the same tree, and so is the rest of a
tile that meets more leaves than it has rays. Rays with a negative reach are not cast.

Margins, with u = 2**-24, local coordinates of boxes within [-1, 1], and `spread` =
1 + max |su| + max |sv| of the tile:

- A side of a tile is ``n . (p - o)`` with a normal n of length up to `spread`. Rounding of n, p, o
  and of the sums is at most 16 u spread (2 + |o|). `_SIDE` of tile_frame.py is four times that.
- The first corner of a triangle, relative to the tile's point, is off by 5 u (1 + |a|), edges by
  5 u of their length. A cross product of an edge and such a corner is off by 24 u |edge| (1 + |a|),
  and its value at (su, sv) by `spread` times that. `EDGE` of tile_leaf.py has twice that.
- A ray that starts off the tile's point by w has a moment that differs by w x edge: `offset` is an
  upper bound of w across the ray, and of its share along m.
- Products of edges below 1e-19 underflow: `FLOOR` covers them.

Parameters of the functions below: `tile` is the address of the memory that tile_memory.py
describes, `rays` the number of rays of the tile; `singles`, `integers`, `numbers` and `floats`
point to this memory as float32, int32, int64 and float64. `mesh` is the address of a `MESH` record.
"""

from __future__ import annotations

import numpy as np
from numba import types

from .cast_record import (
    INSTANCE_BYTES,
    KEYS_PER_INSTANCE,
    MESH_FIELD,
    float32s,
    float64s,
    int32s,
    int64s,
)
from .compiled import INT64, called_by_address, stage
from .ray_walk import SLACK, walk_ray, walk_ray_over_instances
from .tile_exact import shear_rays
from .tile_frame import prepare_tile
from .tile_memory import ENTRY, IX, LENGTH, OX, T, field_index, row_index
from .tile_sizes import SUBTILES
from .tile_walk import list_instances, walk_tile
from .vectors import bit_count, load, max_lane, maximum, splat, square_root, store

_PADDING = field_index("padding")
_OFFSET = field_index("offset")
_SKIPS = field_index("skips")
_PATIENCE = field_index("patience")
_MET = field_index("met")
_NESTED = field_index("nested")
_MAX_SKIPS = 31  # tiles that are cast one by one before another trial
_FEW = 6  # rays that are cast one by one


@stage
def _cast_in_mesh(tile, rays, first_row, mesh, instance, mask):  # type: ignore[no-untyped-def]
    """Cast the rays of the subtiles of a mask in a mesh, as a tile or one by one.

    After a tile that was too wide or met too many leaves, its neighbors are cast one by one; then
    tiles are tried again. The shear of the rays is written. `first_row` is the first row of the
    rays in the mesh's coordinates.
    """
    numbers = int64s(tile)
    if numbers[_SKIPS] > 0:
        numbers[_SKIPS] -= 1
    else:
        if prepare_tile(tile, rays, first_row, mask) != 0:
            mask = walk_tile(tile, rays, mesh, instance, mask)
        if bit_count(mask) > SUBTILES // 2:
            numbers[_PATIENCE] = min(2 * numbers[_PATIENCE] + 1, _MAX_SKIPS)
            numbers[_SKIPS] = numbers[_PATIENCE]
        else:
            numbers[_PATIENCE] = 0
        if mask == 0:
            return
    floats = float64s(tile)
    each = rays // SUBTILES
    t_at = row_index(T, rays)
    for ray in range(rays):
        if (mask >> (ray // each)) & 1 and floats[t_at + ray] >= 0:
            walk_ray(tile, rays, ray, first_row, mesh, instance, 0)


@called_by_address(types.void(*3 * INT64))
def _transform_rays(tile, rays, instance):  # type: ignore[no-untyped-def]  # noqa: PLR0914 - a compiled loop
    """Write all rays in the coordinates of the mesh of an instance, as `to_mesh_coordinates`."""
    floats = float64s(tile)
    m = float64s(instance)
    k = row_index(OX, rays)
    i = row_index(IX, rays)
    length_at = row_index(LENGTH, rays)
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
def _reaching_subtiles(tile, rays, near, mask):  # type: ignore[no-untyped-def]
    """Return the subtiles of a mask with a ray that reaches a depth along the tile's axis m.

    The depth is of the scene: a distance there is at least as long as its depth.
    """
    floats = float64s(tile)
    t_at = row_index(T, rays)
    each = rays // SUBTILES
    left = np.int64(0)
    for subtile in range(SUBTILES):
        farthest = splat(-1e30)
        for k in range(subtile * each, (subtile + 1) * each, 4):
            farthest = maximum(farthest, load(floats, t_at + k))
        left |= np.int64(max_lane(farthest) * (1 + SLACK) + SLACK >= near) << subtile
    return mask & left


@called_by_address(types.void(*6 * INT64))
def cast_tile(tile, rays, mesh, instances, top, last):  # type: ignore[no-untyped-def]
    """Write the closest hits of a tile to its rows `T` and `KEY`, which have reaches and -1.

    `instances` and `top` are addresses of the `INSTANCE` records and of the tree over these, 0 for
    a single mesh without a transform. Rays from number `last` on are copies.
    """
    numbers = int64s(tile)
    singles = float32s(tile)
    each = rays // SUBTILES
    mask = (np.int64(1) << ((last + each - 1) // each)) - 1
    few = last <= _FEW
    numbers[_NESTED] = np.int64(instances != 0)
    if instances == 0:
        shear_rays(tile, rays, OX)
        if few:
            for ray in range(last):
                walk_ray(tile, rays, ray, OX, mesh, 0, 0)
        else:
            _cast_in_mesh(tile, rays, OX, mesh, 0, mask)
        return
    if few or prepare_tile(tile, rays, OX, mask) == 0:
        for ray in range(last):
            if float64s(tile)[row_index(T, rays) + ray] >= 0:
                walk_ray_over_instances(tile, rays, ray, top, instances)
        return
    slack = np.float64(singles[_OFFSET] + singles[_OFFSET] + singles[_PADDING])
    count = list_instances(tile, top, mask)
    met = float32s(numbers[_MET])
    codes = int32s(numbers[_MET])
    while count > 0:
        count -= 1
        subtiles = _reaching_subtiles(
            tile, rays, np.float64(met[ENTRY * count]) - slack, np.int64(codes[ENTRY * count + 2])
        )
        if subtiles == 0:
            continue
        number = np.int64(codes[ENTRY * count + 1])
        record = instances + INSTANCE_BYTES * number
        _transform_rays(tile, rays, record)
        shear_rays(tile, rays, IX)
        mesh = int64s(record)[MESH_FIELD]
        _cast_in_mesh(tile, rays, IX, mesh, KEYS_PER_INSTANCE * number, subtiles)
