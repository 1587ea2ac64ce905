"""What trimesh reads without complaint although it would read it wrong.

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

from .meshdanger import dae_danger, gltf_danger, threemf_danger

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
    if suffix == ".obj":
        return _obj_fault(data)
    if suffix == ".off":
        return _off_fault(data)
    if suffix == ".ply":
        return _ply_fault(data)
    if suffix == ".stl":
        return _stl_fault(data)
    if suffix in (".gltf", ".glb"):
        return _gltf_fault(path, data)
    if suffix == ".dae":
        return dae_danger(data)
    if suffix == ".3mf":
        return threemf_danger(data)
    return None


def _obj_fault(data: bytes) -> str | None:
    """Find relative vertex numbers, which the reader counts from the end of the whole file."""
    relative = re.search(rb"^f[^\n]*\s-\d", data, re.MULTILINE)
    if relative and re.search(rb"^v\s", data[relative.end() :], re.MULTILINE):
        return "numbers its vertices backwards (f -1 -2 -3): export it with absolute numbers"
    return None


def _off_fault(data: bytes) -> str | None:
    """Find fewer vertices and faces than the header announces."""
    text = re.sub(r"#[^\n]*", "", data.decode("utf-8", errors="replace"))
    _, found, rest = text.partition("OFF")
    lines = [line for line in rest.splitlines() if line.strip()]
    counts = lines[0].split() if found and lines else []
    if len(counts) < 2 or not all(count.isdigit() for count in counts[:2]):
        return "has no OFF header with the numbers of vertices and faces"
    announced = int(counts[0]) + int(counts[1])
    if len(lines) - 1 < announced:
        return f"is cut short: {announced} vertices and faces announced, {len(lines) - 1} there"
    last = lines[announced].split()
    if not last[0].isdigit() or len(last) <= int(last[0]):
        return f"is cut short: its last face is '{lines[announced]}'"
    return None


def _ply_fault(data: bytes) -> str | None:
    """Find a header without end, which hangs the reader, no faces, or fewer rows than announced."""
    head, found, body = data.partition(b"end_header")
    if not head.startswith(b"ply") or not found:
        return "has no PLY header, or is cut within it"
    counts = re.findall(rb"^element\s+(\w+)\s+(\d+)", head, re.MULTILINE)
    if not sum(int(count) for name, count in counts if name == b"face"):
        return "is a point cloud, it has no faces: make a mesh of it first"
    if b"format ascii" not in head:
        return None
    rows = [line for line in body.splitlines() if line.strip()]
    announced = sum(int(count) for _, count in counts)
    if len(rows) < announced:
        return f"is cut short: {announced} rows announced, {len(rows)} there"
    last = rows[announced - 1].split()
    if counts[-1][0] == b"face" and (not last[0].isdigit() or len(last) <= int(last[0])):
        return f"is cut short: its last face is {b' '.join(last).decode(errors='replace')!r}"
    return None


def _stl_fault(data: bytes) -> str | None:
    """Find a text file that is cut: the reader drops the solid that is not ended."""
    if data[:5].lower() != b"solid" or b"\0" in data[:1000]:
        return None
    text = data.lower()
    if text.count(b"endsolid") < len(re.findall(rb"^[ \t]*solid\b", text, re.MULTILINE)):
        return "is cut short: it does not end with 'endsolid'"
    return None


def _gltf_fault(path: Path, data: bytes) -> str | None:
    """Find compressed, sparse or normalised positions: read as zeros or on another scale."""
    whole = len(data)
    if path.suffix.lower() == ".glb":
        if data[:4] != b"glTF" or len(data) < 20:
            return "is not a binary glTF file"
        total, size = struct.unpack_from("<II", data, 8)
        if len(data) < total:
            return f"is cut short: {total} bytes announced, {len(data)} there"
        data = data[20 : 20 + size]
    try:
        header = json.loads(data)
    except (ValueError, RecursionError) as error:
        return f"holds no valid JSON ({error})"
    if not isinstance(header, dict):
        return "holds no glTF object"
    foreign = [name for name in header.get("extensionsRequired", ()) if not _LOOKS.match(str(name))]
    if foreign:
        return f"needs {', '.join(map(str, foreign))}, which cannot be read: export without it"
    if not header.get("scenes"):
        return "has no scene: export it with one"
    return gltf_danger(header, path, whole) or _accessor_fault(header)


def _accessor_fault(header: dict[str, Any]) -> str | None:
    """Look for exotic storage of positions and vertex numbers."""
    for mesh in header.get("meshes", ()):
        for primitive in mesh.get("primitives", ()):
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
