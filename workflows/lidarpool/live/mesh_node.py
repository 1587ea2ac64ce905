"""Coloured meshes on a page, each exchanged for another without ever being gone.

They are sent as binary glTF, which is what a browser takes colours by triangle from.
"""

from __future__ import annotations

import json
import struct
import time
from collections.abc import Hashable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .page import LivePage

# A browser needs a moment to load a mesh, longer over a slow connection. What has the same
# shape may stay that long: of two surfaces in one place a browser shows the one it loaded last.
SAME_SHAPE_S, NEW_SHAPE_S = 3.0, 0.7


class MeshNode:
    """Shows the latest of several meshes, each as binary glTF.

    viser's page drops a mesh when it is told of a new one, and has nothing to show until that
    one is loaded; it does not say when that is. So two nodes take turns: the new mesh goes over
    the last but one, the last stays where it is, and is removed when no other has come for a
    while. A browser that is behind never has fewer than one of the two.

    Parameters
    ----------
    page
        Where they are shown.
    name
        Name of the node that holds both, such as "/scene".
    """

    def __init__(self, page: LivePage, name: str) -> None:
        self._page = page
        self._names = [f"{name}/one", f"{name}/other"]  # the latest is the first
        self._nodes: dict[str, Any] = {}
        self._shape: Hashable = None
        self._alone_at = 0.0  # when the last but one may go
        self._visible = True

    @property
    def visible(self) -> bool:
        """Whether they are shown."""
        return self._visible

    @visible.setter
    def visible(self, visible: bool) -> None:
        self._visible = visible
        for node in self._nodes.values():
            node.visible = visible

    def show(self, data: bytes, shape: Hashable) -> None:
        """Show a mesh; `shape` is what differs where its triangles lie elsewhere."""
        stays = SAME_SHAPE_S if shape == self._shape else NEW_SHAPE_S
        self._shape = shape
        self._names.reverse()
        latest = self._names[0]
        self._nodes[latest] = self._page.scene.add_glb(
            latest, data, cast_shadow=False, receive_shadow=False, visible=self._visible
        )
        self._alone_at = time.monotonic() + stays

    def clear(self) -> None:
        """Show nothing."""
        for name in tuple(self._nodes):
            self._nodes.pop(name).remove()
        self._shape = None

    def settle(self) -> bool:
        """Remove the last but one if it is time; returns whether it is still there."""
        if len(self._nodes) < 2:
            return False
        if time.monotonic() < self._alone_at:
            return True
        self._nodes.pop(self._names[1]).remove()
        return False


_FLOAT, _BYTE = 5126, 5121
_HEAD = struct.Struct("<4sII")
_CHUNK = struct.Struct("<II")
_UNLIT = "KHR_materials_unlit"
_JSON, _BINARY = 0x4E4F534A, 0x004E4942

# glTF's colours are linear in light, those on a screen are not (IEC 61966-2-1).
_SCREEN = np.arange(256) / 255
_LINEAR = np.round(
    255 * np.where(_SCREEN <= 0.04045, _SCREEN / 12.92, ((_SCREEN + 0.055) / 1.055) ** 2.4)
).astype(np.uint8)


def coloured_triangles(
    corners: NDArray[np.float32],
    colours: NDArray[np.uint8],
    two_sided: int | None = None,
    *,
    lit: bool = True,
) -> bytes:
    """Write triangles, each of one colour, as a binary glTF file (glTF 2.0, Khronos 2017).

    Parameters
    ----------
    corners
        float32 (f, 3, 3), f >= 1, finite.
    colours
        uint8 (f, 3), as on a screen.
    two_sided
        How many of them, from the first, are seen from both sides; the others are seen from
        where their corners run anticlockwise. All by default.
    lit
        Whether light falls on them; else they have the same colour from everywhere.
    """
    count = 3 * len(corners)
    flat = corners.reshape(-1, 3)
    split = count if two_sided is None else 3 * two_sided
    parts = [(first, end) for first, end in ((0, split), (split, count)) if first < end]
    rgba = np.full((count, 4), 255, np.uint8)  # four bytes each, as the format has them aligned
    rgba[:, :3] = np.repeat(_LINEAR[colours], 3, axis=0)
    places, paints = np.ascontiguousarray(flat, "<f4").tobytes(), rgba.tobytes()
    described = _described(flat, parts, split, lit)
    text = json.dumps(described).encode()
    text += b" " * (-len(text) % 4)
    size = _HEAD.size + 2 * _CHUNK.size + len(text) + len(places) + len(paints)
    return b"".join(
        (
            _HEAD.pack(b"glTF", 2, size),
            _CHUNK.pack(len(text), _JSON),
            text,
            _CHUNK.pack(len(places) + len(paints), _BINARY),
            places,
            paints,
        )
    )


def _described(
    flat: NDArray[np.float32], parts: list[tuple[int, int]], split: int, lit: bool
) -> dict[str, Any]:
    """Describe corners (n, 3) in parts (first, end); those from `split` on have one side."""
    places, paints = 12 * len(flat), 4 * len(flat)  # bytes
    return {
        "asset": {"version": "2.0"},
        "extensionsUsed": [] if lit else [_UNLIT],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [
            {
                "primitives": [
                    {
                        "attributes": {"POSITION": 2 * part, "COLOR_0": 2 * part + 1},
                        "material": part,
                    }
                    for part in range(len(parts))
                ]
            }
        ],
        "materials": [
            {
                "doubleSided": first < split,
                "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.9},
                "extensions": {} if lit else {_UNLIT: {}},
            }
            for first, _ in parts
        ],
        "accessors": [
            accessor for first, end in parts for accessor in _accessors(flat[first:end], first)
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": places},
            {"buffer": 0, "byteOffset": places, "byteLength": paints},
        ],
        "buffers": [{"byteLength": places + paints}],
    }


def _accessors(corners: NDArray[np.float32], first: int) -> list[dict[str, Any]]:
    """Describe places and colours of corners (n, 3), n >= 1, that begin with the `first`."""
    places = {
        "bufferView": 0,
        "byteOffset": 12 * first,
        "componentType": _FLOAT,
        "count": len(corners),
        "type": "VEC3",
        "min": corners.min(axis=0).tolist(),
        "max": corners.max(axis=0).tolist(),
    }
    paints = {
        "bufferView": 1,
        "byteOffset": 4 * first,
        "componentType": _BYTE,
        "normalized": True,
        "count": len(corners),
        "type": "VEC4",
    }
    return [places, paints]
