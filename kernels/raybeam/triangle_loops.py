"""The intersection test of triangle.py as compiled functions."""

from __future__ import annotations

from typing import NamedTuple

from .compiled import inlined


class PlaneHit(NamedTuple):
    """Intersection of a ray with a triangle's plane.

    Attributes
    ----------
    a, b, c
        Signed areas: weights of the three vertices times `det`.
    det
        ``(a + b) + c``, which is 0 if the ray lies in the plane.
    t
        Distance in local units. Meaningless if `det` is 0.
    """

    a: float
    b: float
    c: float
    det: float
    t: float


@inlined
def shear_ray(ox, oy, oz, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Return a ray's longest axis, its origin with this axis last, and its shear."""
    ax = abs(dx)
    ay = abs(dy)
    az = abs(dz)
    along_x = ax >= ay and ax >= az
    along_y = not along_x and ay >= az
    component = dx if along_x else (dy if along_y else dz)
    p = dy if along_x else (dz if along_y else dx)
    q = dz if along_x else (dx if along_y else dy)
    u = oy if along_x else (oz if along_y else ox)
    v = oz if along_x else (ox if along_y else oy)
    w = ox if along_x else (oy if along_y else oz)
    return (
        0 if along_x else (1 if along_y else 2),
        u,
        v,
        w,
        p / component,
        q / component,
        1.0 / component,
    )


@inlined
def intersect_plane(corners, ray):  # type: ignore[no-untyped-def]  # noqa: PLR0914 - a compiled loop
    """Return the `PlaneHit` of a sheared ray on a triangle's plane.

    The coordinates of the three vertices have the longest axis of the ray last.
    """
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
    return PlaneHit(a, b, c, det, (((a * z0 + b * z1) + c * z2) / det) * sz)


@inlined
def same_sign(a, b, c):  # type: ignore[no-untyped-def]
    """Return whether all three areas have the same sign. Zero counts as either sign."""
    return ((a >= 0) & (b >= 0) & (c >= 0)) | ((a <= 0) & (b <= 0) & (c <= 0))
