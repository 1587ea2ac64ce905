"""A triangle mesh in the caster's own coordinates."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .given import as_array
from .memory import require

_BLOCK = 1 << 16  # triangles that are looked at together
_VERTEX_BYTES, _FACE_BYTES = 48, 180  # while a mesh is checked, at most


@dataclass(frozen=True)
class LocalMesh:
    """Triangles moved to the middle of their box and scaled into [-1, 1].

    The move keeps coordinates of hundreds of kilometres exact enough for float32 to see a
    wall; the scale is a power of two, so it rounds nothing, and makes every error bound of
    the single-precision parts a plain number.

    Attributes
    ----------
    centre
        float64 (3,), metres: what was subtracted.
    scale
        Local units in one metre, a power of two.
    corners
        float64 (k, 3, 3), local: triangle, corner, coordinate. Triangles without an area
        are left out.
    index
        int32 (k,): the row of `faces` that each triangle came from.
    face_count
        Rows of `faces`.
    """

    centre: NDArray[np.float64]
    scale: float
    corners: NDArray[np.float64]
    index: NDArray[np.int32]
    face_count: int

    def to_local(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (n, 3) in metres to local coordinates."""
        return (points - self.centre) * self.scale

    @property
    def box(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Least and greatest local coordinates of all triangles: (3,) and (3,)."""
        points = self.corners.reshape(-1, 3)
        if not len(points):
            return np.zeros(3), np.zeros(3)
        return points.min(axis=0), points.max(axis=0)


def local_mesh(vertices: ArrayLike, faces: ArrayLike) -> LocalMesh:
    """Check a mesh and bring it into local coordinates.

    Parameters
    ----------
    vertices
        (v, 3) real and finite, metres.
    faces
        (f, 3) integers: rows of `vertices`.

    Raises
    ------
    ValueError
        For anything else, saying which row is wrong.
    MemoryError
        If there is not enough memory to do that.
    """
    points = _check_vertices(vertices)
    rows = _check_faces(faces, len(points))
    used = np.zeros(len(points), np.bool_)
    used[rows.reshape(-1)] = True
    low, high = points[used].min(axis=0), points[used].max(axis=0)
    centre = low / 2 + high / 2
    half = float(np.maximum(high - centre, centre - low).max())
    if half > 0 and not 1e-100 < half < 1e100:
        raise ValueError(
            f"The mesh reaches from {low.tolist()} to {high.tolist()}: "
            "its size must be between 1e-100 and 1e100 metres."
        )
    scale = math.ldexp(1.0, -math.frexp(half)[1]) if half > 0 else 1.0
    corners = ((points - centre) * scale)[rows]
    solid = np.concatenate(
        [_solid(corners[start : start + _BLOCK]) for start in range(0, len(corners), _BLOCK)]
    )
    index = np.flatnonzero(solid).astype(np.int32)
    return LocalMesh(
        centre, scale, corners if len(index) == len(rows) else corners[solid], index, len(rows)
    )


def _solid(corners: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which triangles have an area."""
    edges = corners[:, 1:] - corners[:, :1]
    x, y, z = np.cross(edges[:, 0], edges[:, 1]).astype(np.bool_).T
    return x | y | z


def _check_vertices(vertices: ArrayLike) -> NDArray[np.float64]:
    given = as_array("vertices", vertices)
    if given.ndim != 2 or given.shape[1] != 3 or given.dtype.kind not in "fiu":
        raise ValueError(
            f"vertices must be real numbers of shape (v, 3), not {given.dtype} {given.shape}."
        )
    points = given.astype(np.float64)
    bad = ~np.isfinite(points).all(axis=1)
    if bad.any():
        row = int(np.argmax(bad))
        raise ValueError(
            f"Vertex {row} is {points[row].tolist()} ({int(bad.sum())} of {len(points)} are not "
            "finite): remove or repair these vertices and their faces first."
        )
    return points


def _check_faces(faces: ArrayLike, vertex_count: int) -> NDArray[np.int64]:
    given = as_array("faces", faces)
    if given.ndim != 2 or given.shape[1] != 3 or not len(given):
        raise ValueError(
            f"faces must have the shape (f, 3) with at least one triangle, not {given.shape}: "
            "triangulate polygons, and do not cast on an empty mesh."
        )
    if given.dtype.kind not in "iu":
        raise ValueError(f"faces must be integers (rows of vertices), not {given.dtype}.")
    if len(given) >= 2**28:
        raise ValueError(f"{len(given)} triangles are too many: the limit is {2**28 - 1}.")
    need = _VERTEX_BYTES * vertex_count + _FACE_BYTES * len(given)
    require(need, f"A mesh of {len(given):,} triangles", "use a smaller mesh")
    bad = ((given < 0) | (given >= vertex_count)).any(axis=1)
    if bad.any():
        row = int(np.argmax(bad))
        raise ValueError(
            f"Face {row} is {given[row].tolist()}, but there are {vertex_count} vertices: "
            f"indices must be 0 to {vertex_count - 1}."
        )
    return given.astype(np.int64, copy=False)
