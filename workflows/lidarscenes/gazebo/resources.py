"""Find the model, mesh, and image files to which Gazebo worlds refer by URI."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple
from urllib.parse import unquote, urlsplit
from xml.etree.ElementTree import Element

from lidarsim.errors import LidarError
from lidarsim.io.input_files import read_input
from lidarsim.io.named_files import is_inside
from lidarsim.words import natural_sort_key, printable

from ..files.lenient_xml import parse_lenient_xml

# Environment variables with folders of models: first Gazebo Sim, then Gazebo classic.
FOLDER_VARIABLES = (
    "GZ_SIM_RESOURCE_PATH",
    "IGN_GAZEBO_RESOURCE_PATH",
    "SDF_PATH",
    "GAZEBO_MODEL_PATH",
    "GAZEBO_RESOURCE_PATH",
)
CACHE_VARIABLES = ("GZ_FUEL_CACHE_PATH", "IGN_FUEL_CACHE_PATH")
CACHES = ("~/.gz/fuel", "~/.ignition/fuel")
_MODELS = "~/.gazebo/models"  # model folder of Gazebo classic
_MAX_FOLDERS_UP = 5  # folders above a world that are searched for models
_PACKAGE = "package.xml"  # file in the folder of a ROS package
_CONFIGS = ("model.config", "manifest.xml")
_MODEL = "model.sdf"  # file of a model without a configuration
_WORLD_FOLDERS = ("worlds", "world")
_SDF_VERSION = (1, 12)  # newest supported version


class ResourceNotFoundError(Exception):
    """Raised if no folder contains a file or model.

    The argument of the error is the name to report.
    """


class Candidate(NamedTuple):
    """A path to which a URI may refer, and the folder that must contain this path.

    If `is_allowed` is False, the path must not be read, because its folder is merely near the
    world, and contains no file that identifies it as a model or package.
    """

    path: Path
    root: Path
    is_allowed: bool = True


class Source(NamedTuple):
    """An SDFormat file, and the folder that must contain files with relative names."""

    path: Path
    root: Path


@dataclass(frozen=True)
class Resources:
    """Finds the files to which a world refers.

    Attributes
    ----------
    world
        The world, and the folder that must contain its files. This is the folder with a package.xml
        that contains the world, at most five levels up. Otherwise, it is the parent of a folder
        called ``worlds``, or the folder of the world.
    folders
        Folders that are searched for models by name, in order. Above the folder of the world, a
        folder is a model only if it contains a model.config or, for ``package://``, a package.xml.
    trusted
        Resolved folders whose files may be referred to from anywhere.
    unmarked
        Resolved folders in which every folder is a model: those that the user names, the folder of
        the world, and the world's package if it has a package.xml.
    caches
        Folders with downloads from Fuel.
    """

    world: Source
    folders: tuple[Path, ...]
    trusted: tuple[Path, ...]
    unmarked: tuple[Path, ...]
    caches: tuple[Path, ...]

    @classmethod
    def for_world(cls, path: Path, assets: tuple[Path, ...]) -> Resources:
        """Determine the folders in which the files of a world are searched for.

        The folders in `assets` are searched first.
        """
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

    def find_model(self, uri: str, source: Source) -> Source:
        """Return a model's SDFormat file, in the newest version that its model.config lists.

        Raises
        ------
        ResourceNotFoundError
            If no folder contains the model.
        LidarError
            If the model must not be read.
        """
        for target in self._targets(uri, source):
            if target.path.is_dir():
                return Source(_newest_file(target.path), _resolved(target.path))
            if target.path.is_file():
                return Source(target.path, target.root)
        raise ResourceNotFoundError(short_name(uri))

    def find_file(self, uri: str, source: Source) -> Source:
        """Return the path of a mesh or image file.

        Raises ResourceNotFoundError and LidarError as `find_model` does.
        """
        for target in self._targets(uri, source):
            if target.path.is_file():
                return target
        raise ResourceNotFoundError(printable(uri))

    def _targets(self, uri: str, source: Source) -> Iterator[Source]:
        """Yield the existing paths to which a URI may refer.

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
        """Yield all paths to which a URI may refer."""
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
        """Yield the path NAME/FILE in each folder."""
        name, _, file = location.lstrip("/").partition("/")
        file = file.lstrip("/")  # otherwise, it would be an absolute path
        if name in ("", ".", ".."):
            return
        marks = (_CONFIGS[0], _PACKAGE) if scheme == "package" else _CONFIGS[:1]
        # A path below the world's folder may be written without a scheme as well.
        unmarked = self.unmarked if scheme else self.trusted
        for folder in self.folders:
            if (folder / name).is_dir():
                model = folder / name
            elif folder.name == name:  # the URI refers to the folder itself
                model = folder
            else:
                continue
            root = _resolved(model)
            is_allowed = any(root.is_relative_to(f) for f in unmarked) or any(
                (model / mark).is_file() for mark in marks
            )
            yield Candidate(model / file, root, is_allowed)

    def _downloads(self, uri: str) -> Iterator[Candidate]:
        """Yield possible paths of a Fuel model or its file, first in caches, then elsewhere."""
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
                    versions = sorted(
                        _existing_folders(model, "*"), key=lambda f: natural_sort_key(f.name)
                    )
                    chosen = [f for f in versions if f.name == version] or versions[-1:]
                    yield from (Candidate(folder / file, _resolved(folder)) for folder in chosen)
        yield from self._in_folders(f"{name}/{file}", "model")


def short_name(uri: str) -> str:
    """Return a short model name for messages, which is OWNER/NAME for models on Fuel."""
    name = printable(unquote(uri.strip()))
    parts = [part for part in name.split("/") if part]
    if name.startswith(("http://", "https://")) and len(parts) >= 6:
        return f"{parts[3]}/{parts[5]}"
    return name.removeprefix("model://")


def _folders_of(variables: tuple[str, ...]) -> list[Path]:
    """Return the existing folders that are listed in environment variables."""
    values = (os.environ.get(variable, "") for variable in variables)
    return _existing([folder for value in values for folder in value.split(os.pathsep) if folder])


def _existing(names: list[str] | tuple[str, ...]) -> list[Path]:
    """Return only those folders that exist."""
    folders = [Path(os.path.expanduser(name)) for name in names]  # noqa: PTH111 - never fails
    return [folder for folder in folders if folder.is_dir()]


def _existing_folders(parent: Path, name: str) -> list[Path]:
    """Return the subfolders that have a name, ignoring case, or all of them for ``*``."""
    try:
        folders = [entry for entry in parent.iterdir() if entry.is_dir()]
    except OSError:
        return []
    return [f for f in folders if name in ("*", f.name) or f.name.lower() == name.lower()]


def _resolved(path: Path) -> Path:
    return path.resolve()


def _newest_file(folder: Path) -> Path:
    """Return the newest supported SDFormat file listed in a model's configuration.

    Raises
    ------
    ResourceNotFoundError
        If the folder is not a model.
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
    """Return the file name for each SDFormat version in a model's configuration."""
    try:
        root = parse_lenient_xml(read_input(path))
    except (OSError, ValueError, LidarError):
        return {}
    return {_version(entry): (entry.text or "").strip() for entry in root.iter("sdf")}


def _version(entry: Element) -> tuple[int, ...]:
    """Return an <sdf> element's version, for example (1, 6), or (0,) if it has none."""
    parts = entry.get("version", "").split(".")
    return tuple(map(int, parts)) if all(part.isdecimal() for part in parts) else (0,)
