"""The test that decides whether a ray hits a triangle, in float64.

It is the watertight test of Woop, Benthin and Wald (2013), "Watertight Ray/Triangle
Intersection": corners are taken relative to the ray's origin and sheared so that the ray runs
along an axis; three signed areas in the plane across that axis then show whether the ray passes
inside.
Shearing a corner does not depend on its triangle, and the sign of ``a * b - c * d`` is right or
zero in floating point as long as no multiply-add is fused. Because zero counts as inside, triangles
that share an edge or a corner leave no gap, whatever the rounding. (Signed volumes of Plücker
coordinates are consistent along an edge too, but round independently for the edges around one
corner, so a ray at a corner can slip through.)

intersect.cu does the same operations in the same order, so its distances have the same bits.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from .arrays import Bools, Floats, Indices


@dataclass(frozen=True)
class ShearedRays:
    """Rays prepared for the test, with an entry for each ray in every array.

    Attributes
    ----------
    kx, ky, kz
        Axes in cyclic order; the ray advances most along kz.
    ox, oy, oz
        Local origin along kx, ky, kz.
    sx, sy, sz
        The shear: direction along kx, ky over direction along kz, and 1 over direction along kz.
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
    """Where the lines of rays (m,) meet the planes of triangles.

    Attributes
    ----------
    a, b, c
        float64 (m,): weights of the three corners times `det`. The ray passes inside if none is
        negative or none is positive (`is_inside`).
    det
        float64 (m,): ``(a + b) + c``; zero if the ray runs in the triangle's plane.
    t
        float64 (m,): distance in local units; meaningless where `det` is zero.
    """

    a: Floats
    b: Floats
    c: Floats
    det: Floats
    t: Floats


def shear_rays(origins: Floats, directions: Floats) -> ShearedRays:
    """Prepare rays with local origins (n, 3) and unit directions (n, 3)."""
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
    """Compute signed areas and distance of pairs of a ray and a triangle.

    Parameters
    ----------
    rays
        Prepared rays.
    ray, triangle
        (m,): the pairs.
    corners
        (k, 3, 3): local corners of all triangles.
    """
    # Areas of rays that are farther than 1e154 m overflow to infinity or NaN, and are never hits.
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
    """Return the coordinates of the three corners of triangles (m,), relative to rays (m,).

    Three lists by corner: x and y across the ray, by the shear, and z along kz; (m,) each.
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
    """Return whether the line of a ray passes through a triangle, edges and corners included."""
    same_sign = ((a >= 0) & (b >= 0) & (c >= 0)) | ((a <= 0) & (b <= 0) & (c <= 0))
    return same_sign & (det != 0)
