"""Plug-ins: extensions by other distributions through entry points.

A table of this package answers first. Entry points are looked up only for names that no table has,
since importing `importlib.metadata` takes 30 ms. Each group is named beside the table that it adds
to.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from types import MappingProxyType
from typing import Any, Generic, TypeVar

from ..errors import LidarError
from ..words import did_you_mean, joined, printable

T = TypeVar("T")


@dataclass(frozen=True)
class Plugin:
    """An entry point of a distribution, with a `value` «module» or «module:attribute»."""

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
        """Import and return the value of the plug-in.

        Raises
        ------
        LidarError
            If the value cannot be imported, or is not of the kind.
        """
        value = _imported(self)
        if not isinstance(value, kind):
            raise LidarError(
                f"{self} is {_a(type(value).__name__)}, but {self.group} requires "
                f"{_a(kind.__name__)}. Install a different version of {self.distribution}."
            )
        return value

    def lacks(self, field: str) -> LidarError:
        """Return the error of a plug-in that lacks a field or function."""
        return LidarError(
            f"{self} lacks {field}, which {self.group} requires. Install a different version of "
            f"{self.distribution}."
        )

    def broken(self, error: BaseException) -> LidarError:
        """Return the error of a plug-in that cannot be imported, or whose import failed later."""
        reason = printable(str(error)) or type(error).__name__
        return LidarError(
            f"{self} cannot be imported: {reason}. Install the dependencies of "
            f"{self.distribution}, or uninstall it."
        )


@cache
def _imported(plugin: Plugin) -> Any:
    """Return the value of a plug-in.

    Raises LidarError if the import fails.
    """
    from importlib.metadata import EntryPoint

    try:
        return EntryPoint(plugin.name, plugin.value, plugin.group).load()
    except Exception as error:  # a module may raise anything while it is imported
        raise plugin.broken(error) from error


def plugins_of(group: str) -> Mapping[str, tuple[Plugin, ...]]:
    """Return the plug-ins of a group by name, sorted.

    Several plug-ins may share a name.
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
    """Return the plug-in of a group with a name, or None.

    Raises
    ------
    LidarError
        If two distributions provide a plug-in of the name.
    """
    candidates = plugins_of(group).get(name, ())
    if len(candidates) > 1:
        providers = " and ".join(f"{plugin.distribution} {plugin.version}" for plugin in candidates)
        raise LidarError(f"{providers} both provide {name!r} for {group}. Uninstall all but one.")
    return candidates[0] if candidates else None


class PluginTable(Generic[T]):
    """A table by names that plug-ins of a group add to.

    Parameters
    ----------
    group
        The group of entry points, whose names are names of the table.
    noun
        What the table has, for errors: «a format of clouds».
    built_in
        The entries of this package, {name: entry}.
    load
        Returns the entry of a plug-in; LidarError if the plug-in cannot be used.
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
        """Names of the table, then names of plug-ins."""
        return [*self._built_in, *plugins_of(self.group)]

    def __getitem__(self, name: str) -> T:
        """Return the entry of a name.

        Raises
        ------
        LidarError
            If no entry has that name, or its plug-in cannot be used.
        """
        if name in self._built_in:
            return self._built_in[name]
        plugin = find_plugin(self.group, name)
        if plugin is None:
            raise LidarError(
                f"Unknown {self._noun} {name!r}.{did_you_mean(name, self.names)} The available "
                f"names are {joined(self.names)}."
            )
        return self._load(plugin)


def _a(noun: str) -> str:
    """Put the indefinite article before a name: «a dict», «an int»."""
    return f"an {noun}" if noun[0].lower() in "aeiou" else f"a {noun}"
