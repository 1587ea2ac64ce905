"""Compiled loops that cast scans tile by tile.

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
from .compiled import compiled, noinline
from .ray_loops import make_rays, write_shared_origin
from .tile_loops import cast_tile
from .tile_memory import KEY, LENGTH, NUMBER, T, field_index, row_index

_T_MIN = field_index("t_min")


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


# Whether this process compiled the loops. Otherwise, numba loaded them from its cache.
COMPILED = bool(cast_rays.stats.cache_misses)
