"""Write scenes as .glb files. Objects become nodes, and masks and colors become materials.

trimesh is not used, because it writes only one material per mesh.
"""

from __future__ import annotations

import io
import json
import struct
from itertools import groupby
from typing import Any

import numpy as np
from PIL import Image

from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import AnyArray, Bytes, Indices, Ints32
from lidarsim.numerics.vectors import matmul, matvec, rotate
from lidarsim.scene.colors import LINEAR
from lidarsim.scene.files.scene_graph import GENERATOR
from lidarsim.scene.scene import Scene
from lidarsim.scene.scene_instances import SceneInstance
from lidarsim.scene.scene_mesh import SceneMesh
from lidarsim.scene.transform import UP_AXES, affine

_MAX_BYTES = 2**32 - 1
_NEAREST = 9728  # filter of textures
_TYPES = {"f": 5126, "u": 5125}  # {kind of NumPy type: component type}


def encode_glb(scene: Scene) -> bytes:
    """Return a .glb file that contains a scene's objects except actors, in meters, Y-up.

    The scene's origin is stored in the nodes in double precision, so that scenes far from the
    origin lose no precision.

    Raises
    ------
    LidarError
        If the file would exceed 4 GiB.
    """
    writer = _Writer(scene)
    for name, parts in groupby(scene.meshes(), lambda mesh: mesh.name):
        instances: dict[bytes, list[SceneMesh | SceneInstance]] = {}
        for part in parts:
            key = part.matrix.tobytes() if isinstance(part, SceneInstance) else b""
            instances.setdefault(key, []).append(part)
        for same_place in instances.values():
            writer.add(name, same_place)
    return writer.data()


class _Writer:
    """The JSON content and the binary buffer of a .glb file."""

    def __init__(self, scene: Scene) -> None:
        self._origin = scene.origin
        stated = {"epsg": scene.epsg, "vertical_datum": scene.vertical_datum}
        system = {name: value for name, value in stated.items() if value}
        extras = {"extras": system} if system else {}
        self._pieces: list[bytes] = []
        self._size = 0
        self._meshes: dict[tuple[int, ...], int] = {}  # {ids of parts: number of the mesh}
        # {(id of a mask or image, name): number of the material}
        self._materials: dict[tuple[int, str], int] = {}
        self._referenced: list[Any] = []  # parts and images, so that their ids are not reused
        self._tree: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": GENERATOR, **extras},
            "scene": 0,
            "scenes": [{"nodes": []}],
            **{name: [] for name in ("nodes", "meshes", "accessors", "bufferViews")},
        }

    def _put(self, kind: str, part: dict[str, Any]) -> int:
        """Append an entry to a list in the JSON content, such as "nodes", and return its index."""
        parts = self._tree.setdefault(kind, [])
        parts.append(part)
        return len(parts) - 1

    def add(self, name: str, object_parts: list[SceneMesh | SceneInstance]) -> None:
        """Add an object as a node, whose parts have the same matrix."""
        meshes = [part.mesh if isinstance(part, SceneInstance) else part for part in object_parts]
        key = tuple(id(mesh) for mesh in meshes)
        translated = self._origin.any() and not isinstance(object_parts[0], SceneInstance)
        if key not in self._meshes:
            self._referenced += meshes
            if translated:
                meshes = [mesh.affine_transform(name, np.eye(3), -self._origin) for mesh in meshes]
            primitives = [primitive for mesh in meshes for primitive in self._primitives(mesh)]
            self._meshes[key] = self._put("meshes", {"name": name, "primitives": primitives})
        node: dict[str, Any] = {"name": name, "mesh": self._meshes[key]}
        if isinstance(object_parts[0], SceneInstance):
            to_y_up = affine(UP_AXES["y"].T, np.zeros(3))
            node["matrix"] = (
                matmul(matmul(to_y_up, object_parts[0].matrix), to_y_up.T).T.ravel().tolist()
            )
        elif translated:
            node["translation"] = matvec(UP_AXES["y"].T, self._origin).tolist()
        self._tree["scenes"][0]["nodes"].append(self._put("nodes", node))

    def _primitives(self, mesh: SceneMesh) -> list[dict[str, Any]]:
        """Return primitives for the opaque triangles, followed by one primitive for each mask."""
        opaque = len(mesh.faces) - sum(len(cut.uv) for cut in mesh.cutouts)
        names: tuple[str, ...] = ("",)
        index = np.zeros(len(mesh.faces), np.int32)
        if mesh.materials is not None:
            names = mesh.materials.names
            index = index if mesh.materials.index is None else mesh.materials.index
        primitives = self._opaque_primitives(mesh, index[:opaque], names)
        return primitives + self._masked_primitives(mesh, opaque, index, names)

    def _opaque_primitives(
        self, mesh: SceneMesh, index: Ints32, names: tuple[str, ...]
    ) -> list[dict[str, Any]]:
        """Return a primitive for each combination of image and material of opaque triangles.

        `index` (n,) contains the indices of the triangles' materials in `names`.
        """
        colors = mesh.colors
        image = np.full(len(index), -1) if colors is None else colors.image[: len(index)]
        points: int | None = None
        primitives = []
        appearances = np.unique(np.column_stack([image, index]), axis=0)
        for number, material in appearances.tolist():
            rows = np.flatnonzero((image == number) & (index == material))
            texture = uv = tints = None
            if colors is not None:
                shown = colors.take(rows)
                texture = colors.images[number]
                uv = None if texture.size == 3 else shown.uv
                if shown.corners is not None and (shown.corners < 255).any():
                    tints = shown.corners
            if uv is None and tints is None:
                if points is None:
                    vertices = rotate(mesh.vertices, UP_AXES["y"].T).astype("<f4")
                    points = self._array(vertices, "VEC3")
                faces = self._array(mesh.faces[rows].astype("<u4").reshape(-1, 1), "SCALAR")
                primitive: dict[str, Any] = {"attributes": {"POSITION": points}, "indices": faces}
            else:
                primitive = {"attributes": self._corners(mesh, rows, uv, tints)}
            if texture is not None or names[material]:
                primitive["material"] = self._material(texture, names[material])
            primitives.append(primitive)
        return primitives

    def _masked_primitives(
        self, mesh: SceneMesh, first: int, index: Ints32, names: tuple[str, ...]
    ) -> list[dict[str, Any]]:
        """Return a primitive for each mask. The masked triangles start at `first`."""
        colors = mesh.colors
        primitives = []
        for cut in mesh.cutouts:
            rows = np.arange(first, first + len(cut.uv))
            # A material has room for one texture with its coordinates, which is the mask.
            tints = (
                None if colors is None else colors.take(rows).mean_colors()[:, None].repeat(3, 1)
            )
            attributes = self._corners(mesh, rows, cut.uv, tints)
            material = self._material(cut.mask, names[index[first]])
            primitives.append({"attributes": attributes, "material": material})
            first += len(cut.uv)
        return primitives

    def _corners(
        self, mesh: SceneMesh, face_indices: Indices, uv: AnyArray | None, tints: Bytes | None
    ) -> dict[str, int]:
        """Return the attributes for triangles that do not share corners."""
        corners = rotate(mesh.vertices[mesh.faces[face_indices]].reshape(-1, 3), UP_AXES["y"].T)
        attributes = {"POSITION": self._array(corners.astype("<f4"), "VEC3")}
        if uv is not None:
            attributes["TEXCOORD_0"] = self._array(uv.reshape(-1, 2).astype("<f4"), "VEC2")
        if tints is not None:
            light = LINEAR[tints].reshape(-1, 3).astype("<f4")
            attributes["COLOR_0"] = self._array(light, "VEC3")
        return attributes

    def _array(self, values: AnyArray, kind: str) -> int:
        """Add an accessor and return its index. Scalars are indices, and vectors attributes."""
        view = self._view(values.tobytes(), target=34963 if kind == "SCALAR" else 34962)
        limits = {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        return self._put(
            "accessors",
            {
                "bufferView": view,
                "componentType": _TYPES[values.dtype.kind],
                "count": len(values),
                "type": kind,
                **limits,
            },
        )

    def _view(self, data: bytes, **fields: Any) -> int:
        """Add data as a buffer view, and return its index."""
        view = {"buffer": 0, "byteOffset": self._size, "byteLength": len(data), **fields}
        data += b"\0" * (-len(data) % 4)
        self._pieces.append(data)
        self._size += len(data)
        return self._put("bufferViews", view)

    def _material(self, image: AnyArray | None, name: str) -> int:
        """Return the index of a material. The material is added on first use.

        `image` is a mask (bool (h, w)), an image, or a single color. It is None for a material that
        only has a name.
        """
        key = id(image), name
        if key not in self._materials:
            self._referenced.append(image)
            matt: dict[str, Any] = {"metallicFactor": 0, "roughnessFactor": 1}
            material: dict[str, Any] = {"pbrMetallicRoughness": matt}
            material |= {"name": name} if name else {}
            if image is None:
                pass  # only a name
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
        """Add an image as a texture, and return its index."""
        png = io.BytesIO()
        image.save(png, "png")
        view = self._view(png.getvalue())
        source = self._put("images", {"bufferView": view, "mimeType": "image/png"})
        if "samplers" not in self._tree:
            self._put("samplers", {"magFilter": _NEAREST, "minFilter": _NEAREST})
        return self._put("textures", {"source": source, "sampler": 0})

    def data(self) -> bytes:
        """Return the file as bytes.

        Raises LidarError if it exceeds 4 GiB.
        """
        self._tree["buffers"] = [{"byteLength": self._size}]
        text = json.dumps(self._tree, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        total = 28 + len(text) + self._size
        if total > _MAX_BYTES:
            raise LidarError(
                "it would exceed 4 GiB, the limit of .glb files. Write a .ply file instead."
            )
        head = struct.pack("<4sIII4s", b"glTF", 2, total, len(text), b"JSON")
        return b"".join([head, text, struct.pack("<I4s", self._size, b"BIN\0"), *self._pieces])
