"""What a reader would take without complaint although it would read it wrong.

Each function here looks at the bytes of one format and returns what is wrong with them, so
that a cut or exotic file is refused instead of scanned with parts missing. What would be
dangerous to read at all is looked for by `meshdanger`.
"""

from __future__ import annotations

import json
import re
import struct
from pathlib import Path
from typing import Any

from .meshcontent import foreign_content
from .meshdanger import dae_danger, gltf_danger, threemf_danger
from .meshfault import MeshFileError

# glTF extensions that change looks, not shapes.
_LOOKS = re.compile(r"KHR_materials_|\w+_texture_|KHR_texture|KHR_lights|KHR_mesh_quantization")


def find_fault(path: Path, data: bytes) -> str | None:
    """Say what is wrong with the bytes of a mesh file.

    Parameters
    ----------
    path
        The file; its ending says the format.
    data
        All that is in it.

    Returns
    -------
    A clause for a sentence, or None where nothing is known against the file.

    Raises
    ------
    Exception
        What one stumbles over in a file that is broken.
    """
    suffix = path.suffix.lower()
    if foreign := foreign_content(suffix, data):
        return foreign
    if suffix == ".stl":
        return _stl_fault(data)
    if suffix == ".dae":
        return dae_danger(data)
    if suffix == ".3mf":
        return threemf_danger(data)
    return None


def _stl_fault(data: bytes) -> str | None:
    """Find a file that is cut: of text, the reader drops the solid that is not ended."""
    if binary_stl_size(data) is None:
        text = data.lower()
        solids = re.findall(rb"^[ \t]*solid\b", text, re.MULTILINE)
        if text.count(b"endsolid") < len(solids):
            return "is cut short: it does not end with 'endsolid'"
        if solids or len(data) < 84:
            return None
        return (
            f"announces {int.from_bytes(data[80:84], 'little'):,} triangles and has "
            f"{max(0, len(data) - 84) // 50:,}: it is cut short, or not an .stl file"
        )
    return None


def binary_stl_size(data: bytes) -> int | None:
    """Bytes that a binary .stl takes by the number of triangles in it, if it is one.

    A few more bytes may follow; less than a triangle, or the number is not to be trusted. A
    file of text gives a number that does not fit.
    """
    if len(data) < 84:
        return None
    size = 84 + 50 * int.from_bytes(data[80:84], "little")
    return size if size <= len(data) < size + 50 else None


def gltf_header(path: Path, data: bytes) -> dict[str, Any]:
    """Take the JSON object from a glTF file.

    Raises
    ------
    MeshFileError
        If there is none, or the file is cut short.
    """
    if path.suffix.lower() == ".glb":
        if data[:4] != b"glTF" or len(data) < 20:
            raise MeshFileError("is not a binary glTF file")
        total, size = struct.unpack_from("<II", data, 8)
        if len(data) < total:
            raise MeshFileError(f"is cut short: {total} bytes announced, {len(data)} there")
        data = data[20 : 20 + size]
    try:
        header = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise MeshFileError(f"holds no valid JSON ({error})") from error
    if not isinstance(header, dict):
        raise MeshFileError("holds no glTF object")
    return header


def gltf_fault(header: dict[str, Any], size: int) -> str | None:
    """Find what would be read wrong, and more numbers than the files hold.

    Parameters
    ----------
    header
        The JSON object.
    size
        Bytes of the file and of those that it takes data from.
    """
    foreign = [name for name in header.get("extensionsRequired", ()) if not _LOOKS.match(str(name))]
    if foreign:
        return f"needs {', '.join(map(str, foreign))}, which cannot be read: export without it"
    if not header.get("scenes"):
        return "has no scene: export it with one"
    return gltf_danger(header, size) or _node_fault(header) or _accessor_fault(header)


def _node_fault(header: dict[str, Any]) -> str | None:
    """Look for what moves vertices besides the places of their nodes."""
    for node in header.get("nodes", ()):
        if "EXT_mesh_gpu_instancing" in node.get("extensions", {}):
            return (
                "places copies by EXT_mesh_gpu_instancing, which cannot be read: export them as "
                "objects of their own"
            )
        if "skin" in node and "mesh" in node:
            return (
                "moves vertices by a skeleton, which is not followed: apply the pose, then export"
            )
    for mesh in header.get("meshes", ()):
        if any(mesh.get("weights", ())):
            return "has morph targets in effect, which are not followed: apply them, then export"
    return None


def _accessor_fault(header: dict[str, Any]) -> str | None:
    """Look for exotic storage of positions and vertex numbers."""
    for mesh in header.get("meshes", ()):
        for primitive in mesh.get("primitives", ()):
            packed = [name for name in primitive.get("extensions", ()) if "compression" in name]
            if packed:
                return f"is packed with {packed[0]}, which cannot be read: export without it"
            if primitive.get("mode", 4) == 6:
                return "draws triangles as fans, which cannot be read: export as triangles"
            used = (primitive.get("attributes", {}).get("POSITION"), primitive.get("indices"))
            for index in used:
                if index is None:
                    continue
                accessor = header["accessors"][index]
                if "sparse" in accessor or "bufferView" not in accessor:
                    return "stores positions sparsely, which cannot be read: export them in full"
                if accessor.get("normalized"):
                    return "stores normalised positions: export without quantisation"
    return None
