"""Formats of mesh files: a row for each format, which is found by the ending of a file.

A row names its reader, and the reader's module is imported when the first file of the format is
read. Rows of further packages are found by the name of their table (`_TABLES`), so that nothing
here imports these packages. Endings that no table has are looked up among plug-ins of the group
`GROUP`, whose names are endings.
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
from ...errors import LidarError, prefixed
from ...schema.checks import check_fields
from ...words import did_you_mean, joined
from .mesh_options import MeshOptions
from .scene_graph import Content, ReadOptions

GROUP = "lidarsim.meshes"

_SHARED = tuple(entry.name for entry in fields(MeshOptions))

# Reader of the content of a file, with its path and options. It raises `MeshFileError` for
# content that it does not support, and any other error for a broken file.
MeshReader = Callable[[bytes, Path, ReadOptions], Content]


@dataclass(frozen=True)
class MeshFormat:
    """A format of mesh files: how its files are recognized and read.

    Parameters
    ----------
    endings
        Endings of its files, with a dot and in lower case.
    read
        The reader, or its name, "module:function"; None for a format that is not read.
    advice
        Advice on files of a format that is not read, as a clause; empty if the format is read.
    animated
        Whether the reader can bake an animation, `ReadOptions.animation`.
    unitless
        Whether files state no unit, nor does the format.
    signatures
        Bytes at the start of files. The error of a file with such a start and another ending
        advises to use one of these endings.
    from_path
        Whether the reader opens the path itself: it gets the first bytes of the file only.
    options
        Dataclass of the options that the format alone has, or its name, "module:Class"; None for
        a format without such options. The reader gets an instance, `ReadOptions.own`. Options
        have defaults; None means that an option is not given. Scenarios have the options that are
        described by `about`; others are arguments in Python only.
    plugin
        The plug-in that provides the row; filled in when the plug-in is loaded.
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
        """Function that reads a file, imported if given by its name.

        LidarError if the reader of a plug-in cannot be imported.
        """
        assert self.read is not None, "of a format that is read"
        if not isinstance(self.read, str):
            return self.read
        reader: MeshReader = self._named(self.read, Callable)
        return reader

    @property
    def own_options(self) -> type | None:
        """Dataclass of the options of the format, imported if given by its name.

        LidarError if the dataclass of a plug-in cannot be imported or used.
        """
        options = self.options
        if isinstance(options, str):
            options = self._named(options, type)
        if options is not None and self.plugin is not None and (flaw := _flaw(options)):
            raise LidarError(
                f"{self.plugin} has options that {flaw}. Install a different version of "
                f"{self.plugin.distribution}."
            )
        return options

    def _named(self, name: str, kind: Any) -> Any:
        """Return an object by its name, "module:object", for a plug-in of a kind."""
        if self.plugin is not None:
            return replace(self.plugin, value=name).load(kind)
        module, _, attribute = name.partition(":")
        return getattr(import_module(module), attribute)


def _flaw(options: type) -> str:
    """Return why a class cannot be the options of a format, as a clause, empty if it can."""
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

# The modules of the readers say why no library is used.
_READ = (
    MeshFormat((".glb",), _GLTF, animated=True, signatures=(b"glTF",)),
    MeshFormat((".gltf",), _GLTF, animated=True),
    MeshFormat((".obj",), f"{_POLYGONS}:read_obj", unitless=True),
    MeshFormat((".stl",), f"{_POLYGONS}:read_stl", unitless=True, signatures=(b"solid ",)),
    MeshFormat((".ply",), f"{_POLYGONS}:read_ply_mesh", unitless=True, signatures=(b"ply",)),
    MeshFormat((".off",), f"{_POLYGONS}:read_off", unitless=True, signatures=(b"OFF",)),
)

# Tables of further packages, each a tuple `MESH_FORMATS`. A package need not be installed.
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
    """Yield the formats of the tables: formats that are read, then formats with advice only."""
    yield from _formats_read()
    yield from _NOT_READ


def _formats_read() -> Iterator[MeshFormat]:
    """Yield the formats of this package and of the packages of `_TABLES`."""
    yield from _READ
    for name in _TABLES:
        yield from _table(name) or ()


def _table(name: str) -> tuple[MeshFormat, ...] | None:
    """Return the formats of a further package, or None if the package is not installed."""
    try:
        formats: tuple[MeshFormat, ...] = import_module(name).MESH_FORMATS
    except ModuleNotFoundError as error:
        if error.name is None or not f"{name}.".startswith(f"{error.name}."):
            raise  # the package is installed, and another one is missing
        return None
    return formats


def missing_packages() -> list[str]:
    """Return the names of packages that would read further formats and are not installed."""
    return [name.partition(".")[0] for name in _TABLES if _table(name) is None]


def format_of(path: str | Path) -> MeshFormat | None:
    """Return the format of a file by its ending, also a format with advice only, or None.

    Raises
    ------
    LidarError
        If two plug-ins have the ending, or the plug-in cannot be used.
    """
    ending = Path(path).suffix.lower()
    row = _row(ending, _formats_read())
    if row is not None:
        return row
    plugin = _plugin_of_ending(ending)
    return _row(ending, iter(_NOT_READ)) if plugin is None else _row_of_plugin(plugin)


def _row(ending: str, rows: Iterator[MeshFormat]) -> MeshFormat | None:
    """Return the first format with an ending, or None."""
    return next((row for row in rows if ending in row.endings), None)


def plugin_of(path: str | Path) -> Plugin | None:
    """Return the plug-in that reads files with the ending of a path, or None."""
    ending = Path(path).suffix.lower()
    return None if _row(ending, _formats_read()) else _plugin_of_ending(ending)


def _plugin_of_ending(ending: str) -> Plugin | None:
    """Return the plug-in of an ending, or None."""
    return _installed_plugin(ending, tuple(sys.path)) if ending else None


@cache
def _installed_plugin(ending: str, folders: tuple[str, ...]) -> Plugin | None:
    """Return the plug-in of an ending among the distributions in `folders`, which is `sys.path`."""
    return find_plugin(GROUP, ending)


def _row_of_plugin(plugin: Plugin) -> MeshFormat:
    """Return the format of a plug-in.

    Raises LidarError for a plug-in that cannot be used.
    """
    row = plugin.load(MeshFormat)
    if row.read is None:
        raise plugin.lacks("read")
    if plugin.name not in row.endings:
        raise LidarError(
            f"{plugin} is a MeshFormat for {' '.join(row.endings)}. Name the plug-in after one of "
            "these extensions."
        )
    return replace(row, plugin=plugin)


def plugin_endings() -> tuple[str, ...]:
    """Return the endings that plug-ins read."""
    return tuple(plugins_of(GROUP))


def options_of(row: MeshFormat, path: Path, given: Mapping[str, Any]) -> tuple[MeshOptions, Any]:
    """Return the options for reading a file: the shared options, and the options of its format.

    Parameters
    ----------
    row
        The format of the file.
    path
        The file, for the error.
    given
        {name of an option: value}; None for an option that is left out.

    Returns
    -------
    The shared options, and an instance of the dataclass of the format, or None if the format has
    no further options.

    Raises
    ------
    LidarError
        If the format lacks an option, with the formats that have it, or a value is refused.
    """
    values = {name: value for name, value in given.items() if value is not None}
    if problem := lacking(row, values):
        raise LidarError(f"{path} {problem}")
    own_values = {name: value for name, value in values.items() if name not in _SHARED}
    shared_values = {name: value for name, value in values.items() if name in _SHARED}
    kind = row.own_options
    shared = MeshOptions(**shared_values)
    own = None if kind is None else kind(**own_values)
    with prefixed(path):
        check_fields(shared)
        if own is not None:
            check_fields(own)
    return shared, own


def lacking(row: MeshFormat | None, options: Iterable[str]) -> str:
    """Return a clause on options that a file does not have by its format, empty if it has all.

    The clause follows the name of the file, and names the formats that have the options.
    """
    names = option_names(row)
    lacks = [name for name in options if name not in names]
    if not lacks:
        return ""
    groups: dict[str, list[str]] = {}  # {endings of formats that have them: options}
    for name in lacks:
        groups.setdefault(" ".join(_endings_with(name)), []).append(name)
    parts = []
    for having, group in groups.items():
        kind = "options" if group[1:] else "an option"
        parts.append(joined(group) + (f" ({kind} of {having})" if having else ""))
    hint = did_you_mean(groups[""][0], names) if "" in groups else ""
    return f"does not support {', '.join(parts)}. Remove {joined(lacks)}.{hint}"


def option_names(row: MeshFormat | None) -> tuple[str, ...]:
    """Return the names of all options of a format, shared and own, or the shared ones for None."""
    if row is None:
        return _SHARED
    shared = _SHARED if row.animated else tuple(name for name in _SHARED if name != "animation")
    kind = row.own_options
    return shared if kind is None else (*shared, *(entry.name for entry in fields(kind)))


def _endings_with(option: str) -> list[str]:
    """Return the endings of the formats, plug-ins included, that have an option."""
    return [
        ending
        for row in formats_with_plugins()
        if option in option_names(row)
        for ending in row.endings
    ]


def formats_with_plugins() -> Iterator[MeshFormat]:
    """Yield the formats that are read, with the formats of plug-ins that can be used."""
    yield from _formats_read()
    for plugins in plugins_of(GROUP).values():
        for plugin in plugins:
            with suppress(LidarError):
                row = _row_of_plugin(plugin)
                row.own_options  # noqa: B018 - raises LidarError if they cannot be used
                yield row


def advice_on(path: str | Path) -> str:
    """Return the advice on a file of a format that is not read, empty for formats that are."""
    row = format_of(path)
    return "" if row is None else row.advice


def endings(
    condition: Callable[[MeshFormat], bool] = lambda row: not row.advice,
) -> tuple[str, ...]:
    """Return the endings of the known formats that fulfill a condition, by default formats read.

    Examples
    --------
    >>> endings(lambda row: row.unitless)
    ('.obj', '.stl', '.ply', '.off')
    """
    return tuple(chain.from_iterable(row.endings for row in known_formats() if condition(row)))


def endings_for(data: bytes) -> tuple[str, ...]:
    """Return the endings of the known formats whose files have the same start as `data`."""
    return endings(lambda row: data.startswith(row.signatures))
