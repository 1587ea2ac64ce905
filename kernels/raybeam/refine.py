"""Distance and weights in float64 for hits that another engine found in float32."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import triangle as exact
from .mesh import LocalMesh

Float = NDArray[np.float64]

# Local units: ten times the error of a float32 distance, unless the ray grazes.
_TRUST = 2.0**-19


class Refiner:
    """Refines hits with the triangles of one mesh; all lengths are local."""

    def __init__(self, mesh: LocalMesh) -> None:
        self._corners = mesh.corners
        first = mesh.corners[:, 0]
        normal = np.cross(mesh.corners[:, 1] - first, mesh.corners[:, 2] - first)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        # One column for each triangle: unit normal, and the plane's distance from zero. Near rays
        # hit the same or near triangles.
        self._planes = np.stack([*normal.T, (normal * first).sum(axis=1)])

    def distance(
        self,
        origins: Float,
        directions: Float,
        place: NDArray[np.intp],
        rough: NDArray[np.floating[Any]],
    ) -> Float:
        """Distances at which rays hit given triangles.

        Parameters
        ----------
        origins
            (m, 3) or (1, 3).
        directions
            (3, m): one row for each axis, which makes this fast.
        place
            (m,): rows of the mesh's corners.
        rough
            (m,): distances in float32 accuracy; inf for a miss.
        """
        x, y, z, offset = (column.take(place, mode="clip") for column in self._planes)
        ox, oy, oz = origins.T
        dx, dy, dz = directions
        offset -= (x * ox + y * oy) + z * oz
        x *= dx
        y *= dy
        z *= dz
        x += y
        x += z
        with np.errstate(divide="ignore", invalid="ignore"):
            t = np.divide(offset, x, out=offset)
            far = np.flatnonzero(~(np.abs(t - rough) <= _TRUST) & (rough < np.inf))
        if len(far):
            # A grazing ray may meet the plane anywhere, but not the triangle.
            at = origins if len(origins) == 1 else origins[far]
            t[far] = self._grazing(at, directions[:, far].T, place[far], rough[far])
        return t

    def weights(
        self, origins: Float, directions: Float, place: NDArray[np.intp]
    ) -> tuple[Float, Float]:
        """Weights of the second and third corner, within the triangle: (m,) and (m,)."""
        a, b, c, det, _ = self._exact(origins, directions, place)
        parts = np.maximum(np.stack([a, b, c]) * np.where(det < 0, -1, 1), 0)
        total = parts.sum(axis=0)
        parts[:, total == 0] = 1  # the ray runs in the plane: any point of the triangle will do
        parts /= parts.sum(axis=0)
        return parts[1], parts[2]

    def _grazing(
        self,
        origins: Float,
        directions: Float,
        place: NDArray[np.intp],
        rough: NDArray[np.floating[Any]],
    ) -> Float:
        a, b, c, det, t = self._exact(origins, directions, place)
        return np.where(exact.inside(a, b, c, det), t, rough)

    def _exact(
        self, origins: Float, directions: Float, place: NDArray[np.intp]
    ) -> tuple[Float, Float, Float, Float, Float]:
        sheared = exact.shear(np.broadcast_to(origins, directions.shape), directions)
        return exact.intersect(sheared, np.arange(len(place)), self._corners, place)
