"""Shell completion of option values and arguments.

Values come from tables that are quick to import. Plug-ins are only looked up for words that no
table completes, because the lookup takes about half the time of a completion.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress

import click
from click.shell_completion import CompletionItem

from lidarfiles.clouds.built_in_formats import EXPORTS
from lidarfiles.clouds.format_table import GROUP
from lidarlive.playback.bridge_table import BRIDGES
from lidarlive.viewers.viewer_table import PAGE, VIEWERS
from lidarsim.errors import LidarError
from lidarsim.schema.vocabulary import (
    ALWAYS_COLUMNS,
    COMPOSED_COLUMNS,
    INSERTIONS,
    OPTIONAL_COLUMNS,
)
from lidarsim.sensor_files.format_table import FORMATS

Items = list[CompletionItem]


def starting_with(incomplete: str, names: Iterable[str]) -> Items:
    """Return completion items for all names that start with the incomplete word."""
    return [CompletionItem(name) for name in names if name.startswith(incomplete)]


def sensors(ctx: click.Context, param: click.Parameter, incomplete: str) -> Items:
    """Complete a file name or the name of a sensor model, with or without its manufacturer."""
    del ctx, param
    from lidarsim.schema.model_names import model_names, plugin_model_names

    names = model_names()
    matches = starting_with(incomplete, names)
    if not matches:
        matches = starting_with(incomplete, (name.partition("/")[2] for name in names))
    if not matches:
        with suppress(LidarError):
            matches = starting_with(incomplete, plugin_model_names(incomplete))
    # The shell completes file names itself. bash only does so if there are no other matches, and
    # discards the items before this one.
    return [CompletionItem(incomplete, type="file"), *matches]


def columns(ctx: click.Context, param: click.Parameter, incomplete: str) -> Items:
    """Complete the last column name in a comma-separated list."""
    del ctx, param
    return _in_list(incomplete, OPTIONAL_COLUMNS)


def colors(ctx: click.Context, param: click.Parameter, incomplete: str) -> Items:
    """Complete the name of a column that can determine the color of points."""
    del ctx, param
    return starting_with(incomplete, (*ALWAYS_COLUMNS, *OPTIONAL_COLUMNS, *COMPOSED_COLUMNS))


def formats(ctx: click.Context, param: click.Parameter, incomplete: str) -> Items:
    """Complete the last cloud format in a comma-separated list."""
    del ctx, param
    return _in_list(incomplete, EXPORTS) or _in_list(incomplete, _plugin_formats())


def format_name(ctx: click.Context, param: click.Parameter, incomplete: str) -> Items:
    """Complete the name of a cloud format."""
    del ctx, param
    return starting_with(incomplete, EXPORTS) or starting_with(incomplete, _plugin_formats())


def sensor_formats(ctx: click.Context, param: click.Parameter, incomplete: str) -> Items:
    """Complete the name of a sensor format, considering the file extension of --out."""
    del param
    file = ctx.params.get("out")
    rows = [row for row in FORMATS if file is None or file.suffix.lower() in row.endings]
    return starting_with(incomplete, (row.name for row in rows))


def sensor_file(ctx: click.Context, param: click.Parameter, incomplete: str) -> Items:
    """Complete a file name, or the file extension that the format given by --as requires."""
    del param
    stem, dot, _ = incomplete.rpartition(".")
    name = ctx.params.get("file_format")
    rows = [row for row in FORMATS if name in (None, row.name)]
    endings = [ending for row in rows for ending in row.endings]
    if name is None:
        endings.append(".png")
    matches = starting_with(incomplete, dict.fromkeys(f"{stem}{ending}" for ending in endings))
    return [CompletionItem(incomplete, type="file"), *(matches if dot else ())]


def bridges(ctx: click.Context, param: click.Parameter, incomplete: str) -> Items:
    """Complete the name of a playback bridge."""
    del ctx, param
    return starting_with(incomplete, BRIDGES)


def live(ctx: click.Context, param: click.Parameter, incomplete: str) -> Items:
    """Complete the value of --live. If it has no value, complete the next argument."""
    del param
    items = starting_with(incomplete, [PAGE, *VIEWERS])
    takes_file = any(isinstance(param, click.Argument) for param in ctx.command.params)
    return [CompletionItem(incomplete, type="file"), *items] if takes_file else items


def insertions(ctx: click.Context, param: click.Parameter, incomplete: str) -> Items:
    """Complete a file name or the name of a built-in object that can be inserted."""
    del ctx, param
    return [
        CompletionItem(incomplete, type="file"),
        *starting_with(incomplete, INSERTIONS),
    ]


def _in_list(incomplete: str, names: Iterable[str]) -> Items:
    before, comma, last = incomplete.rpartition(",")
    used = before.split(",")
    unused = [name for name in names if name not in used]
    return [CompletionItem(f"{before}{comma}{item.value}") for item in starting_with(last, unused)]


def _plugin_formats() -> Iterator[str]:
    from lidarsim.environment.plugins import plugins_of

    yield from plugins_of(GROUP)
