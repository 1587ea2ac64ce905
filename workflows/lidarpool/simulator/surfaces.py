"""Surfaces: objects, their materials, and the energy of returns."""

from __future__ import annotations

from copy import copy
from functools import cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..scene.actors import Actor
from ..scene.scene import Scene
from ..sensor.materials import Material, MaterialTable, at_right_angles

BLOCK_FACES = 1 << 18  # triangles whose normals are made at a time

Triangles = NDArray[np.integer[Any]]
Real = NDArray[np.float64]


class Surfaces:
    """Optical properties of triangles.

    Parameters
    ----------
    scene
        Triangles and objects.
    materials
        Of the objects by name.

    Raises
    ------
    LidarpoolError
        If there are materials, and an object has none, or a name fits no object.
    """

    def __init__(self, scene: Scene, materials: tuple[Material, ...]) -> None:
        self._scene, self._actors = scene.solid(), scene.actors
        self._standing = len(scene.names)  # objects
        # Made on first use, for copies with other actors as well.
        self._normals = cache(partial(_unit_normals, self._scene))
        self.triangles = len(self._scene.faces)
        self.materials = MaterialTable.of(materials, scene.all_names)

    def with_actors(self, actors: tuple[Actor, ...]) -> Surfaces:
        """Return the same surfaces with other trajectories of the actors."""
        surfaces = copy(self)
        surfaces._actors = actors
        return surfaces

    def normals(self, triangle: Triangles, times: Real | NDArray[np.int64]) -> Real:
        """Return the unit normals of triangles (n,): (n, 3), in single precision.

        Normals of actors are rotated by the actor's pose at the times (n,), nanoseconds.
        """
        normals = np.empty((3, len(triangle)))
        for axis, out in zip(self._normals(), normals, strict=True):
            out[:] = axis.take(triangle)
        objects = self.objects(triangle) if self._actors else None
        for number, actor in enumerate(self._actors, self._standing):
            rows = np.flatnonzero(objects == number)
            _, rotations = actor.trajectory.poses(0, times[rows].astype(np.float64))
            if rotations is not None:
                turned = (rotations * normals.T[rows, None, :]).sum(axis=2)
                normals[:, rows] = turned.T
        return normals.T

    def along_normal(
        self, triangle: Triangles, directions: Real, times: Real | NDArray[np.int64]
    ) -> Real:
        """Cosines between unit directions (n, 3) and the normals of triangles (n,) at times."""
        return products(self.normals(triangle, times), directions)

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


def _unit_normals(scene: Scene) -> NDArray[np.float32]:
    """Make unit normals of all triangles, one row for each axis, the fastest layout: (3, f)."""
    out = np.empty((3, len(scene.faces)), np.float32)
    for begin in range(0, out.shape[1], BLOCK_FACES):
        faces = scene.faces[begin : begin + BLOCK_FACES]
        a, b, c = scene.vertices[faces].transpose(1, 0, 2)
        normals = np.cross(b - a, c - a)
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        out[:, begin : begin + BLOCK_FACES] = (normals / np.maximum(lengths, 1e-300)).T
    return out


def products(one: Real, other: Real) -> Real:
    """Scalar products of vectors (n, 3): (n,)."""
    (x, y, z), (a, b, c) = one.T, other.T
    product = x * a
    product += y * b
    product += z * c
    return np.asarray(product)
