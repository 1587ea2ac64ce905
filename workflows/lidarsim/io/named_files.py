"""Checks of file references in input data, which prevent path traversal.

Input data may have been downloaded, so references in it must not lead to other files on this
machine. A referenced file is read only if it is in a folder that belongs to the data, or in one of
its subfolders, after symbolic links have been resolved. Absolute paths, names with `..`, and links
that lead outside are errors. Paths that the user specifies, for example in a scenario or as an
argument, are not checked. Neither are links among the files that are found by listing a folder that
the user specified.

The following folders belong to the data:

- Meshes (glTF, OBJ, Collada, OpenUSD, OmniLidar) and MuJoCo models: the folder that contains the
  file. If a mesh refers to `../textures/wood.png`, that folder must be listed in `assets`.
- URDF: the package, or the folder that contains the file if there is no package, and packages that
  are found by name.
- SDFormat: the package or folder of the world, the folder of each model, and the folders and caches
  for which Gazebo is configured.
- HELIOS++ surveys and scanners: their folder, up to five parent folders to which names may be
  relative, and the working directory, but neither the home folder nor its parents.
- nuScenes: the root of the data set. Its subfolders, such as `samples`, may be links to other
  disks.
- lidarpool data sets and results: their folder, in which jobs and splits are plain names. Links
  that the user created there are followed.

Folders that the user lists in `assets` also belong to the data. References to other files in
CityJSON, IFC, raster, 3MF, E57, LAS, OpenDRIVE, OSI, KITTI and WebDataset files are never followed.
For a bag, only files in its folder are read.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path, PurePath

from ..errors import LidarError
from ..words import printable

_MAX_LETTERS = 200  # maximum length of a name in a message


def is_inside(file: Path, folders: Iterable[Path]) -> bool:
    """Return whether a file is in one of the given folders or their subfolders.

    Symbolic links in the path of the file are resolved. `folders` must already be resolved.

    Raises
    ------
    OSError, ValueError, RuntimeError
        If the path is invalid.
    """
    resolved = file.resolve()
    return any(resolved.is_relative_to(folder) for folder in folders)


def is_plain(name: str) -> bool:
    """Return whether a name is a plain file name, which is neither a path nor `..`."""
    return name not in ("", ".", "..") and not any(letter in name for letter in "/\\\0")


def leads_outside(name: str | PurePath) -> bool:
    """Return whether a name is an absolute path or contains `..`.

    The file need not exist.
    """
    path = PurePath(name)
    return path.is_absolute() or ".." in path.parts


def check_name(name: str, entry: str) -> None:
    """Check that a file reference in data is not an absolute path and does not contain `..`.

    The file need not exist. `entry` describes the location of the reference in the data and is used
    in the error message.

    Raises
    ------
    LidarError
        If the name leads outside the data folder.
    """
    if leads_outside(name):
        raise _outside(name, entry)


def file_below(root: Path, name: str, entry: str) -> Path:
    """Resolve a file reference that is relative to the root folder of the data.

    A folder directly below the root, such as `samples`, may be a link to another disk.

    Parameters
    ----------
    root
        Root folder of the data.
    name, entry
        Name of the file and location of the reference; see `check_name`.

    Raises
    ------
    LidarError
        If the name leads outside the root folder, either directly or through a link.
    """
    check_name(name, entry)
    path = root / name
    folders = [root.resolve()]
    if len(PurePath(name).parts) > 1:
        folders.append((root / PurePath(name).parts[0]).resolve())
    if not is_inside(path, folders):
        raise _outside(name, entry)
    return path


def _outside(name: str, entry: str) -> LidarError:
    return LidarError(
        f"{entry} refers to {printable(name, _MAX_LETTERS)!r}, which is outside the data folder. "
        "Only files in that folder are read. Copy the file there and correct the reference."
    )
