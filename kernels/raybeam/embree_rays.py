"""Rays of a pattern, made sixteen at a time in compiled loops, with the operations of `plain_rays`.

Each step is a loop over the rays of a group that becomes a few vector instructions.
"""

from __future__ import annotations

import numpy as np
from numba import types

from . import embree_memory as memory
from .arrays import Floats, Ints
from .compiled import compiled, inlined, stage
from .embree_memory import LANES, at, float64s, int64s
from .mesh import NEAR
from .pattern import Pattern
from .poses import Poses

_OX, _OY, _OZ, _DX, _DY, _DZ = map(at, ("ox", "oy", "oz", "dx", "dy", "dz"))
_RAY, _ROW, _POSE, _WITHIN = map(at, ("ray", "row", "pose", "within"))
_STRAIGHT = at("straight")
_ACROSS = at("across")
_UP = at("up")
_ASIDE = at("aside")
_ABOVE = at("above")
_ENTRY = at("entry")
_TINY = 2.0**-60  # replaces a direction component of zero, to avoid 0 * inf


@inlined
def whole_times(number, other):  # type: ignore[no-untyped-def]
    """How many times a whole number is in another, both below 2^52: faster than `//`, and exact."""
    return np.int64(np.float64(number) / np.float64(other))


@inlined
def any_axes(x, y, z):  # type: ignore[no-untyped-def]
    """As `sub_rays.any_axes`, of one direction."""
    sign = -1.0 if z < 0 else 1.0
    a = -1.0 / (sign + z)
    b = x * y * a
    return 1 + sign * x * x * a, sign * b, -sign * x, b, sign + y * y * a, -y


@inlined
def axes_about(x, y, z, axis):  # type: ignore[no-untyped-def]
    """As `sub_rays.axes_about`, of one direction."""
    a, b, c = axis
    p = b * z - c * y
    q = c * x - a * z
    r = a * y - b * x
    length = np.sqrt((p * p + q * q) + r * r)
    least = max(length, 1e-300)
    p = p / least
    q = q / least
    r = r / least
    u = y * r - z * q
    v = z * p - x * r
    w = x * q - y * p
    if length < 1e-6:
        p, q, r, u, v, w = any_axes(x, y, z)
    return p, q, r, u, v, w


@stage
def _rows(scratch, first, total):  # type: ignore[no-untyped-def]
    """Find the rows of the rays of a group; `first` is that of the block's first, of `total`."""
    numbers = int64s(scratch)
    most = np.int64(0)
    for lane in range(LANES):
        row = first + numbers[_RAY + lane]
        numbers[_ROW + lane] = row - total if row >= total else row
    for lane in range(LANES):
        most = max(most, numbers[_ROW + lane])
    if most >= total:  # a short pattern that repeats
        for lane in range(LANES):
            numbers[_ROW + lane] %= total


@stage
def _poses(scratch, pose, within, each):  # type: ignore[no-untyped-def]
    """Find the poses of rays, and their numbers within; given are those of the block's first."""
    numbers = int64s(scratch)
    for lane in range(LANES):
        inside = within + numbers[_RAY + lane]
        later = whole_times(inside, each)
        numbers[_POSE + lane] = pose + later
        numbers[_WITHIN + lane] = inside - later * each


@stage
def _shares(scratch, shares, offsets, directions, rows, subrays):  # type: ignore[no-untyped-def]
    """Look up the beams of a group's sub-rays, and what share each has of across and up."""
    numbers = int64s(scratch)
    floats = float64s(scratch)
    table = float64s(shares)
    ahead = float64s(directions)
    more = float64s(offsets)
    for lane in range(LANES):
        row = numbers[_ROW + lane]
        beam = whole_times(row, subrays)
        k = row - beam * subrays
        numbers[_ROW + lane] = beam
        floats[_STRAIGHT + lane] = table[k]
        floats[_ACROSS + lane] = table[subrays + k]
        floats[_UP + lane] = table[2 * subrays + k]
        floats[_ASIDE + lane] = table[3 * subrays + k]
        floats[_ABOVE + lane] = table[4 * subrays + k]
        floats[_DX + lane] = ahead[beam]
        floats[_DY + lane] = ahead[rows + beam]
        floats[_DZ + lane] = ahead[2 * rows + beam]
    if offsets:
        for lane in range(LANES):
            beam = numbers[_ROW + lane]
            across = floats[_ACROSS + lane] + more[beam]
            up = floats[_UP + lane] + more[rows + beam]
            straight = 1 / np.sqrt((1 + across * across) + up * up)
            floats[_STRAIGHT + lane] = straight
            floats[_ACROSS + lane] = across * straight
            floats[_UP + lane] = up * straight


@inlined
def _spread(floats, lane, begins, axes):  # type: ignore[no-untyped-def]
    """Turn the direction of a beam to that of its sub-ray, and note where that starts."""
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
    if begins:
        aside = floats[_ASIDE + lane]
        above = floats[_ABOVE + lane]
        floats[_OX + lane] = aside * a + above * d
        floats[_OY + lane] = aside * b + above * e
        floats[_OZ + lane] = aside * c + above * f


@stage
def _spread_any(scratch, begins):  # type: ignore[no-untyped-def]
    floats = float64s(scratch)
    for lane in range(LANES):
        x = floats[_DX + lane]
        y = floats[_DY + lane]
        z = floats[_DZ + lane]
        _spread(floats, lane, begins, any_axes(x, y, z))


@stage
def _spread_about(scratch, begins, a, b, c):  # type: ignore[no-untyped-def]
    floats = float64s(scratch)
    for lane in range(LANES):
        x = floats[_DX + lane]
        y = floats[_DY + lane]
        z = floats[_DZ + lane]
        _spread(floats, lane, begins, axes_about(x, y, z, (a, b, c)))


@inlined
def _divided(cast, scratch):  # type: ignore[no-untyped-def]
    """Make the directions of sub-rays, and note where they start, off their beams' starts."""
    given = cast.shares, cast.offsets, cast.directions, cast.rows, cast.subrays
    _shares(scratch, *given)
    if cast.about:
        _spread_about(scratch, cast.begins, cast.axis[0], cast.axis[1], cast.axis[2])
    else:
        _spread_any(scratch, cast.begins)


@stage
def _turn_by(scratch, matrix, x, y, z):  # type: ignore[no-untyped-def]
    """Rotate the vectors of a group, whose columns begin at x, y and z, by one matrix."""
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
def _turn_each(scratch, poses, rotations, x, y, z):  # type: ignore[no-untyped-def]
    """Rotate the vectors of a group to the mesh's axes, each by its own pose."""
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
def _turn(cast, scratch, x, y, z):  # type: ignore[no-untyped-def]
    """Rotate the vectors of a group to the mesh's axes."""
    if cast.poses == 1:
        _turn_by(scratch, cast.rotations, x, y, z)
    else:
        _turn_each(scratch, cast.poses, cast.rotations, x, y, z)


@stage
def _drift(scratch, poses, delays, rates, x, y, z):  # type: ignore[no-untyped-def]
    """Turn the vectors of a group by the motion of their poses."""
    numbers = int64s(scratch)
    floats = float64s(scratch)
    after = float64s(delays)
    rate = float64s(rates)
    for lane in range(LANES):
        p = floats[x + lane]
        q = floats[y + lane]
        r = floats[z + lane]
        k = numbers[_POSE + lane]
        delay = after[numbers[_WITHIN + lane]]
        a = rate[k]
        b = rate[k + poses]
        c = rate[k + 2 * poses]
        floats[x + lane] = p + delay * (b * r - c * q)
        floats[y + lane] = q + delay * (c * p - a * r)
        floats[z + lane] = r + delay * (a * q - b * p)


@inlined
def make(cast, scratch, block):  # type: ignore[no-untyped-def]
    """Make the rays of a group, whose numbers in the block are in its memory.

    `block` is what `begin` says of the block's first ray.
    """
    floats = float64s(scratch)
    _rows(scratch, block[0], cast.rows * cast.subrays)
    if cast.still == 0:
        _poses(scratch, block[1], block[2], cast.each)
    if cast.shares != 0:
        _divided(cast, scratch)
    else:
        _look_up(scratch, cast.directions, cast.rows)
    if cast.rotations != 0:
        _turn(cast, scratch, _DX, _DY, _DZ)
    if cast.delays != 0:
        _drift(scratch, cast.poses, cast.delays, cast.rates, _DX, _DY, _DZ)
    if cast.ways != 0:
        _note(scratch, cast.ways + 8 * block[3], cast.all, _DX)
    if cast.still == 0:
        set_out(cast, scratch)
        if cast.starts != 0:
            _note(scratch, cast.starts + 8 * block[3], cast.all, _OX)
        localise(cast, scratch)
    if cast.near == 0:
        low = cast.low
        high = cast.upper
        for lane in range(LANES):
            o = floats[_OX + lane], floats[_OY + lane], floats[_OZ + lane]
            d = floats[_DX + lane], floats[_DY + lane], floats[_DZ + lane]
            floats[_ENTRY + lane] = entered_at(low, high, o, d)


@inlined
def begin(cast, block):  # type: ignore[no-untyped-def]
    """Row, pose, number within the pose, and number of a ray."""
    total = cast.rows * cast.subrays
    each = cast.each
    pose = block // each
    return (cast.first + block) % total, pose, block - pose * each, block


@stage
def _note(scratch, to, count, x):  # type: ignore[no-untyped-def]
    """Write the vectors of a group, whose columns begin at x, among those of all rays."""
    numbers = int64s(scratch)
    floats = float64s(scratch)
    out = float64s(to)
    for lane in range(LANES):
        k = numbers[_RAY + lane]
        out[k] = floats[x + lane]
        out[k + count] = floats[x + LANES + lane]
        out[k + 2 * count] = floats[x + 2 * LANES + lane]


@stage
def _look_up(scratch, directions, rows):  # type: ignore[no-untyped-def]
    """Look up the directions of a group."""
    numbers = int64s(scratch)
    floats = float64s(scratch)
    given = float64s(directions)
    for lane in range(LANES):
        row = numbers[_ROW + lane]
        floats[_DX + lane] = given[row]
        floats[_DY + lane] = given[rows + row]
        floats[_DZ + lane] = given[2 * rows + row]


@stage
def _add(scratch, table, count, number):  # type: ignore[no-untyped-def]
    """Add vectors of a table, of `count` of them those with the `number` of each ray, to starts."""
    numbers = int64s(scratch)
    floats = float64s(scratch)
    given = float64s(table)
    for lane in range(LANES):
        k = numbers[number + lane]
        floats[_OX + lane] += given[k]
        floats[_OY + lane] += given[k + count]
        floats[_OZ + lane] += given[k + 2 * count]


@stage
def _move(scratch, delays, velocities, poses):  # type: ignore[no-untyped-def]
    """Move the starts of rays by the motion of their poses."""
    numbers = int64s(scratch)
    floats = float64s(scratch)
    after = float64s(delays)
    speed = float64s(velocities)
    for lane in range(LANES):
        k = numbers[_POSE + lane]
        delay = after[numbers[_WITHIN + lane]]
        floats[_OX + lane] += delay * speed[k]
        floats[_OY + lane] += delay * speed[k + poses]
        floats[_OZ + lane] += delay * speed[k + 2 * poses]


@stage
def _localise(scratch, x, y, z, scale):  # type: ignore[no-untyped-def]
    """Take the starts of rays to local coordinates."""
    floats = float64s(scratch)
    for lane in range(LANES):
        floats[_OX + lane] = (floats[_OX + lane] - x) * scale
        floats[_OY + lane] = (floats[_OY + lane] - y) * scale
        floats[_OZ + lane] = (floats[_OZ + lane] - z) * scale


@inlined
def localise(cast, scratch):  # type: ignore[no-untyped-def]
    """Take the starts of a group's rays to local coordinates."""
    _localise(scratch, cast.centre[0], cast.centre[1], cast.centre[2], cast.scale)


@inlined
def set_out(cast, scratch):  # type: ignore[no-untyped-def]
    """Write where a group's rays start, metres; sub-rays may have starts already."""
    floats = float64s(scratch)
    begins = cast.shares != 0 and cast.begins != 0
    if not begins:
        for lane in range(LANES):
            floats[_OX + lane] = floats[_OY + lane] = floats[_OZ + lane] = 0.0
    if cast.origins != 0:
        _add(scratch, cast.origins, cast.rows, _ROW)
    if cast.origins != 0 or begins:
        if cast.rotations != 0:
            _turn(cast, scratch, _OX, _OY, _OZ)
        if cast.delays != 0:
            _drift(scratch, cast.poses, cast.delays, cast.rates, _OX, _OY, _OZ)
    _add(scratch, cast.positions, cast.poses, _POSE)
    if cast.delays != 0:
        _move(scratch, cast.delays, cast.velocities, cast.poses)


@inlined
def _clip(low, high, o, d, entry):  # type: ignore[no-untyped-def]
    along = d
    if abs(d) < _TINY:
        along = -_TINY if d < 0 else _TINY
    return max(entry, min((low - o) / along, (high - o) / along))


@inlined
def entered_at(low, high, o, d):  # type: ignore[no-untyped-def]
    """Distance at which a ray from far away comes near the scene's box; 0 from near."""
    entry = 0.0
    if max(max(abs(o[0]), abs(o[1])), abs(o[2])) > NEAR:
        entry = _clip(low[0], high[0], o[0], d[0], entry)
        entry = _clip(low[1], high[1], o[1], d[1], entry)
        entry = _clip(low[2], high[2], o[2], d[2], entry)
    return entry


@compiled(types.void(memory.CASTS, types.int64[::1], types.float64[:, ::1], types.float64[:, ::1]))
def _gather(casts, rays, origins, directions):  # type: ignore[no-untyped-def]
    """Make rays with these numbers; origins are not written if there is no room for any."""
    cast = casts[0]
    count = len(rays)
    begins = origins.shape[1] > 0
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
        make(cast, scratch, begin(cast, first))
        for lane in range(min(LANES, count - start)):
            k = start + lane
            directions[0, k] = floats[_DX + lane]
            directions[1, k] = floats[_DY + lane]
            directions[2, k] = floats[_DZ + lane]
            if begins:
                origins[0, k] = floats[_OX + lane]
                origins[1, k] = floats[_OY + lane]
                origins[2, k] = floats[_OZ + lane]


def rays_of(pattern: Pattern, first: int, ray: Ints, poses: Poses) -> tuple[Floats | None, Floats]:
    """Return rays, see `pattern_rays.checked_rays`: origins and directions, (3, n) each.

    None for origins that are all the position of the pose.
    """
    cast = memory.Cast(np.zeros(1, memory.CAST))
    record = cast.record
    cast.take_pattern(pattern, poses, first)
    # metres
    record["scale"] = 1.0
    record["near"] = 1
    record["scratch"], _ = memory.own.memory(0)
    origins = np.empty((3, 0 if record["still"] else len(ray)))
    directions = np.empty((3, len(ray)))
    _gather(record, np.ascontiguousarray(ray), origins, directions)
    return None if record["still"] else origins, directions
