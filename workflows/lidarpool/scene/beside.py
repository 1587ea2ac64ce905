"""Files that a mesh file names: buffers, materials, images."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from urllib.parse import unquote

from .nodes import MeshFileError, Wanted


def file_beside(mesh: Path, names: Iterable[str], wanted: Wanted) -> Path | None:
    """Find a file that a mesh file names, by the first name that fits.

    None if it is not there; a pipe is none, because reading it would wait for ever.

    Raises
    ------
    MeshFileError
        If a name leads out of the folders that are allowed.
    """
    folder = mesh.parent.resolve()
    targets = {folder / name: name for name in names}
    for target, name in targets.items():
        if not wanted.allows(target):
            raise MeshFileError(outside(name))
    return next((target for target in targets if target.is_file()), None)


def outside(name: str) -> str:
    """Say that a file may not be read, as a clause."""
    return (
        f"takes data from {name[-80:]!r}, but only files in its own folder are read: name a folder "
        "that holds that file by assets in scene.files"
    )


def spellings(uri: str) -> tuple[str, str]:
    """Names that a URI may mean: they are escaped by the standard, but not by all programs."""
    name = uri.strip()
    return name, unquote(name)
