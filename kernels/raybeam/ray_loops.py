"""The rays of a pattern, made one by one in compiled loops, with the operations of `plain_rays`."""

from __future__ import annotations

from typing import Any

import numpy as np

from .arrays import Floats, Ints
from .compiled import compiled, inlined
from .poses import Poses

_BLOCK = 1 << 14  # rays at a time: copies of their poses stay in a core's cache


@inlined
def whole_times(number, other):  # type: ignore[no-untyped-def]
    """How many times a whole number is in another, both below 2^52: faster than `//`, and exact."""
    return np.int64(np.float64(number) / np.float64(other))


@inlined
def turned(m, x, y, z):  # type: ignore[no-untyped-def]
    """Rotate a vector by a matrix (9,)."""
    return (
        (x * m[0] + y * m[1]) + z * m[2],
        (x * m[3] + y * m[4]) + z * m[5],
        (x * m[6] + y * m[7]) + z * m[8],
    )


@inlined
def drifted(rate, delay, x, y, z):  # type: ignore[no-untyped-def]
    """Turn a vector by a rate (3,) for a while."""
    a, b, c = rate[0], rate[1], rate[2]
    return x + delay * (b * z - c * y), y + delay * (c * x - a * z), z + delay * (a * y - b * x)


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
    p, q, r = b * z - c * y, c * x - a * z, a * y - b * x
    length = np.sqrt((p * p + q * q) + r * r)
    least = max(length, 1e-300)
    p, q, r = p / least, q / least, r / least
    u, v, w = y * r - z * q, z * p - x * r, x * q - y * p
    if length < 1e-6:
        p, q, r, u, v, w = any_axes(x, y, z)
    return p, q, r, u, v, w


@inlined
def axes_of(axis, x, y, z):  # type: ignore[no-untyped-def]
    """Axes across a beam: any two, or along and across an `axis` (3,), which may be empty."""
    if len(axis):
        return axes_about(x, y, z, axis)
    return any_axes(x, y, z)


@inlined
def divided(shares, offsets, axes, beam, k, x, y, z):  # type: ignore[no-untyped-def]
    """Direction of sub-ray k of a beam, as `sub_rays.spread`, and where it starts off the beam's.

    `shares` (5, m) are those of `SubRays.table`; `offsets` (2, n) may be empty.
    """
    straight, across, up = shares[0, k], shares[1, k], shares[2, k]
    if offsets.shape[1]:
        across, up = across + offsets[0, beam], up + offsets[1, beam]
        straight = 1 / np.sqrt((1 + across * across) + up * up)
        across, up = across * straight, up * straight
    a, b, c, d, e, f = axes
    x, y = (straight * x + across * a) + up * d, (straight * y + across * b) + up * e
    z = (straight * z + across * c) + up * f
    p, q = shares[3, k], shares[4, k]
    return x, y, z, p * a + q * d, p * b + q * e, p * c + q * f


def made(pattern: Any, first: int, ray: Ints, poses: Poses) -> tuple[Floats, Floats]:
    """Make rays of a pattern, see `Pattern.made`: origins and directions, (3, n) each."""
    motion, sub_rays, none = poses.motion, pattern.sub_rays, np.zeros((0, 3))
    shifts = none if pattern.origins is None else pattern.origins.T
    shifts.flags.writeable = False  # as those of patterns: they are of one type then
    rotations = none if poses.rotations is None else poses.rotations
    velocities, rates = (none, none) if motion is None else (motion.velocities, motion.rates)
    delays = np.zeros(0) if motion is None else np.array(motion.delays, np.float64)
    shares, offsets, axis = np.zeros((5, 0)), np.zeros((2, 0)), np.zeros(0)
    if sub_rays is not None:
        shares = sub_rays.table(pattern.offsets)
        offsets = offsets if pattern.offsets is None else pattern.offsets
        axis = axis if sub_rays.axis is None else np.array(sub_rays.axis, np.float64)
    parts = pattern.directions.T, shifts, shares, offsets, axis
    origins, directions = np.empty((2, 3, len(ray)))
    for begin in range(0, len(ray), _BLOCK):
        block = slice(begin, begin + _BLOCK)
        numbers = np.array(ray[block], np.int64)
        start = int(numbers.min()) // poses.rays
        own = slice(start, int(numbers.max()) // poses.rays + 1)
        copies = (
            np.array(table[own], np.float64, order="C").reshape(-1, 9 if table is rotations else 3)
            for table in (poses.positions, rotations, velocities, rates)
        )
        numbers -= start * poses.rays
        given = *copies, delays, first + start * poses.rays, numbers, poses.rays
        _make(*parts, *given, *(made := np.empty((2, 3, len(numbers)))))
        origins[:, block], directions[:, block] = made
    return origins, directions


@compiled()
def _make(  # type: ignore[no-untyped-def]
    ahead, shifts, shares, offsets, axis, positions, rotations, velocities, rates, delays,
    first, rays, each, origins, directions,
):  # fmt: skip
    subrays, delay = max(shares.shape[1], 1), 0.0
    total, low, row = ahead.shape[1] * subrays, -1 - subrays, 0  # first ray and row of the beam
    begin, pose = -1 - each, 0  # first ray of the pose
    bx, by, bz, sx, sy, sz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    axes = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(len(rays)):
        number = first + rays[k]
        # Rays follow each other: most are of the beam and the pose of the one before.
        if not low <= number < low + subrays:
            part = number - whole_times(number, total) * total
            row = part if subrays == 1 else whole_times(part, subrays)
            low = number - (part - row * subrays)
            bx, by, bz = ahead[0, row], ahead[1, row], ahead[2, row]
            if len(shifts):
                sx, sy, sz = shifts[0, row], shifts[1, row], shifts[2, row]
            if shares.shape[1]:
                axes = axes_of(axis, bx, by, bz)
        if not begin <= rays[k] < begin + each:
            pose = whole_times(rays[k], each) if len(positions) > 1 else 0
            begin = pose * each
        dx, dy, dz, x, y, z = bx, by, bz, sx, sy, sz
        if shares.shape[1]:
            dx, dy, dz, u, v, w = divided(shares, offsets, axes, row, number - low, dx, dy, dz)
            x, y, z = x + u, y + v, z + w
        if len(rotations):
            dx, dy, dz = turned(rotations[pose], dx, dy, dz)
            x, y, z = turned(rotations[pose], x, y, z)
        if len(delays):
            delay = delays[rays[k] - begin]
            dx, dy, dz = drifted(rates[pose], delay, dx, dy, dz)
            x, y, z = drifted(rates[pose], delay, x, y, z)
        x, y, z = x + positions[pose, 0], y + positions[pose, 1], z + positions[pose, 2]
        if len(delays):
            x, y = x + delay * velocities[pose, 0], y + delay * velocities[pose, 1]
            z = z + delay * velocities[pose, 2]
        origins[0, k], origins[1, k], origins[2, k] = x, y, z
        directions[0, k], directions[1, k], directions[2, k] = dx, dy, dz


# Compiled or loaded with the others: a signature has no read-only arrays.
_FIXED, _NONE = np.zeros((3, 1)), np.zeros((0, 3))
_FIXED.flags.writeable = _NONE.flags.writeable = False
_TABLES = np.zeros((5, 0)), np.zeros((2, 0)), np.zeros(0), *np.zeros((4, 1, 9)), np.zeros(1)
_make(_FIXED, _NONE, *_TABLES, 0, np.zeros(0, np.int64), 1, np.zeros((3, 0)), np.zeros((3, 0)))
