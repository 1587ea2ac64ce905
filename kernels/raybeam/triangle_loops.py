"""The test of triangle.py, as parts of compiled loops."""

from __future__ import annotations

from .compiled import inlined


@inlined
def shear(ox, oy, oz, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Longest axis of a ray, origin with that axis last, and shear."""
    ax = abs(dx)
    ay = abs(dy)
    az = abs(dz)
    first = ax >= ay and ax >= az
    second = not first and ay >= az
    along = dx if first else (dy if second else dz)
    p = dy if first else (dz if second else dx)
    q = dz if first else (dx if second else dy)
    u = oy if first else (oz if second else ox)
    v = oz if first else (ox if second else oy)
    w = ox if first else (oy if second else oz)
    return 0 if first else (1 if second else 2), u, v, w, p / along, q / along, 1.0 / along


@inlined
def areas(corners, ray):  # type: ignore[no-untyped-def]
    """Signed areas, their sum, and the distance."""
    u, v, w, sx, sy, sz = ray
    (px, py, pz), (qx, qy, qz), (rx, ry, rz) = corners
    z0 = pz - w
    z1 = qz - w
    z2 = rz - w
    x0 = (px - u) - sx * z0
    y0 = (py - v) - sy * z0
    x1 = (qx - u) - sx * z1
    y1 = (qy - v) - sy * z1
    x2 = (rx - u) - sx * z2
    y2 = (ry - v) - sy * z2
    a = x2 * y1 - y2 * x1
    b = x0 * y2 - y0 * x2
    c = x1 * y0 - y1 * x0
    det = (a + b) + c
    return a, b, c, det, (((a * z0 + b * z1) + c * z2) / det) * sz


@inlined
def within(a, b, c):  # type: ignore[no-untyped-def]
    """Whether all areas have one sign."""
    return ((a >= 0) & (b >= 0) & (c >= 0)) | ((a <= 0) & (b <= 0) & (c <= 0))
