"""Map triangles to kinds of surfaces, which are objects or materials of objects."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from ..media.materials import Material, SurfaceKinds, first_matches
from ..numerics.arrays import Indices, Integers, Ints32
from ..scene.face_materials import FaceMaterials
from ..scene.scene import Scene
from .stored_triangles import StoredTriangles


class TriangleKinds:
    """Surface kinds of the triangles in a scene. Each kind is a row of the material table.

    A kind of surface is an object, or one material of an object whose files have several materials.
    """

    def __init__(
        self,
        scene: Scene,
        kinds: SurfaceKinds,
        materials: tuple[Material, ...],
        triangles: StoredTriangles,
    ) -> None:
        self._scene = scene
        self._materials = materials
        self._triangles = triangles
        self.material_kinds = kinds

    def of_triangles(self, triangle: Integers) -> Ints32:
        """Return the surface kind of each triangle, or -1 for `NO_SURFACE`.

        If several material names of an object match the same material of the survey, they are one
        kind.
        """
        if self._kind_in_object is None:
            return self._triangles.objects(triangle)
        triangle_indices, objects, _ = self._triangles.locate(triangle)
        return self.of_rows(triangle_indices, objects)

    def of_rows(self, triangle_indices: Indices, objects: Ints32) -> Ints32:
        """Return the surface kinds for the given stored triangles and objects.

        Objects are required because instances of different objects can share stored triangles.
        """
        if self._kind_in_object is None:
            return objects
        kinds = self.material_kinds.first[:-1][objects] + self._kind_in_object[triangle_indices]
        return np.where(objects < 0, np.int32(-1), self._material_kind[kinds])

    @cached_property
    def _kind_in_object(self) -> Ints32 | None:
        """Kind of each stored triangle, numbered within its object.

        The shape is (f,). The value is None if each object has a single kind, whose number is then
        the number of the object.
        """
        if len(self.material_kinds.object) == len(self.material_kinds.names):
            return None
        scene = self._scene
        mesh_parts = () if scene.instances is None else scene.instances.mesh_parts
        meshes = [(len(mesh.faces), mesh.materials) for mesh in self._triangles.meshes]
        meshes += [(len(part.faces), part.materials) for part in mesh_parts]
        face_materials = None if scene.materials is None else scene.materials.index
        numbers = [
            np.zeros(len(scene.faces), np.int32) if face_materials is None else face_materials
        ]
        for size, materials in meshes:
            index = None if materials is None else materials.index
            numbers.append(np.zeros(size, np.int32) if index is None else index)
        return np.concatenate(numbers)

    def material_numbers(self, triangle: Integers) -> Ints32:
        """Return the material of each triangle as an index into `Scene.material_names`, or -1."""
        triangle_indices, objects, _ = self._triangles.locate(triangle)
        kinds = self.material_kinds.first[:-1][objects]
        if self._kind_in_object is not None:
            kinds = kinds + self._kind_in_object[triangle_indices]
        return np.where(objects < 0, np.int32(-1), self._number_of_kind[kinds])

    @cached_property
    def _number_of_kind(self) -> Ints32:
        """Index of each kind's material name in `Scene.material_names`, or -1."""
        numbers = {name: number for number, name in enumerate(self._scene.material_names)}
        return np.array([numbers.get(name, -1) for name in self.material_kinds.material], np.int32)

    @cached_property
    def _material_kind(self) -> Ints32:
        """Map from each kind to the first kind that has the same object and material.

        The shape is (kinds,). Several material names in an object's files may match a single
        material of the survey. Their faces then form a single kind, so that a body of water or
        leaves is closed even if its faces have several names.
        """
        kinds = self.material_kinds
        first = first_matches(self._materials, self.material_kinds)
        keys = np.stack([kinds.object, first], axis=1)
        _, first_kinds, combination = np.unique(
            keys, axis=0, return_index=True, return_inverse=True
        )
        return first_kinds[combination.reshape(-1)].astype(np.int32)

    @cached_property
    def _faces_by_object(self) -> tuple[Indices, Indices]:
        """Rows of the scene's faces sorted by object, and the start of each object's rows."""
        owners = self._scene.face_object
        order = np.argsort(owners, kind="stable")
        return order, np.searchsorted(owners[order], np.arange(self._triangles.static_objects + 1))

    def faces_of(self, kind: int) -> Integers:
        """Return the scene's faces of the given surface kind."""
        order, starts = self._faces_by_object
        owner = int(self.material_kinds.object[kind])
        face_indices = order[starts[owner] : starts[owner + 1]]
        if self._scene.materials is None:
            return self._scene.faces[face_indices]
        materials = self._scene.materials.for_object(owner, face_indices)
        return self.select(kind, self._scene.faces[face_indices], materials)

    def select(self, kind: int, faces: Integers, materials: FaceMaterials | None) -> Integers:
        """Select an object's faces of the given surface kind."""
        if self._kind_in_object is None:
            return faces
        kinds = self.material_kinds
        index = 0 if materials is None or materials.index is None else materials.index
        face_kinds = self._material_kind[kinds.first[kinds.object[kind]] + index]
        return faces[np.broadcast_to(face_kinds == kind, len(faces))]
