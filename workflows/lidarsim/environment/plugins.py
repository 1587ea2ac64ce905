"""Plug-ins that other distributions provide through entry points.

Built-in names take precedence. Entry points are searched only for other names, because importing
`importlib.metadata` takes 30 ms. The name of each entry point group is defined next to the table
that it extends.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from types import MappingProxyType
from typing import Any, Generic, TypeVar

from ..errors import LidarError
from ..words import did_you_mean, join_names, printable

T = TypeVar("T")


@dataclass(frozen=True)
class Plugin:
    """An entry point of a distribution.

    `value` has the form "module" or "module:attribute".
    """

    group: str
    name: str
    value: str
    distribution: str
    version: str

    def __str__(self) -> str:
        return f"{self.name!r} of the plug-in {self.distribution} {self.version}"

    @property
    def module(self) -> str:
        """Name of the module that provides the plug-in."""
        return self.value.partition(":")[0].strip()

    def load(self, kind: type[T]) -> T:
        """Import the plug-in and return its value.

        Raises
        ------
        LidarError
            If the value cannot be imported or is not an instance of `kind`.
        """
        value = _imported(self)
        if not isinstance(value, kind):
            raise LidarError(
                f"{self} is {_a(type(value).__name__)}, but {self.group} requires "
                f"{_a(kind.__name__)}. Install a different version of {self.distribution}."
            )
        return value

    def missing_field_error(self, field: str) -> LidarError:
        """Return the error to raise if the plug-in lacks a field or function."""
        return LidarError(
            f"{self} lacks {field}, which {self.group} requires. Install a different version of "
            f"{self.distribution}."
        )

    def import_error(self, error: BaseException) -> LidarError:
        """Return the error to raise if the plug-in cannot be imported."""
        reason = printable(str(error)) or type(error).__name__
        return LidarError(
            f"{self} cannot be imported: {reason}. Install the dependencies of "
            f"{self.distribution}, or uninstall it."
        )


@cache
def _imported(plugin: Plugin) -> Any:
    """Import the value of a plug-in, or raise LidarError if the import fails."""
    from importlib.metadata import EntryPoint

    try:
        return EntryPoint(plugin.name, plugin.value, plugin.group).load()
    except Exception as error:  # importing a module may raise any exception
        raise plugin.import_error(error) from error


def plugins_of(group: str) -> Mapping[str, tuple[Plugin, ...]]:
    """Return the plug-ins in an entry point group, sorted by name.

    The result maps each name to all plug-ins that share it.
    """
    from importlib.metadata import entry_points

    plugins: dict[str, tuple[Plugin, ...]] = {}
    listed = [
        Plugin(group, entry.name, entry.value, entry.dist.name, entry.dist.version)
        for entry in entry_points(group=group)
        if entry.dist is not None
    ]
    for plugin in sorted(listed, key=lambda plugin: (plugin.name, plugin.distribution)):
        plugins[plugin.name] = (*plugins.get(plugin.name, ()), plugin)
    return MappingProxyType(plugins)


def find_plugin(group: str, name: str) -> Plugin | None:
    """Return the plug-in with a given name in an entry point group, or None if there is none.

    Raises
    ------
    LidarError
        If several distributions provide a plug-in with this name.
    """
    candidates = plugins_of(group).get(name, ())
    if len(candidates) > 1:
        providers = " and ".join(f"{plugin.distribution} {plugin.version}" for plugin in candidates)
        raise LidarError(f"{providers} both provide {name!r} for {group}. Uninstall all but one.")
    return candidates[0] if candidates else None


class PluginTable(Generic[T]):
    """Lookup table of named entries that plug-ins can extend.

    Parameters
    ----------
    group
        Entry point group. The names of its entry points are names in the table.
    noun
        Noun for the entries in error messages, for example "point cloud format".
    built_in
        Mapping from names to the entries in this package.
    load
        Function that returns the entry for a plug-in, or raises LidarError if the plug-in cannot be
        used.
    """

    def __init__(
        self, group: str, noun: str, built_in: Mapping[str, T], load: Callable[[Plugin], T]
    ) -> None:
        self.group = group
        self._noun = noun
        self._built_in = built_in
        self._load = cache(load)

    @property
    def names(self) -> list[str]:
        """Built-in names, followed by the names of plug-ins."""
        return [*self._built_in, *plugins_of(self.group)]

    def __getitem__(self, name: str) -> T:
        """Return the entry with a given name.

        Raises
        ------
        LidarError
            If there is no entry with that name, or if its plug-in cannot be used.
        """
        if name in self._built_in:
            return self._built_in[name]
        plugin = find_plugin(self.group, name)
        if plugin is None:
            raise LidarError(
                f"Unknown {self._noun} {name!r}.{did_you_mean(name, self.names)} The available "
                f"names are {join_names(self.names)}."
            )
        return self._load(plugin)


def _a(noun: str) -> str:
    """Prefix a name with the indefinite article, for example "a dict" or "an int"."""
    return f"an {noun}" if noun[0].lower() in "aeiou" else f"a {noun}"
