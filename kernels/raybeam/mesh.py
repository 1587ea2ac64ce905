"""A triangle mesh in coordinates of its own."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from .arrays import Bools, Floats, Ints, Ints32
from .opacity import LocalOpacity, Opacity, check_opacity
from .rays import finite_rows, real_rows, refuse_rows
from .tree import PAD

# A ray that starts farther from zero than this, in local units, is started at the scene's box:
# float32 then rounds by the scene's size, not by the distance to it.
NEAR = 2.0
TINY = 2.0**-60  # replaces a direction component of zero, to avoid 0 * inf


_BLOCK = 1 << 16  # triangles that are processed together


@dataclass(frozen=True)
class Frame:
    """Local coordinates: moved to the middle of a box and scaled into [-1, 1].

    The translation makes coordinates of hundreds of kilometres accurate enough in float32; the
    scale is a power of two, so it rounds nothing, and makes every error bound of the
    single-precision parts a plain number.

    Attributes
    ----------
    centre
        float64 (3,), metres: subtracted from points.
    scale
        Local units in one metre, a power of two.
    low, high
        float64 (3,): least and greatest local coordinates of what is hit, padded as in the tree.
    """

    centre: Floats
    scale: float
    low: Floats
    high: Floats

    def to_local(self, points: Floats) -> Floats:
        """Points (n, 3) in metres to local coordinates."""
        return (points - self.centre) * self.scale

    @property
    def table(self) -> Floats:
        """Centre, scale, low and high, as compiled code reads them: float64 (10,)."""
        return np.concatenate([self.centre, [self.scale], self.low, self.high])


def clip(low: Floats, high: Floats, origins: Floats, directions: Floats) -> tuple[Floats, Floats]:
    """Local distances at which rays enter (0 when they start inside) and leave a box.

    A ray meets the box where ``entry <= leave``.

    Parameters
    ----------
    low, high
        (3,), or (3, n) for a box for each ray.
    origins
        (n, 3) or (1, 3), local.
    directions
        (n, 3), unit vectors.
    """
    entry = np.zeros(len(directions))
    leave = np.full(len(directions), np.inf)
    for axis in range(3):
        along = directions[:, axis]
        along = np.where(np.abs(along) < TINY, np.copysign(TINY, along), along)
        one = (low[axis] - origins[:, axis]) / along
        two = (high[axis] - origins[:, axis]) / along
        np.maximum(entry, np.minimum(one, two), out=entry)
        np.minimum(leave, np.maximum(one, two), out=leave)
    return entry, leave


@dataclass(frozen=True)
class LocalMesh:
    """Triangles in local coordinates.

    Attributes
    ----------
    frame
        Of the mesh.
    points, rows
        Vertices, float64 (v, 3), local; and int64 (k, 3), the rows of the three of each
        triangle. Triangles without an area are left out.
    corners
        float64 (k, 3, 3), local: triangle, corner, coordinate.
    index
        int32 (k,): the row of `faces` that each triangle came from.
    face_count
        Rows of `faces`.
    opacity
        Of the triangles, if parts of them are transparent.
    """

    frame: Frame
    points: Floats
    rows: Ints
    corners: Floats
    index: Ints32
    face_count: int
    opacity: LocalOpacity | None = None


def local_mesh(vertices: ArrayLike, faces: ArrayLike, opacity: Opacity | None = None) -> LocalMesh:
    """Check a mesh and convert it to local coordinates; `Mesh` lists the errors.

    Parameters
    ----------
    vertices
        (v, 3) real and finite, metres.
    faces
        (f, 3) integers: rows of `vertices`.
    opacity
        Where the triangles are opaque; None for everywhere.
    """
    points = real_rows("vertices", vertices)
    rows = _check_faces(faces, len(points))
    refuse_rows("Vertex", points, finite_rows, "finite coordinates")
    points = points.astype(np.float64)
    used = np.zeros(len(points), np.bool_)
    used[rows.reshape(-1)] = True
    centre, scale = middle(points[used].min(axis=0), points[used].max(axis=0))
    points = (points - centre) * scale
    corners = points[rows]
    solid = np.concatenate(
        [_solid(corners[start : start + _BLOCK]) for start in range(0, len(corners), _BLOCK)]
    )
    index = np.flatnonzero(solid).astype(np.int32)
    if not len(index):
        raise ValueError("No triangle of the mesh has an area: there is nothing to hit.")
    face_count = len(rows)
    if len(index) < face_count:
        rows = rows[solid]
        corners = corners[solid]
    hit = corners.reshape(-1, 3)
    low = hit.min(axis=0) - PAD
    high = hit.max(axis=0) + PAD
    frame = Frame(centre, scale, low, high)
    checked = None if opacity is None else check_opacity(opacity, face_count, index)
    return LocalMesh(frame, points, rows, corners, index, face_count, checked)


def middle(low: Floats, high: Floats) -> tuple[Floats, float]:
    """Centre and scale of the frame of a box (3,), metres."""
    centre = low / 2 + high / 2
    half = float(np.maximum(high - centre, centre - low).max())
    return centre, math.ldexp(1.0, -math.frexp(half)[1]) if half > 0 else 1.0


def _solid(corners: Floats) -> Bools:
    """Whether each triangle has an area."""
    edges = corners[:, 1:] - corners[:, :1]
    x, y, z = np.cross(edges[:, 0], edges[:, 1]).astype(np.bool_).T
    return x | y | z


def _check_faces(faces: ArrayLike, vertex_count: int) -> Ints:
    given = np.asarray(faces)
    if given.ndim != 2 or given.shape[1] != 3 or not len(given) or given.dtype.kind not in "iu":
        raise ValueError(
            "faces must be integers (rows of vertices) of shape (f, 3), at least one triangle, "
            f"not {given.dtype} {given.shape}."
        )
    if len(given) >= 2**28:  # positions in the tree have 31 bits, of which a leaf takes 3
        raise ValueError(f"{len(given)} triangles are too many: the limit is {2**28 - 1}.")
    bad = np.flatnonzero(((given < 0) | (given >= vertex_count)).any(axis=1))
    if len(bad):
        raise ValueError(
            f"Face {bad[0]} is {given[bad[0]].tolist()}, but there are {vertex_count} vertices: "
            f"indices must be 0 to {vertex_count - 1}."
        )
    return given.astype(np.int64, copy=False)
