"""Surfaces: objects, their materials, and the energy of returns."""

from __future__ import annotations

from copy import copy
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..scene.scene import Scene
from ..sensor import Trajectory
from ..sensor.materials import Material, MaterialTable, at_right_angles
from .motion import products

BLOCK_FACES = 1 << 18  # triangles whose normals are made at a time

Triangles = NDArray[np.integer[Any]]
Real = NDArray[np.float64]


class Surfaces:
    """Optical properties of triangles.

    Triangles are numbered by the scene's faces, then instance by instance, then by actors.

    Raises
    ------
    LidarpoolError
        If there are materials, and an object has none, or a name fits no object.
    """

    def __init__(self, scene: Scene, materials: tuple[Material, ...]) -> None:
        self._scene = scene
        self._standing = len(scene.names)  # objects
        self.counters = scene.counters
        self.materials = MaterialTable.of(materials, scene.all_names)
        shared = scene.instances
        plain = len(scene.faces)
        sizes = np.zeros(0, np.int64) if shared is None else shared.sizes
        # Where the triangles of each instance begin, and those of actors.
        self._begins = plain + np.cumsum([0, *sizes])
        moving = [len(actor.mesh.faces) for actor in scene.actors]
        owners = np.arange(self._standing, self._standing + len(moving), dtype=np.int32)
        # Objects of the triangles of faces and of actors; the last is of no triangle.
        owned = [scene.face_object, np.repeat(owners, moving), np.zeros(1, np.int32)]
        self.owners = np.concatenate(owned)
        if shared is not None:
            self._turns = _turns(shared.transforms)

    def moved(self, scene: Scene, rows: NDArray[np.intp]) -> Surfaces:
        """Return the same with some of the scene's instances in other places."""
        assert scene.instances is not None
        made = copy(self)
        made._scene, made._turns = scene, self._turns.copy()
        made._turns[rows] = _turns(scene.instances.transforms[rows])
        return made

    def _found(self, triangle: Triangles) -> tuple[Triangles, NDArray[np.intp], NDArray[np.intp]]:
        """Rows without instances, which of them are in one, and in which: (n,), (k,), (k,)."""
        plain, actors = self._begins[[0, -1]]
        rows = np.where(triangle >= actors, triangle - (actors - plain), triangle)
        on = np.flatnonzero((triangle >= plain) & (triangle < actors))
        which = np.searchsorted(self._begins, triangle[on], side="right") - 1
        return rows, on, which

    def normals(
        self, triangle: Triangles, times: Real | NDArray[np.int64], ways: tuple[Trajectory, ...]
    ) -> Real:
        """Return the unit normals of triangles (n,): (n, 3), in single precision.

        Those of actors are rotated by the pose on their ways at the times (n,), nanoseconds.
        """
        normals = np.empty((3, len(triangle)))
        rows, shared = triangle, self._scene.instances
        if shared is not None:
            rows, on, which = self._found(triangle)
            local = rows[on] - self._begins[which]
            rows[on] = self._first_normal[shared.part[which]] + local
        for axis, out in zip(self.unit_normals, normals, strict=True):
            out[:] = axis.take(rows)
        if shared is not None and len(on):
            # In one order of rounding, that of columns.cu.
            turns = self._turns[which].transpose(1, 2, 0)
            x, y, z = (products(row, normals[:, on]) for row in turns)
            normals[:, on] = [x, y, z] / np.sqrt((x * x + y * y) + z * z)
        objects = self.objects(triangle) if ways else None
        for number, way in enumerate(ways, self._standing):
            rows = np.flatnonzero(objects == number)
            _, rotations = way.poses(0, times[rows].astype(np.float64))
            if rotations is not None:
                turned = (rotations * normals.T[rows, None, :]).sum(axis=2)
                normals[:, rows] = turned.T
        return normals.T

    def bodies(self) -> tuple[NDArray[np.int64], Real]:
        """Return what bodies the triangles belong to, in the order of a world's ray caster.

        Returns
        -------
        bodies
            (b, 3): the scene's faces, if there are any, each instance, and all actors as one. Of
            each its first triangle, its object, or -1 if `owners` has that of each triangle, and
            the row of its first normal in `unit_normals`. Rows of the actors begin behind those of
            the scene's faces.
        turns
            (b, 3, 3): matrices that take its normals to the scene's axes, but for their length.
        """
        plain, actors = self._begins[[0, -1]]
        one = np.eye(3)[None]
        bodies: list[Any] = [[[actors - plain, -1, 0]]]
        turns = [one]
        if (shared := self._scene.instances) is not None:
            firsts = self._first_normal[shared.part]
            bodies.insert(0, np.stack([self._begins[:-1], shared.owner, firsts], axis=1))
            turns.insert(0, self._turns)
        if plain:
            bodies.insert(0, [[0, -1, 0]])
            turns.insert(0, one)
        return np.concatenate(bodies).astype(np.int64), np.concatenate(turns)

    def objects(self, triangle: Triangles) -> NDArray[np.int32]:
        """Objects of triangles (n,)."""
        shared = self._scene.instances
        if shared is None:
            return self.owners[triangle]
        rows, on, which = self._found(triangle)
        rows[on] = -1
        objects = self.owners[rows]
        objects[on] = shared.owner[which]
        return objects

    def counter(self, triangle: Triangles) -> Triangles:
        """Counters of hits of triangles (n,), see `Scene.counters`."""
        if self._scene.instances is None:
            return triangle
        rows, on, which = self._found(triangle)
        plain, instances = self._begins[0], len(self._begins) - 1
        rows[rows >= plain] += instances
        rows[on] = plain + which
        return rows

    def energy(self, triangle: Triangles, cosine: Real, distance: Real, extinction: float) -> Real:
        """Received energy of rays that end on triangles (n,), at distances in metres.

        ``reflectance * cosine * (10 m / distance)**2 * exp(-2 * extinction * distance)``; for a
        retro-reflector, a gain replaces the cosine.
        """
        scattered = self.materials.scattered(self.objects(triangle), cosine)
        return np.asarray(scattered * at_right_angles(distance, extinction))

    @cached_property
    def unit_normals(self) -> NDArray[np.float32]:
        """Unit normals of all triangles, one row for each axis, the fastest layout: (3, f).

        Those of actors follow the scene's, and those of the parts of instances follow them.
        """
        scene = self._scene
        bodies: list[tuple[Real, Triangles]] = [(scene.vertices, scene.faces)]
        bodies += [(actor.mesh.vertices, actor.mesh.faces) for actor in scene.actors]
        if scene.instances is not None:
            bodies += [(part.vertices, part.faces) for part in scene.instances.parts]
        out = np.empty((3, sum(len(faces) for _, faces in bodies)), np.float32)
        at = 0
        for vertices, faces in bodies:
            for begin in range(0, len(faces), BLOCK_FACES):
                block = faces[begin : begin + BLOCK_FACES]
                a, b, c = vertices[block].transpose(1, 0, 2)
                normals = np.cross(b - a, c - a)
                lengths = np.linalg.norm(normals, axis=1, keepdims=True)
                out[:, at : at + len(block)] = (normals / np.maximum(lengths, 1e-300)).T
                at += len(block)
        return out

    @cached_property
    def _first_normal(self) -> NDArray[np.intp]:
        """Where the normals of each part of instances begin."""
        assert self._scene.instances is not None
        sizes = [len(part.faces) for part in self._scene.instances.parts]
        return len(self.owners) - 1 + np.cumsum([0, *sizes[:-1]])


def _turns(transforms: Real) -> Real:
    """Matrices (n, 3, 3) that take normals of parts to those of instances, but for their length."""
    return np.asarray(np.linalg.inv(transforms[:, :, :3]).transpose(0, 2, 1), np.float64)
