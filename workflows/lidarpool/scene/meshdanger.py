"""What a mesh file must not make its reader do: read other files, or fill the memory.

Mesh files come from anywhere. Some formats name further files, by paths or by addresses on the
net; some pack much into little. Each function here looks for one such thing before a reader
sees the file, and returns a clause that says what is wrong, or None. The files that a .gltf
names are read by `gltf_buffers`.
"""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Iterator
from typing import IO, Any

from lxml import etree  # type: ignore[import-untyped]

_LEAST_LIMIT = 2**28  # bytes that any file may become in memory
_GROWTH = 100  # and times its size; real .3mf files are packed by 5 to 30

_COMPONENT_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}


def dae_danger(data: bytes) -> str | None:
    """Find a packed document, which the reader would unpack, and a document type."""
    if zipfile.is_zipfile(io.BytesIO(data)):
        return "is a ZIP archive: take the .dae file out of it"
    return _doctype_danger(io.BytesIO(data))


def threemf_danger(data: bytes) -> str | None:
    """Find an archive that grows out of proportion, and document types in it."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        # A member cannot be read beyond the size that is stated here.
        parts = archive.infolist()
        if fault := _growth_danger(sum(part.file_size for part in parts), len(data)):
            return fault
        for part in parts:
            if part.filename.lower().endswith(".model"):
                with archive.open(part) as file:
                    if fault := _doctype_danger(file):
                        return fault
    return None


def gltf_danger(header: dict[str, Any], size: int) -> str | None:
    """Find more numbers than the file can hold.

    Parameters
    ----------
    header
        The JSON object.
    size
        Bytes of the file and of those that it takes data from.
    """
    return _growth_danger(sum(_accessor_bytes(header)), size)


def _accessor_bytes(header: dict[str, Any]) -> Iterator[int]:
    """Bytes of each array that the reader will make."""
    for accessor in header.get("accessors", ()):
        count = accessor["count"]
        if not isinstance(count, int) or count < 0:
            raise ValueError(f"an accessor has a count of {count!r}")
        kind, component = accessor["type"], accessor["componentType"]
        yield math.prod((count, _COMPONENTS[kind], _COMPONENT_BYTES[component]))


def _growth_danger(unpacked: int, size: int) -> str | None:
    if unpacked <= max(_LEAST_LIMIT, _GROWTH * size):
        return None
    return (
        f"has {size:,} bytes and says that it holds {unpacked:,}, out of all proportion: "
        "export it again"
    )


def _doctype_danger(document: IO[bytes]) -> str | None:
    """Find a document type: neither format needs one, and its entities can grow or read files."""
    # An iterator, so that the beginning is read and no more, in whatever encoding it is.
    events = etree.iterparse(
        document, events=("start",), resolve_entities=False, no_network=True, load_dtd=False
    )
    _, root = next(iter(events))
    if root.getroottree().docinfo.doctype:
        return "has a document type (<!DOCTYPE …>), which a mesh does not need: remove it"
    return None
