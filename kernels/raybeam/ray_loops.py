"""Compiled loops that compute a pattern's rays with the same operations as `compute_rays_numpy`.

A ray is a beam of the pattern, or a sub-ray of a beam, that is cast from a pose. The rays of one
tile are computed at a time. `cast` is a `CAST` record (cast_record.py), and `tile` is the address
of tile memory for `rays` rays (tile_memory.py). `floats` and `numbers` access this memory as
float64 and int64. Arrays of a `CAST` are passed by address and have one column per beam or pose. A
vector contains four rays.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import carray, types

from . import cast_record as memory
from .arrays import Floats, Ints
from .cast_record import casts_at, float64s, int64s
from .compiled import INT64, called_by_address, compiled, inlined, noinline
from .pattern import Pattern
from .poses import Poses
from .tile_memory import DX, NUMBER, OX, POSE, ROW, WITHIN, row_index, thread_tiles
from .tile_sizes import VECTOR_RAYS
from .vectors import load, splat, square_root, store

_TINY = 2.0**-60  # replaces zero components of directions, to avoid 0 * inf
_SINGLE_ROW = VECTOR_RAYS  # columns of `SubRays.loop_table` if beams have a single sub-ray
_BEAMS = 64  # beams per tile if rays are computed but not cast


class FirstRay(NamedTuple):
    """Pattern row, pose, and index of the first ray in a call.

    Attributes
    ----------
    row
        Row in the pattern, counting each sub-ray as a row.
    pose, within
        Index of its pose, and index of the ray within the pose.
    ray
        Index of the ray in the scan.
    """

    row: int
    pose: int
    within: int
    ray: int


@inlined
def _floor_divide(number, divisor):  # type: ignore[no-untyped-def]
    """Divide integers below 2**52 and round down, faster than `//`."""
    return np.int64(np.floor(np.float64(number) / np.float64(divisor)))


@inlined
def perpendicular_axes(x, y, z):  # type: ignore[no-untyped-def]
    """Compute the two axes of `sub_rays.perpendicular_axes` as six components."""
    sign = -1.0 if z < 0 else 1.0
    a = -1.0 / (sign + z)
    b = x * y * a
    return 1 + sign * x * x * a, sign * b, -sign * x, b, sign + y * y * a, -y


@inlined
def oriented_axes(x, y, z, axis):  # type: ignore[no-untyped-def]
    """Compute the two axes of `sub_rays.oriented_axes` as six components.

    `axis` contains the three components of `SubRays.axis`.
    """
    a, b, c = axis
    p = b * z - c * y
    q = c * x - a * z
    r = a * y - b * x
    length = np.sqrt((p * p + q * q) + r * r)
    norm = max(length, 1e-300)
    p = p / norm
    q = q / norm
    r = r / norm
    u = y * r - z * q
    v = z * p - x * r
    w = x * q - y * p
    if length < 1e-6:
        p, q, r, u, v, w = perpendicular_axes(x, y, z)
    return p, q, r, u, v, w


@noinline
def _find_rows(tile, rays, first_row, row_count):  # type: ignore[no-untyped-def]
    """Write the pattern row of each ray in a tile. Each sub-ray counts as a separate row.

    `first_row` is the pattern row of the call's first ray. The pattern has `row_count` rows and
    repeats.
    """
    numbers = int64s(tile)
    number_at = row_index(NUMBER, rays)
    target = row_index(ROW, rays)
    for lane in range(rays):
        row = first_row + numbers[number_at + lane]
        numbers[target + lane] = row - _floor_divide(row, row_count) * row_count


@noinline
def _find_poses(tile, rays, first, rays_per_pose, last_pose):  # type: ignore[no-untyped-def]
    """Write each ray's pose index, and its index among the rays that share the pose.

    `first` is the `FirstRay` of the call, and `last_pose` the pose of its last ray. Rays that do
    not belong to the call use the closest of its poses.
    """
    numbers = int64s(tile)
    number_at = row_index(NUMBER, rays)
    pose_at = row_index(POSE, rays)
    within_at = row_index(WITHIN, rays)
    for lane in range(rays):
        inside = first.within + numbers[number_at + lane]
        later = _floor_divide(inside, rays_per_pose)
        numbers[pose_at + lane] = min(max(first.pose + later, first.pose), last_pose)
        numbers[within_at + lane] = inside - later * rays_per_pose


@noinline
def _look_up_beams(tile, rays, directions, beam_count):  # type: ignore[no-untyped-def]
    """Write the direction of each ray in a tile, given its pattern row."""
    numbers = int64s(tile)
    floats = float64s(tile)
    table = float64s(directions)
    row_of = row_index(ROW, rays)
    target = row_index(DX, rays)
    for lane in range(rays):
        row = numbers[row_of + lane]
        floats[target + lane] = table[row]
        floats[target + rays + lane] = table[beam_count + row]
        floats[target + 2 * rays + lane] = table[2 * beam_count + row]


@inlined
def _combine(a, x, b, y):  # type: ignore[no-untyped-def]
    return a * x + b * y


@noinline
def _make_sub_rays(tile, rays, cast):  # type: ignore[no-untyped-def]  # noqa: PLR0914, PLR0915 - a compiled loop
    """Write the direction of each sub-ray in a tile, and its start relative to the beam origin.

    The pattern rows of the sub-rays are replaced by the rows of their beams. Each beam occupies
    `lanes_per_beam` consecutive lanes. If beams have `offsets`, rows 1 and 2 of the sub-ray table
    contain angles, to which the offsets are added, instead of components.
    """
    numbers = int64s(tile)
    floats = float64s(tile)
    table = float64s(cast.sub_ray_table)
    offsets = float64s(cast.offsets)
    directions = float64s(cast.directions)
    beam_count = cast.beam_count
    lanes = cast.lanes_per_beam
    row_of = row_index(ROW, rays)
    origin = row_index(OX, rays)
    target = row_index(DX, rays)
    one = splat(1.0)
    axis = cast.axis[0], cast.axis[1], cast.axis[2]
    for first in range(0, rays, lanes):
        beam = _floor_divide(numbers[row_of + first], cast.subrays)
        for lane in range(first, first + lanes):
            numbers[row_of + lane] = beam
        x = directions[beam]
        y = directions[beam_count + beam]
        z = directions[2 * beam_count + beam]
        if cast.has_axis:
            a, b, c, d, e, f = oriented_axes(x, y, z, axis)
        else:
            a, b, c, d, e, f = perpendicular_axes(x, y, z)
        for k in range(0, lanes, 4):
            forward = load(table, k)
            across = load(table, lanes + k)
            up = load(table, 2 * lanes + k)
            if cast.offsets != 0:
                across = across + splat(offsets[beam])
                up = up + splat(offsets[beam_count + beam])
                forward = one / square_root((one + across * across) + up * up)
                across = across * forward
                up = up * forward
            i = target + first + k
            store(floats, i, _combine(forward, splat(x), across, splat(a)) + up * splat(d))
            store(floats, i + rays, _combine(forward, splat(y), across, splat(b)) + up * splat(e))
            store(
                floats, i + 2 * rays, _combine(forward, splat(z), across, splat(c)) + up * splat(f)
            )
            if cast.has_starts:
                lateral = load(table, 3 * lanes + k)
                vertical = load(table, 4 * lanes + k)
                i = origin + first + k
                store(floats, i, _combine(lateral, splat(a), vertical, splat(d)))
                store(floats, i + rays, _combine(lateral, splat(b), vertical, splat(e)))
                store(floats, i + 2 * rays, _combine(lateral, splat(c), vertical, splat(f)))


@noinline
def _make_single_sub_rays(tile, rays, cast):  # type: ignore[no-untyped-def]  # noqa: PLR0914 - a compiled loop
    """Do the same as `_make_sub_rays`, but for beams with a single sub-ray."""
    numbers = int64s(tile)
    floats = float64s(tile)
    table = float64s(cast.sub_ray_table)
    offsets = float64s(cast.offsets)
    directions = float64s(cast.directions)
    beam_count = cast.beam_count
    row_of = row_index(ROW, rays)
    origin = row_index(OX, rays)
    target = row_index(DX, rays)
    axis = cast.axis[0], cast.axis[1], cast.axis[2]
    forward = table[0]
    across = table[_SINGLE_ROW]
    up = table[2 * _SINGLE_ROW]
    for lane in range(rays):
        beam = numbers[row_of + lane]
        x = directions[beam]
        y = directions[beam_count + beam]
        z = directions[2 * beam_count + beam]
        if cast.has_axis:
            a, b, c, d, e, f = oriented_axes(x, y, z, axis)
        else:
            a, b, c, d, e, f = perpendicular_axes(x, y, z)
        if cast.offsets != 0:
            across = table[_SINGLE_ROW] + offsets[beam]
            up = table[2 * _SINGLE_ROW] + offsets[beam_count + beam]
            forward = 1 / np.sqrt((1 + across * across) + up * up)
            across = across * forward
            up = up * forward
        floats[target + lane] = (forward * x + across * a) + up * d
        floats[target + rays + lane] = (forward * y + across * b) + up * e
        floats[target + 2 * rays + lane] = (forward * z + across * c) + up * f
        if cast.has_starts:
            lateral = table[3 * _SINGLE_ROW]
            vertical = table[4 * _SINGLE_ROW]
            floats[origin + lane] = lateral * a + vertical * d
            floats[origin + rays + lane] = lateral * b + vertical * e
            floats[origin + 2 * rays + lane] = lateral * c + vertical * f


@inlined
def _rotate_four(floats, target, rays, matrix):  # type: ignore[no-untyped-def]
    """Rotate four vectors by four matrices.

    The components of the vectors are in three rows of the tile, starting at index `target`. Each of
    the nine elements of `matrix` contains one number for each of the four matrices.
    """
    a, b, c, d, e, f, g, h, i = matrix
    p = load(floats, target)
    q = load(floats, target + rays)
    r = load(floats, target + 2 * rays)
    store(floats, target, (p * a + q * b) + r * c)
    store(floats, target + rays, (p * d + q * e) + r * f)
    store(floats, target + 2 * rays, (p * g + q * h) + r * i)


@inlined
def _matrix(matrices, pose, poses):  # type: ignore[no-untyped-def]
    """Return a pose's matrix as nine SIMD vectors, each filled with one matrix element."""
    k = pose
    n = poses
    return (
        splat(matrices[k]),
        splat(matrices[k + n]),
        splat(matrices[k + 2 * n]),
        splat(matrices[k + 3 * n]),
        splat(matrices[k + 4 * n]),
        splat(matrices[k + 5 * n]),
        splat(matrices[k + 6 * n]),
        splat(matrices[k + 7 * n]),
        splat(matrices[k + 8 * n]),
    )


@inlined
def _rotate_one(floats, i, rays, matrices, k, n):  # type: ignore[no-untyped-def]
    """Rotate a vector by matrix `k` of `n`. Its components are `rays` apart, from index `i` on."""
    p = floats[i]
    q = floats[i + rays]
    r = floats[i + 2 * rays]
    floats[i] = (p * matrices[k] + q * matrices[k + n]) + r * matrices[k + 2 * n]
    floats[i + rays] = (p * matrices[k + 3 * n] + q * matrices[k + 4 * n]) + r * matrices[k + 5 * n]
    i += 2 * rays
    floats[i] = (p * matrices[k + 6 * n] + q * matrices[k + 7 * n]) + r * matrices[k + 8 * n]


@noinline
def _rotate(tile, rays, first_row, rotations, poses):  # type: ignore[no-untyped-def]
    """Rotate vectors in a tile to the axes of the scene.

    The vectors are in three rows of the tile, starting at row `first_row`. `rotations` is the
    address of the poses' matrices, float64 (9, poses).
    """
    numbers = int64s(tile)
    floats = float64s(tile)
    matrices = float64s(rotations)
    pose_at = row_index(POSE, rays)
    target = row_index(first_row, rays)
    if poses == 1:
        matrix = _matrix(matrices, 0, 1)
        for lane in range(0, rays, 4):
            _rotate_four(floats, target + lane, rays, matrix)
        return
    for start in range(0, rays, 4):
        k = numbers[pose_at + start]
        others = numbers[pose_at + start + 1], numbers[pose_at + start + 2]
        if others[0] == k and others[1] == k and numbers[pose_at + start + 3] == k:
            _rotate_four(floats, target + start, rays, _matrix(matrices, k, poses))
            continue
        for lane in range(start, start + 4):
            _rotate_one(floats, target + lane, rays, matrices, numbers[pose_at + lane], poses)


@noinline
def _apply_rates(tile, rays, first_row, cast):  # type: ignore[no-untyped-def]  # noqa: PLR0914 - a compiled loop
    """Rotate vectors in a tile by the angular velocities of the poses. See `PoseMotion`."""
    numbers = int64s(tile)
    floats = float64s(tile)
    delays = float64s(cast.delays)
    rates = float64s(cast.rates)
    poses = cast.poses
    pose_at = row_index(POSE, rays)
    within_at = row_index(WITHIN, rays)
    target = row_index(first_row, rays)
    for lane in range(rays):
        i = target + lane
        p = floats[i]
        q = floats[i + rays]
        r = floats[i + 2 * rays]
        k = numbers[pose_at + lane]
        delay = delays[numbers[within_at + lane]]
        a = rates[k]
        b = rates[k + poses]
        c = rates[k + 2 * poses]
        floats[i] = p + delay * (b * r - c * q)
        floats[i + rays] = q + delay * (c * p - a * r)
        floats[i + 2 * rays] = r + delay * (a * q - b * p)


@noinline
def _add_to_origins(tile, rays, table, count, field):  # type: ignore[no-untyped-def]
    """Add vectors from a table to the ray origins in a tile.

    Row `field` of the tile contains each ray's column in the table.
    """
    numbers = int64s(tile)
    floats = float64s(tile)
    vectors = float64s(table)
    column_of = row_index(field, rays)
    target = row_index(OX, rays)
    for lane in range(rays):
        k = numbers[column_of + lane]
        floats[target + lane] += vectors[k]
        floats[target + rays + lane] += vectors[k + count]
        floats[target + 2 * rays + lane] += vectors[k + 2 * count]


@noinline
def _add_position(tile, rays, position):  # type: ignore[no-untyped-def]
    """Add the position of a single pose to the ray origins in a tile. `position` is an address."""
    floats = float64s(tile)
    vector = float64s(position)
    target = row_index(OX, rays)
    for axis in range(3):
        number = splat(vector[axis])
        for k in range(target + axis * rays, target + (axis + 1) * rays, 4):
            store(floats, k, load(floats, k) + number)


@noinline
def _apply_velocities(tile, rays, cast):  # type: ignore[no-untyped-def]
    """Move the ray origins in a tile by the velocities of the poses."""
    numbers = int64s(tile)
    floats = float64s(tile)
    delays = float64s(cast.delays)
    velocities = float64s(cast.velocities)
    poses = cast.poses
    pose_at = row_index(POSE, rays)
    within_at = row_index(WITHIN, rays)
    target = row_index(OX, rays)
    for lane in range(rays):
        k = numbers[pose_at + lane]
        delay = delays[numbers[within_at + lane]]
        floats[target + lane] += delay * velocities[k]
        floats[target + rays + lane] += delay * velocities[k + poses]
        floats[target + 2 * rays + lane] += delay * velocities[k + 2 * poses]


@noinline
def _clear_origins(tile, rays):  # type: ignore[no-untyped-def]
    floats = float64s(tile)
    zero = splat(0.0)
    for k in range(row_index(OX, rays), row_index(OX + 3, rays), 4):
        store(floats, k, zero)


@noinline
def _write_origins(tile, rays, cast):  # type: ignore[no-untyped-def]
    """Write the origin of each ray in a tile, in scene coordinates in meters.

    If sub-rays have starts, these must already be in the rows of the origins.
    """
    has_starts = cast.sub_ray_table != 0 and cast.has_starts != 0
    if not has_starts:
        _clear_origins(tile, rays)
    if cast.origins != 0:
        _add_to_origins(tile, rays, cast.origins, cast.beam_count, ROW)
    if cast.origins != 0 or has_starts:
        if cast.rotations != 0:
            _rotate(tile, rays, OX, cast.rotations, cast.poses)
        if cast.delays != 0:
            _apply_rates(tile, rays, OX, cast)
    if cast.poses == 1:
        _add_position(tile, rays, cast.positions)
    else:
        _add_to_origins(tile, rays, cast.positions, cast.poses, POSE)
    if cast.delays != 0:
        _apply_velocities(tile, rays, cast)


@noinline
def _to_local(tile, rays, x, y, z, scale):  # type: ignore[no-untyped-def]
    """Convert the ray origins in a tile from meters to local coordinates."""
    floats = float64s(tile)
    target = row_index(OX, rays)
    factor = splat(scale)
    for k in range(0, rays, 4):
        i = target + k
        store(floats, i, (load(floats, i) - splat(x)) * factor)
        store(floats, i + rays, (load(floats, i + rays) - splat(y)) * factor)
        store(floats, i + 2 * rays, (load(floats, i + 2 * rays) - splat(z)) * factor)


@noinline
def _write_output(tile, rays, first_row, address, total, count):  # type: ignore[no-untyped-def]
    """Copy vectors from a tile to an output array for all rays in a cast.

    `address` is the output for the first ray of the call, and `count` is the number of rays in the
    call.
    """
    numbers = int64s(tile)
    floats = float64s(tile)
    vectors = float64s(address)
    number_at = row_index(NUMBER, rays)
    source = row_index(first_row, rays)
    for lane in range(rays):
        k = numbers[number_at + lane]
        if 0 <= k < count:
            vectors[k] = floats[source + lane]
            vectors[k + total] = floats[source + rays + lane]
            vectors[k + 2 * total] = floats[source + 2 * rays + lane]


@inlined
def first_ray(cast, ray):  # type: ignore[no-untyped-def]
    """Return the `FirstRay` of a call that starts at the given ray of the scan."""
    total = cast.beam_count * cast.subrays
    rays_per_pose = cast.rays_per_pose
    pose = ray // rays_per_pose
    within = ray - pose * rays_per_pose
    return FirstRay((cast.first + ray) % total, pose, within, ray)


@called_by_address(types.void(*4 * INT64))
def make_rays(address, start, rays, count):  # type: ignore[no-untyped-def]
    """Compute the rays in a tile from their indices, in local coordinates.

    `address` is the address of the `CAST`, `start` is the index of the call's first ray in the
    scan, and `count` is the number of rays in the call, or 0 if the rays can be anywhere in the
    scan. The tile may also contain neighboring rays that do not belong to the call. If all rays
    share an origin, `write_shared_origin` must have written it to the tile. The rays are also
    written to the ray outputs of the cast, if there are any.
    """
    cast = carray(casts_at(address), 1)[0]
    tile = cast.tile
    first = first_ray(cast, start)
    _find_rows(tile, rays, first.row, cast.beam_count * cast.subrays)
    if cast.poses > 1 or cast.delays != 0:
        last_pose = cast.poses - 1
        if count > 0:
            last_pose = _floor_divide(start + count - 1, cast.rays_per_pose)
        _find_poses(tile, rays, first, cast.rays_per_pose, last_pose)
    if cast.sub_ray_table != 0:
        if cast.lanes_per_beam == 1:
            _make_single_sub_rays(tile, rays, cast)
        else:
            _make_sub_rays(tile, rays, cast)
    else:
        _look_up_beams(tile, rays, cast.directions, cast.beam_count)
    if cast.rotations != 0:
        _rotate(tile, rays, DX, cast.rotations, cast.poses)
    if cast.delays != 0:
        _apply_rates(tile, rays, DX, cast)
    if cast.directions_out != 0:
        out = cast.directions_out + 8 * first.ray
        _write_output(tile, rays, DX, out, cast.ray_count, count)
    if cast.shares_origin == 0:
        _write_origins(tile, rays, cast)
        if cast.origins_out != 0:
            out = cast.origins_out + 8 * first.ray
            _write_output(tile, rays, OX, out, cast.ray_count, count)
        _to_local(tile, rays, cast.center[0], cast.center[1], cast.center[2], cast.scale)


@noinline
def write_shared_origin(cast, tile, rays):  # type: ignore[no-untyped-def]
    """Write the common origin of all rays in a cast to a tile, in local coordinates.

    All tiles of a cast use the same memory, and `make_rays` does not change this origin, so it is
    written only once before the first tile.
    """
    _write_origins(tile, rays, cast)
    _to_local(tile, rays, cast.center[0], cast.center[1], cast.center[2], cast.scale)


@inlined
def _clip_axis(lower, upper, o, d, entry):  # type: ignore[no-untyped-def]
    """Return the larger of `entry` and the distance at which a ray enters a slab.

    The slab lies between `lower` and `upper` along an axis.
    """
    component = d
    if abs(d) < _TINY:
        component = -_TINY if d < 0 else _TINY
    return max(entry, min((lower - o) / component, (upper - o) / component))


@inlined
def entry_distance(half, o, d):  # type: ignore[no-untyped-def]
    """Return the distance at which a ray enters a cube, or 0 if it starts inside.

    The cube extends from -half to half along each axis. All lengths are in local units. `o` and `d`
    are the origin and the direction of the ray. The result is meaningless if the ray misses the
    cube.
    """
    entry = 0.0
    if max(max(abs(o[0]), abs(o[1])), abs(o[2])) > half:
        entry = _clip_axis(-half, half, o[0], d[0], entry)
        entry = _clip_axis(-half, half, o[1], d[1], entry)
        entry = _clip_axis(-half, half, o[2], d[2], entry)
    return entry


@compiled(types.void(memory.CASTS, types.int64[::1], types.float64[:, ::1], types.float64[:, ::1]))
def _compute_rays(casts, rays, origins, directions):  # type: ignore[no-untyped-def]
    """Write ray directions, and also write ray origins unless the array `origins` is empty."""
    cast = casts[0]
    address = casts.ctypes.data
    tile = cast.tile
    lanes = cast.tile_rays
    each = cast.lanes_per_beam
    count = len(rays)
    numbers = int64s(tile)
    floats = float64s(tile)
    number_at = row_index(NUMBER, lanes)
    origin = row_index(OX, lanes)
    direction = row_index(DX, lanes)
    beams = lanes // each
    for start in range(0, count, beams):
        # Each requested ray takes the lanes of a whole beam, of which one lane contains the ray.
        for k in range(beams):
            number = rays[min(start + k, count - 1)]
            first_of_beam = number - (cast.first + number) % cast.subrays
            for lane in range(each):
                numbers[number_at + k * each + lane] = first_of_beam + min(lane, cast.subrays - 1)
        make_rays(address, 0, lanes, 0)
        for k in range(min(beams, count - start)):
            number = rays[start + k]
            lane = k * each + (cast.first + number) % cast.subrays
            for axis in range(3):
                directions[axis, start + k] = floats[direction + axis * lanes + lane]
            if origins.shape[1] > 0:
                for axis in range(3):
                    origins[axis, start + k] = floats[origin + axis * lanes + lane]


def compute_rays_compiled(
    pattern: Pattern, first: int, ray: Ints, poses: Poses
) -> tuple[Floats | None, Floats]:
    """Compute the origins and directions of rays with compiled loops.

    The arguments are as in `pattern_rays.compute_rays`. The results are float64 (3, m). The origins
    are None if all rays share an origin.
    """
    cast = memory.CastRecord(np.zeros(1, memory.CAST))
    record = cast.record
    cast.set_pattern(pattern, poses, first)
    record["scale"] = 1.0  # local coordinates are scene coordinates in meters
    lanes = _BEAMS * int(record["lanes_per_beam"][0])
    record["tile_rays"] = lanes
    record["tile"] = thread_tiles.address(lanes, 0, 0)
    origins = np.empty((3, 0 if record["shares_origin"] else len(ray)))
    directions = np.empty((3, len(ray)))
    _compute_rays(record, np.ascontiguousarray(ray), origins, directions)
    return None if record["shares_origin"] else origins, directions
