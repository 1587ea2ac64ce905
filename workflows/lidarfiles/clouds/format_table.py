"""Find cloud formats by their names and files, among the built-in formats and plug-ins.

The module is fast to import because the command line uses it for help and completion. Other
distributions add formats through entry points in the group `GROUP`, which are named after the
format.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from lidarsim.environment.plugins import Plugin, PluginTable, plugins_of
from lidarsim.errors import LidarError

from .built_in_formats import DATA_SETS, FORMATS, READ_ONLY
from .format_row import FormatRow

if TYPE_CHECKING:  # NumPy
    from .cloud_format import CloudFormat

GROUP = "lidarpool.clouds"


def data_set_title(data_set: str) -> str:
    """Return the proper name of a data set format, for example KITTI."""
    return load_format(DATA_SETS[data_set]).title if data_set in DATA_SETS else data_set


def _row_of_plugin(plugin: Plugin) -> FormatRow:
    """Return the row of a plug-in.

    Raises LidarError for a plug-in that cannot be used.
    """
    from .cloud_format import CloudFormat

    cloud_format = plugin.load(type)
    if not issubclass(cloud_format, CloudFormat):
        raise plugin.missing_field_error("a subclass of lidarpool.plugins.CloudFormat")
    row = cloud_format.row
    if "/" in row.file or row.file in _FILES:
        raise LidarError(
            f"{plugin} writes {row.file!r}, which contains a parent folder or is used by another "
            "format. Set `file` to a unique file or folder name."
        )
    if row.file and (missing := sorted(cloud_format.__abstractmethods__)):
        raise plugin.missing_field_error(
            f"{cloud_format.__module__}.{cloud_format.__name__}.{missing[0]}"
        )
    return replace(row, plugin=plugin)


_FILES = [row.file for row in FORMATS.values()]
_TABLE = PluginTable(GROUP, "cloud format", FORMATS, _row_of_plugin)


def format_row(name: str) -> FormatRow:
    """Return the row of a writable format from the table or a plug-in.

    Raises
    ------
    LidarError
        If the format is unknown or can only be read, or if its plug-in cannot be used.
    """
    row = _TABLE[name]
    if not row.file:
        raise LidarError(
            f"The format {name!r} can be read, but not written. Write another format, such as ply."
        )
    return row


def load_format(name: str) -> type[CloudFormat]:
    """Import the class of a writable format, without checking whether its packages are installed.

    Raises LidarError like `format_row`.
    """
    return format_row(name).load()


def _all_rows() -> Iterator[FormatRow]:
    """Yield the rows of the table, followed by the rows of usable plug-ins."""
    yield from (*FORMATS.values(), READ_ONLY)
    for name in plugins_of(GROUP):
        with suppress(LidarError):
            yield _TABLE[name]


def format_of_path(path: Path, name: str) -> type[CloudFormat] | None:
    """Return the format that opens a file or folder as a recording, or None if there is none.

    `name` is the name of the file in messages.

    Raises
    ------
    LidarError
        If a package that is required to read the file is not installed.
    """
    suffix = path.suffix.lower()
    is_folder = path.is_dir()
    for row in _all_rows():
        if is_folder:
            opens = any(any(path.glob(pattern)) for pattern in row.folders)
        else:
            opens = suffix in row.suffixes
        if opens:
            return row.load(name)
    return None


def point_suffixes() -> tuple[str, ...]:
    """Return the extensions of files from which scenes can be created."""
    rows = [row for row in _all_rows() if row.suffixes and row.load().for_scenes]
    return tuple(suffix for row in rows for suffix in row.suffixes)


def formats_of_endings() -> dict[str, str]:
    """Return the formats that write a file, by the extension of the file.

    Extensions of other files that can be read have an empty string.
    """
    formats = {suffix: "" for row in _all_rows() for suffix in row.suffixes}
    for name, row in FORMATS.items():
        if suffix := Path(row.file).suffix:
            formats[suffix] = name
    return formats


def plugin_formats(files: Collection[str]) -> list[str]:
    """Return plug-in formats whose file or folder is in `files`.

    Plug-ins that cannot be used are skipped.
    """
    names: list[str] = []
    for name in plugins_of(GROUP) if files else ():
        with suppress(LidarError):
            names += [name] if format_row(name).file in files else []
    return names


def check_all_returns(columns: Iterable[str], keep_every: int) -> None:
    """Raise LidarError if `keep_every` discards returns although the column `ray` is required."""
    if "ray" in columns and keep_every > 1:
        raise LidarError(
            "Range images and organized clouds require all returns, but `keep_every` is "
            f"{keep_every}. Set `cloud.keep_every: 1`."
        )
