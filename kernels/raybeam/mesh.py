"""A triangle mesh in local coordinates."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from .arrays import Bools, Floats, Ints, Ints32
from .opacity import LocalOpacity, Opacity, check_opacity
from .rays import are_finite, as_real_rows, check_rows
from .tree import PAD

# Every traversal in float32 starts inside the box of a scene or mesh: a ray from outside is first
# advanced to the box, so that float32 rounds by the size of the scene, not by the distance to it.
# The box lies within [-1, 1] in local units, plus padding, so no hit is farther from the start than
# its diagonal, 2 * sqrt(3) * (1 + 2**-16) = 3.47. Limits in float32 are clipped to ACROSS.
ACROSS = 4.0
TINY = 2.0**-60  # replaces a direction component of zero, to avoid 0 * inf


_BLOCK = 1 << 16  # triangles that are processed together


@dataclass(frozen=True)
class LocalFrame:
    """Local coordinates: moved to the center of a box and scaled into [-1, 1].

    The translation makes coordinates of hundreds of kilometers accurate enough in float32; the
    scale is a power of two, so it rounds nothing, and makes every error bound of the
    single-precision parts a plain number.

    Attributes
    ----------
    center
        float64 (3,), meters: subtracted from points.
    scale
        Local units in a meter, a power of two.
    lower, upper
        float64 (3,): corners of the box around the triangles, local, padded as in the tree.
    """

    center: Floats
    scale: float
    lower: Floats
    upper: Floats

    def to_local(self, points: Floats) -> Floats:
        """Convert points (n, 3), meters, to local coordinates."""
        return (points - self.center) * self.scale

    @property
    def table(self) -> Floats:
        """Center, scale, lower and upper, as read by compiled code: float64 (10,)."""
        return np.concatenate([self.center, [self.scale], self.lower, self.upper])


def clip_to_box(
    lower: Floats, upper: Floats, origins: Floats, directions: Floats
) -> tuple[Floats, Floats]:
    """Return local distances at which rays enter (0 from inside) and leave a box: (n,) each.

    A ray meets the box if ``entry <= leave``.

    Parameters
    ----------
    lower, upper
        (3,), or (3, n) for a separate box of each ray.
    origins
        (n, 3) or (1, 3), local.
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
        float64 (k, 3, 3), local: triangle, corner, coordinate, without triangles that have no area.
    index
        int32 (k,): row of each triangle in the `faces` of the caller.
    face_count
        Number of rows of `faces`.
    opacity
        Opacity of the triangles; None if all are opaque.
    """

    frame: LocalFrame
    corners: Floats
    index: Ints32
    face_count: int
    opacity: LocalOpacity | None = None


def local_mesh(vertices: ArrayLike, faces: ArrayLike, opacity: Opacity | None = None) -> LocalMesh:
    """Check a mesh and convert vertices to local coordinates.

    `Mesh` lists the errors.

    Parameters
    ----------
    vertices
        (v, 3) real and finite, meters.
    faces
        (f, 3) integers: rows of `vertices`.
    opacity
        Mask of the opaque parts of the triangles; None if all are opaque.
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
    """Return center (3,) and scale of the frame of a box with corners (3,), meters."""
    center = lower / 2 + upper / 2
    half = float(np.maximum(upper - center, center - lower).max())
    return center, math.ldexp(1.0, -math.frexp(half)[1]) if half > 0 else 1.0


def _has_area(corners: Floats) -> Bools:
    """Return a mask (k,) of the triangles that have an area."""
    edges = corners[:, 1:] - corners[:, :1]
    x, y, z = np.cross(edges[:, 0], edges[:, 1]).astype(np.bool_).T
    return x | y | z


def _check_faces(faces: ArrayLike, vertex_count: int) -> Ints:
    """Return faces as int64 (f, 3).

    Raises ValueError for a wrong shape or row, or too many faces.
    """
    rows = np.asarray(faces)
    if rows.ndim != 2 or rows.shape[1] != 3 or not len(rows) or rows.dtype.kind not in "iu":
        raise ValueError(
            "faces must be an integer array (vertex indices) with shape (f, 3) and f > 0, but has "
            f"dtype {rows.dtype} and shape {rows.shape}."
        )
    if len(rows) >= 2**28:  # positions in the tree have 31 bits; a leaf takes 3 of them
        raise ValueError(f"The mesh has {len(rows):,} triangles, but the limit is {2**28 - 1:,}.")
    invalid = np.flatnonzero(((rows < 0) | (rows >= vertex_count)).any(axis=1))
    if len(invalid):
        raise ValueError(
            f"Face {invalid[0]} contains the vertex indices {rows[invalid[0]].tolist()}, but the "
            "mesh "
            f"has {vertex_count} vertices, numbered from 0."
        )
    return rows.astype(np.int64, copy=False)
