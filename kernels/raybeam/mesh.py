"""Triangle meshes in local coordinates."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from .arrays import Bools, Floats, Ints, Ints32
from .opacity import LocalOpacity, Opacity, check_opacity
from .rays import are_finite, as_real_rows, check_rows
from .tree import PAD

# Traversals in float32 start inside the bounding box of a scene or mesh. A ray that starts outside
# is first advanced to the box, so that rounding errors depend on the size of the scene and not on
# the distance to it. The box lies within [-1, 1] in local units, plus padding, so the distance from
# the start to a hit is at most its diagonal, 2 * sqrt(3) * (1 + 2**-16) = 3.47. Limits in float32
# are clipped to MAX_DIAGONAL.
MAX_DIAGONAL = 4.0
TINY = 2.0**-60  # replaces a direction component of zero, to avoid 0 * inf


_BLOCK = 1 << 16  # triangles that are processed at a time


@dataclass(frozen=True)
class LocalFrame:
    """Local coordinates, in which a bounding box is centered at the origin and scaled into [-1, 1].

    The translation makes float32 accurate enough even for coordinates of hundreds of kilometers.
    The scale is a power of two, so that it does not cause rounding errors. Because of the scaling,
    the error bounds of float32 computations are constants.

    Attributes
    ----------
    center
        float64 (3,): point that becomes the origin, in meters.
    scale
        Local units per meter, a power of two.
    lower, upper
        float64 (3,): corners of the bounding box of the triangles in local coordinates, padded like
        the boxes of a tree.
    """

    center: Floats
    scale: float
    lower: Floats
    upper: Floats

    def to_local(self, points: Floats) -> Floats:
        """Convert points from meters to local coordinates."""
        return (points - self.center) * self.scale

    @property
    def table(self) -> Floats:
        """Center, scale, lower corner, and upper corner, for compiled loops. Shape (10,)."""
        return np.concatenate([self.center, [self.scale], self.lower, self.upper])


def clip_to_box(
    lower: Floats, upper: Floats, origins: Floats, directions: Floats
) -> tuple[Floats, Floats]:
    """Compute the distances at which rays enter and leave a box.

    The distances have shape (n,) and are in local units. A ray intersects the box if ``entry <=
    leave``. The entry distance is 0 if the ray starts inside the box.

    Parameters
    ----------
    lower, upper
        Corners of the box, (3,), or (3, n) for a separate box for each ray.
    origins
        (n, 3) or (1, 3), in local coordinates.
    directions
        (n, 3), unit vectors.
    """
    entry = np.zeros(len(directions))
    leave = np.full(len(directions), np.inf)
    for axis in range(3):
        component = directions[:, axis]
        component = np.where(np.abs(component) < TINY, np.copysign(TINY, component), component)
        lower_distance = (lower[axis] - origins[:, axis]) / component
        upper_distance = (upper[axis] - origins[:, axis]) / component
        np.maximum(entry, np.minimum(lower_distance, upper_distance), out=entry)
        np.minimum(leave, np.maximum(lower_distance, upper_distance), out=leave)
    return entry, leave


@dataclass(frozen=True)
class LocalMesh:
    """Triangles in local coordinates.

    Attributes
    ----------
    frame
        Local coordinates of the mesh.
    corners
        float64 (k, 3, 3): vertices of each triangle in local coordinates. Triangles with zero area
        are omitted.
    index
        int32 (k,): index of each triangle in the caller's `faces`.
    face_count
        Number of rows of `faces`.
    opacity
        Opacity of the triangles. None if all are opaque.
    """

    frame: LocalFrame
    corners: Floats
    index: Ints32
    face_count: int
    opacity: LocalOpacity | None = None


def local_mesh(vertices: ArrayLike, faces: ArrayLike, opacity: Opacity | None = None) -> LocalMesh:
    """Validate a mesh and convert it to local coordinates.

    The parameters and exceptions are those of `Mesh`.
    """
    points = as_real_rows("vertices", vertices)
    rows = _check_faces(faces, len(points))
    check_rows("Vertex", points, are_finite, "finite")
    points = points.astype(np.float64)
    is_used = np.zeros(len(points), np.bool_)
    is_used[rows.reshape(-1)] = True
    center, scale = center_and_scale(points[is_used].min(axis=0), points[is_used].max(axis=0))
    points = (points - center) * scale
    corners = points[rows]
    has_area = np.concatenate(
        [_has_area(corners[start : start + _BLOCK]) for start in range(0, len(corners), _BLOCK)]
    )
    index = np.flatnonzero(has_area).astype(np.int32)
    if not len(index):
        raise ValueError("The mesh contains only triangles with zero area.")
    face_count = len(rows)
    if len(index) < face_count:
        corners = corners[has_area]
    by_triangle = corners.reshape(-1, 9)
    lower = by_triangle.min(axis=0).reshape(3, 3).min(axis=0) - PAD
    upper = by_triangle.max(axis=0).reshape(3, 3).max(axis=0) + PAD
    frame = LocalFrame(center, scale, lower, upper)
    checked = None if opacity is None else check_opacity(opacity, face_count, index)
    return LocalMesh(
        frame=frame,
        corners=corners,
        index=index,
        face_count=face_count,
        opacity=checked,
    )


def center_and_scale(lower: Floats, upper: Floats) -> tuple[Floats, float]:
    """Compute the center and scale of the local coordinates for a bounding box in meters."""
    center = lower / 2 + upper / 2
    half = float(np.maximum(upper - center, center - lower).max())
    return center, math.ldexp(1.0, -math.frexp(half)[1]) if half > 0 else 1.0


def _has_area(corners: Floats) -> Bools:
    """Return a mask of the triangles with nonzero area."""
    edges = corners[:, 1:] - corners[:, :1]
    x, y, z = np.cross(edges[:, 0], edges[:, 1]).astype(np.bool_).T
    return x | y | z


def _check_faces(faces: ArrayLike, vertex_count: int) -> Ints:
    """Return faces as an int64 array.

    Raises ValueError if the shape is wrong, a vertex index is invalid, or there are too many faces.
    """
    rows = np.asarray(faces)
    if rows.ndim != 2 or rows.shape[1] != 3 or not len(rows) or rows.dtype.kind not in "iu":
        raise ValueError(
            "faces must be an integer array (vertex indices) with shape (f, 3) and f > 0, but has "
            f"dtype {rows.dtype} and shape {rows.shape}."
        )
    if len(rows) >= 2**28:  # see `instances.py`: 31 bits, of which a leaf takes 3
        raise ValueError(f"The mesh has {len(rows):,} triangles, but the limit is {2**28 - 1:,}.")
    invalid = np.flatnonzero(((rows < 0) | (rows >= vertex_count)).any(axis=1))
    if len(invalid):
        raise ValueError(
            f"Face {invalid[0]} contains the vertex indices {rows[invalid[0]].tolist()}, but the "
            f"mesh has {vertex_count} vertices, numbered from 0."
        )
    return rows.astype(np.int64, copy=False)
