"""The test that decides whether a ray hits a triangle, in float64.

It is the watertight test of Woop, Benthin and Wald (2013), "Watertight Ray/Triangle
Intersection": corners are taken relative to the ray's origin and sheared so that the ray runs
along one axis; three signed areas in the plane across it then show whether the ray passes inside.
Shearing a corner does not depend on its triangle, and the sign of ``a * b - c * d`` is right or
zero in floating point as long as no multiply-add is fused. Because zero counts as inside, triangles
that share an edge or a corner leave no gap, whatever the rounding. (Signed volumes of Plücker
coordinates are consistent along an edge too, but round independently for the edges around one
corner, so a ray at a corner can slip through.)

intersect.cu does the same operations in the same order, so its distances have the same bits.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .arrays import Bools, Floats, Indices


@dataclass(frozen=True)
class ShearedRays:
    """Rays prepared for the test; every array has one entry a ray.

    Attributes
    ----------
    kx, ky, kz
        Axes in cyclic order; kz is the one along which the ray advances most.
    ox, oy, oz
        Local origin along those axes.
    sx, sy, sz
        The shear: direction along kx, ky over that along kz, and 1 over that along kz.
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


def shear(origins: Floats, directions: Floats) -> ShearedRays:
    """Prepare rays with local origins (n, 3) and unit directions (n, 3)."""
    kz = np.argmax(np.abs(directions), axis=1)
    kx = (kz + 1) % 3
    ky = (kz + 2) % 3
    row = np.arange(len(directions))
    along = directions[row, kz]
    return ShearedRays(
        kx,
        ky,
        kz,
        origins[row, kx],
        origins[row, ky],
        origins[row, kz],
        directions[row, kx] / along,
        directions[row, ky] / along,
        1 / along,
    )


def intersect(
    rays: ShearedRays, ray: Indices, corners: Floats, triangle: Indices
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Signed areas and distance of pairs of a ray and a triangle.

    Parameters
    ----------
    rays
        Prepared rays.
    ray, triangle
        (m,): the pairs.
    corners
        (k, 3, 3): local corners of all triangles.

    Returns
    -------
    a, b, c
        (m,): the weights of the three corners times `det`. The ray passes inside when none is
        negative or none is positive, see `inside`.
    det
        (m,): ``(a + b) + c``; zero when the ray runs in the triangle's plane.
    t
        (m,): distance in local units; meaningless where `det` is zero.
    """
    flat = corners.reshape(-1)
    base = triangle * 9
    at_x = base + rays.kx[ray]
    at_y = base + rays.ky[ray]
    at_z = base + rays.kz[ray]
    ox = rays.ox[ray]
    oy = rays.oy[ray]
    oz = rays.oz[ray]
    sx = rays.sx[ray]
    sy = rays.sy[ray]
    x: list[Floats] = []
    y: list[Floats] = []
    z: list[Floats] = []
    for corner in (0, 3, 6):
        depth = flat.take(at_z + corner) - oz
        x.append((flat.take(at_x + corner) - ox) - sx * depth)
        y.append((flat.take(at_y + corner) - oy) - sy * depth)
        z.append(depth)
    a = x[2] * y[1] - y[2] * x[1]
    b = x[0] * y[2] - y[0] * x[2]
    c = x[1] * y[0] - y[1] * x[0]
    det = (a + b) + c
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (((a * z[0] + b * z[1]) + c * z[2]) / det) * rays.sz[ray]
    return a, b, c, det, t


def inside(a: Floats, b: Floats, c: Floats, det: Floats) -> Bools:
    """Whether the ray's line passes through the triangle, its edges and corners included."""
    one_side = ((a >= 0) & (b >= 0) & (c >= 0)) | ((a <= 0) & (b <= 0) & (c <= 0))
    return one_side & (det != 0)
