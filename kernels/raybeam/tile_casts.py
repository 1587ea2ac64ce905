"""Compiled loops that cast scans tile by tile, and rays at moving bodies.

tile_plan.py determines which rays form a tile. The hits of a call are first stored by ray index and
then written to the output in ray order.
"""

from __future__ import annotations

import numpy as np
from numba import types

from . import cast_record as memory
from .cast_record import (
    FIRST_ROW_FIELD,
    INSTANCE_BYTES,
    KEYS_PER_INSTANCE,
    float64s,
    int32s,
    int64s,
)
from .compiled import compiled, inlined, noinline
from .moving_loops import (
    NEAREST_HITS,
    PADS_M,
    PAIRS,
    box_corners,
    intersects_box,
    pose_rotation,
    to_body_axes,
)
from .ray_loops import make_rays, write_shared_origin
from .rays import UNIT_SLACK
from .tile_loops import cast_tile
from .tile_memory import KEY, LENGTH, NORM, NUMBER, OX, T, field_index, row_index
from .tile_sizes import SUBTILES

_T_MIN = field_index("t_min")
_TILE_RAYS = 8 * SUBTILES  # rays per tile if rays are cast at bodies


@noinline
def _number_rays(tile, rays, lanes, first, count):  # type: ignore[no-untyped-def]
    """Write the ray indices of a tile.

    Return whether any of these rays belong to the call. The indices are `first` plus the numbers at
    the address `lanes`. An index below 0, or not below `count`, belongs to a ray that is cast with
    the tile but ignored.
    """
    numbers = int64s(tile)
    lane_numbers = int64s(lanes)
    row = row_index(NUMBER, rays)
    exists = np.int64(0)
    for lane in range(rays):
        number = first + lane_numbers[lane]
        numbers[row + lane] = number
        exists |= np.int64((number >= 0) & (number < count))
    return exists != 0


@noinline
def _clear_hits(tile, rays, t_max, count):  # type: ignore[no-untyped-def]
    """Clear a tile's hits, and set the maximum distance of each ray.

    The maximum distance is -1 for rays that do not belong to the call.
    """
    floats = float64s(tile)
    numbers = int64s(tile)
    t_at = row_index(T, rays)
    key_at = row_index(KEY, rays)
    length_at = row_index(LENGTH, rays)
    number_at = row_index(NUMBER, rays)
    for k in range(rays):
        number = numbers[number_at + k]
        floats[t_at + k] = t_max if (number >= 0) & (number < count) else -1.0
        floats[length_at + k] = 1.0
        numbers[key_at + k] = -1


@noinline
def _store_hits(tile, rays, hits, count):  # type: ignore[no-untyped-def]
    """Copy a tile's hits to the scratch memory of a call with `count` rays.

    Hits of rays that do not belong to the call go to an additional last row.
    """
    floats = float64s(tile)
    numbers = int64s(tile)
    distances = float64s(hits)
    keys = int64s(hits + 8 * (count + 1))
    t_at = row_index(T, rays)
    key_at = row_index(KEY, rays)
    number_at = row_index(NUMBER, rays)
    for lane in range(rays):
        number = numbers[number_at + lane]
        ray = number if (number >= 0) & (number < count) else count
        distances[ray] = floats[t_at + lane]
        keys[ray] = numbers[key_at + lane]


@compiled(types.int64(memory.CASTS, types.int64, types.int64))
def cast_rays(casts, start, stop):  # type: ignore[no-untyped-def]  # noqa: PLR0914, PLR0915 - a compiled loop
    """Cast rays `start` to `stop` of a `CAST`, and return how many of them hit.

    The hits are written to the outputs of the `CAST` in ray order.
    """
    cast = casts[0]
    address = casts.ctypes.data
    tile = cast.tile
    rays = cast.tile_rays
    instances = cast.instances
    firing = cast.firing
    meter = 1.0 / cast.scale
    index = int32s(cast.index)
    indexed = cast.index != 0
    shifts = int64s(cast.shifts)
    float64s(tile)[_T_MIN] = cast.t_min
    count = stop - start
    distances = float64s(cast.hits)
    keys = int64s(cast.hits + 8 * (count + 1))
    ray_out = memory.uint32s(cast.ray)
    distance_out = float64s(cast.distance)
    triangle_out = int32s(cast.triangle)
    instance_out = int32s(cast.instance)
    if cast.shares_origin != 0:
        write_shared_origin(cast, tile, rays)
    lead = (cast.first + start) % firing  # rays of the first firing that precede the call
    firing_count = -(-(count + lead) // firing)
    max_shift = np.int64(0)
    for group in range(cast.groups):
        max_shift = max(max_shift, shifts[group])
    for column in range(-(-(firing_count + max_shift) // cast.firings)):
        for group in range(cast.groups):
            number = (column * cast.firings - shifts[group]) * firing - lead
            if _number_rays(tile, rays, cast.lanes + 8 * rays * group, number, count):
                make_rays(address, start, rays, count)
                _clear_hits(tile, rays, cast.t_max, count)
                cast_tile(tile, rays, cast.mesh, instances, cast.top, rays)
                _store_hits(tile, rays, cast.hits, count)
    hit_count = 0
    for k in range(count):
        key = keys[k]
        if key < 0:
            continue
        triangle = key & (KEYS_PER_INSTANCE - 1)
        if instances != 0:
            number = key // KEYS_PER_INSTANCE
            record = int64s(instances + INSTANCE_BYTES * number)
            triangle += record[FIRST_ROW_FIELD]
            instance_out[hit_count] = number
        ray_out[hit_count] = start - cast.first_ray + k
        distance_out[hit_count] = distances[k] * meter
        triangle_out[hit_count] = index[triangle] if indexed else triangle
        hit_count += 1
    return hit_count


@inlined
def _write_ray(cast, floats, lane, origin, direction):  # type: ignore[no-untyped-def]
    """Write a ray to a tile lane in local coordinates, and return the length of its direction.

    `origin`, in meters, and `direction` are in the frame of the body. The length differs from 1
    only if the sensor rotates while the rays of a pose are fired.
    """
    scale = cast.scale
    center = cast.center
    u, v, w = direction
    squared = (u * u + v * v) + w * w
    length = np.sqrt(squared)
    if abs(squared - 1) > UNIT_SLACK:
        max_component = max(abs(u), max(abs(v), abs(w)))
        u = u / max_component
        v = v / max_component
        w = w / max_component
        norm = np.sqrt((u * u + v * v) + w * w)
        u = u / norm
        v = v / norm
        w = w / norm
    k = row_index(OX, _TILE_RAYS) + lane
    floats[k] = (origin[0] - center[0]) * scale
    floats[k + _TILE_RAYS] = (origin[1] - center[1]) * scale
    floats[k + 2 * _TILE_RAYS] = (origin[2] - center[2]) * scale
    floats[k + 3 * _TILE_RAYS] = u
    floats[k + 4 * _TILE_RAYS] = v
    floats[k + 5 * _TILE_RAYS] = w
    return length


@inlined
def _fill_lanes(tile, filled):  # type: ignore[no-untyped-def]
    """Fill the unused lanes of a tile, after the first `filled` ones, with copies of its first ray.

    The maximum distance of the copies is -1, so that they are not cast. The hits of all rays are
    cleared.
    """
    floats = float64s(tile)
    numbers = int64s(tile)
    for lane in range(_TILE_RAYS):
        numbers[row_index(KEY, _TILE_RAYS) + lane] = -1
        floats[row_index(LENGTH, _TILE_RAYS) + lane] = 1.0
    for lane in range(filled, _TILE_RAYS):
        floats[row_index(T, _TILE_RAYS) + lane] = -1.0
    for field in range(6):
        k = row_index(OX + field, _TILE_RAYS)
        for lane in range(filled, _TILE_RAYS):
            floats[k + lane] = floats[k]


@inlined
def _write_hits(cast, pairs, nearest, filled):  # type: ignore[no-untyped-def]  # noqa: PLR0914 - a compiled loop
    """Record the hits of a tile's first `filled` rays in a `NearestHits` if they are closer."""
    numbers = int64s(cast.tile)
    floats = float64s(cast.tile)
    index = int32s(cast.index)
    meter = 1.0 / cast.scale
    distance, bodies, instance, triangle = nearest
    t_at = row_index(T, _TILE_RAYS)
    key_at = row_index(KEY, _TILE_RAYS)
    pair_at = row_index(NUMBER, _TILE_RAYS)
    norm_at = row_index(NORM, _TILE_RAYS)
    for lane in range(filled):
        key = numbers[key_at + lane]
        pair = numbers[pair_at + lane]
        ray = pairs.row[pair]
        body = pairs.body[pair]
        meters = floats[t_at + lane] * meter / floats[norm_at + lane]
        nearer = meters < distance[ray] or (meters == distance[ray] and body < bodies[ray])
        if key < 0 or not nearer:
            continue
        row = key & (KEYS_PER_INSTANCE - 1)
        instance[ray] = 0
        if cast.instances != 0:
            number = key // KEYS_PER_INSTANCE
            instance[ray] = number
            row += int64s(cast.instances + INSTANCE_BYTES * number)[FIRST_ROW_FIELD]
        distance[ray] = meters
        bodies[ray] = body
        triangle[ray] = index[row]


@compiled(types.void(memory.CASTS, PAIRS, NEAREST_HITS))
def cast_pairs(casts, pairs, nearest):  # type: ignore[no-untyped-def]  # noqa: PLR0914 - a compiled loop
    """Cast rays at bodies with a `CAST` record, and record closer hits in a `NearestHits`.

    If a ray misses the bounding box of the body, or ends in front of it, the pair does not occupy a
    lane of a tile.
    """
    cast = casts[0]
    tile = cast.tile
    numbers = int64s(tile)
    floats = float64s(tile)
    rays = pairs.rays
    poses = pairs.poses
    row = pairs.row
    bodies = pairs.body
    floats[_T_MIN] = cast.t_min
    corners = box_corners(float64s(pairs.box.ctypes.data))
    pair_at = row_index(NUMBER, _TILE_RAYS)
    norm_at = row_index(NORM, _TILE_RAYS)
    t_at = row_index(T, _TILE_RAYS)
    pair = 0
    while pair < len(row):
        filled = 0
        body = bodies[pair]
        while filled < _TILE_RAYS and pair < len(row) and bodies[pair] == body:
            k = row[pair]
            p = pairs.pose[pair]
            rotation = pose_rotation(poses, p)
            x = rays[0, k] - poses[0, p]
            y = rays[1, k] - poses[1, p]
            z = rays[2, k] - poses[2, p]
            origin = to_body_axes(rotation, x, y, z)
            direction = to_body_axes(rotation, rays[3, k], rays[4, k], rays[5, k])
            if intersects_box(corners, PADS_M, nearest.distance[k], origin, direction):
                norm = _write_ray(cast, floats, filled, origin, direction)
                floats[norm_at + filled] = norm
                reach = nearest.distance[k] * norm * cast.scale * (1 + 2.0**-40)
                floats[t_at + filled] = min(reach, cast.t_max)
                numbers[pair_at + filled] = pair
                filled += 1
            pair += 1
        if filled != 0:
            _fill_lanes(tile, filled)
            cast_tile(tile, _TILE_RAYS, cast.mesh, cast.instances, cast.top, filled)
            _write_hits(cast, pairs, nearest, filled)


# Whether this process compiled the loops. Otherwise, numba loaded them from its cache.
COMPILED = bool(cast_rays.stats.cache_misses)
