"""Versions of the software on which the bytes of a result depend.

A run records the versions of its driver, and refuses workers that have different versions.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import psutil

from lidarsim._version import __version__
from lidarsim.environment.plugins import Plugin, find_plugin
from lidarsim.errors import LidarError
from raybeam.registry import backend_versions

T = TypeVar("T")

PACKAGES = ("lidarpool", "lidarscenes", "lidarsim", "lidarview", "poolpart", "raybeam")
# Files next to a package in a checkout, which an installed package does not contain.
_DISTRIBUTION_FILES = ("pyproject.toml", "README.md", "LICENSE")
IMPORTED = time.time()  # in a forked worker, the time of the import in the fork server
CLOCK_TOLERANCE_S = 5.0  # maximum clock difference between a file server and this machine


def software(backend: str = "", plugins: Iterable[Plugin] = ()) -> dict[str, str]:
    """Return the versions of the software in this process, keyed by name.

    Processes with the same versions produce the same bytes. This does not depend on the processor,
    because no result comes from a function whose last bits differ between processors (see
    `lidarsim.numerics.elementary` and `lidarsim.numerics.vectors`).

    Parameters
    ----------
    backend
        Name of the ray-casting backend, or an empty string for processes that do not cast rays.
    plugins
        Plug-ins that the run uses. Plug-ins that are not installed in this process are skipped.

    Returns
    -------
    ``lidarpool`` is the version of lidarpool and the hash of its sources. ``numpy`` and ``backend``
    are included if a backend is given. Each plug-in has an entry with the version and the source
    hash of its distribution.
    """
    described = {"lidarpool": f"{__version__} (sources {source_hash()})"}
    if backend:
        described["numpy"] = np.__version__
        described["backend"] = f"{backend} {backend_versions(backend)}".strip()
    for plugin in plugins:
        if (installed := find_plugin(plugin.group, plugin.name)) is not None:
            described[_entry_name(installed)] = _plugin_version(installed)
    return described


@cache
def source_hash() -> str:
    """Return a hash of the installed source files, as eight hexadecimal digits.

    If files have changed since this process started, it may be running older code. The function
    then returns a text that says so instead of a hash.
    """
    return _hash_packages(PACKAGES)


@cache
def _plugin_version(plugin: Plugin) -> str:
    return f"{plugin.version} (sources {_hash_packages((_top_package(plugin.module),))})"


def _top_package(module: str) -> str:
    """Return the outermost package that contains a module.

    Returns the module itself if there is no such package. Namespace packages are skipped, because
    several distributions can share them.
    """
    parts = module.split(".")
    for count in range(1, len(parts)):
        name = ".".join(parts[:count])
        spec = find_spec(name)
        if spec is not None and spec.origin is not None:
            return name
    return module


def _hash_packages(packages: Iterable[str]) -> str:
    """Return the hash of the files in packages or modules, as `source_hash` describes."""
    digest = hashlib.sha256()
    newest_s = 0.0
    for package in packages:
        for name, path in _package_files(package):
            content = path.read_bytes()
            newest_s = max(newest_s, path.stat().st_mtime)
            digest.update(f"{name} {len(content)} ".encode() + content)
    if newest_s > min(IMPORTED, psutil.Process().create_time()) + CLOCK_TOLERANCE_S:
        return "changed since the process started"
    return digest.hexdigest()[:8]


def _package_files(package: str) -> Iterator[tuple[str, Path]]:
    """Yield the name and path of each file in a package.

    Each name begins with the name of the package.
    """
    try:
        spec = find_spec(package)
    except ModuleNotFoundError:  # the parent package is missing
        spec = None
    if spec is None:
        return
    if not spec.submodule_search_locations:
        if spec.origin is not None:
            yield package, Path(spec.origin)
        return
    root = Path(spec.submodule_search_locations[0])
    files = {path.relative_to(root).as_posix(): path for path in root.rglob("*") if path.is_file()}
    for name in sorted(files):
        if "__pycache__" not in files[name].parts and name not in _DISTRIBUTION_FILES:
            yield f"{package}/{name}", files[name]


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
            from lidarsim.environment.plugins import Plugin

            from .software import software
        except ModuleNotFoundError:
            return {"lidarpool": __version__}
        return software(backend, [Plugin(*fields) for fields in named])

    return query


def plugin_versions(plugins: Iterable[Plugin]) -> dict[Plugin, str]:
    """Return the version and source hash of each plug-in installed in this process."""
    return {plugin: _plugin_version(plugin) for plugin in plugins}


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
    required = {_entry_name(plugin): version for plugin, version in versions.items()}
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


def _entry_name(plugin: Plugin) -> str:
    return f"plug-in {plugin.distribution}"


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
