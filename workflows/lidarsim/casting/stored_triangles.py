"""Triangle numbers of a scene, and the geometry that instances share."""

from __future__ import annotations

from copy import copy
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from ..numerics.arrays import Floats, Floats32, Indices, Integers, Ints, Ints32, to_writable
from ..numerics.vectors import inverse, norm
from ..scene.actors import distinct_meshes
from ..scene.colors import Colors
from ..scene.scene import Scene

if TYPE_CHECKING:
    from .surface_loops import TriangleNumbers, TriangleOwners

BLOCK_FACES = 1 << 18  # number of triangles whose normals are computed at a time


class StoredTriangles:
    """Numbers, owners and shared geometry of the triangles in a scene.

    Triangles are numbered in this order: the faces of the scene, the triangles of each instance,
    and the triangles of each actor. Stored triangles are the faces of the scene, the distinct
    meshes of actors, and the distinct mesh parts of instances. Instances of the same part share its
    stored triangles. The objects of actors are numbered after the static objects.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self.static_objects = len(scene.names)  # number of static objects
        self.counters = scene.counters
        instances = scene.instances
        face_count = len(scene.faces)
        instance_sizes = np.zeros(0, np.int64) if instances is None else instances.sizes
        # First triangle of each instance, followed by the first triangle of the actors.
        self.instance_starts = face_count + np.cumsum([0, *instance_sizes])
        actor_sizes = [len(actor.mesh.faces) for actor in scene.actors]
        self.meshes, self.actor_mesh = distinct_meshes(actor.mesh for actor in scene.actors)
        mesh_sizes = [len(mesh.faces) for mesh in self.meshes]
        self.mesh_starts = mesh_starts = face_count + np.cumsum([0, *mesh_sizes])
        actor_starts = self.instance_starts[-1] + np.cumsum([0, *actor_sizes])[:-1]
        # (actors,): offset from an actor's triangle numbers to its rows among the stored triangles.
        self._actor_shifts = mesh_starts[self.actor_mesh] - actor_starts
        self._parts_start = int(mesh_starts[-1])
        owners = np.arange(
            self.static_objects, self.static_objects + len(actor_sizes), dtype=np.int32
        )
        # Objects that the triangles of faces and actors belong to. The last entry is for no
        # triangle.
        objects = [scene.face_object, np.repeat(owners, actor_sizes), np.full(1, -1, np.int32)]
        self.owners = np.concatenate(objects)

    @cached_property
    def normal_matrices(self) -> Floats:
        """Matrices that map part normals to unnormalized instance normals.

        The shape is (n, 3, 3).
        """
        instances = self._scene.instances
        if instances is None:
            return np.zeros((0, 3, 3))
        return np.ascontiguousarray(inverse(instances.transforms[:, :, :3]).transpose(0, 2, 1))

    def with_moved_instances(self, scene: Scene) -> StoredTriangles:
        """Return a copy for a scene in which instances have moved."""
        triangles = copy(self)
        triangles._scene = scene
        vars(triangles).pop("normal_matrices", None)
        return triangles

    def locate(self, triangle: Integers) -> TriangleOwners:
        """Return the object and instance of each triangle, and the row in which it is stored."""
        from . import surface_loops  # imported here because numba takes half a second to import

        count = len(triangle)
        row, instance = np.empty((2, count), np.int64)
        located = surface_loops.TriangleOwners(row, np.empty(count, np.int32), instance)
        surface_loops.find_owners(to_writable(triangle, np.int32), self._triangle_numbers, located)
        return located

    @cached_property
    def _triangle_numbers(self) -> TriangleNumbers:
        """Triangle, object and instance numbers, as arrays for compiled loops."""
        from .surface_loops import TriangleNumbers

        instances = self._scene.instances
        no_instances = np.zeros(0, np.int64)
        return TriangleNumbers(
            instance_starts=to_writable(self.instance_starts, np.int64),
            owners=to_writable(self.owners, np.int32),
            instance_objects=to_writable(
                no_instances if instances is None else instances.owner, np.int32
            ),
            instance_rows=to_writable(
                no_instances if instances is None else self.part_starts[instances.part], np.int64
            ),
            actor_shifts=to_writable(self._actor_shifts, np.int64),
            static_objects=self.static_objects,
        )

    def bodies(self) -> tuple[Ints, Floats]:
        """Return the bodies that triangles belong to, in the order used by `SceneCaster`.

        Returns
        -------
        bodies
            (b, 3): a row for the faces of the scene, if any, for each instance, and for all actors
            as one body. The columns are the first triangle; the object, or -1 if `owners` has an
            object for each triangle; and the row of the first normal in `unit_normals`, or -1 for
            actors, which share normals. In `owners`, actors follow the faces of the scene.
        normal_matrices
            (b, 3, 3): matrices that transform rows of `unit_normals` to unnormalized normals in the
            scene frame.
        """
        face_count, actors_start = self.instance_starts[[0, -1]]
        identity = np.eye(3)[None]
        bodies: list[Any] = [[[actors_start - face_count, -1, -1]]]
        normal_matrices = [identity]
        if (instances := self._scene.instances) is not None:
            first_rows = self.part_starts[instances.part]
            bodies.insert(
                0, np.stack([self.instance_starts[:-1], instances.owner, first_rows], axis=1)
            )
            normal_matrices.insert(0, self.normal_matrices)
        if face_count:
            bodies.insert(0, [[0, -1, 0]])
            normal_matrices.insert(0, identity)
        return np.concatenate(bodies).astype(np.int64), np.concatenate(normal_matrices)

    def objects(self, triangle: Integers) -> Ints32:
        """Return the object of each triangle, or -1 for `NO_SURFACE`."""
        if self._scene.instances is None:
            return self.owners[triangle]
        return self.locate(triangle).object

    def instances(self, triangle: Integers) -> Indices:
        """Return the instance of each triangle. All triangles must belong to instances."""
        return np.searchsorted(self.instance_starts, triangle, side="right") - 1

    def counter(self, triangle: Integers) -> Integers:
        """Return the hit counter of each triangle.

        The counters are sorted as in `Scene.counters`: one for each face of the scene, then one for
        each instance, which counts the hits on all of its triangles, then one for each triangle of
        an actor.
        """
        if self._scene.instances is None:
            return triangle
        face_count, actors_start = self.instance_starts[[0, -1]]
        instance = self.locate(triangle).instance
        # Number of triangles of instances minus one counter for each instance.
        shift = actors_start - face_count - (len(self.instance_starts) - 1)
        face_or_actor = np.where(triangle >= actors_start, triangle - shift, triangle)
        return np.where(instance >= 0, face_count + instance, face_or_actor)

    def count(self, triangle: Integers) -> Ints:
        """Return the number of hits per hit counter.

        The shape is (counters,).
        """
        return np.bincount(self.counter(triangle), minlength=self.counters)

    @property
    def stored_bodies(self) -> list[tuple[Floats, Integers, Colors | None]]:
        """Vertices, faces and colors of the scene, the actors' meshes, and the instance parts."""
        scene = self._scene
        bodies: list[tuple[Floats, Integers, Colors | None]] = [
            (scene.vertices, scene.faces, scene.colors)
        ]
        bodies += [(mesh.vertices, mesh.faces, mesh.colors) for mesh in self.meshes]
        if scene.instances is not None:
            mesh_parts = scene.instances.mesh_parts
            bodies += [(part.vertices, part.faces, part.colors) for part in mesh_parts]
        return bodies

    @cached_property
    def unit_normals(self) -> Floats32:
        """Unit normals of the stored triangles.

        The shape is (f, 3).
        """
        bodies = self.stored_bodies
        normals = np.empty((sum(len(faces) for _, faces, _ in bodies), 3), np.float32)
        row = 0
        for vertices, faces, _ in bodies:
            for begin in range(0, len(faces), BLOCK_FACES):
                block = faces[begin : begin + BLOCK_FACES]
                normals[row : row + len(block)] = normals_of(vertices[block])
                row += len(block)
        return normals

    @cached_property
    def part_starts(self) -> Indices:
        """Index of each mesh part's first stored triangle."""
        assert self._scene.instances is not None
        sizes = [len(part.faces) for part in self._scene.instances.mesh_parts]
        return self._parts_start + np.cumsum([0, *sizes[:-1]])


def normals_of(corners: Floats) -> Floats32:
    """Return the unit normals of triangles in single precision."""
    a, b, c = corners.transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    return (normals / np.maximum(norm(normals)[:, None], 1e-300)).astype(np.float32)
