"""glTF 2.0 files, .glb and .gltf, after the specification by the Khronos Group (2021).

This is not trimesh 5.2, which puts a node of several parents into one place, loses what hangs on a
camera, ignores sparse and normalised positions, skins and required extensions, and reads neither
fans nor files without scenes; nor assimp, which skips what it cannot read. Only triangles are read,
not materials and pictures.
"""

from __future__ import annotations

import base64
import json
import re
import struct
from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import unquote, unquote_to_bytes

import numpy as np
from numpy.typing import NDArray

from ..base.allowance import Allowance
from .mesh import Mesh
from .nodes import SMALLER, Content, MeshFileError, Node, instances, joined, settled
from .polygons import fanned, unrolled

# Extensions that do not change shapes, or that are supported here.
_READ = re.compile(
    r"KHR_materials_|KHR_techni|\w+_texture_|KHR_texture|KHR_lights|KHR_mesh_quantization"
)
_DRACO = "KHR_draco_mesh_compression"
_INSTANCING = "EXT_mesh_gpu_instancing"

_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


def read_gltf(data: bytes, path: Path) -> Content:
    """Read the default scene of a file, or all nodes if it has no scenes.

    Buffer files are read only from the folder of `path` and below.
    """
    header, body = _chunks(data)
    _check(header)
    reader = _Reader(header, body, path, len(data))
    content = settled(instances(_roots(header), reader.node, path.stem))
    content.unit_m, content.up_axis = 1.0, "y"
    content.generator = str(header.get("asset", {}).get("generator", ""))
    return content


_OLD = "is glTF 1.0, which is not supported: convert it to glTF 2.0"


def _chunks(data: bytes) -> tuple[dict[str, Any], bytes]:
    """JSON object, and the binary buffer of a .glb."""
    body = b""
    if data[:4] == b"glTF" and len(data) >= 20:
        version, total, size = struct.unpack_from("<III", data, 4)
        if version == 1:
            raise MeshFileError(_OLD)
        if len(data) < total:
            raise MeshFileError(f"is cut short: {total} bytes announced, {len(data)} there")
        body = data[28 + size : total]
        data = data[20 : 20 + size]
    elif data[:1] not in b"{[ \t\r\n":
        raise MeshFileError("is not glTF")
    try:
        header = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise MeshFileError(f"holds no valid JSON ({error})") from error
    if not isinstance(header, dict):
        raise MeshFileError("holds no glTF object")
    return header, body


def _check(header: dict[str, Any]) -> None:
    """Refuse other versions, and features that move vertices other than by nodes."""
    # Version 1.0 names parts, instead of numbering them.
    if str(header.get("asset", {}).get("version", "2")).startswith("1") or isinstance(
        header.get("nodes"), dict
    ):
        raise MeshFileError(_OLD)
    for name in map(str, header.get("extensionsRequired", ())):
        if not _READ.match(name) and name not in (_DRACO, _INSTANCING):
            raise MeshFileError(f"needs {name}, which cannot be read: export without it")
    for node in (node for node in header.get("nodes", ()) if "mesh" in node):
        if _INSTANCING in node.get("extensions", {}):
            raise MeshFileError(
                f"places copies by {_INSTANCING}, which cannot be read: export them as objects of "
                "their own"
            )
        if "skin" in node:
            raise MeshFileError(
                "moves vertices by a skeleton, which is not supported: apply the pose, then export"
            )
        mesh = header["meshes"][node["mesh"]]
        morphs = any("targets" in primitive for primitive in mesh["primitives"])
        if morphs and any(node.get("weights", mesh.get("weights", ()))):
            raise MeshFileError(
                "has active morph targets, which are not supported: apply them, then export"
            )


def _roots(header: dict[str, Any]) -> list[int]:
    """Find the outermost nodes."""
    nodes = header.get("nodes", ())
    if scenes := header.get("scenes"):
        return list(scenes[header.get("scene", 0)].get("nodes", ()))
    inner = {child for node in nodes for child in node.get("children", ())}
    return [index for index in range(len(nodes)) if index not in inner]


class _Reader:
    """Nodes, meshes, accessors and buffers by their numbers, each read once."""

    def __init__(self, header: dict[str, Any], body: bytes, path: Path, size: int) -> None:
        self._header, self._body, self._path = header, body, path
        self._allowance = Allowance(size, SMALLER)
        self._mesh, self._accessor = cache(self._read_mesh), cache(self._read_accessor)
        self._beside, self._buffer = cache(self._read_beside), cache(self._read_buffer)

    def _part(self, kind: str, index: Any) -> dict[str, Any]:
        """Part of the file by its number; a negative one would count from the end."""
        part: dict[str, Any] = self._header[kind][_natural(index)]
        return part

    def node(self, index: int) -> Node:
        """Node `index`; without a name it gets that of its mesh."""
        found = self._part("nodes", index)
        name, meshes = str(found.get("name") or ""), []
        if "mesh" in found:
            name = name or str(self._part("meshes", found["mesh"]).get("name") or "")
            meshes = self._mesh(found["mesh"])
        return Node(name, _matrix(found), meshes, found.get("children", ()))

    def _read_mesh(self, index: int) -> list[Mesh]:
        """One mesh of all primitives, which differ by material only."""
        mesh = self._part("meshes", index)
        surfaces = [p for p in mesh["primitives"] if p.get("mode", 4) >= 4]
        name = str(mesh.get("name") or self._path.stem)
        return joined(name, map(self._primitive, surfaces), self._allowance)

    def _primitive(self, primitive: dict[str, Any]) -> tuple[NDArray[Any], NDArray[np.int64]]:
        """Vertices (v, 3) and faces (f, 3)."""
        position, index = primitive["attributes"].get("POSITION"), primitive.get("indices")
        packed = primitive.get("extensions", {}).get(_DRACO)
        if position is None:
            return np.empty((0, 3)), np.empty((0, 3), np.int64)
        if packed and "bufferView" not in self._part("accessors", position):
            return _unpacked(bytes(self._view(packed["bufferView"])), self._allowance)
        vertices = self._accessor(position)
        mode = primitive.get("mode", 4)
        # The corners, and the triangles of strips and fans, before they are checked.
        count = len(vertices if index is None else self._accessor(index))
        self._allowance.take((8 if mode == 4 else 24) * count)
        corners = np.arange(count)
        if index is not None:
            corners = self._accessor(index)[:, 0].astype(np.int64)
        if mode == 4:
            return vertices, corners[: len(corners) // 3 * 3].reshape(-1, 3)
        return vertices, unrolled(corners) if mode == 5 else fanned(corners)

    def _read_accessor(self, index: int) -> NDArray[Any]:
        """Numbers (count, width) of an accessor; those of a buffer are not copied."""
        accessor = self._part("accessors", index)
        count, width = _natural(accessor["count"]), _WIDTHS[accessor["type"]]
        kind = np.dtype(_TYPES[accessor["componentType"]])
        sparse = accessor.get("sparse")
        if sparse:
            self._allowance.take(count * width * kind.itemsize)
        if "bufferView" in accessor:
            numbers = self._array(accessor, kind, count, width)
        elif sparse:
            numbers = np.zeros((count, width), kind)
        else:
            raise ValueError(f"accessor {index} has no content")
        if sparse:
            changed, values = sparse["indices"], sparse["values"]
            where = np.dtype(_TYPES[changed["componentType"]])
            rows = self._array(changed, where, sparse["count"], 1)[:, 0]
            numbers = numbers.copy()
            numbers[rows] = self._array(values, kind, sparse["count"], width)
        if accessor.get("normalized") and kind.kind in "iu":
            self._allowance.take(8 * numbers.size)
            # glTF 2.0, 3.6.2.2
            return np.maximum(numbers / np.iinfo(kind).max, -1.0)
        return numbers

    def _array(self, at: dict[str, Any], kind: np.dtype[Any], count: int, width: int) -> Any:
        """Numbers (count, width) of a buffer view, from `at['byteOffset']` on."""
        row = kind.itemsize * width
        stride = self._part("bufferViews", at["bufferView"]).get("byteStride", row)
        view = self._view(at["bufferView"])[at.get("byteOffset", 0) :]
        if not count:
            return np.empty((0, width), kind)
        if stride * (count - 1) + row > len(view):
            raise ValueError(f"{count:,} elements announced, {len(view):,} bytes there")
        return np.ndarray((count, width), kind, view, strides=(stride, kind.itemsize))

    def _view(self, index: int) -> memoryview:
        view = self._part("bufferViews", index)
        begin = view.get("byteOffset", 0)
        return memoryview(self._buffer(view["buffer"]))[begin : begin + view["byteLength"]]

    def _read_buffer(self, index: int) -> bytes:
        buffer = self._part("buffers", index)
        uri = buffer.get("uri")
        if uri is None:
            if index:
                raise MeshFileError("has a buffer without content, as packed files have: unpack it")
            content = self._body
        elif uri.startswith("data:"):
            kind, _, text = uri.partition(",")
            content = unquote_to_bytes(text)
            content = base64.b64decode(content) if kind.endswith(";base64") else content
        else:
            content = self._beside(uri)
        if len(content) < buffer["byteLength"]:
            raise MeshFileError(
                f"takes {buffer['byteLength']:,} bytes from {uri[:80] if uri else 'itself'!r}, "
                f"which is cut short: it has {len(content):,}"
            )
        return content

    def _read_beside(self, uri: str) -> bytes:
        """Read a buffer file: names are escaped by the standard, but not by all programs."""
        folder = self._path.parent.resolve()
        targets = [folder / name for name in (uri.strip(), unquote(uri.strip()))]
        if not all(target.resolve().is_relative_to(folder) for target in targets):
            raise MeshFileError(
                f"takes data from {uri[:80]!r}, but only files in its own folder are read: "
                "export it as .glb, in one file"
            )
        for target in targets:
            if target.is_file():  # reading a pipe would wait for ever
                content = target.read_bytes()
                self._allowance.grow(len(content))
                return content
        raise MeshFileError(
            f"takes data from {uri[:80]!r}, a file that is not there: put it beside, or export as "
            ".glb"
        )


def _natural(number: Any) -> int:
    """Check a count or an index; a negative index would count from the end."""
    if type(number) is not int or number < 0:
        raise ValueError(f"{number!r} is given as an index or a count")
    return number


def _matrix(node: dict[str, Any]) -> NDArray[np.float64]:
    """Matrix (4, 4) of a node, from its columns or from translation, rotation and scale."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    rotation = np.array(node.get("rotation", (0, 0, 0, 1)), np.float64)
    x, y, z, w = rotation / np.linalg.norm(rotation)
    turn = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip
    out = np.eye(4)
    out[:3, :3] = turn * np.array(node.get("scale", (1, 1, 1)), np.float64)
    out[:3, 3] = node.get("translation", (0, 0, 0))
    return out


def _unpacked(data: bytes, allowance: Allowance) -> tuple[NDArray[Any], NDArray[np.int64]]:
    """Vertices and faces that are packed with Draco."""
    try:
        import DracoPy
    except ImportError as error:
        raise MeshFileError(
            f"is packed with {_DRACO}: install DracoPy to read it, or export without it"
        ) from error
    allowance.take(24 * sum(_draco_counts(data)))
    mesh = DracoPy.decode(data)
    return np.asarray(mesh.points).reshape(-1, 3), np.asarray(mesh.faces, np.int64).reshape(-1, 3)


def _draco_counts(data: bytes) -> tuple[int, int]:
    """Two counts of faces and vertices that a Draco mesh announces, as its format 2.2 stores them.

    The decoder makes them all, though a few bytes can stand for any number.
    """
    magic, version, kind, method, flags = struct.unpack_from("<5sHBBH", data)
    if magic != b"DRACO" or kind != 1 or method > 1:
        raise ValueError("its Draco data are not a mesh")
    if version != 0x0202 or flags & 0x8000:
        raise MeshFileError(
            "has Draco data of another version than 2.2, or with metadata: export it again"
        )
    # Numbers of seven bits a byte, the least first; the second method has a byte more before them.
    first, second = re.findall(rb"(?s)[\x80-\xff]*[\0-\x7f]", data[11 + method : 31])[:2]
    return _varint(first), _varint(second)


def _varint(data: bytes) -> int:
    return sum((byte & 0x7F) << 7 * at for at, byte in enumerate(data))
