"""Rays of a scan, made sixteen at a time in compiled loops; with the operations of `Pattern.made`.

Each step is a loop over the rays of a group that becomes a few vector instructions.
"""

from __future__ import annotations

import numpy as np

from .compiled import inlined, stage
from .embree_memory import LANES, at, float64s, int64s
from .mesh import NEAR
from .ray_loops import any_axes, axes_about

_OX, _OY, _OZ, _DX, _DY, _DZ = map(at, ("ox", "oy", "oz", "dx", "dy", "dz"))
_RAY, _ROW, _POSE, _WITHIN = map(at, ("ray", "row", "pose", "within"))
_STRAIGHT, _ACROSS, _UP = at("straight"), at("across"), at("up")
_ASIDE, _ABOVE, _ENTRY = at("aside"), at("above"), at("entry")
_TINY = 2.0**-60  # replaces a direction component of zero, to avoid 0 * inf


@inlined
def _times(number, other):  # type: ignore[no-untyped-def]
    """How many times a whole number is in another, both below 2^52: faster than `//`, and exact."""
    return np.int64(np.float64(number) / np.float64(other))


@stage
def _rows(scratch, first, total):  # type: ignore[no-untyped-def]
    """Find the rows of the rays of a group; `first` is that of the block's first, of `total`."""
    numbers, most = int64s(scratch), np.int64(0)
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
        later = _times(inside, each)
        numbers[_POSE + lane], numbers[_WITHIN + lane] = pose + later, inside - later * each


@inlined
def _divided(cast, numbers, floats):  # type: ignore[no-untyped-def]
    """Turn the directions of beams to those of sub-rays, and note where those start."""
    rows, subrays, shares, offsets = cast.rows, cast.subrays, float64s(cast.shares), cast.offsets
    about, begins, axis = cast.about, cast.begins, cast.axis
    for lane in range(LANES):
        row = numbers[_ROW + lane]
        beam = _times(row, subrays)
        k = row - beam * subrays
        numbers[_ROW + lane] = beam
        floats[_STRAIGHT + lane] = shares[k]
        floats[_ACROSS + lane], floats[_UP + lane] = shares[subrays + k], shares[2 * subrays + k]
        floats[_ASIDE + lane] = shares[3 * subrays + k]
        floats[_ABOVE + lane] = shares[4 * subrays + k]
    if offsets:
        table = float64s(offsets)
        for lane in range(LANES):
            beam = numbers[_ROW + lane]
            across = floats[_ACROSS + lane] + table[beam]
            up = floats[_UP + lane] + table[rows + beam]
            straight = 1 / np.sqrt((1 + across * across) + up * up)
            floats[_STRAIGHT + lane] = straight
            floats[_ACROSS + lane], floats[_UP + lane] = across * straight, up * straight
    directions = float64s(cast.directions)
    for lane in range(LANES):
        beam = numbers[_ROW + lane]
        floats[_DX + lane], floats[_DY + lane] = directions[beam], directions[rows + beam]
        floats[_DZ + lane] = directions[2 * rows + beam]
    ahead = axis[0], axis[1], axis[2]
    for lane in range(LANES):
        x, y, z = floats[_DX + lane], floats[_DY + lane], floats[_DZ + lane]
        a, b, c, d, e, f = axes_about(x, y, z, ahead) if about else any_axes(x, y, z)
        straight, across, up = floats[_STRAIGHT + lane], floats[_ACROSS + lane], floats[_UP + lane]
        floats[_DX + lane] = (straight * x + across * a) + up * d
        floats[_DY + lane] = (straight * y + across * b) + up * e
        floats[_DZ + lane] = (straight * z + across * c) + up * f
        if begins:
            aside, above = floats[_ASIDE + lane], floats[_ABOVE + lane]
            floats[_OX + lane] = aside * a + above * d
            floats[_OY + lane] = aside * b + above * e
            floats[_OZ + lane] = aside * c + above * f


@stage
def _turn_by(scratch, matrix, x, y, z):  # type: ignore[no-untyped-def]
    """Rotate the vectors of a group, whose columns begin at x, y and z, by one matrix."""
    floats, m = float64s(scratch), float64s(matrix)
    a, b, c, d, e, f, g, h, i = m[0], m[1], m[2], m[3], m[4], m[5], m[6], m[7], m[8]
    for lane in range(LANES):
        p, q, r = floats[x + lane], floats[y + lane], floats[z + lane]
        floats[x + lane] = (p * a + q * b) + r * c
        floats[y + lane] = (p * d + q * e) + r * f
        floats[z + lane] = (p * g + q * h) + r * i


@stage
def _turn_each(scratch, poses, rotations, x, y, z):  # type: ignore[no-untyped-def]
    """Rotate the vectors of a group to the mesh's axes, each by its own pose."""
    numbers, floats, matrices = int64s(scratch), float64s(scratch), float64s(rotations)
    for lane in range(LANES):
        p, q, r, k = floats[x + lane], floats[y + lane], floats[z + lane], numbers[_POSE + lane]
        a, b, c = matrices[k], matrices[k + poses], matrices[k + 2 * poses]
        d, e, f = matrices[k + 3 * poses], matrices[k + 4 * poses], matrices[k + 5 * poses]
        g, h, i = matrices[k + 6 * poses], matrices[k + 7 * poses], matrices[k + 8 * poses]
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
    numbers, floats = int64s(scratch), float64s(scratch)
    after, rate = float64s(delays), float64s(rates)
    for lane in range(LANES):
        p, q, r = floats[x + lane], floats[y + lane], floats[z + lane]
        k, delay = numbers[_POSE + lane], after[numbers[_WITHIN + lane]]
        a, b, c = rate[k], rate[k + poses], rate[k + 2 * poses]
        floats[x + lane] = p + delay * (b * r - c * q)
        floats[y + lane] = q + delay * (c * p - a * r)
        floats[z + lane] = r + delay * (a * q - b * p)


@inlined
def make(cast, scratch, block):  # type: ignore[no-untyped-def]
    """Make the rays of a group, whose numbers in the block are in its memory.

    `block` is the row, the pose and the number within it of the block's first ray.
    """
    numbers, floats = int64s(scratch), float64s(scratch)
    rows, each, subrays, directions = cast.rows, cast.each, cast.subrays, float64s(cast.directions)
    _rows(scratch, block[0], rows * subrays)
    if cast.poses > 1 or cast.delays != 0:
        _poses(scratch, block[1], block[2], each)
    begins = cast.shares != 0 and cast.begins != 0
    if cast.shares != 0:
        _divided(cast, numbers, floats)
    else:
        for lane in range(LANES):
            row = numbers[_ROW + lane]
            floats[_DX + lane], floats[_DY + lane] = directions[row], directions[rows + row]
            floats[_DZ + lane] = directions[2 * rows + row]
    if cast.rotations != 0:
        _turn(cast, scratch, _DX, _DY, _DZ)
    if cast.delays != 0:
        _drift(scratch, cast.poses, cast.delays, cast.rates, _DX, _DY, _DZ)
    if cast.still == 0:
        _place(cast, scratch, begins)
    if cast.near == 0:
        low, high = cast.low, cast.upper
        for lane in range(LANES):
            o = floats[_OX + lane], floats[_OY + lane], floats[_OZ + lane]
            d = floats[_DX + lane], floats[_DY + lane], floats[_DZ + lane]
            floats[_ENTRY + lane] = _entry(low, high, o, d)


@inlined
def begin(cast, block):  # type: ignore[no-untyped-def]
    """Row, pose and number within the pose of a ray."""
    total, each = cast.rows * cast.subrays, cast.each
    pose = block // each
    return (cast.first + block) % total, pose, block - pose * each


@inlined
def _place(cast, scratch, begins):  # type: ignore[no-untyped-def]
    """Write the local origins of a group's rays; sub-rays have starts already if it `begins`."""
    numbers, floats = int64s(scratch), float64s(scratch)
    if cast.poses == 1 and cast.delays == 0:  # all of one pose, which was not looked up
        for lane in range(LANES):
            numbers[_POSE + lane] = 0
    rows, poses, positions = cast.rows, cast.poses, float64s(cast.positions)
    if cast.origins != 0:
        origins = float64s(cast.origins)
        for lane in range(LANES):
            row = numbers[_ROW + lane]
            x, y, z = origins[row], origins[rows + row], origins[2 * rows + row]
            if begins:
                x, y, z = x + floats[_OX + lane], y + floats[_OY + lane], z + floats[_OZ + lane]
            floats[_OX + lane], floats[_OY + lane], floats[_OZ + lane] = x, y, z
    if cast.origins != 0 or begins:
        if cast.rotations != 0:
            _turn(cast, scratch, _OX, _OY, _OZ)
        if cast.delays != 0:
            _drift(scratch, cast.poses, cast.delays, cast.rates, _OX, _OY, _OZ)
        for lane in range(LANES):
            k = numbers[_POSE + lane]
            floats[_OX + lane] += positions[k]
            floats[_OY + lane] += positions[k + poses]
            floats[_OZ + lane] += positions[k + 2 * poses]
    else:
        for lane in range(LANES):
            k = numbers[_POSE + lane]
            floats[_OX + lane], floats[_OY + lane] = positions[k], positions[k + poses]
            floats[_OZ + lane] = positions[k + 2 * poses]
    if cast.delays != 0:
        delays, velocities = float64s(cast.delays), float64s(cast.velocities)
        for lane in range(LANES):
            k, delay = numbers[_POSE + lane], delays[numbers[_WITHIN + lane]]
            floats[_OX + lane] += delay * velocities[k]
            floats[_OY + lane] += delay * velocities[k + poses]
            floats[_OZ + lane] += delay * velocities[k + 2 * poses]
    cx, cy, cz, scale = cast.centre[0], cast.centre[1], cast.centre[2], cast.scale
    for lane in range(LANES):
        floats[_OX + lane] = (floats[_OX + lane] - cx) * scale
        floats[_OY + lane] = (floats[_OY + lane] - cy) * scale
        floats[_OZ + lane] = (floats[_OZ + lane] - cz) * scale


@inlined
def stand(cast, floats):  # type: ignore[no-untyped-def]
    """Write the local origins of rays that all start at one position."""
    positions, centre, scale = float64s(cast.positions), cast.centre, cast.scale
    cx, cy, cz = centre[0], centre[1], centre[2]
    for lane in range(LANES):
        floats[_OX + lane] = (positions[0] - cx) * scale
        floats[_OY + lane] = (positions[1] - cy) * scale
        floats[_OZ + lane] = (positions[2] - cz) * scale
        floats[_ENTRY + lane] = 0.0


@inlined
def _clip(low, high, o, d, entry):  # type: ignore[no-untyped-def]
    along = d
    if abs(d) < _TINY:
        along = -_TINY if d < 0 else _TINY
    return max(entry, min((low - o) / along, (high - o) / along))


@inlined
def _entry(low, high, o, d):  # type: ignore[no-untyped-def]
    """Distance at which a ray from far away comes near the scene's box; 0 from near."""
    entry = 0.0
    if max(max(abs(o[0]), abs(o[1])), abs(o[2])) > NEAR:
        entry = _clip(low[0], high[0], o[0], d[0], entry)
        entry = _clip(low[1], high[1], o[1], d[1], entry)
        entry = _clip(low[2], high[2], o[2], d[2], entry)
    return entry
