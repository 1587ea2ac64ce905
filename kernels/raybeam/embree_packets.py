"""The loop that casts a scan: groups of 16 neighbouring rays in Embree's packets, hits in order.

The numbers of two neighbours along a ring differ by `step`. A block has `rays_along` neighbours
along a ring, and all rays between these neighbours, so `step` rings; a group has `rays_along` rays
of `rays_across` rings of a block. After a block, its hits are written in the order of rays.

`scratch` is the address of the `SCRATCH` memory, `numbers` and `floats` point to that memory as
int64 and float64; `valid`, `packet` and `arguments` of that memory are what Embree reads.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import carray, types

from . import embree_exact as exact
from . import embree_memory as memory
from .compiled import callback, compiled, external, inlined, stage
from .embree_memory import (
    KEYS_PER_INSTANCE,
    LANES,
    byte_offset,
    casts_at,
    field_index,
    float32s,
    float64s,
    int32s,
    int64s,
)
from .embree_rays import block_start, localise, make_group, write_origins
from .triangle_loops import areas, shear

_ARGUMENTS = field_index("arguments")
_ARGUMENTS_AT = byte_offset("arguments")
_FILTER = field_index("arguments") + 2
_VALID_AT = byte_offset("valid")
_PACKET = field_index("packet")
_PACKET_AT = byte_offset("packet")
_RAY_IN_GROUP = field_index("ray_in_group")
_LANE = field_index("lane")
_RAY = field_index("ray")
_REAL = field_index("real")
_ENTRY = field_index("entry")
_OX, _OY, _OZ, _DX, _DY, _DZ = map(field_index, ("ox", "oy", "oz", "dx", "dy", "dz"))
_MESH = field_index("mesh")
_INSTANCES = field_index("instances")
_MASKED = field_index("masked")
_T_MIN = field_index("t_min")
_T_MAX = field_index("t_max")
_SCENE = field_index("scene")
_NEARBY = field_index("nearby")
_INSIDE = field_index("inside")
_LENGTH = field_index("length")
_ROUGH = field_index("rough")
_FIRST = field_index("first_candidate")
_SECOND = field_index("second_candidate")
_ROUGH_32 = field_index("rough_32")
_FIRST_32 = field_index("first_32")
_SECOND_32 = field_index("second_32")
_T = field_index("t")
_KEY = field_index("key")
_SURE = field_index("sure")
_POSE = field_index("pose")
f64_1 = types.float64[::1]
f64_2 = types.float64[:, ::1]
i32_1 = types.int32[::1]
_FIELDS = 22  # numbers of each ray in a packet, an RTCRayHitN: field by field, N rays each

_intersect_4, _intersect_8, _intersect_16 = (
    types.ExternalFunction(
        f"rtcIntersect{width}", types.void(types.intp, types.intp, types.intp, types.intp)
    )
    for width in (4, 8, 16)
)


@inlined
def prepare(cast):  # type: ignore[no-untyped-def]
    """Write the numbers that all rays of a `CAST` share to the scratch memory."""
    scratch = cast.scratch
    width = cast.width
    numbers = int64s(scratch)
    floats = float64s(scratch)
    rays = float32s(scratch)
    integers = int32s(scratch)
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
                integers[k + 9 * width] = -1
                integers[k + 10 * width] = 0
                integers[k + 11 * width] = 0
                for field in (18, 19, 20):
                    integers[k + field * width] = -1
    for lane in range(LANES):  # without instances nothing writes it again
        floats[_LENGTH + lane] = 1.0


@inlined
def _is_incoherent(floats, coherence):  # type: ignore[no-untyped-def]
    """Return whether a sampled ray of a group differs too much from the first ray for a packet.

    `coherence` is the minimum cosine between their directions.
    """
    x = floats[_DX]
    y = floats[_DY]
    z = floats[_DZ]
    for lane in (5, 10, LANES - 1):
        if x * floats[_DX + lane] + y * floats[_DY + lane] + z * floats[_DZ + lane] < coherence:
            return True
    return False


@inlined
def _on_grid(d, rounding):  # type: ignore[no-untyped-def]
    """Return a component of a direction in a packet: rounded, so that none is too close to zero.

    With the flag `COHERENT`, Embree (`intersectCoherent` of bvh_intersector_hybrid.cpp) divides a
    packet into parts whose directions have the same signs, and casts each part as a frustum, whose
    sides follow from the sign of the reciprocals. But for the reciprocals, `zero_fix` of vec3.h
    replaces components nearer to zero than 1e-18 by +1e-18. So a ray with a component of -1e-19 is
    in the part of the negative components, and its reciprocal is positive: that turns the frustum
    inside out, and all rays of the part miss. Zeros of both signs count as positive in both places.
    A ray that is cast by itself is in no frustum.

    A component becomes a multiple of the spacing of numbers about `rounding`, see
    `embree_library.direction_grid`.
    """
    return np.float32((d + rounding) - rounding)


def _filler(width: int) -> Any:
    """Return a function that fills packets of `width` rays, by vector instructions."""

    @stage
    def fill(scratch, t_min, t_max, rounding, has_origins):  # type: ignore[no-untyped-def]
        """Write the rays of a group to packets, in float32.

        Origins and the lower limits of distances are not written if the packets have these already;
        directions and the upper limits are. `t_min` and `t_max` are local, `rounding` is of the
        `CAST`.
        """
        rays = float32s(scratch)
        floats = float64s(scratch)
        if not has_origins:
            for lane in range(LANES):
                k = _PACKET + (_FIELDS - 1) * (lane & -width) + lane
                entry = floats[_ENTRY + lane]
                rays[k] = exact.embree_origin(floats[_OX + lane], floats[_DX + lane], entry)
                rays[k + width] = exact.embree_origin(floats[_OY + lane], floats[_DY + lane], entry)
                rays[k + 2 * width] = exact.embree_origin(
                    floats[_OZ + lane], floats[_DZ + lane], entry
                )
                rays[k + 3 * width] = np.float32(max(t_min - entry - exact.MARGIN, 0.0))
        for lane in range(LANES):
            k = _PACKET + (_FIELDS - 1) * (lane & -width) + lane
            reach = min(t_max - floats[_ENTRY + lane] + exact.MARGIN, exact.MAX_DISTANCE)
            rays[k + 4 * width] = _on_grid(floats[_DX + lane], rounding)
            rays[k + 5 * width] = _on_grid(floats[_DY + lane], rounding)
            rays[k + 6 * width] = _on_grid(floats[_DZ + lane], rounding)
            rays[k + 8 * width] = np.float32(reach)

    return fill


_fill_4, _fill_8, _fill_16 = map(_filler, (4, 8, 16))


@inlined
def _fill(cast, has_origins):  # type: ignore[no-untyped-def]
    """Write a group's rays to the packets of a `CAST`; the origins unless `has_origins`."""
    if cast.width == 16:
        _fill_16(cast.scratch, cast.t_min, cast.t_max, cast.rounding, has_origins)
    elif cast.width == 8:
        _fill_8(cast.scratch, cast.t_min, cast.t_max, cast.rounding, has_origins)
    else:
        _fill_4(cast.scratch, cast.t_min, cast.t_max, cast.rounding, has_origins)


@stage
def _select_rays(scratch, first_ring, rays_across, step, count):  # type: ignore[no-untyped-def]
    """Write the numbers within the block of a group's rays; return how many are no copies.

    `first_ring` is the lowest of the group's `rays_across` rings, and the number of the first ray.
    Copies of the first ray stand for rays beyond the `step` rings or the `count` rays of the block.
    """
    numbers = int64s(scratch)
    valid = int32s(scratch + _VALID_AT)
    real = np.int64(0)
    for lane in range(LANES):
        ring = first_ring + (lane & (rays_across - 1))
        ray = first_ring + numbers[_RAY_IN_GROUP + lane]
        exists = (ring < step) & (ray < count)
        numbers[_RAY + lane] = ray if exists else first_ring
        numbers[_REAL + lane] = np.int64(exists)
        valid[lane] = np.int32(-1) if exists else np.int32(0)
        real += np.int64(exists)
    return real


@stage
def _reset(scratch, masked):  # type: ignore[no-untyped-def]
    """Reset the candidates; in 32 bits alone unless `masked`."""
    singles = float32s(scratch)
    integers = int32s(scratch)
    for lane in range(LANES):
        singles[_ROUGH_32 + lane] = np.float32(np.inf)
        integers[_FIRST_32 + lane] = integers[_SECOND_32 + lane] = np.int32(-1)
    if masked:
        numbers = int64s(scratch)
        floats = float64s(scratch)
        for lane in range(LANES):
            floats[_ROUGH + lane] = np.inf
            numbers[_INSIDE + lane] = -1
            numbers[_FIRST + lane] = numbers[_SECOND + lane] = -1
            numbers[_SURE + lane] = 1


@stage
def _count_candidates(scratch):  # type: ignore[no-untyped-def]
    """Return the number of rays with a candidate in 32 bits, and of rays along an axis."""
    floats = float64s(scratch)
    integers = int32s(scratch)
    candidates = np.int64(0)
    axis_rays = np.int64(0)
    for lane in range(LANES):
        candidates += np.int64(integers[_FIRST_32 + lane] >= 0)
    for lane in range(LANES):
        axis_rays += np.int64(exact.is_along_axis(floats, lane))
    return candidates, axis_rays


@stage
def _cast_singly(scene, scratch, proposer, t_max):  # type: ignore[no-untyped-def]
    """Cast each ray of a group by itself; `proposer` is the address of the filter."""
    numbers = int64s(scratch)
    flags = int32s(scratch + _ARGUMENTS_AT)
    flags[0] = exact.CALL_FILTER
    numbers[_FILTER] = proposer
    for lane in range(LANES):
        if numbers[_REAL + lane]:
            exact.cast_single(scene, scratch, lane, t_max, 0.0, 0.0)
    flags[0] = exact.CALL_FILTER | exact.COHERENT


@inlined
def _cast_packets(cast, has_origins):  # type: ignore[no-untyped-def]
    """Cast a group in packets; `has_origins` if the packets have the origins already."""
    scratch = cast.scratch
    scene = cast.scene
    width = cast.width
    numbers = int64s(scratch)
    _fill(cast, has_origins)
    arguments = scratch + _ARGUMENTS_AT
    numbers[_FILTER] = cast.packets[0]
    if width == 16:
        _intersect_16(scratch + _VALID_AT, scene, scratch + _PACKET_AT, arguments)
        return
    for packet in range(LANES // width):
        numbers[_FILTER] = cast.packets[packet]
        numbers[_LANE] = packet * width
        valid = scratch + _VALID_AT + 4 * packet * width
        rays = scratch + _PACKET_AT + 4 * _FIELDS * packet * width
        if width == 8:
            _intersect_8(valid, scene, rays, arguments)
        else:
            _intersect_4(valid, scene, rays, arguments)
    numbers[_LANE] = 0


@inlined
def _cast_unsure(cast, axis_rays):  # type: ignore[no-untyped-def]
    """Cast the rays whose hits are not sure, and rays along an axis, by themselves."""
    scratch = cast.scratch
    numbers = int64s(scratch)
    floats = float64s(scratch)
    for lane in range(LANES):
        unsure = numbers[_SURE + lane] == 0 or (axis_rays and exact.is_along_axis(floats, lane))
        if unsure and numbers[_REAL + lane]:
            numbers[_FILTER] = cast.decide
            exact.cast_until_sure(cast.scene, scratch, lane, cast.t_max)


@callback(types.int64(types.int64, types.int64, types.int64))
def _cast_group(address, real, has_origins):  # type: ignore[no-untyped-def]
    """Cast the rays of a group, and write their hits to `t` and `key`; return 0 if all miss.

    `address` is of a `CAST`, `real` the number of rays that are no copies, and `has_origins`
    whether the packets have the origins already.
    """
    cast = carray(casts_at(address), 1)[0]
    mesh = cast.mesh
    instances = cast.instances
    scratch = cast.scratch
    masked = cast.masked
    numbers = int64s(scratch)
    floats = float64s(scratch)
    _reset(scratch, masked)
    if masked and instances == 0:  # `propose` looks at masks
        exact.shear_all(scratch)
    if cast.width == 1 or real == 1 or _is_incoherent(floats, cast.coherence):
        _cast_singly(cast.scene, scratch, cast.single, cast.t_max)
    else:
        _cast_packets(cast, has_origins)
    candidates, axis_rays = _count_candidates(scratch)
    if not masked and candidates + axis_rays == 0:
        return False
    if not masked:
        exact.verify_all(scratch, mesh, instances, cast.t_min)
    else:
        for lane in range(LANES):
            exact.verify(mesh, instances, numbers, floats, lane)
    _cast_unsure(cast, axis_rays)
    return True


# `_cast_group`, called by its address: as a part of each loop it would take 4 s more to compile.
cast_group = external("raybeam_cast_group", _cast_group)


@compiled(types.int64(memory.CASTS, types.int64, types.int64))
def trace(casts, start, stop):  # type: ignore[no-untyped-def]  # noqa: C901, PLR0914, PLR0915 - a compiled loop
    """Cast rays `start` to `stop` of a `CAST`; write the hits in ray order, return their number."""
    cast = casts[0]
    address = casts.ctypes.data
    scratch = cast.scratch
    instances = cast.instances
    t_max = cast.t_max
    shares_origin = cast.shares_origin != 0
    step = cast.step
    rays_across = cast.rays_across
    shift = 0 if rays_across == 1 else (1 if rays_across == 2 else 2)
    metre = 1.0 / cast.scale
    index = int32s(cast.index)
    indexed = cast.index != 0
    numbers = int64s(scratch)
    floats = float64s(scratch)
    span = step * cast.rays_along
    block_distances = float64s(cast.block_memory)
    block_triangles = int32s(cast.block_memory + 8 * span)  # -1 for a miss
    block_instances = int32s(cast.block_memory + 12 * span)
    ray_out = memory.uint32s(cast.ray)
    distance_out = float64s(cast.distance)
    triangle_out = int32s(cast.triangle)
    instance_out = int32s(cast.instance)
    prepare(cast)
    has_origins = np.int64(shares_origin and cast.starts_near != 0)
    for lane in range(LANES):
        numbers[_RAY_IN_GROUP + lane] = (lane >> shift) * step + (lane & (rays_across - 1))
        numbers[_POSE + lane] = 0
        floats[_ENTRY + lane] = 0.0
    if shares_origin:
        write_origins(cast, scratch)
        localise(cast, scratch)
        if cast.width > 1:
            _fill(cast, np.int64(0))
    hit_count = 0
    for block in range(start, stop, span):
        count = min(span, stop - block)
        block_first = block_start(cast, block)
        for ring in range(0, min(step, count), rays_across):
            real = _select_rays(scratch, ring, rays_across, step, count)
            make_group(cast, scratch, block_first)
            if not cast_group(address, real, has_origins):
                for lane in range(LANES):
                    block_triangles[numbers[_RAY + lane]] = -1
                continue
            for lanes_after in range(LANES):  # backwards: the first ray overwrites the copies
                lane = LANES - 1 - lanes_after
                ray = numbers[_RAY + lane]
                t = floats[_T + lane]
                key = numbers[_KEY + lane]
                block_distances[ray] = t
                block_triangles[ray] = key if t <= t_max else -1
                if instances != 0:
                    block_instances[ray] = key // KEYS_PER_INSTANCE
        for k in range(count):
            triangle = np.int64(block_triangles[k])
            if triangle < 0:
                continue
            if instances != 0:
                record = int64s(instances + memory.INSTANCE_BYTES * block_instances[k])
                triangle = (triangle & (KEYS_PER_INSTANCE - 1)) + record[memory.FIRST_ROW_FIELD]
                instance_out[hit_count] = block_instances[k]
            ray_out[hit_count] = block - cast.first_ray + k
            distance_out[hit_count] = block_distances[k] * metre
            triangle_out[hit_count] = index[triangle] if indexed else triangle
            hit_count += 1
    return hit_count


@compiled(types.void(memory.CASTS, f64_2, f64_2, i32_1, i32_1, f64_1, f64_1))
def weigh(  # type: ignore[no-untyped-def]  # noqa: PLR0914 - a compiled loop
    casts, origins, directions, triangle_row, instance, u, v
):
    """Write the weights `u` and `v` (m,) of the second and third corner for hits of a `CAST`.

    Rays (m, 3) are local to the scene; origins are (1, 3) if all rays share their origin.
    `triangle_row`, the row in the corners of all meshes, and `instance` are hits that `trace` wrote
    with `index` 0.
    """
    mesh = casts[0].mesh
    instances = casts[0].instances
    for k in range(len(triangle_row)):
        o = origins[k if len(origins) > 1 else 0]
        d = directions[k]
        ox = o[0]
        oy = o[1]
        oz = o[2]
        dx = d[0]
        dy = d[1]
        dz = d[2]
        row = np.int64(triangle_row[k])
        mesh_address = mesh
        if instances != 0:
            address = instances + memory.INSTANCE_BYTES * np.int64(instance[k])
            record = int64s(address)
            mesh_address = record[memory.MESH_FIELD]
            row = row - record[memory.FIRST_ROW_FIELD]
            ox, oy, oz, dx, dy, dz, _ = exact.enter_instance(
                float64s(address), ox, oy, oz, dx, dy, dz
            )
        axis, p, q, r, sx, sy, sz = shear(ox, oy, oz, dx, dy, dz)
        corners = exact.corners_of(float64s(int64s(mesh_address)[0]), row, axis)
        a, b, c, det, _ = areas(corners, (p, q, r, sx, sy, sz))
        sign = -1.0 if det < 0 else 1.0  # areas of a hit have the sign of `det`, or are 0
        a = max(sign * a, 0.0)
        b = max(sign * b, 0.0)
        c = max(sign * c, 0.0)
        total = (a + b) + c
        u[k] = b / total
        v[k] = c / total


# Whether this process compiled the loops; otherwise numba loaded the code of an earlier process.
COMPILED = bool(trace.stats.cache_misses)
