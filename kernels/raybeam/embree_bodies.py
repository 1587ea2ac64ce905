"""The loop that casts rays at moving bodies with Embree, as `cast_crossing` of crossing.py.

`cast` is a `CAST` record, `scratch` the address of the `SCRATCH` memory, `floats` and `numbers`
point to that memory as float64 and int64, and `lane` is a ray of the group. Local coordinates are
the body's scene coordinates, centred and scaled.
"""

from __future__ import annotations

import numpy as np
from numba import types

from . import embree_memory as memory
from .compiled import compiled, inlined
from .embree_memory import (
    FIRST_ROW_FIELD,
    INSTANCE_BYTES,
    KEYS_PER_INSTANCE,
    LANES,
    byte_offset,
    field_index,
    float64s,
    int32s,
    int64s,
)
from .embree_packets import cast_group, prepare
from .embree_rays import entry_distance
from .moving_loops import (
    CROSSING,
    NEAREST,
    PADS_M,
    box_corners,
    passes_box,
    pose_rotation,
    to_body_axes,
)
from .rays import UNIT_SLACK

_OX, _OY, _OZ, _DX, _DY, _DZ = map(field_index, ("ox", "oy", "oz", "dx", "dy", "dz"))
_ENTRY, _REAL, _T, _KEY = map(field_index, ("entry", "real", "t", "key"))
_PAIR = field_index("row")  # number of the pair of a `Crossing`
_DIRECTION_LENGTH = field_index("straight")  # before the direction was made a unit vector
_VALID_AT = byte_offset("valid")


@inlined
def _write_ray(cast, floats, lane, origin, direction):  # type: ignore[no-untyped-def]
    """Write a ray to a lane of a group, in local coordinates; return the length of its direction.

    `origin`, metres, and `direction` are in the axes of the body. The length is 1 but for a sensor
    that turns during a pose.
    """
    scale = cast.scale
    centre = cast.centre
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
    x = (origin[0] - centre[0]) * scale
    y = (origin[1] - centre[1]) * scale
    z = (origin[2] - centre[2]) * scale
    floats[_OX + lane] = x
    floats[_OY + lane] = y
    floats[_OZ + lane] = z
    floats[_DX + lane] = u
    floats[_DY + lane] = v
    floats[_DZ + lane] = w
    floats[_ENTRY + lane] = entry_distance(cast.lower, cast.upper, (x, y, z), (u, v, w))
    return length


@inlined
def _fill_up(scratch, filled):  # type: ignore[no-untyped-def]
    """Write copies of the first ray to the lanes after `filled`, the number of a group's rays."""
    numbers = int64s(scratch)
    floats = float64s(scratch)
    valid = int32s(scratch + _VALID_AT)
    for lane in range(LANES):
        numbers[_REAL + lane] = np.int64(lane < filled)
        valid[lane] = np.int32(-1) if lane < filled else np.int32(0)
    for lane in range(filled, LANES):
        for field in (_OX, _OY, _OZ, _DX, _DY, _DZ, _ENTRY):
            floats[field + lane] = floats[field]


@inlined
def _write_hits(cast, crossing, nearest, filled):  # type: ignore[no-untyped-def]  # noqa: PLR0914 - a compiled loop
    """Write the hits of a group's first `filled` rays to a `Nearest`, where they are nearer.

    `key`, negative for a miss, is the row of the triangle in its mesh's corners, and
    `KEYS_PER_INSTANCE` times the instance.
    """
    scratch = cast.scratch
    numbers = int64s(scratch)
    floats = float64s(scratch)
    index = int32s(cast.index)
    metre = 1.0 / cast.scale
    distance, bodies, instance, triangle = nearest
    for lane in range(filled):
        t = floats[_T + lane]
        key = numbers[_KEY + lane]
        pair = numbers[_PAIR + lane]
        ray = crossing.row[pair]
        body = crossing.body[pair]
        metres = t * metre / floats[_DIRECTION_LENGTH + lane]
        nearer = metres < distance[ray] or (metres == distance[ray] and body < bodies[ray])
        if key < 0 or t > cast.t_max or not nearer:
            continue
        row = key & (KEYS_PER_INSTANCE - 1)
        instance[ray] = 0
        if cast.instances != 0:
            instance[ray] = key // KEYS_PER_INSTANCE
            row += int64s(cast.instances + INSTANCE_BYTES * (key // KEYS_PER_INSTANCE))[
                FIRST_ROW_FIELD
            ]
        distance[ray] = metres
        bodies[ray] = body
        triangle[ray] = index[row]


@compiled(types.void(memory.CASTS, CROSSING, NEAREST))
def cast_crossing(casts, crossing, nearest):  # type: ignore[no-untyped-def]  # noqa: PLR0914 - a compiled loop
    """Cast the pairs of a `Crossing` with a `CAST`, and write nearer hits to a `Nearest`.

    A pair whose ray misses the body's box, or ends before the box, takes no lane of a group.
    """
    cast = casts[0]
    scratch = cast.scratch
    numbers = int64s(scratch)
    floats = float64s(scratch)
    rays = crossing.rays
    poses = crossing.poses
    row = crossing.row
    corners = box_corners(float64s(crossing.box.ctypes.data))
    prepare(cast)
    pair = 0
    while pair < len(row):
        filled = 0
        while filled < LANES and pair < len(row):
            k = row[pair]
            p = crossing.pose[pair]
            rotation = pose_rotation(poses, p)
            x = rays[0, k] - poses[0, p]
            y = rays[1, k] - poses[1, p]
            z = rays[2, k] - poses[2, p]
            origin = to_body_axes(rotation, x, y, z)
            direction = to_body_axes(rotation, rays[3, k], rays[4, k], rays[5, k])
            if passes_box(corners, PADS_M, nearest.distance[k], origin, direction):
                floats[_DIRECTION_LENGTH + filled] = _write_ray(
                    cast, floats, filled, origin, direction
                )
                numbers[_PAIR + filled] = pair
                filled += 1
            pair += 1
        _fill_up(scratch, filled)
        if filled != 0 and cast_group(casts.ctypes.data, filled, 0):
            _write_hits(cast, crossing, nearest, filled)
