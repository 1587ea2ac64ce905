"""Compiled loops that cast rays at moving bodies, tile by tile.

The backend imports this module when rays are first cast at a body, because compiling or loading its
loops takes time that a static scene does not need.
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
from .compiled import compiled, inlined
from .moving_loops import (
    NEAREST_HITS,
    PADS_M,
    PAIRS,
    box_corners,
    intersects_box,
    pose_rotation,
    to_body_axes,
)
from .rays import UNIT_SLACK
from .tile_loops import cast_tile
from .tile_memory import KEY, LENGTH, NORM, NUMBER, OX, T, field_index, row_index
from .tile_sizes import SUBTILES

_T_MIN = field_index("t_min")
_TILE_RAYS = 8 * SUBTILES  # rays per tile


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
