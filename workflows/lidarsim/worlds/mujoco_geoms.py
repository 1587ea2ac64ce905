"""Triangle meshes of MuJoCo geoms, in the geom frames."""

from __future__ import annotations

import math
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

from ..errors import LidarError
from ..numerics.arrays import Floats, Ints
from ..numerics.elementary import arctan2
from ..scene.actors import box
from ..scene.scene_mesh import SceneMesh
from ..scene.shapes import capsule, cylinder

# Half the side length of infinite planes, in meters. It is far beyond the range of a lidar on a
# robot, and small enough for single precision to resolve a millimeter.
PLANE_M = 4000.0
# Maximum distance in meters between triangles and the surface of a cylinder. For spheres, it is
# twice as large.
SAG_M = 2.5e-4
_MAX_SEGMENTS = 1024


class GeomType(IntEnum):
    """Geom types in MuJoCo (mjtGeom)."""

    PLANE = 0
    HFIELD = 1
    SPHERE = 2
    CAPSULE = 3
    ELLIPSOID = 4
    CYLINDER = 5
    BOX = 6
    MESH = 7
    SDF = 8


class GeomMesh(NamedTuple):
    """Triangle mesh of a geom in the geom frame."""

    vertices: Floats  # (v, 3), meters
    faces: Ints  # (f, 3)


def create_geom_mesh(model: Any, geom: int, sag_m: float, plane_m: float = PLANE_M) -> GeomMesh:
    """Create the triangle mesh of a geom.

    Parameters
    ----------
    model
        An `mjModel`.
    geom
        ID of the geom.
    sag_m
        Maximum distance in meters between the triangles and a curved surface. For spheres and
        ellipsoids, it is twice as large.
    plane_m
        Half the side length of infinite planes, in meters.

    Raises
    ------
    LidarError
        If the type of the geom is unknown.
    """
    kind = int(model.geom_type[geom])
    size = np.asarray(model.geom_size[geom], np.float64)
    radius, half, _ = size.tolist()
    match kind:
        case GeomType.PLANE:
            return _plane(size, plane_m)
        case GeomType.HFIELD:
            return height_field(model, int(model.geom_dataid[geom]))
        case GeomType.SPHERE:
            return _geom_mesh(capsule(radius, 0, count_segments(radius, sag_m), "ball"))
        case GeomType.CAPSULE:
            return _geom_mesh(capsule(radius, 2 * half, count_segments(radius, sag_m), "capsule"))
        case GeomType.ELLIPSOID:
            ball = capsule(1, 0, count_segments(float(size.max()), sag_m), "ball")
            return GeomMesh(ball.vertices * size, ball.faces)
        case GeomType.CYLINDER:
            return _geom_mesh(cylinder(radius, 2 * half, count_segments(radius, sag_m), "cylinder"))
        case GeomType.BOX:
            cube = box("box", (2.0, 2.0, 2.0))
            return GeomMesh((cube.vertices - [0, 0, 1]) * size, cube.faces)
        case GeomType.MESH | GeomType.SDF:
            return _mesh(model, int(model.geom_dataid[geom]))
    raise LidarError(f"Geom {geom} has the unknown type {kind}. The known types are {[*GeomType]}.")


def count_segments(radius: float, sag_m: float) -> int:
    """Return the number of sides of a polygon that approximates a circle.

    The centers of the sides are at most `sag_m` from the circle, unless the number of sides is
    limited. The result is a multiple of 4.
    """
    fraction = min(max(sag_m / radius, 1e-9), 0.2)
    half_angle = float(arctan2(math.sqrt((2 - fraction) * fraction), 1 - fraction))
    return min(4 * math.ceil(math.pi / half_angle / 4), _MAX_SEGMENTS)


def height_field(model: Any, field: int) -> GeomMesh:
    """Create the triangle mesh of a height field, including its sides and base.

    As in MuJoCo, the diagonal of each cell runs from the vertex with the lowest row and column to
    the vertex with the highest.
    """
    columns = int(model.hfield_ncol[field])
    top = _field_vertices(model, field)
    grid = np.arange(len(top)).reshape(-1, columns)
    rim = np.concatenate([grid[0, :-1], grid[:-1, -1], grid[-1, :0:-1], grid[:0:-1, 0]])
    bottom = top[rim].copy()
    bottom[:, 2] = -float(model.hfield_size[field][3])
    sides = columns - 1, len(grid) - 1, columns - 1
    corners = len(top) + np.cumsum([0, *sides])
    base = corners[[[0, 2, 1], [0, 3, 2]]]
    faces = np.concatenate([_cells(grid), _walls(rim, len(top)), base])
    return GeomMesh(np.concatenate([top, bottom]), faces.astype(np.int64))


def _field_vertices(model: Any, field: int) -> Floats:
    """Return the vertices of a height field in row order.

    The shape is (rows * columns, 3).
    """
    rows = int(model.hfield_nrow[field])
    columns = int(model.hfield_ncol[field])
    first = int(model.hfield_adr[field])
    half_x, half_y, height, _ = np.asarray(model.hfield_size[field], np.float64).tolist()
    fractions = np.asarray(model.hfield_data[first : first + rows * columns], np.float64)
    row, column = np.divmod(np.arange(rows * columns), columns)
    x = 2 * half_x / (columns - 1) * column - half_x
    y = 2 * half_y / (rows - 1) * row - half_y
    return np.stack([x, y, fractions * height], axis=1)


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


def _plane(size: Floats, plane_m: float) -> GeomMesh:
    """Create the mesh of a plane, which extends to `plane_m` along axes without a size."""
    x, y = np.where(size[:2] > 0, size[:2], plane_m).tolist()
    corners = np.array([[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]])
    return GeomMesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))


def _mesh(model: Any, mesh: int) -> GeomMesh:
    vertex = int(model.mesh_vertadr[mesh])
    face = int(model.mesh_faceadr[mesh])
    vertices = model.mesh_vert[vertex : vertex + int(model.mesh_vertnum[mesh])]
    faces = model.mesh_face[face : face + int(model.mesh_facenum[mesh])]
    return GeomMesh(np.array(vertices, np.float64), np.array(faces, np.int64))


def _geom_mesh(mesh: SceneMesh) -> GeomMesh:
    return GeomMesh(mesh.vertices, mesh.faces)
