"""The loop that casts rays at bodies that move, as `strike` of crossing.py, with Embree."""

from __future__ import annotations

import numpy as np
from numba import types

from . import embree_memory as memory
from .compiled import compiled, inlined
from .embree_memory import FIRST_PLACE, LANES, NUMBER, RECORD, at, float64s, int32s, int64s, offset
from .embree_packets import cast_group, prepare
from .embree_rays import entered_at
from .moving_loops import PADS_M, passes, sides_of, taken, turn_of
from .rays import UNIT_SLACK

_OX, _OY, _OZ, _DX, _DY, _DZ = map(at, ("ox", "oy", "oz", "dx", "dy", "dz"))
_ENTRY, _REAL, _T, _KEY = map(at, ("entry", "real", "t", "key"))
# row in the `Crossing`, length of the direction
_ROW = at("row")
_FULL = at("straight")
_VALID_AT = offset("valid")
_f64_1 = types.float64[::1]
_f64_2 = types.float64[:, ::1]
_i64_1 = types.int64[::1]
_i32_1 = types.int32[::1]


@inlined
def _put(cast, floats, lane, x, y, z, u, v, w):  # type: ignore[no-untyped-def]
    """Make a ray, in metres in the axes of its body, one of the group; returns its length."""
    scale = cast.scale
    centre = cast.centre
    low = cast.low
    high = cast.upper
    squared = (u * u + v * v) + w * w
    length = np.sqrt(squared)
    if abs(squared - 1) > UNIT_SLACK:
        most = max(abs(u), max(abs(v), abs(w)))
        u = u / most
        v = v / most
        w = w / most
        rest = np.sqrt((u * u + v * v) + w * w)
        u = u / rest
        v = v / rest
        w = w / rest
    x = (x - centre[0]) * scale
    y = (y - centre[1]) * scale
    z = (z - centre[2]) * scale
    floats[_OX + lane] = x
    floats[_OY + lane] = y
    floats[_OZ + lane] = z
    floats[_DX + lane] = u
    floats[_DY + lane] = v
    floats[_DZ + lane] = w
    floats[_ENTRY + lane] = entered_at(low, high, (x, y, z), (u, v, w))
    return length


@inlined
def _fill_up(scratch, filled):  # type: ignore[no-untyped-def]
    """Make the rest of a group copies of its first ray."""
    numbers = int64s(scratch)
    floats = float64s(scratch)
    valid = int32s(scratch + _VALID_AT)
    for lane in range(LANES):
        numbers[_REAL + lane] = np.int64(lane < filled)
        valid[lane] = np.int32(-1) if lane < filled else np.int32(0)
    for lane in range(filled, LANES):
        for field in (_OX, _OY, _OZ, _DX, _DY, _DZ, _ENTRY):
            floats[field + lane] = floats[field]


@compiled(
    types.void(
        memory.CASTS, _f64_2, _i64_1, _i64_1, _i64_1, _f64_2, _f64_1, _f64_1, _i64_1, _i32_1, _i32_1
    )
)
def strike(  # type: ignore[no-untyped-def]
    casts, rays, row, body, number, poses, box, distance, bodies, instance, triangle
):
    """Cast the rays of a `Crossing` with one `CAST`, and note in a `Nearest` what they hit."""
    cast = casts[0]
    scratch = cast.scratch
    t_max = cast.t_max
    metre = 1.0 / cast.scale
    numbers = int64s(scratch)
    floats = float64s(scratch)
    index = int32s(cast.index)
    sides = sides_of(float64s(box.ctypes.data))
    prepare(cast)
    done = 0
    while done < len(row):
        filled = 0
        while filled < LANES and done < len(row):
            k = row[done]
            p = number[done]
            turn = turn_of(poses, p)
            x = rays[0, k] - poses[0, p]
            y = rays[1, k] - poses[1, p]
            z = rays[2, k] - poses[2, p]
            x, y, z = taken(turn, x, y, z)
            u, v, w = taken(turn, rays[3, k], rays[4, k], rays[5, k])
            if passes(sides, PADS_M, distance[k], x, y, z, u, v, w):
                floats[_FULL + filled] = _put(cast, floats, filled, x, y, z, u, v, w)
                numbers[_ROW + filled] = done
                filled += 1
            done += 1
        _fill_up(scratch, filled)
        if filled == 0 or not cast_group(casts.ctypes.data, filled, 0):
            continue
        for lane in range(filled):
            t = floats[_T + lane]
            key = numbers[_KEY + lane]
            n = numbers[_ROW + lane]
            k = row[n]
            own = body[n]
            far = t * metre / floats[_FULL + lane]
            nearer = far < distance[k] or (far == distance[k] and own < bodies[k])
            if key < 0 or t > t_max or not nearer:
                continue
            place = key & (NUMBER - 1)
            instance[k] = 0
            if cast.instances != 0:
                instance[k] = key // NUMBER
                place += int64s(cast.instances + RECORD * (key // NUMBER))[FIRST_PLACE]
            distance[k] = far
            bodies[k] = own
            triangle[k] = index[place]
