"""Coloured triangles as binary glTF, which is what a browser takes colours by triangle from."""

from __future__ import annotations

import json
import struct

import numpy as np
from numpy.typing import NDArray

_FLOAT, _BYTE = 5126, 5121
_HEAD = struct.Struct("<4sII")
_CHUNK = struct.Struct("<II")
_JSON, _BINARY = 0x4E4F534A, 0x004E4942

# glTF's colours are linear in light, those on a screen are not (IEC 61966-2-1).
_SCREEN = np.arange(256) / 255
_LINEAR = np.round(
    255 * np.where(_SCREEN <= 0.04045, _SCREEN / 12.92, ((_SCREEN + 0.055) / 1.055) ** 2.4)
).astype(np.uint8)


def coloured_triangles(corners: NDArray[np.float32], colours: NDArray[np.uint8]) -> bytes:
    """Write triangles, each of one colour, as a binary glTF file (glTF 2.0, Khronos 2017).

    Parameters
    ----------
    corners
        float32 (f, 3, 3), f >= 1, finite.
    colours
        uint8 (f, 3), as on a screen.
    """
    count = 3 * len(corners)
    flat = corners.reshape(-1, 3)
    rgba = np.full((count, 4), 255, np.uint8)  # four bytes each, as the format has them aligned
    rgba[:, :3] = np.repeat(_LINEAR[colours], 3, axis=0)
    places, paints = np.ascontiguousarray(flat, "<f4").tobytes(), rgba.tobytes()
    described = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 1}, "material": 0}]}],
        "materials": [
            {
                "doubleSided": True,
                "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.9},
            }
        ],
        "accessors": [
            {
                "bufferView": 0,
                "componentType": _FLOAT,
                "count": count,
                "type": "VEC3",
                "min": flat.min(axis=0).tolist(),
                "max": flat.max(axis=0).tolist(),
            },
            {
                "bufferView": 1,
                "componentType": _BYTE,
                "normalized": True,
                "count": count,
                "type": "VEC4",
            },
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": len(places)},
            {"buffer": 0, "byteOffset": len(places), "byteLength": len(paints)},
        ],
        "buffers": [{"byteLength": len(places) + len(paints)}],
    }
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
