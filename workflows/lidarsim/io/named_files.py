"""Files that data names: which of them are read.

Data may have been downloaded, so the names in it must not lead to other files of this machine. A
file that data names is read only if it lies in a folder that belongs to the data, or below, after
links have been followed. Everything else is an error that quotes the name: absolute paths, names
with `..` and links that lead outside. What a user writes, such as a file in a scenario or an
argument, is the user's choice and is not checked; nor is a link among files that are found by
listing a folder that the user names.

These folders belong to the data:

- meshes (glTF, OBJ, Collada, OpenUSD, OmniLidar) and models of MuJoCo: the folder of the file. A
  mesh that names `../textures/wood.png` needs that folder as `assets`
- URDF: the package, or the folder of a file without a package, and packages found by their names
- SDFormat: the package or folder of the world, the folder of each model, and the folders and caches
  that Gazebo is set up with
- surveys and scanners of HELIOS++: their folder, up to five folders above, in which names start,
  and the working folder; neither the home folder nor the folders above it
- nuScenes: the root of the data set; its folders, such as `samples`, may be links to other disks
- data sets and results of lidarpool: their folder, in which jobs and splits are plain names; links
  that the user made in it are followed

Folders that the user gives as `assets` belong to the data as well. CityJSON, IFC, rasters, 3MF,
E57, LAS, OpenDRIVE, OSI, KITTI and WebDataset name no files that are read; of a bag, only files in
its folder are.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path, PurePath

from ..errors import LidarError
from ..words import printable

_MAX_LETTERS = 200  # of a name in a message


def is_inside(file: Path, folders: Iterable[Path]) -> bool:
    """Return True if a file lies in one of some folders or below, after links are followed.

    `folders` must be resolved. OSError, ValueError or RuntimeError if no file can have this name.
    """
    resolved = file.resolve()
    return any(resolved.is_relative_to(folder) for folder in folders)


def is_plain(name: str) -> bool:
    """Return True for the name of a file in a folder, without separators: no path, no `..`."""
    return name not in ("", ".", "..") and not any(letter in name for letter in "/\\\0")


def leads_outside(name: str | PurePath) -> bool:
    """Return True if a name is an absolute path or has `..`, whatever files exist."""
    path = PurePath(name)
    return path.is_absolute() or ".." in path.parts


def check_name(name: str, entry: str) -> None:
    """Check that a name in data is neither an absolute path nor has `..`, whatever files exist.

    `entry` is the place in the data that has the name, for the message.

    Raises
    ------
    LidarError
        If the name leads to a file outside of the folder of the data.
    """
    if leads_outside(name):
        raise _outside(name, entry)


def file_below(root: Path, name: str, entry: str) -> Path:
    """Return the path of a file that data names, relative to the root of the data.

    Parameters
    ----------
    root
        Folder of the data.
    name, entry
        Name of the file and its place in the data, as of `check_name`.

    Raises
    ------
    LidarError
        If the name leads to a file outside of the folder, also by a link. A folder directly in
        the root, such as `samples`, may be a link to another disk.
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
