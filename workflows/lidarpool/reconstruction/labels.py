"""Labels that assign the class and object of each point to surfels.

As in SemanticKITTI, the lower 16 bits of a label are the class. The upper bits are the object
number plus 1. Class and object are combined in one number, so the most frequent label of the points
of a surfel always has a consistent class and object.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lidarsim.columns.sweep import Sweep
from lidarsim.numerics.arrays import Ints
from lidarsim.scene.face_materials import FaceMaterials
from lidarsim.scene.scene_mesh import SceneMesh

from ..scenario.point_scene import CLASS_MATERIAL, surfel_faces

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


def split_by_object(mesh: SceneMesh) -> list[SceneMesh]:
    """Split a surfel mesh by object, and name its materials by class.

    Objects are in ascending order of their numbers. Surfels without an object are last, and keep
    the name of the mesh. Class 0 means that there is no class, so it has no material.
    """
    if mesh.materials is None:
        return [mesh]
    names = mesh.materials.names
    label = np.array([int(name.removeprefix(CLASS_MATERIAL) or 0) for name in names])
    index = mesh.materials.index
    of_face = np.full(len(mesh.faces), label[0]) if index is None else label[index]
    number = (of_face >> _CLASS_BITS) - 1
    classes = of_face & _MAX_CLASS
    parts = []
    for value in sorted(np.unique(number).tolist(), key=lambda value: (value < 0, value)):
        faces = np.flatnonzero(number == value)
        name = mesh.name if value < 0 else f"{OBJECT_NAME}{value}"
        parts.append(_part(mesh, name, faces, classes[faces]))
    return parts


def _part(mesh: SceneMesh, name: str, faces: Ints, classes: Ints) -> SceneMesh:
    """Return the surfels with the given faces as a mesh whose materials are named by class."""
    corners = mesh.vertices.reshape(-1, 4, 3)[faces[::2] // 2]
    present, rows = np.unique(classes, return_inverse=True)
    names = tuple(f"{CLASS_MATERIAL}{number}" if number else "" for number in present.tolist())
    return replace(
        mesh,
        name=name,
        vertices=corners.reshape(-1, 3),
        faces=surfel_faces(len(corners)),
        colors=None if mesh.colors is None else mesh.colors.take(faces),
        materials=FaceMaterials(names, rows.astype(np.int32)) if any(names) else None,
    )
