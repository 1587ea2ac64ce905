"""Labels that assign the class and object of each point to surfels.

As in SemanticKITTI, the lower 16 bits of a label are the class. The upper bits are the object
number plus 1. Class and object are combined in one number, so the most frequent label of the points
of a surfel always has a consistent class and object.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from lidarscenario.points.point_scene import CLASS_MATERIAL, surfel_faces
from lidarsim.columns.sweep import Sweep
from lidarsim.numerics.arrays import Floats, Ints
from lidarsim.scene.face_materials import FaceMaterials
from lidarsim.scene.scene_mesh import SceneMesh

from .porosity import Porosity

OBJECT_NAME = "object "  # followed by the object number in the recording
_CLASS_BITS = 16
_MAX_CLASS = (1 << _CLASS_BITS) - 1


def labels_of(sweep: Sweep) -> Ints | None:
    """Return the label of each point in a sweep, or None if there are no classes and objects."""
    classes, objects = sweep.classes, sweep.objects
    known = objects if classes is None else classes
    if known is None:
        return None
    label = np.zeros(len(known), np.int64)
    if classes is not None:
        numbers = np.asarray(classes).astype(np.int64)
        label += np.where((numbers >= 0) & (numbers <= _MAX_CLASS), numbers, 0)
    if objects is not None:
        label += np.maximum(np.asarray(objects).astype(np.int64) + 1, 0) << _CLASS_BITS
    return label


class SurfelMaterial(NamedTuple):
    """Class, porosity and spread of surfels, which determine their material in the scene."""

    semantic_class: int  # 0 without a class
    gap_fraction: float
    range_spread_m: float
    reflectance_spread: float

    @property
    def name(self) -> str:
        """Name of the material, which is empty for opaque, uniform surfels without a class."""
        parts = []
        if self.semantic_class:
            parts.append(f"{CLASS_MATERIAL}{self.semantic_class}")
        if self.gap_fraction:
            parts.append(f"gaps {self.gap_fraction:.1f}")
        if self.range_spread_m:
            parts.append(f"spread {self.range_spread_m:.2f}")
        if self.reflectance_spread:
            parts.append(f"contrast {self.reflectance_spread:.1f}")
        return ", ".join(parts)

    @classmethod
    def from_name(cls, name: str) -> SurfelMaterial:
        """Return the material with the given name."""
        values = {
            key: float(value) for key, value in (part.split(" ") for part in name.split(", "))
        }
        return cls(
            int(values.get(CLASS_MATERIAL.strip(), 0)),
            values.get("gaps", 0.0),
            values.get("spread", 0.0),
            values.get("contrast", 0.0),
        )

    def entry(self) -> dict[str, Any]:
        """Return the fields of the material in a scenario, except for the reflectance."""
        fields = {"class": self.semantic_class} | self._asdict()
        fields.pop("semantic_class")
        return {"material": self.name} | {name: value for name, value in fields.items() if value}


def class_of(label: int) -> int:
    """Return the class number in a label, or 0 if there is none."""
    return label & _MAX_CLASS


def split_by_object(
    mesh: SceneMesh, porosity: Porosity, reflectance_spreads: Floats
) -> list[SceneMesh]:
    """Split a surfel mesh by object, and name its materials (`SurfelMaterial`).

    Objects are in ascending order of their numbers. Surfels without an object are last, and keep
    the name of the mesh. Class 0 means that there is no class. Opaque surfels without a class and
    without a spread have no material.
    """
    count = len(mesh.faces) // 2
    labels = np.zeros(count, np.int64)
    if mesh.materials is not None:
        names = mesh.materials.names
        label = np.array([int(name.removeprefix(CLASS_MATERIAL) or 0) for name in names])
        index = mesh.materials.index
        labels[:] = label[0] if index is None else label[index[::2]]
    number = (labels >> _CLASS_BITS) - 1
    kinds = np.column_stack([labels & _MAX_CLASS, *porosity, reflectance_spreads])
    parts = []
    for value in sorted(np.unique(number).tolist(), key=lambda value: (value < 0, value)):
        surfels = np.flatnonzero(number == value)
        name = mesh.name if value < 0 else f"{OBJECT_NAME}{value}"
        parts.append(_part(mesh, name, surfels, kinds[surfels]))
    return parts


def _part(mesh: SceneMesh, name: str, surfels: Ints, kinds: Floats) -> SceneMesh:
    """Return the given surfels as a mesh with named materials.

    `kinds` has the fields of `SurfelMaterial` as columns.
    """
    corners = mesh.vertices.reshape(-1, 4, 3)[surfels]
    present, rows = np.unique(kinds, axis=0, return_inverse=True)
    materials = [SurfelMaterial(int(number), *rest) for number, *rest in present.tolist()]
    names = tuple(material.name for material in materials)
    faces = np.stack([2 * surfels, 2 * surfels + 1], axis=1).ravel()
    index = rows.reshape(-1).astype(np.int32).repeat(2)
    return replace(
        mesh,
        name=name,
        vertices=corners.reshape(-1, 3),
        faces=surfel_faces(len(corners)),
        colors=None if mesh.colors is None else mesh.colors.take(faces),
        materials=FaceMaterials(names, index) if any(names) else None,
    )
