"""Scenes as .glb files: an object is a node, and its masks are textures.

This is not trimesh, which writes one material for a mesh.
"""

from __future__ import annotations

import io
import json
import struct
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ..base.errors import LidarpoolError
from .instances import Instance
from .mesh import Cutout, Mesh
from .meshfile import GENERATOR
from .scene import Scene
from .transform import UP_AXES

_MOST_BYTES = 2**32 - 1
_NEAREST = 9728
_TYPES = {"f": 5126, "u": 5125}


def glb_of(scene: Scene) -> bytes:
    """Content of a .glb file with all objects of a scene but the actors, in metres, Y-up.

    Nodes have the scene's origin, in double precision, so that far scenes lose no digits.

    Raises
    ------
    LidarpoolError
        If it would have more than 4 GiB.
    """
    writer = _Writer(scene.origin)
    for name, parts in groupby(scene.meshes(), lambda one: one.name):
        places: dict[bytes, list[Mesh | Instance]] = {}
        for one in parts:
            key = one.matrix.tobytes() if isinstance(one, Instance) else b""
            places.setdefault(key, []).append(one)
        for found in places.values():
            writer.add(name, found)
    return writer.data()


class _Writer:
    """The JSON object of a file, and its buffer."""

    def __init__(self, origin: NDArray[np.float64]) -> None:
        self._origin = origin
        self._pieces: list[bytes] = []
        self._size = 0
        self._meshes: dict[tuple[int, ...], int] = {}  # {ids of parts: number of the mesh}
        self._materials: dict[int, int] = {}  # {id of a mask: number of the material}
        self._kept: list[Any] = []  # what has these ids
        self._tree: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": GENERATOR},
            "scene": 0,
            "scenes": [{"nodes": []}],
            **{name: [] for name in ("nodes", "meshes", "accessors", "bufferViews")},
        }

    def _put(self, kind: str, part: dict[str, Any]) -> int:
        """Add a part of a kind; its number."""
        parts = self._tree.setdefault(kind, [])
        parts.append(part)
        return len(parts) - 1

    def add(self, name: str, parts: list[Mesh | Instance]) -> None:
        """Add an object of parts in one place."""
        meshes = [one.mesh if isinstance(one, Instance) else one for one in parts]
        key = tuple(id(mesh) for mesh in meshes)
        far = self._origin.any() and not isinstance(parts[0], Instance)
        if key not in self._meshes:
            self._kept += meshes
            if far:
                meshes = [one.moved(name, np.eye(3), -self._origin) for one in meshes]
            primitives = [primitive for mesh in meshes for primitive in self._primitives(mesh)]
            self._meshes[key] = self._put("meshes", {"name": name, "primitives": primitives})
        node: dict[str, Any] = {"name": name, "mesh": self._meshes[key]}
        if isinstance(parts[0], Instance):
            turn = np.eye(4)
            turn[:3, :3] = UP_AXES["y"].T
            node["matrix"] = (turn @ parts[0].matrix @ turn.T).T.ravel().tolist()
        elif far:
            node["translation"] = (self._origin @ UP_AXES["y"]).tolist()
        self._tree["scenes"][0]["nodes"].append(self._put("nodes", node))

    def _primitives(self, mesh: Mesh) -> list[dict[str, Any]]:
        """Return opaque triangles, then those of each mask."""
        first = len(mesh.faces) - sum(len(cut.uv) for cut in mesh.cutouts)
        out = []
        if first:
            points = self._array((mesh.vertices @ UP_AXES["y"]).astype("<f4"), "VEC3", 34962)
            faces = self._array(mesh.faces[:first].astype("<u4").reshape(-1, 1), "SCALAR", 34963)
            out.append({"attributes": {"POSITION": points}, "indices": faces})
        for cut in mesh.cutouts:
            # Corners have texture coordinates of their own.
            corners = mesh.vertices[mesh.faces[first : first + len(cut.uv)]].reshape(-1, 3)
            attributes = {
                "POSITION": self._array((corners @ UP_AXES["y"]).astype("<f4"), "VEC3", 34962),
                "TEXCOORD_0": self._array(cut.uv.reshape(-1, 2).astype("<f4"), "VEC2", 34962),
            }
            out.append({"attributes": attributes, "material": self._material(cut)})
            first += len(cut.uv)
        return out

    def _array(self, rows: NDArray[Any], kind: str, target: int) -> int:
        """Add an accessor; its number."""
        view = self._view(rows.tobytes(), target=target)
        limits = {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
        return self._put(
            "accessors",
            {"bufferView": view, "componentType": _TYPES[rows.dtype.kind], "count": len(rows),
             "type": kind, **limits},
        )  # fmt: skip

    def _view(self, data: bytes, **more: Any) -> int:
        view = {"buffer": 0, "byteOffset": self._size, "byteLength": len(data), **more}
        data += b"\0" * (-len(data) % 4)
        self._pieces.append(data)
        self._size += len(data)
        return self._put("bufferViews", view)

    def _material(self, cut: Cutout) -> int:
        """Return the number of a mask's material."""
        key = id(cut.mask)
        if key not in self._materials:
            self._kept.append(cut.mask)
            alpha = Image.fromarray(cut.mask.astype(np.uint8) * 255)
            png = io.BytesIO()
            Image.merge("LA", [Image.new("L", alpha.size, 255), alpha]).save(png, "png")
            view = self._view(png.getvalue())
            image = self._put("images", {"bufferView": view, "mimeType": "image/png"})
            if "samplers" not in self._tree:
                self._put("samplers", {"magFilter": _NEAREST, "minFilter": _NEAREST})
            texture = self._put("textures", {"source": image, "sampler": 0})
            self._materials[key] = self._put(
                "materials",
                {
                    "alphaMode": "MASK",
                    "doubleSided": True,
                    "pbrMetallicRoughness": {"baseColorTexture": {"index": texture}},
                },
            )
        return self._materials[key]

    def data(self) -> bytes:
        """Content of the file."""
        self._tree["buffers"] = [{"byteLength": self._size}]
        text = json.dumps(self._tree, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        total = 28 + len(text) + self._size
        if total > _MOST_BYTES:
            raise LidarpoolError("it would have more than 4 GiB, the most of .glb: write a .ply.")
        head = struct.pack("<4sIII4s", b"glTF", 2, total, len(text), b"JSON")
        return b"".join([head, text, struct.pack("<I4s", self._size, b"BIN\0"), *self._pieces])
