"""Files that a mesh file names: buffers, materials, images."""

from __future__ import annotations

from pathlib import Path, PureWindowsPath
from urllib.parse import unquote

from ...base.allowance import Allowance
from ..masks import MaskError
from .scene_graph import MeshFileError, ReadOptions


def named_file(mesh: Path, name: str, wanted: ReadOptions, *, moved: bool = True) -> Path | None:
    """Find a file that a mesh file names; None if it is not there.

    Names may be escaped, as URIs are by the standard but not by all programs, have backslashes, or
    be of another machine: then their last part counts, if files may be `moved`. A pipe is no file,
    because reading it would wait for ever.

    Raises
    ------
    MeshFileError
        If it is only in folders that are not allowed.
    """
    name = name.strip().removeprefix("file://")
    windows = PureWindowsPath(unquote(name))
    refused = False
    last = windows.name if moved else ""
    for one in filter(None, (name, unquote(name), windows.as_posix(), last)):
        target = mesh.parent.resolve() / one
        try:
            if not wanted.allows(target):
                refused = True
            elif target.is_file():
                return target
        except (OSError, ValueError, RuntimeError):
            continue  # no file can have this name
    if refused:
        raise MeshFileError(outside(name))
    return None


def image_file(mesh: Path, name: str, wanted: ReadOptions, allowance: Allowance) -> Path:
    """Find an image that a mesh file names, as `named_file`, and count its bytes with the file's.

    Raises
    ------
    MaskError
        If it is not there, or only in folders that are not allowed.
    """
    try:
        file = named_file(mesh, name, wanted)
    except MeshFileError as error:
        raise MaskError(str(error)) from error
    if file is None:
        raise MaskError(f"its image {name[-80:]!r} is not there")
    allowance.add_file(file)
    return file


def outside(name: str) -> str:
    """Say that a file may not be read, as a clause."""
    return (
        f"takes data from {name[-80:]!r}, but only files in its own folder are read: name a folder "
        "that holds that file as assets"
    )
