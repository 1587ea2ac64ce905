"""Material names of faces, as stated in scene files."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from ..errors import LidarError
from ..numerics.arrays import Integers, Ints32
from .colors import are_valid_indices


@dataclass(frozen=True, eq=False)
class FaceMaterials:
    """Material names of mesh faces.

    Attributes
    ----------
    names
        Distinct names. The empty string denotes faces without a material.
    index
        Index into `names` for each face, or None if all faces have the first name. Shape (f,),
        int32.
    """

    names: tuple[str, ...]
    index: Ints32 | None = None

    @classmethod
    def from_name(cls, name: str) -> FaceMaterials | None:
        """Assign the same material to all faces, or return None if the name is empty."""
        return cls((name,)) if name else None

    def take(self, face_selection: Integers | slice) -> FaceMaterials:
        """Return the materials of the selected faces, keeping unused names."""
        return self if self.index is None else FaceMaterials(self.names, self.index[face_selection])

    def check(self, name: str, faces: int) -> None:
        """Check that the materials match the faces of an object.

        Raises
        ------
        LidarError
            If names are not unique, or if the index has a wrong shape, type or value.
        """
        index = self.index
        fits = len(self.names) > 0 and len(set(self.names)) == len(self.names)
        if index is not None:
            fits = fits and index.shape == (faces,) and index.dtype == np.int32
            fits = fits and are_valid_indices(index, len(self.names))
        if not fits:
            raise LidarError(
                f"The materials of {name!r} do not match its {faces} faces. Names must be unique, "
                "and index must be None or int32 (f,) with row numbers of the names."
            )


@dataclass(frozen=True, eq=False)
class ObjectMaterials:
    """Material names of the static objects in a scene.

    Attributes
    ----------
    names
        Material names of each object, which are empty for objects without materials.
    index
        Index into the names of the object for each face in `Scene.faces`, or None if all faces have
        the first name. Shape (f,), int32. Each part of an instance has a separate index.
    """

    names: tuple[tuple[str, ...], ...]
    index: Ints32 | None = None

    @classmethod
    def from_meshes(
        cls,
        objects: Sequence[FaceMaterials | None],
        meshes: Sequence[FaceMaterials | None],
        sizes: Sequence[int],
    ) -> ObjectMaterials | None:
        """Return the materials of a scene, or None if no object has materials.

        Parameters
        ----------
        objects
            Materials of each object.
        meshes
            Materials of the meshes that form the scene's faces, in order.
        sizes
            Number of faces of each mesh.
        """
        if not any(materials is not None for materials in objects):
            return None
        names = tuple(() if materials is None else materials.names for materials in objects)
        if all(materials is None or materials.index is None for materials in meshes):
            return cls(names)
        rows = [
            np.zeros(size, np.int32)
            if materials is None or materials.index is None
            else materials.index
            for materials, size in zip(meshes, sizes, strict=True)
        ]
        return cls(names, np.concatenate(rows))

    def for_object(self, owner: int, faces: Integers) -> FaceMaterials | None:
        """Return the materials of selected faces, which must all belong to the object `owner`."""
        if not self.names[owner]:
            return None
        single = self.index is None or len(self.names[owner]) == 1
        return FaceMaterials(
            self.names[owner], None if single or self.index is None else self.index[faces]
        )


def join_materials(
    mesh_materials: Sequence[FaceMaterials | None], sizes: Iterable[int]
) -> FaceMaterials | None:
    """Concatenate the materials of meshes, or return None if no mesh has materials.

    `sizes` contains the number of faces of each mesh. Faces without a material have an empty name.
    """
    if not any(part is not None for part in mesh_materials):
        return None
    numbers: dict[str, int] = {}  # {name: index}
    index: list[Ints32] = []  # an array of shape (f,) for each mesh
    for part, size in zip(mesh_materials, sizes, strict=True):
        names = ("",) if part is None else part.names
        rows = [numbers.setdefault(name, len(numbers)) for name in names]
        if part is None or part.index is None:
            index.append(np.full(size, rows[0], np.int32))
        else:
            index.append(np.array(rows, np.int32)[part.index])
    if len(numbers) == 1:
        return FaceMaterials((*numbers,))
    return FaceMaterials((*numbers,), np.concatenate(index))
