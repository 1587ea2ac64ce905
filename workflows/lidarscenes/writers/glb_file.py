"""Scenes as .glb files: an object is a node, and its masks and colours are materials.

This is not trimesh, which writes one material for a mesh.
"""

from __future__ import annotations

import io
import json
import struct
from itertools import groupby
from typing import Any

import numpy as np
from PIL import Image

from lidarsim.base.arrays import AnyArray, Bytes, Floats, Indices
from lidarsim.base.errors import LidarError
from lidarsim.base.vectors import applied, matmul, turned
from lidarsim.scene.colours import LINEAR
from lidarsim.scene.files.meshfile import GENERATOR
from lidarsim.scene.scene import Scene
from lidarsim.scene.scene_instances import SceneInstance
from lidarsim.scene.scene_mesh import SceneMesh
from lidarsim.scene.transform import UP_AXES, affine

_MOST_BYTES = 2**32 - 1
_NEAREST = 9728
_TYPES = {"f": 5126, "u": 5125}


def glb_of(scene: Scene) -> bytes:
    """Content of a .glb file with all objects of a scene but the actors, in metres, Y-up.

    Nodes have the scene's origin, in double precision, so that far scenes lose no digits.

    Raises
    ------
    LidarError
        If it would have more than 4 GiB.
    """
    writer = _Writer(scene.origin)
    for name, parts in groupby(scene.meshes(), lambda one: one.name):
        places: dict[bytes, list[SceneMesh | SceneInstance]] = {}
        for one in parts:
            key = one.matrix.tobytes() if isinstance(one, SceneInstance) else b""
            places.setdefault(key, []).append(one)
        for found in places.values():
            writer.add(name, found)
    return writer.data()


class _Writer:
    """The JSON object of a file, and its buffer."""

    def __init__(self, origin: Floats) -> None:
        self._origin = origin
        self._pieces: list[bytes] = []
        self._size = 0
        self._meshes: dict[tuple[int, ...], int] = {}  # {ids of parts: number of the mesh}
        # {(id of a mask or image, name): number of the material}
        self._materials: dict[tuple[int, str], int] = {}
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

    def add(self, name: str, parts: list[SceneMesh | SceneInstance]) -> None:
        """Add an object of parts in one place."""
        meshes = [one.mesh if isinstance(one, SceneInstance) else one for one in parts]
        key = tuple(id(mesh) for mesh in meshes)
        far = self._origin.any() and not isinstance(parts[0], SceneInstance)
        if key not in self._meshes:
            self._kept += meshes
            if far:
                meshes = [one.moved(name, np.eye(3), -self._origin) for one in meshes]
            primitives = [primitive for mesh in meshes for primitive in self._primitives(mesh)]
            self._meshes[key] = self._put("meshes", {"name": name, "primitives": primitives})
        node: dict[str, Any] = {"name": name, "mesh": self._meshes[key]}
        if isinstance(parts[0], SceneInstance):
            turn = affine(UP_AXES["y"].T, np.zeros(3))
            node["matrix"] = matmul(matmul(turn, parts[0].matrix), turn.T).T.ravel().tolist()
        elif far:
            node["translation"] = applied(UP_AXES["y"].T, self._origin).tolist()
        self._tree["scenes"][0]["nodes"].append(self._put("nodes", node))

    def _primitives(self, mesh: SceneMesh) -> list[dict[str, Any]]:
        """Return opaque triangles by their images, then those of each mask."""
        first = len(mesh.faces) - sum(len(cut.uv) for cut in mesh.cutouts)
        colours = mesh.colours
        out = []
        image = np.full(first, -1) if colours is None else colours.image[:first]
        names: tuple[str, ...] = ("",)
        index = np.zeros(len(mesh.faces), np.int32)
        if mesh.materials is not None:
            names = mesh.materials.names
            index = index if mesh.materials.index is None else mesh.materials.index
        points: int | None = None
        looks = np.unique(np.column_stack([image, index[:first]]), axis=0)
        for number, of_material in looks.tolist():
            rows = np.flatnonzero((image == number) & (index[:first] == of_material))
            one = uv = tints = None
            if colours is not None:
                shown = colours.take(rows)
                one = colours.images[number]
                uv = None if one.size == 3 else shown.uv
                if shown.corners is not None and (shown.corners < 255).any():
                    tints = shown.corners
            if uv is None and tints is None:
                if points is None:
                    points = self._array(
                        turned(mesh.vertices, UP_AXES["y"].T).astype("<f4"), "VEC3"
                    )
                faces = self._array(mesh.faces[rows].astype("<u4").reshape(-1, 1), "SCALAR")
                primitive: dict[str, Any] = {"attributes": {"POSITION": points}, "indices": faces}
            else:
                primitive = {"attributes": self._corners(mesh, rows, uv, tints)}
            if one is not None or names[of_material]:
                primitive["material"] = self._material(one, names[of_material])
            out.append(primitive)
        for cut in mesh.cutouts:
            rows = np.arange(first, first + len(cut.uv))
            # A texture has no room beside a mask, which has coordinates of its own.
            tints = None if colours is None else colours.take(rows).means()[:, None].repeat(3, 1)
            attributes = self._corners(mesh, rows, cut.uv, tints)
            material = self._material(cut.mask, names[index[first]])
            out.append({"attributes": attributes, "material": material})
            first += len(cut.uv)
        return out

    def _corners(
        self, mesh: SceneMesh, rows: Indices, uv: AnyArray | None, tints: Bytes | None
    ) -> dict[str, int]:
        """Attributes of some triangles (k,), whose corners have their own (k, 3, …)."""
        corners = turned(mesh.vertices[mesh.faces[rows]].reshape(-1, 3), UP_AXES["y"].T)
        attributes = {"POSITION": self._array(corners.astype("<f4"), "VEC3")}
        if uv is not None:
            attributes["TEXCOORD_0"] = self._array(uv.reshape(-1, 2).astype("<f4"), "VEC2")
        if tints is not None:
            light = LINEAR[tints].reshape(-1, 3).astype("<f4")
            attributes["COLOR_0"] = self._array(light, "VEC3")
        return attributes

    def _array(self, rows: AnyArray, kind: str) -> int:
        """Add an accessor of attributes, or of indices (scalars); its number."""
        view = self._view(rows.tobytes(), target=34963 if kind == "SCALAR" else 34962)
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

    def _material(self, image: AnyArray | None, name: str) -> int:
        """Return the number of the material of a mask, bool (h, w), an image, colour or name."""
        key = id(image), name
        if key not in self._materials:
            self._kept.append(image)
            matt: dict[str, Any] = {"metallicFactor": 0, "roughnessFactor": 1}
            material: dict[str, Any] = {"pbrMetallicRoughness": matt}
            material |= {"name": name} if name else {}
            if image is None:
                pass  # a name alone
            elif image.size == 3 and image.ndim == 3:
                matt["baseColorFactor"] = [*LINEAR[image.ravel()].round(6).tolist(), 1]
            elif image.ndim == 3:
                matt["baseColorTexture"] = {"index": self._texture(Image.fromarray(image))}
            else:
                alpha = Image.fromarray(image.astype(np.uint8) * 255)
                white = Image.merge("LA", [Image.new("L", alpha.size, 255), alpha])
                matt["baseColorTexture"] = {"index": self._texture(white)}
                material |= {"alphaMode": "MASK", "doubleSided": True}
            self._materials[key] = self._put("materials", material)
        return self._materials[key]

    def _texture(self, image: Image.Image) -> int:
        png = io.BytesIO()
        image.save(png, "png")
        view = self._view(png.getvalue())
        source = self._put("images", {"bufferView": view, "mimeType": "image/png"})
        if "samplers" not in self._tree:
            self._put("samplers", {"magFilter": _NEAREST, "minFilter": _NEAREST})
        return self._put("textures", {"source": source, "sampler": 0})

    def data(self) -> bytes:
        """Content of the file."""
        self._tree["buffers"] = [{"byteLength": self._size}]
        text = json.dumps(self._tree, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        total = 28 + len(text) + self._size
        if total > _MOST_BYTES:
            raise LidarError("it would have more than 4 GiB, the most of .glb: write a .ply.")
        head = struct.pack("<4sIII4s", b"glTF", 2, total, len(text), b"JSON")
        return b"".join([head, text, struct.pack("<I4s", self._size, b"BIN\0"), *self._pieces])
