"""Plain colours of generated scenes, by what their objects are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .colours import Colours
from .scene import Scene

# {class of objects: sRGB colours, which its objects take in turn}
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
    np.array([[[*bytes.fromhex(one)]]], np.uint8) for some in _PAINTS.values() for one in some
)
_TRUNK_M = 0.6  # crowns begin higher
_UP, _FLAT, _STEEP = 0.2, 0.98, 0.65  # of normals along z: roofs, level ones; of ground: rock


def painted(scene: Scene) -> Scene:
    """Give a scene of `city` or `terrain` plain colours."""
    kinds = [name.rpartition("-")[0] or name for name in scene.names]
    turns = [int(name.rpartition("-")[2]) if "-" in name else 0 for name in scene.names]
    paints = [
        _FIRST[kind] + turn % len(_PAINTS[kind]) if kind in _PAINTS else 0
        for kind, turn in zip(kinds, turns, strict=True)
    ]
    owner, corners = scene.face_object, scene.vertices[scene.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    up = normals[:, 2] / np.maximum(np.linalg.norm(normals, axis=1), 1e-12)
    above = corners[..., 2].min(axis=1) - scene.object_bounds[owner, 0, 2]
    image = np.array(paints, np.int32)[owner]
    kind = np.array([_NAMES.index(kind) if kind in _PAINTS else -1 for kind in kinds])[owner]

    def paint(which: str, where: NDArray[np.bool_], colour: str) -> None:
        image[(kind == _NAMES.index(which)) & where] = _FIRST[colour]

    paint("building", up > _UP, "tiles")
    paint("building", up > _FLAT, "roof")
    paint("tree", above < _TRUNK_M, "bark")
    paint("terrain", up < _STEEP, "rock")
    shared = scene.instances
    if shared is not None:
        parts = []
        for number, part in enumerate(shared.parts):
            # A leaf shares no corner with others; cars have none.
            leaf = np.bincount(part.faces.ravel())[part.faces].max(axis=1) == 1
            cars, leaves = _PAINTS["car"], _PAINTS["tree"]
            of_car = np.full(len(leaf), _FIRST["car"] + number % len(cars))
            of_tree = np.where(leaf, _FIRST["tree"] + number % len(leaves), _FIRST["bark"])
            own = (of_tree if leaf.any() else of_car).astype(np.int32)
            parts.append(part._replace(colours=Colours(_PALETTE, own)))
        shared = replace(shared, parts=tuple(parts))
    return replace(scene, colours=Colours(_PALETTE, image), instances=shared)
