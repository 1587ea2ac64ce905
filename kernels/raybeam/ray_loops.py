"""What rays are made of, one by one, in compiled loops; with the operations of `Pattern.made`."""

from __future__ import annotations

import numpy as np

from .compiled import inlined


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
def divided(shares, offsets, axis, beam, k, x, y, z):  # type: ignore[no-untyped-def]
    """Direction of sub-ray k of a beam, as `sub_rays.spread`, and where it starts off the beam's.

    `shares` (5, m) are those of `SubRays.table`; `offsets` (2, n) and `axis` (3,) may be empty.
    """
    straight, across, up = shares[0, k], shares[1, k], shares[2, k]
    if offsets.shape[1]:
        across, up = across + offsets[0, beam], up + offsets[1, beam]
        straight = 1 / np.sqrt((1 + across * across) + up * up)
        across, up = across * straight, up * straight
    if len(axis):
        a, b, c, d, e, f = axes_about(x, y, z, axis)
    else:
        a, b, c, d, e, f = any_axes(x, y, z)
    x, y = (straight * x + across * a) + up * d, (straight * y + across * b) + up * e
    z = (straight * z + across * c) + up * f
    p, q = shares[3, k], shares[4, k]
    return x, y, z, p * a + q * d, p * b + q * e, p * c + q * f
