"""Color generated scenes according to the classes of their objects."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from lidarsim.numerics.arrays import Bools, Floats32, Ints32
from lidarsim.scene.colors import Colors
from lidarsim.scene.scene import Scene

# {object class: sRGB colors, used in turn}
_PAINTS = {
    "ground": ["46464a"],
    "pavement": ["a5a097"],
    "terrain": ["6b7f45"],
    "building": ["c4b296", "96543f", "b2b2ae", "d6cdba", "78808a", "a88c70"],
    "tree": ["3e622c", "507032", "345634"],
    "car": ["284278", "e1e1e1", "961e20", "232323", "a0a0a0"],
    "lamp": ["3c4044"],
    "bark": ["5c4632"], "tiles": ["803e30"], "roof": ["6e6c68"], "rock": ["827c72"],
}  # fmt: skip
_NAMES = tuple(_PAINTS)
_FIRST = dict(zip(_NAMES, np.cumsum([0, *map(len, _PAINTS.values())]).tolist(), strict=False))
_PALETTE = tuple(
    np.array([[[*bytes.fromhex(color)]]], np.uint8)
    for colors in _PAINTS.values()
    for color in colors
)
_TRUNK_M = 0.6  # faces of a tree below this height belong to its trunk
# Limits for the z component of normals.
_UP = 0.2  # minimum for roofs
_FLAT = 0.98  # minimum for flat roofs
_STEEP = 0.65  # maximum for rock


def paint_scene(scene: Scene) -> Scene:
    """Color a `city` or `terrain` scene based on the names of its objects."""
    numbered = [name.rpartition("-") for name in scene.names]
    kinds = [kind or name for kind, _, name in numbered]
    numbers = [int(number) if kind else 0 for kind, _, number in numbered]
    paints = [
        _FIRST[kind] + number % len(_PAINTS[kind]) if kind in _PAINTS else 0
        for kind, number in zip(kinds, numbers, strict=True)
    ]
    image = np.array(paints, np.int32)[scene.face_object]
    kind_of_object = np.array([_NAMES.index(kind) if kind in _PAINTS else -1 for kind in kinds])
    face_kind = kind_of_object[scene.face_object]
    faces = _face_geometry(scene)

    def paint(kind: str, mask: Bools, color: str) -> None:
        """Paint those faces of a kind that a mask selects."""
        image[(face_kind == _NAMES.index(kind)) & mask] = _FIRST[color]

    paint("building", faces.up > _UP, "tiles")
    paint("building", faces.up > _FLAT, "roof")
    paint("tree", faces.height < _TRUNK_M, "bark")
    paint("terrain", faces.up < _STEEP, "rock")
    instances = scene.instances
    if instances is not None:
        mesh_parts = [
            part._replace(colors=Colors(_PALETTE, _part_paint(part.faces, number)))
            for number, part in enumerate(instances.mesh_parts)
        ]
        instances = replace(instances, mesh_parts=tuple(mesh_parts))
    return replace(scene, colors=Colors(_PALETTE, image), instances=instances)


class _FaceGeometry(NamedTuple):
    """Slope and height of each face in a scene."""

    up: Floats32  # (f,) z of the unit normal
    height: Floats32  # (f,) height of the lowest corner above the base of the object, in meters


def _face_geometry(scene: Scene) -> _FaceGeometry:
    """Compute the slope and height of each face in single precision."""
    x, y, z = (axis[scene.faces].T for axis in scene.vertices.T.astype(np.float32))
    (ax, bx), (ay, by), (az, bz) = ((axis[1] - axis[0], axis[2] - axis[0]) for axis in (x, y, z))
    normal = ax * by - ay * bx
    up = normal / np.sqrt((ay * bz - az * by) ** 2 + (az * bx - ax * bz) ** 2 + normal**2 + 1e-20)
    lowest = z.min(axis=0)
    foot = np.full(len(scene.names), np.inf, np.float32)
    np.minimum.at(foot, scene.face_object, lowest)
    return _FaceGeometry(up, lowest - foot[scene.face_object])


def _part_paint(faces: Ints32, number: int) -> Ints32:
    """Return the palette index for each face of an instanced mesh, either a leafy tree or a car."""
    # Leaves do not share vertices with other triangles. Cars have no leaves.
    leaf = np.bincount(faces.ravel())[faces].max(axis=1) == 1
    if leaf.any():
        leaf_paint = _FIRST["tree"] + number % len(_PAINTS["tree"])
        return np.where(leaf, leaf_paint, _FIRST["bark"]).astype(np.int32)
    return np.full(len(leaf), _FIRST["car"] + number % len(_PAINTS["car"])).astype(np.int32)
