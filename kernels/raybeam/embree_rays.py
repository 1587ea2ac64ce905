"""Rays of a pattern, sixteen at a time in compiled loops, with the operations of `plain_rays`.

Each step is a loop over the `LANES` rays of a group that becomes a few vector instructions. A ray
is a beam of the pattern, or a sub-ray of a beam, cast from a pose.

`cast` is a `CAST` record and `scratch` the address of the `SCRATCH` memory (embree_memory.py), to
which `floats` and `numbers` point as float64 and int64. A function that writes a quantity of a
group's rays writes the field of the scratch memory of that name. Tables that a `CAST` names come as
addresses, with one column for each beam or pose.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import types

from . import embree_memory as memory
from .arrays import Floats, Ints
from .compiled import compiled, inlined, stage
from .embree_memory import LANES, field_index, float64s, int64s
from .mesh import NEAR
from .pattern import Pattern
from .poses import Poses

_OX, _OY, _OZ, _DX, _DY, _DZ = map(field_index, ("ox", "oy", "oz", "dx", "dy", "dz"))
_RAY, _ROW, _POSE, _WITHIN = map(field_index, ("ray", "row", "pose", "within"))
_STRAIGHT = field_index("straight")
_ACROSS = field_index("across")
_UP = field_index("up")
_ASIDE = field_index("aside")
_ABOVE = field_index("above")
_ENTRY = field_index("entry")
_TINY = 2.0**-60  # replaces a direction component of zero, to avoid 0 * inf


class BlockStart(NamedTuple):
    """The first ray of a block.

    Attributes
    ----------
    row
        Row in the pattern, counted in sub-rays.
    pose, within
        Number of the pose, and number of the ray within the pose.
    ray
        Number of the ray in the scan.
    """

    row: int
    pose: int
    within: int
    ray: int


@inlined
def exact_quotient(number, divisor):  # type: ignore[no-untyped-def]
    """Return ``number // divisor``, for whole numbers from 0 to 2^52: exact, faster than `//`."""
    return np.int64(np.float64(number) / np.float64(divisor))


@inlined
def any_axes(x, y, z):  # type: ignore[no-untyped-def]
    """Return the two axes across a unit direction of `sub_rays.any_axes`, as six numbers."""
    sign = -1.0 if z < 0 else 1.0
    a = -1.0 / (sign + z)
    b = x * y * a
    return 1 + sign * x * x * a, sign * b, -sign * x, b, sign + y * y * a, -y


@inlined
def axes_about(x, y, z, axis):  # type: ignore[no-untyped-def]
    """Return the two axes across a unit direction of `sub_rays.axes_about`, as six numbers.

    `axis` is `SubRays.axis`: three numbers.
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
        p, q, r, u, v, w = any_axes(x, y, z)
    return p, q, r, u, v, w


@stage
def _find_rows(scratch, first_row, row_count):  # type: ignore[no-untyped-def]
    """Write the rows in the pattern of a group's rays, counted in sub-rays.

    `first_row` is the row of the block's first ray; the pattern, of `row_count` rows, repeats.
    """
    numbers = int64s(scratch)
    max_row = np.int64(0)
    for lane in range(LANES):
        row = first_row + numbers[_RAY + lane]
        numbers[_ROW + lane] = row - row_count if row >= row_count else row
    for lane in range(LANES):
        max_row = max(max_row, numbers[_ROW + lane])
    if max_row >= row_count:  # a short pattern that repeats
        for lane in range(LANES):
            numbers[_ROW + lane] %= row_count


@stage
def _find_poses(scratch, pose, within, rays_per_pose):  # type: ignore[no-untyped-def]
    """Write the poses of a group's rays, and the numbers of the rays within their poses.

    `pose` and `within` are the numbers of the block's first ray.
    """
    numbers = int64s(scratch)
    for lane in range(LANES):
        inside = within + numbers[_RAY + lane]
        later = exact_quotient(inside, rays_per_pose)
        numbers[_POSE + lane] = pose + later
        numbers[_WITHIN + lane] = inside - later * rays_per_pose


@stage
def _look_up_subrays(scratch, shares, offsets, directions, rows, subrays):  # type: ignore[no-untyped-def]
    """Write the beam direction of each sub-ray of a group, and the sub-ray's components.

    The components, from `SubRays.loop_table` at `shares`, are of the sub-ray's direction along the
    beam, across and up, and of its start across and up. With `offsets` (2, rows) of the
    beams, radians, rows across and up of the table are tangents of angles, to which the offsets are
    added; 0 for none. Rows in the pattern become rows of the `rows` beams.
    """
    numbers = int64s(scratch)
    floats = float64s(scratch)
    table = float64s(shares)
    beam_directions = float64s(directions)
    beam_offsets = float64s(offsets)
    for lane in range(LANES):
        row = numbers[_ROW + lane]
        beam = exact_quotient(row, subrays)
        k = row - beam * subrays
        numbers[_ROW + lane] = beam
        floats[_STRAIGHT + lane] = table[k]
        floats[_ACROSS + lane] = table[subrays + k]
        floats[_UP + lane] = table[2 * subrays + k]
        floats[_ASIDE + lane] = table[3 * subrays + k]
        floats[_ABOVE + lane] = table[4 * subrays + k]
        floats[_DX + lane] = beam_directions[beam]
        floats[_DY + lane] = beam_directions[rows + beam]
        floats[_DZ + lane] = beam_directions[2 * rows + beam]
    if offsets:
        for lane in range(LANES):
            beam = numbers[_ROW + lane]
            across = floats[_ACROSS + lane] + beam_offsets[beam]
            up = floats[_UP + lane] + beam_offsets[rows + beam]
            straight = 1 / np.sqrt((1 + across * across) + up * up)
            floats[_STRAIGHT + lane] = straight
            floats[_ACROSS + lane] = across * straight
            floats[_UP + lane] = up * straight


@inlined
def _spread_lane(floats, lane, has_starts, axes):  # type: ignore[no-untyped-def]
    """Replace the direction of a beam by its sub-ray's, and write the sub-ray's start.

    `axes` are six numbers: the axes across and up.
    """
    x = floats[_DX + lane]
    y = floats[_DY + lane]
    z = floats[_DZ + lane]
    a, b, c, d, e, f = axes
    straight = floats[_STRAIGHT + lane]
    across = floats[_ACROSS + lane]
    up = floats[_UP + lane]
    floats[_DX + lane] = (straight * x + across * a) + up * d
    floats[_DY + lane] = (straight * y + across * b) + up * e
    floats[_DZ + lane] = (straight * z + across * c) + up * f
    if has_starts:
        aside = floats[_ASIDE + lane]
        above = floats[_ABOVE + lane]
        floats[_OX + lane] = aside * a + above * d
        floats[_OY + lane] = aside * b + above * e
        floats[_OZ + lane] = aside * c + above * f


@stage
def _spread_any(scratch, has_starts):  # type: ignore[no-untyped-def]
    """Write the sub-rays of a group, across the axes of `any_axes`."""
    floats = float64s(scratch)
    for lane in range(LANES):
        x = floats[_DX + lane]
        y = floats[_DY + lane]
        z = floats[_DZ + lane]
        _spread_lane(floats, lane, has_starts, any_axes(x, y, z))


@stage
def _spread_about(scratch, has_starts, a, b, c):  # type: ignore[no-untyped-def]
    """Write the sub-rays of a group, across the axes of `axes_about`."""
    floats = float64s(scratch)
    for lane in range(LANES):
        x = floats[_DX + lane]
        y = floats[_DY + lane]
        z = floats[_DZ + lane]
        _spread_lane(floats, lane, has_starts, axes_about(x, y, z, (a, b, c)))


@inlined
def _make_subrays(cast, scratch):  # type: ignore[no-untyped-def]
    """Write the directions of a group's sub-rays, and starts relative to the beams' origins."""
    _look_up_subrays(scratch, cast.shares, cast.offsets, cast.directions, cast.rows, cast.subrays)
    if cast.has_axis:
        _spread_about(scratch, cast.has_starts, cast.axis[0], cast.axis[1], cast.axis[2])
    else:
        _spread_any(scratch, cast.has_starts)


@stage
def _rotate_by_one(scratch, matrix, x, y, z):  # type: ignore[no-untyped-def]
    """Rotate vectors of a group by a matrix at an address; x, y, z are the components' fields."""
    floats = float64s(scratch)
    m = float64s(matrix)
    a = m[0]
    b = m[1]
    c = m[2]
    d = m[3]
    e = m[4]
    f = m[5]
    g = m[6]
    h = m[7]
    i = m[8]
    for lane in range(LANES):
        p = floats[x + lane]
        q = floats[y + lane]
        r = floats[z + lane]
        floats[x + lane] = (p * a + q * b) + r * c
        floats[y + lane] = (p * d + q * e) + r * f
        floats[z + lane] = (p * g + q * h) + r * i


@stage
def _rotate_by_poses(scratch, poses, rotations, x, y, z):  # type: ignore[no-untyped-def]  # noqa: PLR0914 - a compiled loop
    """Rotate vectors of a group from the sensor's to the scene's axes, by the pose of each ray.

    `rotations` is the address of matrices, float64 (9, poses).
    """
    numbers = int64s(scratch)
    floats = float64s(scratch)
    matrices = float64s(rotations)
    for lane in range(LANES):
        p = floats[x + lane]
        q = floats[y + lane]
        r = floats[z + lane]
        k = numbers[_POSE + lane]
        a = matrices[k]
        b = matrices[k + poses]
        c = matrices[k + 2 * poses]
        d = matrices[k + 3 * poses]
        e = matrices[k + 4 * poses]
        f = matrices[k + 5 * poses]
        g = matrices[k + 6 * poses]
        h = matrices[k + 7 * poses]
        i = matrices[k + 8 * poses]
        floats[x + lane] = (p * a + q * b) + r * c
        floats[y + lane] = (p * d + q * e) + r * f
        floats[z + lane] = (p * g + q * h) + r * i


@inlined
def _rotate(cast, scratch, x, y, z):  # type: ignore[no-untyped-def]
    """Rotate vectors of a group to the scene's axes; x, y and z are fields of their components."""
    if cast.poses == 1:
        _rotate_by_one(scratch, cast.rotations, x, y, z)
    else:
        _rotate_by_poses(scratch, cast.poses, cast.rotations, x, y, z)


@stage
def _apply_rates(scratch, poses, delays, rates, x, y, z):  # type: ignore[no-untyped-def]
    """Rotate vectors of a group by the angular rates of their poses, as `PoseMotion` describes.

    x, y and z are fields of the components of the vectors.
    """
    numbers = int64s(scratch)
    floats = float64s(scratch)
    delay_of_ray = float64s(delays)
    rate = float64s(rates)
    for lane in range(LANES):
        p = floats[x + lane]
        q = floats[y + lane]
        r = floats[z + lane]
        k = numbers[_POSE + lane]
        delay = delay_of_ray[numbers[_WITHIN + lane]]
        a = rate[k]
        b = rate[k + poses]
        c = rate[k + 2 * poses]
        floats[x + lane] = p + delay * (b * r - c * q)
        floats[y + lane] = q + delay * (c * p - a * r)
        floats[z + lane] = r + delay * (a * q - b * p)


@inlined
def make_group(cast, scratch, start):  # type: ignore[no-untyped-def]
    """Compute the rays of a group in local coordinates, by their numbers `ray` within a block.

    `start` is the `BlockStart` of the block. Origins that all rays share are not computed: the
    caller has written these. Rays are also written to the outputs of rays of the cast, if any.
    """
    floats = float64s(scratch)
    _find_rows(scratch, start.row, cast.rows * cast.subrays)
    if cast.shares_origin == 0:
        _find_poses(scratch, start.pose, start.within, cast.rays_per_pose)
    if cast.shares != 0:
        _make_subrays(cast, scratch)
    else:
        _look_up_beams(scratch, cast.directions, cast.rows)
    if cast.rotations != 0:
        _rotate(cast, scratch, _DX, _DY, _DZ)
    if cast.delays != 0:
        _apply_rates(scratch, cast.poses, cast.delays, cast.rates, _DX, _DY, _DZ)
    if cast.directions_out != 0:
        _write_vectors(scratch, cast.directions_out + 8 * start.ray, cast.ray_count, _DX)
    if cast.shares_origin == 0:
        write_origins(cast, scratch)
        if cast.origins_out != 0:
            _write_vectors(scratch, cast.origins_out + 8 * start.ray, cast.ray_count, _OX)
        localise(cast, scratch)
    if cast.starts_near == 0:
        lower = cast.lower
        upper = cast.upper
        for lane in range(LANES):
            o = floats[_OX + lane], floats[_OY + lane], floats[_OZ + lane]
            d = floats[_DX + lane], floats[_DY + lane], floats[_DZ + lane]
            floats[_ENTRY + lane] = entry_distance(lower, upper, o, d)


@inlined
def block_start(cast, ray):  # type: ignore[no-untyped-def]
    """Return the `BlockStart` of a block, by the number of its first ray in the scan."""
    total = cast.rows * cast.subrays
    rays_per_pose = cast.rays_per_pose
    pose = ray // rays_per_pose
    within = ray - pose * rays_per_pose
    return BlockStart((cast.first + ray) % total, pose, within, ray)


@stage
def _write_vectors(scratch, address, count, x):  # type: ignore[no-untyped-def]
    """Write vectors of a group, whose first field is x, to an output (3, count) of all rays.

    `address` is of the output of the block's first ray.
    """
    numbers = int64s(scratch)
    floats = float64s(scratch)
    vectors = float64s(address)
    for lane in range(LANES):
        k = numbers[_RAY + lane]
        vectors[k] = floats[x + lane]
        vectors[k + count] = floats[x + LANES + lane]
        vectors[k + 2 * count] = floats[x + 2 * LANES + lane]


@stage
def _look_up_beams(scratch, directions, rows):  # type: ignore[no-untyped-def]
    """Write the directions of a group's rays, by their rows in the pattern."""
    numbers = int64s(scratch)
    floats = float64s(scratch)
    beam_directions = float64s(directions)
    for lane in range(LANES):
        row = numbers[_ROW + lane]
        floats[_DX + lane] = beam_directions[row]
        floats[_DY + lane] = beam_directions[rows + row]
        floats[_DZ + lane] = beam_directions[2 * rows + row]


@stage
def _add_to_origins(scratch, table, count, field):  # type: ignore[no-untyped-def]
    """Add vectors of a table (3, count) to the origins; `field` has the column of each ray."""
    numbers = int64s(scratch)
    floats = float64s(scratch)
    vectors = float64s(table)
    for lane in range(LANES):
        k = numbers[field + lane]
        floats[_OX + lane] += vectors[k]
        floats[_OY + lane] += vectors[k + count]
        floats[_OZ + lane] += vectors[k + 2 * count]


@stage
def _apply_velocities(scratch, delays, velocities, poses):  # type: ignore[no-untyped-def]
    """Move the origins of a group's rays by the velocities of their poses."""
    numbers = int64s(scratch)
    floats = float64s(scratch)
    delay_of_ray = float64s(delays)
    velocity = float64s(velocities)
    for lane in range(LANES):
        k = numbers[_POSE + lane]
        delay = delay_of_ray[numbers[_WITHIN + lane]]
        floats[_OX + lane] += delay * velocity[k]
        floats[_OY + lane] += delay * velocity[k + poses]
        floats[_OZ + lane] += delay * velocity[k + 2 * poses]


@stage
def _localise(scratch, x, y, z, scale):  # type: ignore[no-untyped-def]
    """Convert the origins of a group's rays, metres, to coordinates about a centre x, y, z."""
    floats = float64s(scratch)
    for lane in range(LANES):
        floats[_OX + lane] = (floats[_OX + lane] - x) * scale
        floats[_OY + lane] = (floats[_OY + lane] - y) * scale
        floats[_OZ + lane] = (floats[_OZ + lane] - z) * scale


@inlined
def localise(cast, scratch):  # type: ignore[no-untyped-def]
    """Convert the origins of a group's rays, metres, to local coordinates."""
    _localise(scratch, cast.centre[0], cast.centre[1], cast.centre[2], cast.scale)


@inlined
def write_origins(cast, scratch):  # type: ignore[no-untyped-def]
    """Write the origins of a group's rays in the scene, metres.

    If sub-rays have starts, the fields of the origins hold these starts, as `_spread_lane` wrote.
    """
    floats = float64s(scratch)
    has_starts = cast.shares != 0 and cast.has_starts != 0
    if not has_starts:
        for lane in range(LANES):
            floats[_OX + lane] = 0.0
            floats[_OY + lane] = 0.0
            floats[_OZ + lane] = 0.0
    if cast.origins != 0:
        _add_to_origins(scratch, cast.origins, cast.rows, _ROW)
    if cast.origins != 0 or has_starts:
        if cast.rotations != 0:
            _rotate(cast, scratch, _OX, _OY, _OZ)
        if cast.delays != 0:
            _apply_rates(scratch, cast.poses, cast.delays, cast.rates, _OX, _OY, _OZ)
    _add_to_origins(scratch, cast.positions, cast.poses, _POSE)
    if cast.delays != 0:
        _apply_velocities(scratch, cast.delays, cast.velocities, cast.poses)


@inlined
def _clip_axis(lower, upper, o, d, entry):  # type: ignore[no-untyped-def]
    """Return the larger of `entry` and the distance at which a ray enters a slab of the box."""
    component = d
    if abs(d) < _TINY:
        component = -_TINY if d < 0 else _TINY
    return max(entry, min((lower - o) / component, (upper - o) / component))


@inlined
def entry_distance(lower, upper, o, d):  # type: ignore[no-untyped-def]
    """Return the distance at which a remote ray enters the scene's box, local; 0 for others."""
    entry = 0.0
    if max(max(abs(o[0]), abs(o[1])), abs(o[2])) > NEAR:
        entry = _clip_axis(lower[0], upper[0], o[0], d[0], entry)
        entry = _clip_axis(lower[1], upper[1], o[1], d[1], entry)
        entry = _clip_axis(lower[2], upper[2], o[2], d[2], entry)
    return entry


@compiled(types.void(memory.CASTS, types.int64[::1], types.float64[:, ::1], types.float64[:, ::1]))
def _make_rays(casts, rays, origins, directions):  # type: ignore[no-untyped-def]
    """Write the directions (3, m), and the origins unless (3, 0), of rays with numbers (m,)."""
    cast = casts[0]
    count = len(rays)
    writes_origins = origins.shape[1] > 0
    scratch = cast.scratch
    numbers = int64s(scratch)
    floats = float64s(scratch)
    for lane in range(LANES):
        numbers[_POSE + lane] = 0
    for start in range(0, count, LANES):
        first = rays[start]
        for k in range(start + 1, min(start + LANES, count)):
            first = min(first, rays[k])
        for lane in range(LANES):
            numbers[_RAY + lane] = rays[min(start + lane, count - 1)] - first
        make_group(cast, scratch, block_start(cast, first))
        for lane in range(min(LANES, count - start)):
            k = start + lane
            directions[0, k] = floats[_DX + lane]
            directions[1, k] = floats[_DY + lane]
            directions[2, k] = floats[_DZ + lane]
            if writes_origins:
                origins[0, k] = floats[_OX + lane]
                origins[1, k] = floats[_OY + lane]
                origins[2, k] = floats[_OZ + lane]


def compiled_rays(
    pattern: Pattern, first: int, ray: Ints, poses: Poses
) -> tuple[Floats | None, Floats]:
    """Return origins and directions, float64 (3, m), of rays with numbers (m,).

    Arguments are those of `pattern_rays.checked_rays`. Origins are None if all rays start at the
    position of a single pose.
    """
    cast = memory.Cast(np.zeros(1, memory.CAST))
    record = cast.record
    cast.set_pattern(pattern, poses, first)
    record["scale"] = 1.0  # local coordinates are metres, about the origin of the scene
    record["starts_near"] = 1
    record["scratch"], _ = memory.thread_memory.addresses(0)
    origins = np.empty((3, 0 if record["shares_origin"] else len(ray)))
    directions = np.empty((3, len(ray)))
    _make_rays(record, np.ascontiguousarray(ray), origins, directions)
    return None if record["shares_origin"] else origins, directions
