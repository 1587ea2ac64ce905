"""What a file is by its first bytes, where its ending says something else."""

from __future__ import annotations

import re

# What files of each kind begin with; those with a format of their own are mesh files.
_PACKED = (
    (b"\x1f\x8b", "gzip"),
    (b"BZh", "bzip2"),
    (b"\xfd7zXZ\0", "xz"),
    (b"7z\xbc\xaf", "7-Zip"),
)
_MESHES = (
    (re.compile(rb"glTF"), ".glb"),
    (re.compile(rb"ply[ \t]*[\r\n]"), ".ply"),
    (re.compile(rb"(ST)?C?N?OFF\b"), ".off"),
    (re.compile(rb"solid\b[^\0]*\bfacet\s+normal"), ".stl"),
    (re.compile(rb"<\?xml[^\0]*<COLLADA\b"), ".dae"),
    (re.compile(rb'\{[^\0]*"asset"\s*:'), ".gltf"),
)


def foreign_content(suffix: str, data: bytes) -> str | None:
    """Say what a file is that is not what it is called.

    Parameters
    ----------
    suffix
        The ending of its name, in small letters.
    data
        All that is in it.

    Returns
    -------
    A clause for a sentence, or None where nothing else was recognised.
    """
    head = data[:4000].lstrip()
    for magic, packer in _PACKED:
        if data.startswith(magic):
            return f"is packed with {packer}: unpack it first"
    if data.startswith(b"PK\3\4") and suffix != ".3mf":
        return "is a ZIP archive: unpack it first, or call it .3mf if it is one"
    if re.match(rb"<!doctype html|<html", head, re.IGNORECASE):
        return "is a page of the web, not a mesh: download the file itself"
    if head.startswith(b"version https://git-lfs"):
        return "only points to a mesh: get it with git lfs pull"
    kinds = [kind for pattern, kind in _MESHES if pattern.match(head)]
    if kinds and suffix not in kinds:
        return f"is a {kinds[0]} file by its content: give it that ending"
    return None
