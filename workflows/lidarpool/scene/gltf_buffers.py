"""The files beside a .gltf that hold its vertices: read here, so that its reader opens none."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from .meshfault import MeshFileError


def buffers_beside(header: dict[str, Any], path: Path) -> dict[str, bytes]:
    """Read the buffers that are files of their own.

    Parameters
    ----------
    header
        The JSON object.
    path
        The file: what stands beside it and below may be read.

    Returns
    -------
    {name as the header has it: content}

    Raises
    ------
    MeshFileError
        If a buffer is elsewhere, missing, no file or cut short.
    """
    found = {}
    for buffer in header.get("buffers", ()):
        uri = buffer.get("uri")
        if uri is None or "base64," in uri:  # this is what the reader goes by
            continue
        target = _target(uri, path)
        shown = repr(uri[:80])
        if not target.exists():
            raise MeshFileError(
                f"takes data from {shown}, which is not there: put it beside, or export as .glb"
            )
        if not target.is_file():
            raise MeshFileError(f"takes data from {shown}, which is not a file")
        found[uri] = target.read_bytes()
        if len(found[uri]) < buffer["byteLength"]:
            raise MeshFileError(
                f"takes {buffer['byteLength']:,} bytes from {shown}, which is cut short: it has "
                f"{len(found[uri]):,}"
            )
    return found


def _target(uri: str, path: Path) -> Path:
    """File of a buffer: names are escaped by the standard, and by some programs not."""
    folder = path.parent.resolve()
    for name in (uri.strip(), unquote(uri.strip())):
        target = folder / name
        scheme = re.match(r"[A-Za-z][A-Za-z0-9+.-]*:", name)
        if scheme or not target.resolve().is_relative_to(folder):
            raise MeshFileError(
                f"takes data from {uri[:80]!r}, but only files in its own folder are read: "
                "export it as .glb, in one file"
            )
        if target.exists():
            break
    return target
