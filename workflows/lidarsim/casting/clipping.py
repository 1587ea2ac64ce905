"""Clip triangles to a box around the sensors.

Ray casters compute in single precision relative to the size of the scene. Ground planes that extend
to ± 200 km would make a cast 140 times slower. Within the box, the clipped triangles cover the same
points, and the error of new corners is about 1e-16 of the triangle's size.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ..numerics.arrays import Bools, Floats, Indices, Integers, Ints

_Corner = tuple[float, float, float]  # x, y, z of a corner


class ClippedMesh(NamedTuple):
    """A mesh clipped to a box."""

    vertices: Floats  # (v, 3)
    faces: Ints  # (f, 3)
    origin: Indices  # (f,): original triangle of which each triangle is part, ascending


def box_planes(region: Floats, transform: Floats | None = None) -> Floats:
    """Return the six planes that bound a box.

    `region` has the lower and upper corner. Each row of the result has a normal and an offset, and
    a point p is inside the box if ``normal @ p <= offset`` for all rows. If `transform` (3, 4) maps
    a mesh frame to the frame of the box, the planes are in the mesh frame.
    """
    matrix = np.eye(3, 4) if transform is None else transform
    lower, upper = region
    above = np.column_stack([matrix[:, :3], upper - matrix[:, 3]])
    below = np.column_stack([-matrix[:, :3], matrix[:, 3] - lower])
    return np.concatenate([above, below])


def clip_triangles(vertices: Floats, faces: Integers, planes: Floats) -> ClippedMesh | None:
    """Clip triangles to the inner side of all planes. Return None if all triangles are inside."""
    is_outside = _outside(vertices, planes)[faces]  # (f, 3, 6)
    crossing = is_outside.any(axis=(1, 2))
    if not crossing.any():
        return None
    absent = np.any(np.all(is_outside, axis=1), axis=1)
    cut_triangles = [
        part
        for face in np.flatnonzero(crossing & ~absent).tolist()
        for part in _parts_of(face, [*map(tuple, vertices[faces[face]].tolist())], planes)
    ]
    face_indices = np.flatnonzero(~crossing)
    new_vertices = np.array([part.corners for part in cut_triangles], np.float64).reshape(-1, 3)
    new_faces = len(vertices) + np.arange(3 * len(cut_triangles)).reshape(-1, 3)
    origin = np.append(face_indices, np.array([part.face for part in cut_triangles], np.intp))
    order = np.argsort(origin, kind="stable")
    return ClippedMesh(
        np.concatenate([vertices, new_vertices]),
        np.concatenate([faces[face_indices], new_faces])[order].astype(np.int64),
        origin[order],
    )


class _Part(NamedTuple):
    """A triangle that remains of a clipped face."""

    face: int
    corners: tuple[_Corner, _Corner, _Corner]


def _outside(vertices: Floats, planes: Floats) -> Bools:
    x, y, z = vertices.T[:, :, None]
    a, b, c, offset = planes.T
    return np.asarray(a * x + b * y + c * z > offset)


def _parts_of(face: int, polygon: Sequence[_Corner], planes: Floats) -> list[_Part]:
    """Clip a polygon to the inner side of planes, and triangulate the result.

    The algorithm is that of Sutherland and Hodgman (1974).
    """
    for plane in planes.tolist():
        polygon = _cut_polygon(polygon, plane)
    return [_Part(face, (polygon[0], second, third)) for second, third in pairwise(polygon[1:])]


def _cut_polygon(polygon: Sequence[_Corner], plane: list[float]) -> list[_Corner]:
    """Return the part of a polygon on the inner side of a plane."""
    a, b, c, offset = plane
    heights = [a * x + b * y + c * z - offset for x, y, z in polygon]
    corners: list[_Corner] = []
    for index, corner in enumerate(polygon):
        height = heights[index]
        if height <= 0:
            corners.append(corner)
        next_index = (index + 1) % len(polygon)
        if (height <= 0) != (heights[next_index] <= 0):
            corners.append(_crossing((corner, height), (polygon[next_index], heights[next_index])))
    return corners


def _crossing(first: tuple[_Corner, float], second: tuple[_Corner, float]) -> _Corner:
    """Return the point where an edge crosses a plane, given its ends and their heights.

    Heights are signed distances from the plane. The corners are sorted so that both triangles that
    share the edge get the same point.
    """
    (start, start_height), (stop, stop_height) = sorted((first, second))
    fraction = start_height / (start_height - stop_height)
    x, y, z = (p + fraction * (q - p) for p, q in zip(start, stop, strict=True))
    return x, y, z
