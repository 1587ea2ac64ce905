"""Names of the sensor models in this package and in plug-ins.

This module is quick to import because it does not load the data of the models, which would require
NumPy and pydantic. Shell completion depends on it.
"""

from __future__ import annotations

from functools import cache
from importlib.resources import files
from importlib.resources.abc import Traversable
from types import ModuleType

from ..environment.plugins import Plugin, find_plugin, plugins_of

BUILT_IN = files("lidarsim") / "sensor" / "data"
# A plug-in is a package with data files named MAKER/MODEL.yaml. The maker is the plug-in's name.
GROUP = "lidarsim.sensors"


@cache
def model_names() -> tuple[str, ...]:
    """Return the sorted names of the models that are included in this package."""
    makers = (entry for entry in BUILT_IN.iterdir() if entry.is_dir())
    return tuple(sorted(name for maker in makers for name in names_in(maker)))


def names_in(maker: Traversable) -> list[str]:
    """Return the sorted model names in a maker's folder."""
    file_names = sorted(entry.name for entry in maker.iterdir())
    return [
        f"{maker.name}/{file.removesuffix('.yaml')}"
        for file in file_names
        if file.endswith(".yaml")
    ]


def plugin_model_names(start: str = "") -> tuple[str, ...]:
    """Return the sorted names of plug-in models that begin with `start`.

    Models that are included in this package are omitted. Plug-ins of makers that do not match
    `start` are not imported.

    Raises
    ------
    LidarError
        If a plug-in cannot be used, or if two plug-ins have the same maker.
    """
    makers = [maker for maker in plugins_of(GROUP) if _may_begin(f"{maker}/", start)]
    plugins = [find_plugin(GROUP, maker) for maker in makers]
    names = [name for plugin in plugins if plugin for name in names_in(maker_folder(plugin))]
    return tuple(name for name in names if name.startswith(start) and name not in model_names())


def _may_begin(folder: str, start: str) -> bool:
    """Return whether names in a folder such as "acme/" may begin with `start`."""
    return folder.startswith(start) or start.startswith(folder)


def maker_folder(plugin: Plugin) -> Traversable:
    """Return the folder that contains the data files of a plug-in.

    Raises
    ------
    LidarError
        If the plug-in cannot be imported or lacks the folder.
    """
    package = plugin.load(ModuleType)
    folder = files(package) / plugin.name if hasattr(package, "__path__") else None
    if folder is None or not folder.is_dir():
        raise plugin.missing_field_error(f"the folder {plugin.name} in {plugin.module}")
    return folder


def full_name(name: str) -> str:
    """Add the maker to a model name such as "riegl-vz400" if the maker is unambiguous."""
    matches = [model for model in model_names() if model.partition("/")[2] == name]
    return matches[0] if len(matches) == 1 else name
