"""Cast the rays in a tile.

A tile contains up to some hundred neighboring rays. They become points (su, sv) on a plane
perpendicular to the tile's mean direction m: in the axes (u, v, m), the direction of a ray is (su,
sv, 1), scaled so that its component along m is 1. In these coordinates,

- a box is outside the tile if it is outside one of four planes, which is tested for the eight
  children of a node at a time. The same test for eight subtiles at a time yields a mask of
  subtiles;
- a triangle consists of three linear functions of (su, sv), which are computed for eight triangles
  of a leaf at a time. Their maxima over a range of (su, sv) discard triangles for a tile or a
  subtile;
- a test of eight rays takes six multiply-adds and a comparison with the depth so far.

These tests use float32 with margins, and they only discard candidates. The remaining candidates are
decided in float64 by the test of triangle.py in the same order of operations, so that the hits have
the same bits as those of the other backends.

If a tile is too wide or too far away, its rays are cast one by one in the same tree. If a tile
visits more leaves than it has rays, the remaining part of the traversal is also done ray by ray.
Rays with a negative maximum distance are not cast.

The margins are as follows, where u = 2**-24, local coordinates of boxes are within [-1, 1], and
`spread` = 1 + max |su| + max |sv| of the tile.

- A side of a tile is ``n . (p - o)`` with a normal n whose length is at most `spread`. The rounding
  errors of n, p, o and of the sums are at most 16 u spread (2 + |o|). `_SIDE` in tile_frame.py is
  four times as large.
- The first vertex of a triangle, relative to the tile's point, has an error of 5 u (1 + |a|), and
  edges have an error of 5 u times their length. The cross product of an edge and such a vertex has
  an error of 24 u |edge| (1 + |a|), and its value at (su, sv) has an error of `spread` times as
  much. `EDGE` in tile_leaf.py is twice as large.
- If a ray starts at an offset w from the tile's point, its moment differs by w x edge. `offset` is
  an upper bound of the component of w across the ray plus its component along m.
- Products of edges below 1e-19 underflow. `FLOOR` covers them.

In the functions below, `tile` is the address of the memory that tile_memory.py describes, and
`rays` is the number of rays in the tile. `singles`, `integers`, `numbers` and `floats` access this
memory as float32, int32, int64 and float64. `mesh` is the address of a `MESH` record.
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
from .compiled import INT64, called_by_address, noinline
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
_MAX_SKIPS = 31  # maximum number of tiles that are cast ray by ray before the next attempt
_FEW = 6  # up to this number of rays, tiles are cast ray by ray


@noinline
def _cast_in_mesh(tile, rays, first_row, mesh, instance, mask):  # type: ignore[no-untyped-def]
    """Cast the rays in selected subtiles at a mesh, either together or one by one.

    If a tile is too wide or visits too many leaves, the following tiles are cast ray by ray,
    because they are likely to be similar. After that, tiles are tried again. The rays must already
    be sheared. `first_row` is the first row of the rays in mesh coordinates.
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
    """Transform all rays to the mesh coordinates of an instance, like `to_mesh_coordinates`."""
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


@noinline
def _reaching_subtiles(tile, rays, near, mask):  # type: ignore[no-untyped-def]
    """Return a mask of those given subtiles in which a ray reaches the depth `near`.

    The depth is in scene coordinates, in which a distance along a ray is at least as long as its
    depth.
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
    """Find the closest hits of a tile's rays, and write them to its rows `T` and `KEY`.

    Before the call, these rows contain the maximum distances and -1. `instances` and `top` are the
    addresses of the `INSTANCE` records and of their tree, or 0 for a single mesh without a
    transform. Rays from index `last` on are copies.
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
