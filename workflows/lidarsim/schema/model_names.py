"""Names of sensor models, of the package and of plug-ins, quick to import.

Completion of the command lists them without their data, which NumPy and pydantic describe.
"""

from __future__ import annotations

from functools import cache
from importlib.resources import files
from importlib.resources.abc import Traversable
from types import ModuleType

from ..environment.plugins import Plugin, find_plugin, plugins_of

BUILT_IN = files("lidarsim") / "sensor" / "data"
# Plug-ins are packages with data files, as MAKER/MODEL.yaml; the maker is the plug-in's name.
GROUP = "lidarsim.sensors"


@cache
def model_names() -> tuple[str, ...]:
    """Return the names of the models that come with the package, in order."""
    makers = (entry for entry in BUILT_IN.iterdir() if entry.is_dir())
    return tuple(sorted(name for maker in makers for name in names_in(maker)))


def names_in(maker: Traversable) -> list[str]:
    """Return the names of the models in the folder of a maker, in order."""
    file_names = sorted(entry.name for entry in maker.iterdir())
    return [
        f"{maker.name}/{file.removesuffix('.yaml')}"
        for file in file_names
        if file.endswith(".yaml")
    ]


def plugin_model_names(start: str = "") -> tuple[str, ...]:
    """Return the names of the models of plug-ins that begin with `start`, in order.

    Models of the package are left out. Plug-ins of other makers are not imported.

    Raises
    ------
    LidarError
        If a plug-in cannot be used, or two have the same maker.
    """
    makers = [maker for maker in plugins_of(GROUP) if _may_begin(f"{maker}/", start)]
    plugins = [find_plugin(GROUP, maker) for maker in makers]
    names = [name for plugin in plugins if plugin for name in names_in(maker_folder(plugin))]
    return tuple(name for name in names if name.startswith(start) and name not in model_names())


def _may_begin(folder: str, start: str) -> bool:
    """Return True if names in a folder, such as «acme/», may begin with `start`."""
    return folder.startswith(start) or start.startswith(folder)


def maker_folder(plugin: Plugin) -> Traversable:
    """Return the folder with the data files of a plug-in.

    Raises
    ------
    LidarError
        If the plug-in cannot be imported, or lacks the folder.
    """
    package = plugin.load(ModuleType)
    folder = files(package) / plugin.name if hasattr(package, "__path__") else None
    if folder is None or not folder.is_dir():
        raise plugin.lacks(f"the folder {plugin.name} in {plugin.module}")
    return folder


def full_name(name: str) -> str:
    """Return the name of a model with its maker, if the name alone is unambiguous: riegl-vz400."""
    matches = [model for model in model_names() if model.partition("/")[2] == name]
    return matches[0] if len(matches) == 1 else name
