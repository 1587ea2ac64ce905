"""Access to the parts, accessors, buffers and images of a glTF 2.0 file."""

from __future__ import annotations

import base64
import json
import re
import struct
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import unquote_to_bytes

import numpy as np

from ...io.allowance import Allowance
from ...io.input_files import read_input
from ...numerics.arrays import AnyArray
from ...words import list_names, printable
from .companions import find_named_file, image_file
from .gltf_draco import DRACO
from .scene_graph import MeshFileError, ReadOptions

INSTANCING = "EXT_mesh_gpu_instancing"
VISIBILITY = "KHR_node_visibility"  # applies to a node and its descendants
# Extensions that do not change shapes, or that are supported here.
_READ = re.compile(
    r"KHR_materials_|KHR_techni|\w+_texture_|KHR_texture|KHR_lights|KHR_mesh_quantization|"
    rf"({DRACO}|{INSTANCING}|{VISIBILITY})$"
)
# Extensions that affect neither shapes nor colors, so that users need not know about them.
_WITHOUT_SHAPE = re.compile(
    r"(KHR_xmp(_json_ld)?|KHR_node_(selectability|hoverability)|KHR_audio_emitter|EXT_lights_\w+|"
    r"EXT_(structural_metadata|mesh_features|instance_features)|CESIUM_primitive_outline)$"
)

_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_OLD = "is glTF 1.0, which is not supported. Convert it to glTF 2.0"
V = TypeVar("V")


def split_chunks(data: bytes) -> tuple[dict[str, Any], bytes]:
    """Return the JSON object of a file and, for a .glb file, its binary buffer."""
    body = b""
    if data[:4] == b"glTF" and len(data) >= 20:
        version, total, size = struct.unpack_from("<III", data, 4)
        if version == 1:
            raise MeshFileError(_OLD)
        if len(data) < total:
            raise MeshFileError(f"is truncated: it declares {total} bytes, but has {len(data)}")
        body = data[28 + size : total]
        data = data[20 : 20 + size].rstrip(b"\0")  # some programs pad the chunk with zeros
    elif data[:1] not in b"{[ \t\r\n":
        raise MeshFileError("is not glTF")
    try:
        header = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise MeshFileError(f"does not contain valid JSON ({error})") from error
    if not isinstance(header, dict):
        raise MeshFileError("does not contain a glTF object")
    return header, body


def check_readable(header: dict[str, Any]) -> None:
    """Raise MeshFileError if a file is not glTF 2.0 or requires an unsupported extension."""
    # In version 1.0, parts have names instead of indices.
    if str(header.get("asset", {}).get("version", "2")).startswith("1") or isinstance(
        header.get("nodes"), dict
    ):
        raise MeshFileError(_OLD)
    for name in map(str, header.get("extensionsRequired", ())):
        if not _READ.match(name):
            raise MeshFileError(
                f"requires the extension {name}, which is not supported. Export it without the "
                "extension"
            )


def extension_notes(header: dict[str, Any]) -> list[str]:
    """Return a note about unsupported extensions that a file uses but does not require."""
    names = dict.fromkeys(printable(str(name))[:60] for name in header.get("extensionsUsed", ()))
    unknown = [name for name in names if not (_READ.match(name) or _WITHOUT_SHAPE.match(name))]
    return (
        [f"uses extensions that are not supported and were ignored: {list_names(unknown, 8)}"]
        if unknown
        else []
    )


def root_nodes(header: dict[str, Any]) -> list[int]:
    """Return the root nodes of the default scene, or of the file if it has no scenes."""
    nodes = header.get("nodes", ())
    if scenes := header.get("scenes"):
        return list(scenes[header.get("scene", 0)].get("nodes", ()))
    inner = {child for node in nodes for child in node.get("children", ())}
    return [index for index in range(len(nodes)) if index not in inner]


class GltfFile:
    """A glTF file, whose accessors and buffers are read on demand and cached."""

    def __init__(
        self,
        header: dict[str, Any],
        body: bytes,
        path: Path,
        options: ReadOptions,
        allowance: Allowance,
    ) -> None:
        self.header = header
        self.path = path
        self.allowance = allowance
        self._body = body
        self._options = options
        self.accessor = cache(self._read_accessor)
        self._buffer_file = cache(self._read_buffer_file)
        self._buffer = cache(self._read_buffer)

    def part(self, kind: str, index: Any) -> dict[str, Any]:
        """Return an element of a top-level array in the file.

        Raises
        ------
        ValueError
            If the index is out of range.
        """
        entries: list[dict[str, Any]] = self.header.get(kind, [])
        number = check_index(index)
        if number >= len(entries):
            raise ValueError(
                f"it refers to index {number} of its {kind}, but there are {len(entries)}"
            )
        return entries[number]

    def _read_accessor(self, index: int) -> AnyArray:
        """Return the values of an accessor, avoiding a copy if possible.

        The shape is (count, width).
        """
        accessor = self.part("accessors", index)
        count = check_index(accessor["count"])
        if accessor["type"] not in _WIDTHS or accessor["componentType"] not in _TYPES:
            raise ValueError(
                f"accessor {index} has the type {accessor['type']!r} with components of type "
                f"{accessor['componentType']!r}, which glTF does not define"
            )
        width = _WIDTHS[accessor["type"]]
        kind = np.dtype(_TYPES[accessor["componentType"]])
        sparse = accessor.get("sparse")
        if sparse:
            self.allowance.reserve(count * width * kind.itemsize)
        if "bufferView" in accessor:
            numbers = self._array(accessor, kind, count, width)
        elif sparse:
            numbers = np.zeros((count, width), kind)
        else:
            raise ValueError(f"accessor {index} has no content")
        if sparse:
            changed = sparse["indices"]
            values = sparse["values"]
            index_type = np.dtype(_TYPES[changed["componentType"]])
            rows = self._array(changed, index_type, sparse["count"], 1)[:, 0]
            numbers = numbers.copy()
            numbers[rows] = self._array(values, kind, sparse["count"], width)
        return self.normalize_integers(numbers) if accessor.get("normalized") else numbers

    def normalize_integers(self, numbers: AnyArray) -> AnyArray:
        """Convert normalized integers to floating-point values (glTF 2.0, section 3.6.2.2)."""
        if numbers.dtype.kind not in "iu":
            return numbers
        self.allowance.reserve(8 * numbers.size)
        return np.maximum(numbers / np.iinfo(numbers.dtype).max, -1.0)

    def _array(self, part: dict[str, Any], kind: np.dtype[Any], count: int, width: int) -> Any:
        """Return the values in a buffer view that start at `part['byteOffset']`.

        The shape is (count, width).
        """
        row = kind.itemsize * width
        stride = self.part("bufferViews", part["bufferView"]).get("byteStride", row)
        view = self.view(part["bufferView"])[part.get("byteOffset", 0) :]
        if not count:
            return np.empty((0, width), kind)
        if stride * (count - 1) + row > len(view):
            raise ValueError(
                f"{count:,} elements are declared, but their buffer has only {len(view):,} bytes"
            )
        return np.ndarray((count, width), kind, view, strides=(stride, kind.itemsize))

    def view(self, index: int) -> memoryview:
        """Return the bytes of a buffer view."""
        view = self.part("bufferViews", index)
        start = view.get("byteOffset", 0)
        return memoryview(self._buffer(view["buffer"]))[start : start + view["byteLength"]]

    def _read_buffer(self, index: int) -> bytes:
        """Read a buffer, which can be in the file itself, in a data URI or in another file."""
        buffer = self.part("buffers", index)
        uri = buffer.get("uri")
        if uri is None:
            if index:
                raise MeshFileError(
                    "has a buffer without content, which is typical of compressed files. "
                    "Decompress the file first"
                )
            content = self._body
        elif uri.startswith("data:"):
            content = _decode_data_uri(uri)
        else:
            content = self._buffer_file(uri)
        if len(content) < buffer["byteLength"]:
            raise MeshFileError(
                f"requires {buffer['byteLength']:,} bytes from {uri[:80] if uri else 'itself'!r}, "
                f"which is truncated to {len(content):,}"
            )
        return content

    def _read_buffer_file(self, uri: str) -> bytes:
        target = find_named_file(self.path, uri, self._options, allow_moved=False)
        if target is None:
            raise MeshFileError(
                f"takes data from {uri[:80]!r}, which does not exist. Copy this file to the "
                "folder of the model, or export the model as .glb"
            )
        self.allowance.add_file(target)
        return read_input(target)

    def image(self, index: int, read: Callable[[Path | bytes, Allowance], V]) -> V:
        """Read an image with the given function."""
        image = self.part("images", index)
        if "bufferView" in image:
            return read(bytes(self.view(image["bufferView"])), self.allowance)
        uri = image["uri"]
        if uri.startswith("data:"):
            return read(_decode_data_uri(uri), self.allowance)
        return read(image_file(self.path, uri, self._options, self.allowance), self.allowance)


def _decode_data_uri(uri: str) -> bytes:
    kind, _, text = uri.partition(",")
    content = unquote_to_bytes(text)
    return base64.b64decode(content) if kind.endswith(";base64") else content


def extension(part: dict[str, Any], name: str) -> dict[str, Any]:
    """Return a part's data for an extension, or an empty dictionary."""
    content: dict[str, Any] = part.get("extensions", {}).get(name, {})
    return content


def check_index(number: Any) -> int:
    """Validate a count or an index.

    Raises
    ------
    ValueError
        If it is negative or not an integer.
    """
    if type(number) is not int or number < 0:
        raise ValueError(f"an index or a count must be a non-negative integer, but is {number!r}")
    return number
