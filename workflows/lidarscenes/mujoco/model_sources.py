"""Check the included models, meshes, and textures to which a MuJoCo model refers.

MuJoCo opens these files itself. They are checked here first, so that a model reads data only from
its own folder and from folders that the user allows.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from xml.etree.ElementTree import Element

from lidarsim.io.allowance import Allowance
from lidarsim.io.input_files import check_input, read_input
from lidarsim.scene.files.companions import outside_message
from lidarsim.scene.files.scene_graph import MeshFileError, ReadOptions

from ..files.lenient_xml import parse_lenient_xml

ROOT = "mujoco"
_INCLUDED_ROOTS = (ROOT, "mujocoinclude")
_OF_XML = ("include", "model")  # elements that refer to other MJCF files
_FOLDERS = ("meshdir", "texturedir", "assetdir")
_MAX_FILES = 20_000
_OTHER_ROOTS = {  # {root element of other XML files: advice}
    "robot": "is a URDF robot. Change its extension to .urdf",
    "sdf": "is a Gazebo world. Change its extension to .sdf",
    "document": "is not a MuJoCo model but may be a HELIOS++ survey. Convert it with "
    "`lidarpool import`",
    "fcd-export": "is not a MuJoCo model but SUMO floating car data. Set it as traffic.file in a "
    "scenario",
}


def check_sources(data: bytes, path: Path, options: ReadOptions, allowance: Allowance) -> None:
    """Check that a file is a MuJoCo model, and that all files to which it refers may be read.

    The sizes of all files are added to the allowance. Missing files are reported by MuJoCo later.

    Raises
    ------
    ValueError
        If a file is not XML.
    MeshFileError
        If a file is not a MuJoCo model, or is in a folder that is not allowed.
    """
    root = parse_lenient_xml(data)
    if root.tag != ROOT:
        advice = "is an XML file, but not a MuJoCo model. Its root element is <{}>"
        raise MeshFileError(_OTHER_ROOTS.get(root.tag, advice.format(root.tag[:40])))
    home = path.resolve().parent
    roots = {path.resolve(): root}  # {file: its root element}
    pending = [path.resolve()]
    while pending:
        file = pending.pop()
        for name in _names_of(roots[file], _OF_XML):
            for included in _targets(name, {home, file.parent}, options):
                if included not in roots:
                    _count(len(roots))
                    roots[included] = _included_root(included)
                    pending.append(included)
    folders = {home, *(file.parent for file in roots)}
    for root in roots.values():
        for compiler in root.iter("compiler"):
            inner = filter(None, map(compiler.get, _FOLDERS))
            folders |= {folder / name for name in inner for folder in folders}
            _count(len(folders))
    names = {name for root in roots.values() for name in _names_of(root)}
    _count(len(names) * len(folders))
    targets = {target for name in names for target in _targets(name, folders, options)}
    for target in {path.resolve(), *roots, *targets}:
        check_input(target)
        allowance.add_file(target)


def _count(count: int) -> None:
    """Raise MeshFileError if a model refers to too many files."""
    if count > _MAX_FILES:
        raise MeshFileError(f"refers to more than {_MAX_FILES:,} files. Split the model")


def _names_of(root: Element, tags: tuple[str, ...] = ()) -> Iterator[str]:
    """Yield the file names to which elements refer, optionally only for elements with `tags`."""
    for element in root.iter():
        if not tags or element.tag in tags:
            for attribute, name in element.items():
                if attribute.startswith("file") and name.strip():
                    yield name.strip()


def _targets(name: str, folders: set[Path], options: ReadOptions) -> Iterator[Path]:
    """Yield the existing files to which a name may refer in the given folders.

    Raises MeshFileError if a file is in a folder that is not allowed.
    """
    names = {name, name.replace("\\", "/"), name.replace("\\", "/").rpartition("/")[2]}
    for folder in folders:
        for candidate in names:
            target = folder / candidate
            try:
                is_file = target.exists() and not target.is_dir()
                resolved = target.resolve()
            except (OSError, ValueError, RuntimeError):
                continue  # no file can have this name
            if is_file:
                if not options.allows(resolved):
                    raise MeshFileError(outside_message(name))
                yield resolved


def _included_root(file: Path) -> Element:
    """Parse an included file, and return its root element.

    Raises ValueError if it is not an MJCF file.
    """
    try:
        root = parse_lenient_xml(read_input(file))
    except ValueError as error:
        raise ValueError(f"{file.name}: {error}") from error
    if root.tag not in _INCLUDED_ROOTS:
        raise ValueError(
            f"{file.name} has the root element <{root.tag[:40]}>, which MuJoCo does not define"
        )
    return root
