"""Triangle meshes of the shapes of physics engines, centered at the origin."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..numerics.arrays import Floats, Ints
from ..numerics.elementary import arctan2, sin_cos
from ..scene.actors import box
from ..scene.scene_mesh import SceneMesh
from ..scene.shapes import capsule, cylinder, revolve

# Half the side length of infinite planes, in meters. It is far beyond the range of a lidar on a
# robot, and small enough for single precision to resolve a millimeter.
PLANE_M = 4000.0
# Maximum distance in meters between triangles and the surface of a cylinder. For spheres, it is
# twice as large.
SAG_M = 2.5e-4
_MAX_SEGMENTS = 1024


class ShapeMesh(NamedTuple):
    """Triangle mesh of a shape in the frame of the shape."""

    vertices: Floats  # (v, 3), meters
    faces: Ints  # (f, 3)


def box_mesh(half_sizes: Floats) -> ShapeMesh:
    """Create the mesh of a box with the given half side lengths (3,)."""
    cube = box("box", (2.0, 2.0, 2.0))
    return ShapeMesh((cube.vertices - [0, 0, 1]) * half_sizes, cube.faces)


def capsule_mesh(radius: float, half_height: float, sag_m: float) -> ShapeMesh:
    """Create the mesh of an upright capsule, or of a sphere if `half_height` is 0."""
    return _shape_mesh(capsule(radius, 2 * half_height, count_segments(radius, sag_m), "capsule"))


def ellipsoid_mesh(radii: Floats, sag_m: float) -> ShapeMesh:
    """Create the mesh of an ellipsoid with the given semi-axes (3,)."""
    ball = capsule(1, 0, count_segments(float(radii.max()), sag_m), "ball")
    return ShapeMesh(ball.vertices * radii, ball.faces)


def cylinder_mesh(
    radius: float, half_height: float, sag_m: float, barrel_radius: float = 0.0
) -> ShapeMesh:
    """Create the mesh of an upright cylinder or barrel.

    `radius` is the radius of the ends. The side of a barrel is an arc with the radius
    `barrel_radius`, which is at least `half_height`. A value of 0 creates a straight side.
    """
    if not barrel_radius:
        segments = count_segments(radius, sag_m)
        return _shape_mesh(cylinder(radius, 2 * half_height, segments, "cylinder"))
    offset = math.sqrt(barrel_radius**2 - half_height**2)
    arc = float(arctan2(half_height, offset))  # half the angle of the arc
    pieces = math.ceil(count_segments(barrel_radius, sag_m) * arc / math.pi)
    sines, cosines = sin_cos(np.linspace(-arc, arc, pieces + 1))
    radii = np.concatenate([[0], radius + barrel_radius * cosines - offset, [0]])
    heights = np.concatenate([[-half_height], barrel_radius * sines, [half_height]])
    segments = count_segments(float(radii.max()), sag_m)
    return _shape_mesh(revolve(np.stack([radii, heights], axis=1), segments))


def cone_mesh(radius: float, half_height: float, sag_m: float) -> ShapeMesh:
    """Create the mesh of an upright cone, whose tip is at `half_height`."""
    profile = [(0, -half_height), (radius, -half_height), (0, half_height)]
    return _shape_mesh(revolve(profile, count_segments(radius, sag_m)))


def plane_mesh(half_sizes: Floats, plane_m: float = PLANE_M) -> ShapeMesh:
    """Create the mesh of a horizontal rectangle with the given half side lengths (2,).

    Along axes with a size of 0, it extends to `plane_m`.
    """
    x, y = np.where(half_sizes > 0, half_sizes, plane_m).tolist()
    corners = np.array([[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]])
    return ShapeMesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))


def height_field_mesh(heights: Floats, half_sizes: tuple[float, float], base: float) -> ShapeMesh:
    """Create the triangle mesh of a height field, including its sides and base.

    The diagonal of each cell runs from the vertex with the lowest row and column to the vertex with
    the highest.

    Parameters
    ----------
    heights
        Heights in meters, with rows along y and columns along x. Shape (rows, columns).
    half_sizes
        Half the side lengths along x and y, in meters.
    base
        Height of the base in meters.
    """
    top = _field_vertices(heights, half_sizes)
    grid = np.arange(len(top)).reshape(heights.shape)
    rim = np.concatenate([grid[0, :-1], grid[:-1, -1], grid[-1, :0:-1], grid[:0:-1, 0]])
    bottom = top[rim].copy()
    bottom[:, 2] = base
    rows, columns = heights.shape
    corners = len(top) + np.cumsum([0, columns - 1, rows - 1, columns - 1])
    floor = corners[[[0, 2, 1], [0, 3, 2]]]
    faces = np.concatenate([_cells(grid), _walls(rim, len(top)), floor])
    return ShapeMesh(np.concatenate([top, bottom]), faces.astype(np.int64))


def _field_vertices(heights: Floats, half_sizes: tuple[float, float]) -> Floats:
    """Return the vertices of a height field in row order.

    The shape is (rows * columns, 3).
    """
    rows, columns = heights.shape
    half_x, half_y = half_sizes
    row, column = np.divmod(np.arange(rows * columns), columns)
    x = 2 * half_x / (columns - 1) * column - half_x
    y = 2 * half_y / (rows - 1) * row - half_y
    return np.stack([x, y, heights.reshape(-1)], axis=1)


def _cells(grid: Ints) -> Ints:
    first = grid[:-1, :-1]
    right = grid[:-1, 1:]
    above = grid[1:, :-1]
    opposite = grid[1:, 1:]
    return np.concatenate(
        [
            np.stack([first, right, opposite], axis=-1).reshape(-1, 3),
            np.stack([first, opposite, above], axis=-1).reshape(-1, 3),
        ]
    )


def _walls(rim: Ints, first_lower: int) -> Ints:
    """Return the triangles between a closed rim and the vertices below it.

    The index of the first lower vertex is `first_lower`.
    """
    lower = first_lower + np.arange(len(rim))
    next_rim = np.roll(rim, -1)
    next_lower = np.roll(lower, -1)
    return np.concatenate(
        [
            np.stack([rim, lower, next_lower], axis=-1),
            np.stack([rim, next_lower, next_rim], axis=-1),
        ]
    )


def count_segments(radius: float, sag_m: float) -> int:
    """Return the number of sides of a polygon that approximates a circle.

    The centers of the sides are at most `sag_m` from the circle, unless the number of sides is
    limited. The result is a multiple of 4.
    """
    fraction = min(max(sag_m / radius, 1e-9), 0.2)
    half_angle = float(arctan2(math.sqrt((2 - fraction) * fraction), 1 - fraction))
    return min(4 * math.ceil(math.pi / half_angle / 4), _MAX_SEGMENTS)


def _shape_mesh(mesh: SceneMesh) -> ShapeMesh:
    return ShapeMesh(mesh.vertices, mesh.faces)
