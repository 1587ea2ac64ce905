"""Surfaces: objects, their materials, and the energy of returns."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..scene.scene import Scene
from ..sensor import Trajectory
from ..sensor.materials import Material, MaterialTable, at_right_angles

BLOCK_FACES = 1 << 18  # triangles whose normals are made at a time

Triangles = NDArray[np.integer[Any]]
Real = NDArray[np.float64]


class Surfaces:
    """Optical properties of triangles.

    Raises
    ------
    LidarpoolError
        If there are materials, and an object has none, or a name fits no object.
    """

    def __init__(self, scene: Scene, materials: tuple[Material, ...]) -> None:
        self._scene = scene.solid()
        self._standing = len(scene.names)  # objects
        self.triangles = len(self._scene.faces)
        self.materials = MaterialTable.of(materials, scene.all_names)

    def normals(
        self, triangle: Triangles, times: Real | NDArray[np.int64], ways: tuple[Trajectory, ...]
    ) -> Real:
        """Return the unit normals of triangles (n,): (n, 3), in single precision.

        Those of actors are rotated by the pose on their ways at the times (n,), nanoseconds.
        """
        normals = np.empty((3, len(triangle)))
        for axis, out in zip(self._unit_normals, normals, strict=True):
            out[:] = axis.take(triangle)
        objects = self.objects(triangle) if ways else None
        for number, way in enumerate(ways, self._standing):
            rows = np.flatnonzero(objects == number)
            _, rotations = way.poses(0, times[rows].astype(np.float64))
            if rotations is not None:
                turned = (rotations * normals.T[rows, None, :]).sum(axis=2)
                normals[:, rows] = turned.T
        return normals.T

    def objects(self, triangle: Triangles) -> NDArray[np.int32]:
        """Objects of triangles (n,)."""
        return self._scene.face_object[triangle]

    def energy(self, triangle: Triangles, cosine: Real, distance: Real, extinction: float) -> Real:
        """Received energy of rays that end on triangles (n,), at distances in metres.

        ``reflectance * cosine * (10 m / distance)**2 * exp(-2 * extinction * distance)``; for a
        retro-reflector, a gain replaces the cosine.
        """
        scattered = self.materials.scattered(self.objects(triangle), cosine)
        return np.asarray(scattered * at_right_angles(distance, extinction))

    @cached_property
    def _unit_normals(self) -> NDArray[np.float32]:
        """Unit normals of all triangles, one row for each axis, the fastest layout: (3, f)."""
        vertices, faces = self._scene.vertices, self._scene.faces
        out = np.empty((3, len(faces)), np.float32)
        for begin in range(0, len(faces), BLOCK_FACES):
            block = slice(begin, begin + BLOCK_FACES)
            a, b, c = vertices[faces[block]].transpose(1, 0, 2)
            normals = np.cross(b - a, c - a)
            lengths = np.linalg.norm(normals, axis=1, keepdims=True)
            out[:, block] = (normals / np.maximum(lengths, 1e-300)).T
        return out
