"""Access to the files that a mesh file refers to, such as buffers, materials and images."""

from __future__ import annotations

from pathlib import Path, PureWindowsPath
from urllib.parse import unquote

from ...io.allowance import Allowance
from ..masks import MaskError
from .scene_graph import MeshFileError, ReadOptions


def find_named_file(
    mesh: Path, name: str, options: ReadOptions, *, allow_moved: bool = True
) -> Path | None:
    """Return the path of a file that a mesh file refers to, or None if the file does not exist.

    The name may be escaped like a URI: the standard requires it, but not all programs comply. It
    can also contain backslashes, or be a path on another machine. In this case, if `allow_moved` is
    set, the last component of the path is looked up in the folder of the mesh file and in the asset
    folders. Pipes do not count as files because reading a pipe can block forever.

    Raises
    ------
    MeshFileError
        If the file only exists in folders that are not allowed.
    """
    name = name.strip().removeprefix("file://")
    windows = PureWindowsPath(unquote(name))
    refused = False
    names = filter(None, (name, unquote(name), windows.as_posix()))
    targets = [mesh.parent.resolve() / candidate for candidate in names]
    if allow_moved and windows.name:
        folders = dict.fromkeys((mesh.parent.resolve(), *options.folders))
        targets += [folder / windows.name for folder in folders]
    for target in targets:
        try:
            if not options.allows(target):
                refused = True
            elif target.is_file():
                return target
        except (OSError, ValueError, RuntimeError):
            continue  # no file can have this name
    if refused:
        raise MeshFileError(outside_message(name))
    return None


def image_file(mesh: Path, name: str, options: ReadOptions, allowance: Allowance) -> Path:
    """Return the path of an image that a mesh file refers to, and add its size to the allowance.

    Raises
    ------
    MaskError
        If the image does not exist, or only exists in folders that are not allowed.
    """
    try:
        file = find_named_file(mesh, name, options)
    except MeshFileError as error:
        raise MaskError(str(error)) from error
    if file is None:
        raise MaskError(f"its image {name[-80:]!r} does not exist")
    allowance.add_file(file)
    return file


def outside_message(name: str) -> str:
    """Return the error message for a file outside the allowed folders.

    The message is a clause that follows the name of the mesh file.
    """
    return (
        f"takes data from {name[-80:]!r}, but only files in its own folder are read. Set assets "
        "to the folder that contains that file"
    )
