"""Plain colours of generated scenes, by what their objects are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lidarsim.base.arrays import Bools
from lidarsim.scene.colours import Colours
from lidarsim.scene.scene import Scene

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
# of normals along z: roofs, level ones; of ground: rock
_UP = 0.2
_FLAT = 0.98
_STEEP = 0.65


def painted(scene: Scene) -> Scene:
    """Give a scene of `city` or `terrain` plain colours, by the names that these give objects."""
    numbered = [name.rpartition("-") for name in scene.names]
    kinds = [kind or name for kind, _, name in numbered]
    turns = [int(number) if kind else 0 for kind, _, number in numbered]
    paints = [
        _FIRST[kind] + turn % len(_PAINTS[kind]) if kind in _PAINTS else 0
        for kind, turn in zip(kinds, turns, strict=True)
    ]
    owner = scene.face_object
    x, y, z = (axis[scene.faces].T for axis in scene.vertices.T.astype(np.float32))
    (ax, bx), (ay, by), (az, bz) = ((axis[1] - axis[0], axis[2] - axis[0]) for axis in (x, y, z))
    normal = ax * by - ay * bx
    up = normal / np.sqrt((ay * bz - az * by) ** 2 + (az * bx - ax * bz) ** 2 + normal**2 + 1e-20)
    lowest = z.min(axis=0)
    foot = np.full(len(kinds), np.inf, np.float32)
    np.minimum.at(foot, owner, lowest)
    above = lowest - foot[owner]
    image = np.array(paints, np.int32)[owner]
    kind = np.array([_NAMES.index(kind) if kind in _PAINTS else -1 for kind in kinds])[owner]

    def paint(which: str, where: Bools, colour: str) -> None:
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
            cars = _PAINTS["car"]
            leaves = _PAINTS["tree"]
            of_car = np.full(len(leaf), _FIRST["car"] + number % len(cars))
            of_tree = np.where(leaf, _FIRST["tree"] + number % len(leaves), _FIRST["bark"])
            own = (of_tree if leaf.any() else of_car).astype(np.int32)
            parts.append(part._replace(colours=Colours(_PALETTE, own)))
        shared = replace(shared, parts=tuple(parts))
    return replace(scene, colours=Colours(_PALETTE, image), instances=shared)
