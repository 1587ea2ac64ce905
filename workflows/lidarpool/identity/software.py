"""Comparison of the software of workers with that of the driver.

A run records the versions of its driver, and refuses workers that have different versions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

from lidarfiles.identity.versions import entry_name, software
from lidarsim.environment.plugins import Plugin
from lidarsim.errors import LidarError

T = TypeVar("T")


def software_query(
    backend: str = "", plugins: Sequence[Plugin] = ()
) -> Callable[[], dict[str, str]]:
    """Return a function that workers can run to call `software`.

    The returned function is nested, so that it is pickled by value. Workers that lack lidarpool, or
    have a different version, can therefore run it, too. If lidarpool is not installed, it returns
    an empty dictionary.
    """
    # Tuples are pickled by value, whereas instances of `Plugin` require its class on the worker.
    named = [
        (plugin.group, plugin.name, plugin.value, plugin.distribution, plugin.version)
        for plugin in plugins
    ]

    def query() -> dict[str, str]:
        try:
            from lidarsim._version import __version__
        except ModuleNotFoundError:
            return {}
        try:
            from lidarfiles.identity.versions import software
            from lidarsim.environment.plugins import Plugin
        except ModuleNotFoundError:
            return {"lidarpool": __version__}
        return software(backend, [Plugin(*fields) for fields in named])

    return query


def call_with_same_sources(required: str, function: Callable[..., T], *arguments: Any) -> T:
    """Check that the worker has the same sources as the driver, and call a function.

    Parameters
    ----------
    required
        Value of ``lidarpool`` that `software` returned in the driver.
    function, arguments
        Function to call, and its arguments.

    Raises
    ------
    LidarError
        If the worker has different sources.
    """
    return _call_if_compatible(software(), {"lidarpool": required}, function, *arguments)


def call_with_plugins(
    versions: Mapping[Plugin, str], function: Callable[..., T], *arguments: Any
) -> T:
    """Check that the worker has the same plug-ins as the driver, and call a function.

    Parameters
    ----------
    versions
        Versions of the plug-ins, which `plugin_versions` returned in the driver.
    function, arguments
        Function to call, and its arguments.

    Raises
    ------
    LidarError
        If a plug-in is missing, or has a different version or different sources.
    """
    required = {entry_name(plugin): version for plugin, version in versions.items()}
    return _call_if_compatible(software(plugins=versions), required, function, *arguments)


def _call_if_compatible(
    installed: Mapping[str, str],
    required: Mapping[str, str],
    function: Callable[..., T],
    *arguments: Any,
) -> T:
    if differs := describe_difference(installed, required):
        from distributed import get_worker  # imported late because it takes long

        worker = get_worker()
        raise LidarError(
            f"Worker {worker.name} at {worker.address} has {differs}. Install the same version on "
            "both machines, and restart the worker."
        )
    return function(*arguments)


def describe_difference(installed: Mapping[str, Any], required: Mapping[str, str]) -> str:
    """Describe the first difference between the installed and the required software.

    Returns an empty string if all required entries are the same.

    Examples
    --------
    >>> describe_difference({"numpy": "2.3.1"}, {"numpy": "2.4.6"})
    'numpy 2.3.1, but the run requires numpy 2.4.6'
    >>> describe_difference({}, {"numpy": "2.4.6"})
    'no numpy, but the run requires numpy 2.4.6'
    """
    for name, value in required.items():
        if installed.get(name) != value:
            label = "the backend" if name == "backend" else name
            present = f"{label} {installed[name]}" if installed.get(name) else f"no {name}"
            return f"{present}, but the run requires {label} {value}"
    return ""
