"""Registry of mesh file formats, keyed by file extension.

The module of a reader is imported when the first file in its format is read. Formats of other
packages are found through the tables in `_TABLES`, so that this module does not import these
packages. Other extensions are looked up among the plug-ins in the entry point group `GROUP`, whose
names are extensions.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, replace
from functools import cache
from importlib import import_module
from itertools import chain
from pathlib import Path
from typing import Any

from ...environment.plugins import Plugin, find_plugin, plugins_of
from ...errors import LidarError, prefix_errors
from ...schema.checks import check_fields
from ...words import did_you_mean, join_names
from .mesh_options import MeshOptions
from .scene_graph import Content, ReadOptions

GROUP = "lidarsim.meshes"

_SHARED = tuple(entry.name for entry in fields(MeshOptions))

# Function that reads a file from its content, path and options. It raises `MeshFileError` if it
# does not support the content, and any other error if the file is invalid.
MeshReader = Callable[[bytes, Path, ReadOptions], Content]


@dataclass(frozen=True)
class MeshFormat:
    """A mesh file format with its reader and options.

    Parameters
    ----------
    endings
        File extensions in lower case, including the dot.
    read
        The reader, or its name as "module:function", or None if the format cannot be read.
    advice
        Advice for users if the format cannot be read, as a clause. Otherwise, an empty string.
    animated
        Whether the reader can bake an animation (`ReadOptions.animation`).
    unitless
        Whether neither the file nor the format specifies a unit.
    signatures
        Bytes at the start of files. If a file has the signature but a different extension, the
        error message suggests one of these extensions.
    from_path
        Whether the reader opens the path itself. In this case, only the first bytes of the file are
        passed to it.
    options
        Dataclass with format-specific options, or its name as "module:Class", or None if there are
        no such options. An instance is passed to the reader as `ReadOptions.own`. All options
        require defaults, and None means that an option is not set. Options that are annotated with
        `about` are available in scenarios. Other options are available only in Python.
    plugin
        The plug-in that provides the format. It is set when the plug-in is loaded.
    """

    endings: tuple[str, ...]
    read: MeshReader | str | None = None
    advice: str = ""
    animated: bool = False
    unitless: bool = False
    signatures: tuple[bytes, ...] = ()
    from_path: bool = False
    options: type | str | None = None
    plugin: Plugin | None = field(default=None, compare=False)

    @property
    def reader(self) -> MeshReader:
        """Reader function, which is imported if it is specified by name.

        Raises
        ------
        LidarError
            If the reader of a plug-in cannot be imported.
        """
        assert self.read is not None, "of a format that is read"
        if not isinstance(self.read, str):
            return self.read
        reader: MeshReader = self._import_object(self.read, Callable)
        return reader

    @property
    def own_options(self) -> type | None:
        """Dataclass with format-specific options, which is imported if it is specified by name.

        Raises
        ------
        LidarError
            If the dataclass of a plug-in cannot be imported or used.
        """
        options = self.options
        if isinstance(options, str):
            options = self._import_object(options, type)
        if options is not None and self.plugin is not None and (flaw := _options_problem(options)):
            raise LidarError(
                f"{self.plugin} has options that {flaw}. Install a different version of "
                f"{self.plugin.distribution}."
            )
        return options

    def _import_object(self, name: str, kind: Any) -> Any:
        """Import an object by its name, "module:object".

        If the format belongs to a plug-in, the type of the object is checked.
        """
        if self.plugin is not None:
            return replace(self.plugin, value=name).load(kind)
        module, _, attribute = name.partition(":")
        return getattr(import_module(module), attribute)


def _options_problem(options: type) -> str:
    """Explain why a class cannot define format-specific options.

    The result is an empty string if the class is suitable.
    """
    if not is_dataclass(options):
        return "are not a dataclass"
    for entry in fields(options):
        if entry.default is MISSING:
            return f"have no default for {entry.name}"
        if entry.name in _SHARED:
            return f"redefine {entry.name}, an option of all formats"
    return ""


_GLTF = "lidarsim.scene.files.gltf:read_gltf"
_POLYGONS = "lidarsim.scene.files.polygon_files"

# The modules of the readers explain why they do not use a library.
_READ = (
    MeshFormat((".glb",), _GLTF, animated=True, signatures=(b"glTF",)),
    MeshFormat((".gltf",), _GLTF, animated=True),
    MeshFormat((".obj",), f"{_POLYGONS}:read_obj", unitless=True),
    MeshFormat((".stl",), f"{_POLYGONS}:read_stl", unitless=True, signatures=(b"solid ",)),
    MeshFormat((".ply",), f"{_POLYGONS}:read_ply_mesh", unitless=True, signatures=(b"ply",)),
    MeshFormat((".off",), f"{_POLYGONS}:read_off", unitless=True, signatures=(b"OFF",)),
)

# Modules of other packages that define a tuple `MESH_FORMATS`. The packages are optional.
_TABLES = ("lidarscenes.files.formats",)

_POINTS = "convert it to a mesh with lidarpool scene points"

_NOT_READ = (
    MeshFormat(
        (".fbx", ".blend", ".3ds", ".x3d", ".wrl", ".dxf", ".abc"),
        advice="export it as .glb, for example from Blender",
    ),
    MeshFormat(
        (".las", ".laz", ".pcd", ".xyz", ".e57", ".pts", ".ptx", ".npy", ".bin"), advice=_POINTS
    ),
    MeshFormat((".csv", ".txt"), advice=f"if it is a point cloud, {_POINTS}"),
    MeshFormat(
        (".pcap", ".pcapng", ".mcap", ".bag", ".db3", ".osf"),
        advice="it is a recording. Write its points to a .ply, .pcd or .las file, and convert this "
        "file to a mesh with lidarpool scene points",
    ),
    MeshFormat(
        (".step", ".stp", ".iges", ".igs", ".brep", ".fcstd"),
        advice="it is a CAD model. Export it as a mesh, for example as .stl or .glb from FreeCAD",
    ),
    MeshFormat(
        (".dwg", ".skp"),
        advice="export it as .dae, .obj or .glb from the program that wrote it",
    ),
    MeshFormat(
        (".gml",),
        advice="it is a city model. Convert it to CityJSON with citygml-tools to-cityjson IN.gml",
    ),
    MeshFormat(
        (".osm",),
        advice="it is a map. Create a mesh of its buildings, for example with Blosm in Blender",
    ),
    MeshFormat((".mjcf",), advice="MuJoCo models must have the extension .xml. Rename the file"),
)


def known_formats() -> Iterator[MeshFormat]:
    """Yield all formats in the tables.

    Formats that cannot be read come last.
    """
    yield from _formats_read()
    yield from _NOT_READ


def _formats_read() -> Iterator[MeshFormat]:
    """Yield the formats of this package and of the packages in `_TABLES`."""
    yield from _READ
    for name in _TABLES:
        yield from _table(name) or ()


def _table(name: str) -> tuple[MeshFormat, ...] | None:
    """Return the formats of another package, or None if the package is not installed."""
    try:
        formats: tuple[MeshFormat, ...] = import_module(name).MESH_FORMATS
    except ModuleNotFoundError as error:
        if error.name is None or not f"{name}.".startswith(f"{error.name}."):
            raise  # the package is installed, but one of its dependencies is missing
        return None
    return formats


def missing_packages() -> list[str]:
    """Return the packages that would provide additional formats but are not installed."""
    return [name.partition(".")[0] for name in _TABLES if _table(name) is None]


def format_of(path: str | Path) -> MeshFormat | None:
    """Return the format of a file according to its extension, or None if it is unknown.

    The format can be one that lidarpool cannot read and for which it only gives advice.

    Raises
    ------
    LidarError
        If several plug-ins provide the extension, or if the plug-in cannot be used.
    """
    ending = Path(path).suffix.lower()
    row = _first_with_ending(ending, _formats_read())
    if row is not None:
        return row
    plugin = _plugin_of_ending(ending)
    return _first_with_ending(ending, iter(_NOT_READ)) if plugin is None else _row_of_plugin(plugin)


def _first_with_ending(ending: str, rows: Iterator[MeshFormat]) -> MeshFormat | None:
    return next((row for row in rows if ending in row.endings), None)


def plugin_of(path: str | Path) -> Plugin | None:
    """Return the plug-in for the extension of a path, or None."""
    ending = Path(path).suffix.lower()
    return None if _first_with_ending(ending, _formats_read()) else _plugin_of_ending(ending)


def _plugin_of_ending(ending: str) -> Plugin | None:
    return _installed_plugin(ending, tuple(sys.path)) if ending else None


@cache
def _installed_plugin(ending: str, folders: tuple[str, ...]) -> Plugin | None:
    """Return the plug-in for an extension.

    `folders` is `sys.path`, which is part of the cache key because it determines the installed
    distributions.
    """
    return find_plugin(GROUP, ending)


def _row_of_plugin(plugin: Plugin) -> MeshFormat:
    """Load the format of a plug-in, or raise LidarError if the plug-in cannot be used."""
    row = plugin.load(MeshFormat)
    if row.read is None:
        raise plugin.missing_field_error("read")
    if plugin.name not in row.endings:
        raise LidarError(
            f"{plugin} is a MeshFormat for {' '.join(row.endings)}. Name the plug-in after one of "
            "these extensions."
        )
    return replace(row, plugin=plugin)


def plugin_endings() -> tuple[str, ...]:
    """Return the file extensions for which there are plug-ins."""
    return tuple(plugins_of(GROUP))


def split_options(row: MeshFormat, path: Path, given: Mapping[str, Any]) -> tuple[MeshOptions, Any]:
    """Validate options, and split them into shared and format-specific options.

    Parameters
    ----------
    row
        The format of the file.
    path
        The file, which is named in error messages.
    given
        Option values by name. None means that an option is not set.

    Returns
    -------
    tuple[MeshOptions, Any]
        The shared options, and an instance of the options dataclass of the format. The latter is
        None if the format has no specific options.

    Raises
    ------
    LidarError
        If the format does not support an option, or if a value is invalid.
    """
    values = {name: value for name, value in given.items() if value is not None}
    if problem := unsupported_options(row, values):
        raise LidarError(f"{path} {problem}")
    own_values = {name: value for name, value in values.items() if name not in _SHARED}
    shared_values = {name: value for name, value in values.items() if name in _SHARED}
    kind = row.own_options
    shared = MeshOptions(**shared_values)
    own = None if kind is None else kind(**own_values)
    with prefix_errors(path):
        check_fields(shared)
        if own is not None:
            check_fields(own)
    return shared, own


def unsupported_options(row: MeshFormat | None, options: Iterable[str]) -> str:
    """Return an error message about unsupported options, or an empty string.

    The message is a clause that follows the name of the file. It lists the formats that support the
    options.
    """
    names = option_names(row)
    lacks = [name for name in options if name not in names]
    if not lacks:
        return ""
    groups: dict[str, list[str]] = {}  # {extensions of formats with these options: options}
    for name in lacks:
        groups.setdefault(" ".join(_endings_with(name)), []).append(name)
    parts = []
    for having, group in groups.items():
        kind = "options" if group[1:] else "an option"
        parts.append(join_names(group) + (f" ({kind} of {having})" if having else ""))
    hint = did_you_mean(groups[""][0], names) if "" in groups else ""
    return f"does not support {', '.join(parts)}. Remove {join_names(lacks)}.{hint}"


def option_names(row: MeshFormat | None) -> tuple[str, ...]:
    """Return the names of all options that a format supports.

    Without a format, only the shared options are returned.
    """
    if row is None:
        return _SHARED
    shared = _SHARED if row.animated else tuple(name for name in _SHARED if name != "animation")
    kind = row.own_options
    return shared if kind is None else (*shared, *(entry.name for entry in fields(kind)))


def _endings_with(option: str) -> list[str]:
    """Return the extensions of all formats that support an option, including plug-ins."""
    return [
        ending
        for row in formats_with_plugins()
        if option in option_names(row)
        for ending in row.endings
    ]


def formats_with_plugins() -> Iterator[MeshFormat]:
    """Yield all formats that can be read, including those of usable plug-ins."""
    yield from _formats_read()
    for plugins in plugins_of(GROUP).values():
        for plugin in plugins:
            with suppress(LidarError):
                row = _row_of_plugin(plugin)
                row.own_options  # noqa: B018 - raises LidarError if they cannot be used
                yield row


def advice_on(path: str | Path) -> str:
    """Return the advice for a format that cannot be read, or an empty string for other formats."""
    row = format_of(path)
    return "" if row is None else row.advice


def endings(
    condition: Callable[[MeshFormat], bool] = lambda row: not row.advice,
) -> tuple[str, ...]:
    """Return the extensions of known formats that satisfy a condition.

    By default, these are the formats that can be read.

    Examples
    --------
    >>> endings(lambda row: row.unitless)
    ('.obj', '.stl', '.ply', '.off')
    """
    return tuple(chain.from_iterable(row.endings for row in known_formats() if condition(row)))


def endings_for(data: bytes) -> tuple[str, ...]:
    """Return the extensions of known formats whose signature matches the start of `data`."""
    return endings(lambda row: data.startswith(row.signatures))
