"""Generated meshes: surfaces of revolution and the six objects of the demo scene."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..numerics.arrays import Floats, Ints
from ..numerics.elementary import cos, interp, sin, sin_cos
from ..numerics.vectors import norm
from .scene_mesh import SceneMesh

SEED_RADIUS_M = 2.0
SEED_RINGS = 80
SEED_SEGMENTS = 80
SEED_POSITIONS = (
    (-20.0, -20.0),
    (20.0, -20.0),
    (-20.0, 20.0),
    (20.0, 20.0),
    (-10.0, -5.0),
    (5.0, 5.0),
)

# Control polygons from the lower pole to the upper pole, as (radius, height) in meters. The first
# and the last segment are horizontal, so that the surface is smooth at the axis. A repeated point
# makes a tighter bend. Radii are scaled afterward so that the largest is SEED_RADIUS_M.
SEED_OUTLINES: dict[str, tuple[tuple[float, float], ...]] = {
    "Vase": (
        (0.0, 0.0), (1.1, 0.0), (1.1, 0.0), (1.2, 0.3), (2.4, 1.4), (2.0, 2.9), (0.7, 3.4),
        (0.7, 4.1), (1.3, 4.5), (1.3, 4.6), (1.1, 4.6), (0.5, 4.1), (0.5, 3.5), (0.0, 3.5),
    ),
    "Bell": (
        (0.0, 0.0), (2.0, 0.0), (2.0, 0.0), (2.0, 0.25), (1.75, 0.5), (1.4, 1.5), (1.3, 3.0),
        (0.9, 3.5), (0.3, 3.6), (0.3, 3.8), (0.55, 4.0), (0.4, 4.4), (0.0, 4.4),
    ),
    "Pawn": (
        (0.0, 0.0), (2.0, 0.0), (2.0, 0.0), (2.0, 0.5), (1.7, 0.8), (1.3, 0.9), (0.8, 1.6),
        (0.6, 2.7), (0.7, 2.8), (1.2, 2.9), (1.2, 3.1), (0.6, 3.2), (0.6, 3.3), (1.3, 3.6),
        (1.3, 4.7), (0.6, 5.1), (0.0, 5.1),
    ),
    "Spindle": (
        (0.0, 0.0), (0.25, 0.0), (0.5, 0.6), (2.2, 1.7), (2.2, 2.1), (0.9, 2.6), (0.4, 3.6),
        (0.6, 3.9), (0.3, 4.3), (0.0, 4.3),
    ),
    # The bowl is low because it would hide the pawn from the default poses otherwise.
    "Bowl": (
        (0.0, 0.0), (1.1, 0.0), (1.1, 0.0), (1.0, 0.25), (0.5, 0.4), (0.5, 0.55), (1.9, 0.7),
        (2.2, 1.6), (2.0, 2.2), (1.85, 2.2), (2.0, 1.6), (1.7, 0.95), (0.0, 0.8),
    ),
}  # fmt: skip


def seed_objects(rings: int = SEED_RINGS, segments: int = SEED_SEGMENTS) -> tuple[SceneMesh, ...]:
    """Create the six objects of the demo scene.

    These are a sphere, a vase, a bell, a pawn, a spindle and a bowl. Each object is placed on the
    plane z = 0 at its position in `SEED_POSITIONS` and has a radius of `SEED_RADIUS_M`. Each has
    `2 * rings * segments` triangles, which is a total of 76,800 by default.
    """
    angles = np.linspace(-np.pi / 2, np.pi / 2, rings + 2)
    sphere = SEED_RADIUS_M * np.stack([cos(angles), 1 + sin(angles)], axis=1)
    profiles = {"Sphere": sphere} | {
        name: resample(smooth(outline), rings + 2) for name, outline in SEED_OUTLINES.items()
    }
    meshes = []
    for (name, profile), (x, y) in zip(profiles.items(), SEED_POSITIONS, strict=True):
        profile[:, 0] *= SEED_RADIUS_M / profile[:, 0].max()
        mesh = revolve(profile, segments, name=name)
        meshes.append(SceneMesh(name, mesh.vertices + np.array([x, y, 0.0]), mesh.faces))
    return tuple(meshes)


def revolve(profile: ArrayLike, segments: int, name: str = "Revolved") -> SceneMesh:
    """Create a closed surface of revolution about the z axis.

    The mesh has `2 * (n - 2) * segments` triangles with outward normals, a single vertex at each
    pole, and no duplicate vertices at the seam. It is watertight if the profile does not intersect
    itself.

    Parameters
    ----------
    profile
        Radii and heights in meters, from the lower pole to the upper pole. The first and last
        radius are replaced by zero, and all other radii must be positive. Shape (n, 2) with n >= 3.
    segments
        Number of segments around the axis, at least 3.
    name
        Name of the mesh.
    """
    line = np.asarray(profile, dtype=np.float64)
    rings = len(line) - 2
    azimuth = 2 * np.pi * np.arange(segments) / segments
    radius, height = line[1:-1].T
    circles = np.empty((rings, segments, 3))
    circles[..., 0] = radius[:, None] * cos(azimuth)
    circles[..., 1] = radius[:, None] * sin(azimuth)
    circles[..., 2] = height[:, None]
    poles = [[0.0, 0.0, line[0, 1]], [0.0, 0.0, line[-1, 1]]]
    vertices = np.concatenate([circles.reshape(-1, 3), poles])
    return SceneMesh(name, vertices, _revolved_faces(rings, segments))


def capsule(radius: float, height: float, segments: int, name: str) -> SceneMesh:
    """Create an upright capsule centered at the origin.

    The height in meters is the length of the cylindrical part. A height of zero creates a sphere.
    """
    angles = np.linspace(-np.pi / 2, np.pi / 2, segments // 2 + 1)
    ball = radius * np.stack(sin_cos(angles)[::-1], axis=1)
    up = [0, height / 2]
    middle = segments // 4
    profile = np.concatenate([ball[: middle + bool(height)] - up, ball[middle:] + up])
    return revolve(profile, segments, name)


def cylinder(radius: float, height: float, segments: int, name: str) -> SceneMesh:
    """Create an upright cylinder centered at the origin."""
    half = height / 2
    return revolve([(0, -half), (radius, -half), (radius, half), (0, half)], segments, name)


def _revolved_faces(rings: int, segments: int) -> Ints:
    """Return the faces of a surface of revolution.

    The surface has `rings` circles with `segments` vertices each. The last two vertices are the
    lower pole and the upper pole.
    """
    grid = np.arange(rings * segments).reshape(rings, segments)
    following = np.roll(grid, -1, axis=1)
    lower = grid[:-1]
    lower_next = following[:-1]
    upper = grid[1:]
    upper_next = following[1:]
    lower_pole = rings * segments
    upper_pole = rings * segments + 1
    bands = [
        np.stack([lower, lower_next, upper_next], axis=-1).reshape(-1, 3),
        np.stack([lower, upper_next, upper], axis=-1).reshape(-1, 3),
    ]
    bottom = np.stack([np.full(segments, lower_pole), following[0], grid[0]], axis=-1)
    top = np.stack([np.full(segments, upper_pole), grid[-1], following[-1]], axis=-1)
    return np.concatenate([bottom, *bands, top])


def smooth(outline: ArrayLike, rounds: int = 5) -> Floats:
    """Smooth a polyline by cutting its corners (Chaikin 1974), without moving its ends.

    The limit is a quadratic B-spline, which never leaves the convex hull of three adjacent control
    points. Radii therefore remain positive. The polyline has shape (n, d).
    """
    line = np.asarray(outline, dtype=np.float64)
    for _ in range(rounds):
        quarter = 0.75 * line[:-1] + 0.25 * line[1:]
        three_quarters = 0.25 * line[:-1] + 0.75 * line[1:]
        cut = np.stack([quarter, three_quarters], axis=1).reshape(-1, line.shape[1])
        line = np.concatenate([line[:1], cut, line[-1:]])
    return line


def resample(line: ArrayLike, count: int) -> Floats:
    """Place equidistant points along a polyline, including both of its ends.

    The polyline has shape (n, d), and the points have shape (count, d).
    """
    points = np.asarray(line, dtype=np.float64)
    distances = np.concatenate([[0.0], np.cumsum(norm(np.diff(points, axis=0)))])
    even_distances = np.linspace(0.0, distances[-1], count)
    return np.stack([interp(even_distances, distances, column) for column in points.T], axis=1)
