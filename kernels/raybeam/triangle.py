"""The float64 intersection test that decides whether a ray hits a triangle.

The test is that of Woop, Benthin and Wald (2013), "Watertight Ray/Triangle Intersection". The
vertices are translated to the origin of the ray and sheared so that the ray runs along an axis.
Three signed areas in the plane perpendicular to this axis then determine whether the ray passes
through the triangle.

The sheared position of a vertex does not depend on the triangle, and in floating point, the sign of
``a * b - c * d`` is either correct or zero as long as no fused multiply-add is used. Because zero
counts as inside, there are no gaps between triangles that share an edge or a vertex, regardless of
rounding. Signed volumes in Plücker coordinates are also consistent along an edge, but they round
independently for the edges that meet at a vertex, so that a ray at a vertex can slip through.

intersect.cu performs the same operations in the same order, so its distances have the same bits.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from .arrays import Bools, Floats, Indices


@dataclass(frozen=True)
class ShearedRays:
    """Rays that are prepared for the test, with one element per ray in each array.

    Attributes
    ----------
    kx, ky, kz
        Axes in cyclic order, where kz is the axis of the largest direction component.
    ox, oy, oz
        Local origin along kx, ky and kz.
    sx, sy, sz
        Shear: the direction components along kx and ky, divided by the component along kz, and the
        reciprocal of the component along kz.
    """

    kx: Indices
    ky: Indices
    kz: Indices
    ox: Floats
    oy: Floats
    oz: Floats
    sx: Floats
    sy: Floats
    sz: Floats


class PlaneHits(NamedTuple):
    """Intersections of rays with the planes of triangles.

    Attributes
    ----------
    a, b, c
        float64 (m,): weights of the three vertices times `det`. The ray passes through the triangle
        if all have the same sign or are zero (see `is_inside`).
    det
        float64 (m,): ``(a + b) + c``, which is zero if the ray lies in the plane of the triangle.
    t
        float64 (m,): distance in local units. Meaningless if `det` is zero.
    """

    a: Floats
    b: Floats
    c: Floats
    det: Floats
    t: Floats


def shear_rays(origins: Floats, directions: Floats) -> ShearedRays:
    """Prepare rays with local origins and unit directions for the test."""
    kz = np.argmax(np.abs(directions), axis=1)
    kx = (kz + 1) % 3
    ky = (kz + 2) % 3
    row = np.arange(len(directions))
    component = directions[row, kz]
    return ShearedRays(
        kx=kx,
        ky=ky,
        kz=kz,
        ox=origins[row, kx],
        oy=origins[row, ky],
        oz=origins[row, kz],
        sx=directions[row, kx] / component,
        sy=directions[row, ky] / component,
        sz=1 / component,
    )


def intersect(rays: ShearedRays, ray: Indices, corners: Floats, triangle: Indices) -> PlaneHits:
    """Compute signed areas and distances for pairs of a ray and a triangle.

    Parameters
    ----------
    rays
        Prepared rays.
    ray, triangle
        (m,): indices of the rays and triangles.
    corners
        (k, 3, 3): vertices of all triangles in local coordinates.
    """
    # If a ray is farther away than 1e154 m, the areas overflow to infinity or NaN, which is not a
    # hit.
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        x, y, z = _sheared_corners(rays, ray, corners, triangle)
        a = x[2] * y[1] - y[2] * x[1]
        b = x[0] * y[2] - y[0] * x[2]
        c = x[1] * y[0] - y[1] * x[0]
        det = (a + b) + c
        t = (((a * z[0] + b * z[1]) + c * z[2]) / det) * rays.sz[ray]
    return PlaneHits(a, b, c, det, t)


def _sheared_corners(
    rays: ShearedRays, ray: Indices, corners: Floats, triangle: Indices
) -> tuple[list[Floats], list[Floats], list[Floats]]:
    """Return the coordinates of each triangle's three vertices relative to the ray.

    The result is three lists with one array (m,) per vertex: sheared x and y, and z along kz.
    """
    flat = corners.reshape(-1)
    row_x = triangle * 9 + rays.kx[ray]
    row_y = triangle * 9 + rays.ky[ray]
    row_z = triangle * 9 + rays.kz[ray]
    ox = rays.ox[ray]
    oy = rays.oy[ray]
    oz = rays.oz[ray]
    sx = rays.sx[ray]
    sy = rays.sy[ray]
    x: list[Floats] = []
    y: list[Floats] = []
    z: list[Floats] = []
    for corner in (0, 3, 6):
        depth = flat.take(row_z + corner) - oz
        x.append((flat.take(row_x + corner) - ox) - sx * depth)
        y.append((flat.take(row_y + corner) - oy) - sy * depth)
        z.append(depth)
    return x, y, z


def is_inside(a: Floats, b: Floats, c: Floats, det: Floats) -> Bools:
    """Return whether each ray passes through its triangle, including edges and vertices."""
    same_sign = ((a >= 0) & (b >= 0) & (c >= 0)) | ((a <= 0) & (b <= 0) & (c <= 0))
    return same_sign & (det != 0)
