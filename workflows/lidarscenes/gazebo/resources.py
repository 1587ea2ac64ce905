"""Files of models, meshes and images that worlds of Gazebo name by URIs."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple
from urllib.parse import unquote, urlsplit
from xml.etree.ElementTree import Element

from lidarsim.base.errors import LidarError
from lidarsim.base.input_files import read_input
from lidarsim.base.named_files import is_inside
from lidarsim.base.words import natural, printable

from ..files.lenient_xml import parse_lenient_xml

# Variables with folders of models and resources, of Gazebo Sim, then of Gazebo classic.
FOLDER_VARIABLES = (
    "GZ_SIM_RESOURCE_PATH",
    "IGN_GAZEBO_RESOURCE_PATH",
    "SDF_PATH",
    "GAZEBO_MODEL_PATH",
    "GAZEBO_RESOURCE_PATH",
)
CACHE_VARIABLES = ("GZ_FUEL_CACHE_PATH", "IGN_FUEL_CACHE_PATH")
CACHES = ("~/.gz/fuel", "~/.ignition/fuel")
_MODELS = "~/.gazebo/models"  # folder of Gazebo classic
_MAX_FOLDERS_UP = 5  # folders above a world that are searched for models
_PACKAGE = "package.xml"  # file in the folder of a package of ROS
_CONFIGS = ("model.config", "manifest.xml")
_MODEL = "model.sdf"  # file of models without a configuration
_WORLD_FOLDERS = ("worlds", "world")
_SDF_VERSION = (1, 12)  # the newest that is known


class ResourceNotFoundError(Exception):
    """A file or model that no folder has.

    The text of the error is the name to report.
    """


class Candidate(NamedTuple):
    """A path that a URI may mean, and the folder that must contain the path.

    A folder that may not be read has nothing that marks the folder as a model or package, and is
    found only because the folder is near the world.
    """

    path: Path
    root: Path
    is_allowed: bool = True


class Source(NamedTuple):
    """A file of SDFormat, and the folder that must contain the files of its relative names."""

    path: Path
    root: Path


@dataclass(frozen=True)
class Resources:
    """Finder of the files that a world names.

    Attributes
    ----------
    world
        The world, and its folder: with a package.xml at most five folders above that one, else the
        folder above a folder `worlds`.
    folders
        Folders that are searched for models by name, in order. In folders above the world, only
        folders with a model.config are models, and for ``package://`` folders with a package.xml.
    trusted
        Resolved folders whose files may be read from anywhere.
    unmarked
        Resolved folders whose folders are all models: folders that the user names, the world's
        folder, and the world's package if it has a package.xml.
    caches
        Folders of downloads from Fuel.
    """

    world: Source
    folders: tuple[Path, ...]
    trusted: tuple[Path, ...]
    unmarked: tuple[Path, ...]
    caches: tuple[Path, ...]

    @classmethod
    def for_world(cls, path: Path, assets: tuple[Path, ...]) -> Resources:
        """Return the resources of a world, which `assets` are searched for first."""
        folder = path.parent.resolve()
        above = [folder, *folder.parents][: _MAX_FOLDERS_UP + 1]
        default = folder.parent if folder.name.lower() in _WORLD_FOLDERS else folder
        root = next((f for f in above if (f / _PACKAGE).is_file()), default)
        named = [*assets, *_folders_of(FOLDER_VARIABLES), *_existing([_MODELS])]
        nearby = [f / name for f in above for name in ("", "models")]
        folders = dict.fromkeys([*named, *(f for f in nearby if f.is_dir())])
        caches = [*_folders_of(CACHE_VARIABLES), *_existing(CACHES)]
        chosen = [f.resolve() for f in [*named, *caches]]
        own = root if (root / _PACKAGE).is_file() else folder
        return cls(
            world=Source(path, root),
            folders=tuple(folders),
            trusted=(root.resolve(), *chosen),
            unmarked=(own, *chosen),
            caches=tuple(caches),
        )

    def model(self, uri: str, source: Source) -> Source:
        """Return the file of SDFormat of a model, the newest that its model.config names.

        Raises
        ------
        MissingFileError
            If no folder has the model.
        LidarError
            If the name leaves the folder of the file that has the name.
        """
        for target in self._targets(uri, source):
            if target.path.is_dir():
                return Source(_newest_file(target.path), _resolved(target.path))
            if target.path.is_file():
                return Source(target.path, target.root)
        raise ResourceNotFoundError(short_name(uri))

    def file(self, uri: str, source: Source) -> Source:
        """Return a file of a mesh or an image.

        Raises MissingFileError and LidarError as `model` does.
        """
        for target in self._targets(uri, source):
            if target.path.is_file():
                return target
        raise ResourceNotFoundError(printable(uri))

    def _targets(self, uri: str, source: Source) -> Iterator[Source]:
        """Yield the existing paths that a URI may name.

        Raises LidarError if a path must not be read.
        """
        refused: Path | None = None
        for path, root, is_allowed in self._candidates(uri, source):
            try:
                if not path.exists():
                    continue
                resolved = path.resolve()
                if not is_allowed:
                    is_file = path.is_file() or (path / _MODEL).is_file()
                    refused = root if is_file and refused is None else refused
                    continue
            except (OSError, ValueError, RuntimeError):
                continue  # no file can have this name
            roots = (root, *self.trusted)
            if not is_inside(resolved, roots):
                raise LidarError(
                    f"{printable(uri)!r} refers to a file outside {root}. Move the file there, "
                    "or set `assets` to its folder."
                )
            yield Source(path, next(f for f in roots if resolved.is_relative_to(f)))
        if refused is not None:
            raise LidarError(
                f"{printable(uri)!r} is in {refused}, which has no {_CONFIGS[0]}. Set "
                "`assets` to the folder that contains it."
            )

    def _candidates(self, uri: str, source: Source) -> Iterator[Candidate]:
        """Yield the paths that a URI may mean."""
        name = unquote(uri.strip())
        scheme, mark, location = name.partition("://")
        if mark and scheme in ("http", "https"):
            yield from self._downloads(uri)
        elif mark and scheme in ("model", "package"):
            yield from self._in_folders(location, scheme)
        elif not mark or scheme == "file":
            location = location if mark else name.removeprefix("file:")
            yield Candidate(source.path.parent / location, source.root)
            if not location.startswith("/"):
                yield from self._in_folders(location)
        else:
            raise ResourceNotFoundError(printable(uri))

    def _in_folders(self, location: str, scheme: str = "") -> Iterator[Candidate]:
        """Yield the paths NAME/FILE in all folders."""
        name, _, file = location.lstrip("/").partition("/")
        file = file.lstrip("/")  # else the file would be an absolute path
        if name in ("", ".", ".."):
            return
        marks = (_CONFIGS[0], _PACKAGE) if scheme == "package" else _CONFIGS[:1]
        # A path below the world's folder may be written without a scheme as well.
        unmarked = self.unmarked if scheme else self.trusted
        for folder in self.folders:
            if (folder / name).is_dir():
                model = folder / name
            elif folder.name == name:  # URI of the package or model itself
                model = folder
            else:
                continue
            root = _resolved(model)
            is_allowed = any(root.is_relative_to(f) for f in unmarked) or any(
                (model / mark).is_file() for mark in marks
            )
            yield Candidate(model / file, root, is_allowed)

    def _downloads(self, uri: str) -> Iterator[Candidate]:
        """Yield the paths of a model of Fuel, or of its file: in the caches, then by its name."""
        parts = [unquote(part) for part in urlsplit(uri.strip()).path.split("/") if part]
        if len(parts) < 4 or parts[2].lower() != "models" or ".." in parts:
            return
        _, owner, _, name, *options = parts
        version = options[0] if options and options[0] != "files" else ""
        file = "/".join(options[options.index("files") + 1 :]) if "files" in options else ""
        for cache in self.caches:
            for host in _existing_folders(cache, "*"):
                folders = [host]
                for part in (owner, "models", name):
                    folders = [f for g in folders for f in _existing_folders(g, part)]
                for model in folders:
                    versions = sorted(_existing_folders(model, "*"), key=lambda f: natural(f.name))
                    chosen = [f for f in versions if f.name == version] or versions[-1:]
                    yield from (Candidate(folder / file, _resolved(folder)) for folder in chosen)
        yield from self._in_folders(f"{name}/{file}", "model")


def short_name(uri: str) -> str:
    """Return the name of a model for messages: without the scheme, of Fuel with its owner."""
    name = printable(unquote(uri.strip()))
    parts = [part for part in name.split("/") if part]
    if name.startswith(("http://", "https://")) and len(parts) >= 6:
        return f"{parts[3]}/{parts[5]}"
    return name.removeprefix("model://")


def _folders_of(variables: tuple[str, ...]) -> list[Path]:
    """Return the folders that variables of the environment name, if they exist."""
    values = (os.environ.get(variable, "") for variable in variables)
    return _existing([folder for value in values for folder in value.split(os.pathsep) if folder])


def _existing(names: list[str] | tuple[str, ...]) -> list[Path]:
    """Return the folders that exist among names."""
    folders = [Path(os.path.expanduser(name)) for name in names]  # noqa: PTH111 - never fails
    return [folder for folder in folders if folder.is_dir()]


def _existing_folders(parent: Path, name: str) -> list[Path]:
    """Return the folders in a folder with a name, in upper or lower case, or with any name."""
    try:
        folders = [entry for entry in parent.iterdir() if entry.is_dir()]
    except OSError:
        return []
    return [f for f in folders if name in ("*", f.name) or f.name.lower() == name.lower()]


def _resolved(path: Path) -> Path:
    """Return a path without links."""
    return path.resolve()


def _newest_file(folder: Path) -> Path:
    """Return the file of the newest version that is known, by a model's configuration.

    Raises
    ------
    MissingFileError
        If the folder has no model.
    """
    for name in _CONFIGS:
        if (folder / name).is_file():
            files = _configured_files(folder / name)
            for version in sorted(files, reverse=True):
                file = folder / files[version]
                if version <= _SDF_VERSION and file.parent == folder and file.is_file():
                    return file
    if (folder / _MODEL).is_file():
        return folder / _MODEL
    raise ResourceNotFoundError(printable(folder.name))


def _configured_files(path: Path) -> dict[tuple[int, ...], str]:
    """Return the files that a configuration names: {version: name}."""
    try:
        root = parse_lenient_xml(read_input(path))
    except (OSError, ValueError, LidarError):
        return {}
    return {_version(entry): (entry.text or "").strip() for entry in root.iter("sdf")}


def _version(entry: Element) -> tuple[int, ...]:
    """Return the version of an <sdf>, such as (1, 6), or (0,) without a version."""
    parts = entry.get("version", "").split(".")
    return tuple(map(int, parts)) if all(part.isdecimal() for part in parts) else (0,)
