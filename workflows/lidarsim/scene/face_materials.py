"""Names that the materials of faces have in scene files."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from ..errors import LidarError
from ..numerics.arrays import Integers, Ints32
from .colors import are_indices


@dataclass(frozen=True, eq=False)
class FaceMaterials:
    """Names of the materials of a mesh's faces.

    Attributes
    ----------
    names
        Distinct names; "" for faces without a material.
    index
        int32 (f,): row of `names` for each face; None if all faces have the first.
    """

    names: tuple[str, ...]
    index: Ints32 | None = None

    @classmethod
    def named(cls, name: str) -> FaceMaterials | None:
        """Return the same material for all faces, or None without a name."""
        return cls((name,)) if name else None

    def take(self, face_selection: Integers | slice) -> FaceMaterials:
        """Return the materials of selected faces, with the same names."""
        return self if self.index is None else FaceMaterials(self.names, self.index[face_selection])

    def check(self, name: str, faces: int) -> None:
        """Check that names are distinct, and rows fit a number of faces.

        Raises LidarError if not.
        """
        index = self.index
        fits = len(self.names) > 0 and len(set(self.names)) == len(self.names)
        if index is not None:
            fits = fits and index.shape == (faces,) and index.dtype == np.int32
            fits = fits and are_indices(index, len(self.names))
        if not fits:
            raise LidarError(
                f"The materials of {name!r} do not match its {faces} faces. Names must be unique, "
                "and index must be None or int32 (f,) with row numbers of the names."
            )


@dataclass(frozen=True, eq=False)
class ObjectMaterials:
    """Names of the materials of a scene's objects, without actors.

    Attributes
    ----------
    names
        Names of the materials of each object; () for an object without materials.
    index
        int32 (f,) for the scene's faces: row of the names of the face's object; None if all faces
        have the first name. Parts of instances have a separate index.
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

    def of_object(self, owner: int, faces: Integers) -> FaceMaterials | None:
        """Return the materials of the scene's `faces` (k,), which belong to the object `owner`."""
        if not self.names[owner]:
            return None
        single = self.index is None or len(self.names[owner]) == 1
        return FaceMaterials(
            self.names[owner], None if single or self.index is None else self.index[faces]
        )


def join_materials(
    mesh_materials: Sequence[FaceMaterials | None], sizes: Iterable[int]
) -> FaceMaterials | None:
    """Join the materials of meshes in order, or return None if no mesh has materials.

    `sizes` are the numbers of faces of the meshes; faces without a material get the name "".
    """
    if not any(part is not None for part in mesh_materials):
        return None
    numbers: dict[str, int] = {}  # {name: row}
    index: list[Ints32] = []  # (f,) of each mesh
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
