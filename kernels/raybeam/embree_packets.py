"""The loop that casts a scan: groups of 16 neighbouring rays in Embree's packets, hits in order.

A block is some neighbours along a ring (`high`, each `step` rays on from the last) times all rays
between them; a group has `high` times `wide` of its rays. When a block is done, its hits are
written in the order of rays.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import carray, types

from . import embree_exact as exact
from . import embree_memory as memory
from .compiled import callback, compiled, external, inlined, stage
from .embree_memory import LANES, NUMBER, at, casts_at, float32s, float64s, int32s, int64s, offset
from .embree_rays import begin, localise, make, set_out
from .triangle_loops import areas, shear

_ARGUMENTS = at("arguments")
_ARGUMENTS_AT = offset("arguments")
_FILTER = at("arguments") + 2
_VALID_AT = offset("valid")
_PACKET = at("packet")
_PACKET_AT = offset("packet")
_TILE = at("tile")
_LANE = at("lane")
_RAY = at("ray")
_REAL = at("real")
_ENTRY = at("entry")
_OX, _OY, _OZ, _DX, _DY, _DZ = map(at, ("ox", "oy", "oz", "dx", "dy", "dz"))
_MESH = at("mesh")
_INSTANCES = at("instances")
_MASKED = at("masked")
_T_MIN = at("t_min")
_T_MAX = at("t_max")
_SCENE = at("scene")
_NEARBY = at("nearby")
_INSIDE = at("inside")
_ROUGH = at("rough")
_ONE = at("one")
_OTHER = at("other")
_ROUGH_32 = at("rough_32")
_ONE_32 = at("one_32")
_OTHER_32 = at("other_32")
_T = at("t")
_KEY = at("key")
_SURE = at("sure")
_POSE = at("pose")
f64_1 = types.float64[::1]
f64_2 = types.float64[:, ::1]
i32_1 = types.int32[::1]
_FIELDS = 22  # numbers of a ray of a packet

_intersect_4, _intersect_8, _intersect_16 = (
    types.ExternalFunction(
        f"rtcIntersect{width}", types.void(types.intp, types.intp, types.intp, types.intp)
    )
    for width in (4, 8, 16)
)


@inlined
def prepare(cast):  # type: ignore[no-untyped-def]
    """Write to the scratch memory what all rays share."""
    scratch = cast.scratch
    width = cast.width
    numbers = int64s(scratch)
    floats = float64s(scratch)
    rays = float32s(scratch)
    whole = int32s(scratch)
    numbers[0] = -1  # no instance
    numbers[_MESH] = cast.mesh
    numbers[_INSTANCES] = cast.instances
    numbers[_MASKED] = cast.masked
    floats[_T_MIN] = cast.t_min
    floats[_T_MAX] = cast.t_max
    numbers[_LANE] = 0
    numbers[_SCENE] = cast.scene
    numbers[_NEARBY] = cast.nearby
    numbers[_ARGUMENTS] = np.int64(-1) << 32 | exact.CALL_FILTER | exact.COHERENT  # all features
    numbers[_ARGUMENTS + 1] = scratch
    numbers[_ARGUMENTS + 3] = numbers[_ARGUMENTS + 4] = 0
    if width > 1:
        for packet in range(0, LANES, width):
            ray = _PACKET + _FIELDS * packet
            for k in range(ray, ray + width):
                rays[k + 3 * width] = np.float32(max(cast.t_min - exact.MARGIN, 0.0))
                rays[k + 7 * width] = np.float32(0)
                whole[k + 9 * width] = -1
                whole[k + 10 * width] = 0
                whole[k + 11 * width] = 0
                for field in (18, 19, 20):
                    whole[k + field * width] = -1


@inlined
def _apart(floats, coherence):  # type: ignore[no-untyped-def]
    """Whether some rays of a group differ too much from the first."""
    x = floats[_DX]
    y = floats[_DY]
    z = floats[_DZ]
    for lane in (5, 10, LANES - 1):
        if x * floats[_DX + lane] + y * floats[_DY + lane] + z * floats[_DZ + lane] < coherence:
            return True
    return False


def _filler(width: int) -> Any:
    """Make what gives packets of a size their rays: with a constant, in vector instructions."""

    @stage
    def fill(scratch, t_min, t_max, fixed):  # type: ignore[no-untyped-def]
        """Origins and distances from which hits count, if not `fixed`; directions and reaches."""
        rays = float32s(scratch)
        floats = float64s(scratch)
        if not fixed:
            for lane in range(LANES):
                k = _PACKET + (_FIELDS - 1) * (lane & -width) + lane
                entry = floats[_ENTRY + lane]
                rays[k] = exact.begun(floats[_OX + lane], floats[_DX + lane], entry)
                rays[k + width] = exact.begun(floats[_OY + lane], floats[_DY + lane], entry)
                rays[k + 2 * width] = exact.begun(floats[_OZ + lane], floats[_DZ + lane], entry)
                rays[k + 3 * width] = np.float32(max(t_min - entry - exact.MARGIN, 0.0))
        for lane in range(LANES):
            k = _PACKET + (_FIELDS - 1) * (lane & -width) + lane
            far = min(t_max - floats[_ENTRY + lane] + exact.MARGIN, exact.FAR)
            rays[k + 4 * width] = np.float32(floats[_DX + lane])
            rays[k + 5 * width] = np.float32(floats[_DY + lane])
            rays[k + 6 * width] = np.float32(floats[_DZ + lane])
            rays[k + 8 * width] = np.float32(far)

    return fill


_fill_4, _fill_8, _fill_16 = map(_filler, (4, 8, 16))


@inlined
def _fill(scratch, width, t_min, t_max, fixed):  # type: ignore[no-untyped-def]
    """Give the packets of a group their rays; their starts only if those are not `fixed`."""
    if width == 16:
        _fill_16(scratch, t_min, t_max, fixed)
    elif width == 8:
        _fill_8(scratch, t_min, t_max, fixed)
    else:
        _fill_4(scratch, t_min, t_max, fixed)


@stage
def _reals(scratch, first, wide, step, count):  # type: ignore[no-untyped-def]
    """Take those rays of a group that there are, and copies of its first; returns their number."""
    numbers = int64s(scratch)
    valid = int32s(scratch + _VALID_AT)
    real = np.int64(0)
    for lane in range(LANES):
        right = first + (lane & (wide - 1))
        ray = first + numbers[_TILE + lane]
        there = (right < step) & (ray < count)
        numbers[_RAY + lane] = ray if there else first
        numbers[_REAL + lane] = np.int64(there)
        valid[lane] = np.int32(-1) if there else np.int32(0)
        real += np.int64(there)
    return real


@stage
def _reset(scratch, plain):  # type: ignore[no-untyped-def]
    """Forget what filters have found."""
    singles = float32s(scratch)
    integers = int32s(scratch)
    for lane in range(LANES):
        singles[_ROUGH_32 + lane] = np.float32(np.inf)
        integers[_ONE_32 + lane] = integers[_OTHER_32 + lane] = np.int32(-1)
    if not plain:
        numbers = int64s(scratch)
        floats = float64s(scratch)
        for lane in range(LANES):
            floats[_ROUGH + lane] = np.inf
            numbers[_INSIDE + lane] = -1
            numbers[_ONE + lane] = numbers[_OTHER + lane] = -1


@stage
def _found(scratch):  # type: ignore[no-untyped-def]
    """How many rays of a group have a candidate in a plain scene, and how many go along an axis."""
    floats = float64s(scratch)
    integers = int32s(scratch)
    found = np.int64(0)
    straight = np.int64(0)
    for lane in range(LANES):
        found += np.int64(integers[_ONE_32 + lane] >= 0)
    for lane in range(LANES):
        straight += np.int64(exact.along(floats, lane))
    return found, straight


@stage
def _one_by_one(scene, scratch, proposer, t_max):  # type: ignore[no-untyped-def]
    """Cast the rays of a group one by one."""
    numbers = int64s(scratch)
    flags = int32s(scratch + _ARGUMENTS_AT)
    flags[0] = exact.CALL_FILTER
    numbers[_FILTER] = proposer
    for lane in range(LANES):
        if numbers[_REAL + lane]:
            exact.single(scene, scratch, lane, t_max, 0.0, 0.0)
    flags[0] = exact.CALL_FILTER | exact.COHERENT


@callback(types.int64(types.int64, types.int64, types.int64))
def _cast_group(address, real, fixed):  # type: ignore[no-untyped-def]
    """Write to `t` and `key` what the rays of a group hit; 0 if none hits anything."""
    cast = carray(casts_at(address), 1)[0]
    scene = cast.scene
    width = cast.width
    mesh = cast.mesh
    instances = cast.instances
    scratch = cast.scratch
    t_min = cast.t_min
    t_max = cast.t_max
    masked = cast.masked
    numbers = int64s(scratch)
    floats = float64s(scratch)
    plain = instances == 0 and not masked
    _reset(scratch, plain)
    if masked and instances == 0:  # `propose` looks at masks
        exact.shear_all(scratch)
    if width == 1 or real == 1 or _apart(floats, cast.coherence):
        _one_by_one(scene, scratch, cast.single, t_max)
    else:
        _fill(scratch, width, t_min, t_max, fixed)
        arguments = scratch + _ARGUMENTS_AT
        numbers[_FILTER] = cast.packets[0]
        if width == 16:
            _intersect_16(scratch + _VALID_AT, scene, scratch + _PACKET_AT, arguments)
        else:
            for part in range(LANES // width):
                numbers[_FILTER] = cast.packets[part]
                numbers[_LANE] = part * width
                asked = scratch + _VALID_AT + 4 * part * width
                rays = scratch + _PACKET_AT + 4 * _FIELDS * part * width
                if width == 8:
                    _intersect_8(asked, scene, rays, arguments)
                else:
                    _intersect_4(asked, scene, rays, arguments)
            numbers[_LANE] = 0
    found, straight = _found(scratch)
    if plain and found + straight == 0:
        return False
    if plain:
        exact.verify_all(float64s(int64s(mesh)[0]), scratch, t_min)
    else:
        for lane in range(LANES):
            exact.verify(mesh, instances, numbers, floats, lane)
    for lane in range(LANES):
        again = numbers[_SURE + lane] == 0 or (straight and exact.along(floats, lane))
        if again and numbers[_REAL + lane]:
            numbers[_FILTER] = cast.decide
            exact.decided(scene, scratch, lane, t_max)
    return True


# Given a `CAST`'s address, how many rays are no copies, and whether starts of packets stay as they
# are. Called by its own address: as a part of each loop it would take 4 s more to compile.
cast_group = external("raybeam_cast_group", _cast_group)


@compiled(types.int64(memory.CASTS, types.int64, types.int64))
def trace(casts, start, stop):  # type: ignore[no-untyped-def]
    """Cast rays `start` to `stop`, and write those that hit in their order; returns their number.

    `casts` is one `CAST`.
    """
    cast = casts[0]
    address = casts.ctypes.data
    scratch = cast.scratch
    instances = cast.instances
    t_max = cast.t_max
    still = cast.still != 0
    near = cast.near != 0
    step = cast.step
    high = cast.high
    wide = cast.wide
    before = cast.before
    shift = 0 if wide == 1 else (1 if wide == 2 else 2)
    metre = 1.0 / cast.scale
    index = int32s(cast.index)
    indexed = cast.index != 0
    numbers = int64s(scratch)
    floats = float64s(scratch)
    span = step * high
    distances = float64s(cast.room)
    places = int32s(cast.room + 8 * span)
    numbered = int32s(cast.room + 12 * span)
    out_ray = memory.uint32s(cast.ray)
    out_metres = float64s(cast.distance)
    out_triangle = int32s(cast.triangle)
    out_instance = int32s(cast.instance)
    prepare(cast)
    fixed = np.int64(still and near)
    for lane in range(LANES):
        numbers[_TILE + lane] = (lane >> shift) * step + (lane & (wide - 1))
        numbers[_POSE + lane] = 0
        floats[_ENTRY + lane] = 0.0
    if still:
        set_out(cast, scratch)
        localise(cast, scratch)
        if cast.width > 1:
            _fill(scratch, cast.width, cast.t_min, t_max, np.int64(0))
    kept = 0
    for block in range(start, stop, span):
        count = min(span, stop - block)
        begins = begin(cast, block)
        for column in range(0, min(step, count), wide):
            real = _reals(scratch, column, wide, step, count)
            make(cast, scratch, begins)
            if not cast_group(address, real, fixed):
                for lane in range(LANES):
                    places[numbers[_RAY + lane]] = -1
                continue
            for back in range(LANES):  # copies of the first come before it
                lane = LANES - 1 - back
                to = numbers[_RAY + lane]
                t = floats[_T + lane]
                key = numbers[_KEY + lane]
                distances[to] = t
                places[to] = key if t <= t_max else -1
                if instances != 0:
                    numbered[to] = key // NUMBER
        for k in range(count):
            place = np.int64(places[k])
            if place < 0:
                continue
            if instances != 0:
                record = int64s(instances + memory.RECORD * numbered[k])
                place = (place & (NUMBER - 1)) + record[memory.FIRST_PLACE]
                out_instance[kept] = numbered[k]
            out_ray[kept] = block - before + k
            out_metres[kept] = distances[k] * metre
            out_triangle[kept] = index[place] if indexed else place
            kept += 1
    return kept


@compiled(types.void(memory.CASTS, f64_2, f64_2, i32_1, i32_1, f64_1, f64_1))
def weigh(casts, origins, directions, place, instance, u, v):  # type: ignore[no-untyped-def]
    """Write weights of the second and third corner for hits of rays (m, 3), local to the scene.

    The hits' `place`, in all meshes' corners, and `instance` are those that `trace` wrote.
    """
    mesh = casts[0].mesh
    instances = casts[0].instances
    for k in range(len(place)):
        o = origins[k if len(origins) > 1 else 0]
        to = directions[k]
        ox = o[0]
        oy = o[1]
        oz = o[2]
        dx = to[0]
        dy = to[1]
        dz = to[2]
        at = np.int64(place[k])
        mesh_at = mesh
        if instances != 0:
            address = instances + memory.RECORD * np.int64(instance[k])
            record = int64s(address)
            mesh_at = record[memory.MESH_OF]
            at = at - record[memory.FIRST_PLACE]
            ox, oy, oz, dx, dy, dz, _ = exact.entered(float64s(address), ox, oy, oz, dx, dy, dz)
        axis, p, q, r, sx, sy, sz = shear(ox, oy, oz, dx, dy, dz)
        triangle = exact.corners_of(float64s(int64s(mesh_at)[0]), at, axis)
        a, b, c, det, _ = areas(triangle, (p, q, r, sx, sy, sz))
        sign = -1.0 if det < 0 else 1.0  # outside by float32's rounding: at the edge
        a = max(sign * a, 0.0)
        b = max(sign * b, 0.0)
        c = max(sign * c, 0.0)
        total = (a + b) + c
        u[k] = b / total
        v[k] = c / total


# Whether this process compiled the loops; otherwise it loaded what an earlier one had kept.
COMPILED = bool(trace.stats.cache_misses)
