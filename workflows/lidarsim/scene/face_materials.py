"""Names that the materials of faces have in scene files."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from ..base.arrays import Integers, Ints32
from ..base.errors import LidarError
from .colours import within


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
        """Return one material for all faces; None without a name."""
        return cls((name,)) if name else None

    def take(self, rows: Integers | slice) -> FaceMaterials:
        """Select faces; the names stay."""
        return self if self.index is None else FaceMaterials(self.names, self.index[rows])

    def check(self, name: str, faces: int) -> None:
        """Check that they are those of a number of faces; LidarError if not."""
        index = self.index
        fits = len(self.names) > 0 and len(set(self.names)) == len(self.names)
        if index is not None:
            fits = fits and index.shape == (faces,) and index.dtype == np.int32
            fits = fits and within(index, len(self.names))
        if not fits:
            raise LidarError(
                f"The materials of {name!r} do not fit its {faces} faces: names are distinct, and "
                "index is int32 (f,), rows of them, or None."
            )


@dataclass(frozen=True, eq=False)
class ObjectMaterials:
    """Names of the materials of a scene's objects, without actors.

    Attributes
    ----------
    names
        Names of the materials of each object; none for an object without materials.
    index
        int32 (f,) of the scene's faces: row of the names of the face's object; None if all faces
        have the first. Parts of instances have their own.
    """

    names: tuple[tuple[str, ...], ...]
    index: Ints32 | None = None

    @classmethod
    def of(
        cls,
        objects: Sequence[FaceMaterials | None],
        meshes: Sequence[FaceMaterials | None],
        sizes: Sequence[int],
    ) -> ObjectMaterials | None:
        """Return those of objects; None if no object has any.

        `meshes` are those of the scene's faces, of some numbers of faces, one after the other.
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
        """Materials of some of the scene's faces, which an object has."""
        if not self.names[owner]:
            return None
        single = self.index is None or len(self.names[owner]) == 1
        return FaceMaterials(
            self.names[owner], None if single or self.index is None else self.index[faces]
        )


def joined(parts: Sequence[FaceMaterials | None], sizes: Iterable[int]) -> FaceMaterials | None:
    """Materials of meshes of some numbers of faces, one after the other; None for no name."""
    if not any(part is not None for part in parts):
        return None
    numbers: dict[str, int] = {}  # {name: its row}
    index: list[Ints32] = []
    for part, size in zip(parts, sizes, strict=True):
        names = ("",) if part is None else part.names
        rows = [numbers.setdefault(name, len(numbers)) for name in names]
        if part is None or part.index is None:
            index.append(np.full(size, rows[0], np.int32))
        else:
            index.append(np.array(rows, np.int32)[part.index])
    if len(numbers) == 1:
        return FaceMaterials((*numbers,))
    return FaceMaterials((*numbers,), np.concatenate(index))
