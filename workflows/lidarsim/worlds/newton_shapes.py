"""Triangle meshes of Newton shapes, in the shape frames."""

from __future__ import annotations

from enum import IntEnum
from typing import Any

import numpy as np

from ..errors import LidarError
from ..numerics.arrays import Floats
from .shape_meshes import (
    ShapeMesh,
    box_mesh,
    capsule_mesh,
    cone_mesh,
    cylinder_mesh,
    ellipsoid_mesh,
    height_field_mesh,
    plane_mesh,
)


class ShapeType(IntEnum):
    """Shape types in Newton (GeoType)."""

    NONE = 0
    PLANE = 1
    HFIELD = 2
    SPHERE = 3
    CAPSULE = 4
    ELLIPSOID = 5
    CYLINDER = 6
    BOX = 7
    MESH = 8
    CONE = 9
    CONVEX_MESH = 10
    GAUSSIAN = 11


# Types without a surface. Gaussian splats only depict surfaces.
INVISIBLE_TYPES = (ShapeType.NONE, ShapeType.GAUSSIAN)


def create_shape_mesh(kind: int, scale: Floats, source: Any, sag_m: float) -> ShapeMesh:
    """Create the triangle mesh of a shape.

    Parameters
    ----------
    kind
        Type of the shape (`ShapeType`).
    scale
        Size of the shape in meters, or scale of its source. Shape (3,).
    source
        A `newton.Mesh` or `newton.Heightfield`, or None for other types.
    sag_m
        Maximum distance in meters between the triangles and a curved surface. For spheres and
        ellipsoids, it is twice as large.

    Raises
    ------
    LidarError
        If the type of the shape is unknown.
    """
    radius, half_height, barrel_radius = scale.tolist()
    match kind:
        case ShapeType.PLANE:
            return plane_mesh(scale[:2] / 2)
        case ShapeType.HFIELD:
            return _height_field(source, scale)
        case ShapeType.SPHERE:
            return capsule_mesh(radius, 0, sag_m)
        case ShapeType.CAPSULE:
            return capsule_mesh(radius, half_height, sag_m)
        case ShapeType.ELLIPSOID:
            return ellipsoid_mesh(scale, sag_m)
        case ShapeType.CYLINDER:
            return cylinder_mesh(radius, half_height, sag_m, barrel_radius)
        case ShapeType.CONE:
            return cone_mesh(radius, half_height, sag_m)
        case ShapeType.BOX:
            return box_mesh(scale)
        case ShapeType.MESH | ShapeType.CONVEX_MESH:
            vertices = np.asarray(source.vertices, np.float64).reshape(-1, 3)
            faces = np.asarray(source.indices, np.int64).reshape(-1, 3)
            return ShapeMesh(vertices * scale, faces)
    known = ", ".join(item.name.lower() for item in ShapeType)
    raise LidarError(f"It has the unknown type {kind}. The known types are {known}.")


def _height_field(field: Any, scale: Floats) -> ShapeMesh:
    """Create the triangle mesh of a height field, including its sides and base.

    The diagonals of the cells are those of Newton's collision detection.
    """
    fractions = np.asarray(field.data, np.float64)
    heights = (field.min_z + fractions * (field.max_z - field.min_z)) * scale[2]
    half_sizes = float(field.hx * scale[0]), float(field.hy * scale[1])
    return height_field_mesh(heights, half_sizes, float(field.min_z * scale[2]))
