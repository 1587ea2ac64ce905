"""Triangle meshes of MuJoCo geoms, in the geom frames."""

from __future__ import annotations

from enum import IntEnum
from typing import Any

import numpy as np

from ..errors import LidarError
from .shape_meshes import (
    PLANE_M,
    ShapeMesh,
    box_mesh,
    capsule_mesh,
    cylinder_mesh,
    ellipsoid_mesh,
    height_field_mesh,
    plane_mesh,
)


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


def create_geom_mesh(model: Any, geom: int, sag_m: float, plane_m: float = PLANE_M) -> ShapeMesh:
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
            return plane_mesh(size[:2], plane_m)
        case GeomType.HFIELD:
            return height_field(model, int(model.geom_dataid[geom]))
        case GeomType.SPHERE:
            return capsule_mesh(radius, 0, sag_m)
        case GeomType.CAPSULE:
            return capsule_mesh(radius, half, sag_m)
        case GeomType.ELLIPSOID:
            return ellipsoid_mesh(size, sag_m)
        case GeomType.CYLINDER:
            return cylinder_mesh(radius, half, sag_m)
        case GeomType.BOX:
            return box_mesh(size)
        case GeomType.MESH | GeomType.SDF:
            return _mesh(model, int(model.geom_dataid[geom]))
    raise LidarError(f"Geom {geom} has the unknown type {kind}. The known types are {[*GeomType]}.")


def height_field(model: Any, field: int) -> ShapeMesh:
    """Create the triangle mesh of a height field, including its sides and base."""
    rows = int(model.hfield_nrow[field])
    columns = int(model.hfield_ncol[field])
    first = int(model.hfield_adr[field])
    half_x, half_y, height, base = np.asarray(model.hfield_size[field], np.float64).tolist()
    fractions = np.asarray(model.hfield_data[first : first + rows * columns], np.float64)
    heights = fractions.reshape(rows, columns) * height
    return height_field_mesh(heights, (half_x, half_y), -base)


def _mesh(model: Any, mesh: int) -> ShapeMesh:
    vertex = int(model.mesh_vertadr[mesh])
    face = int(model.mesh_faceadr[mesh])
    vertices = model.mesh_vert[vertex : vertex + int(model.mesh_vertnum[mesh])]
    faces = model.mesh_face[face : face + int(model.mesh_facenum[mesh])]
    return ShapeMesh(np.array(vertices, np.float64), np.array(faces, np.int64))
