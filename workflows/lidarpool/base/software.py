"""The software of a process, as far as the bytes of a result depend on it."""

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
from distributed import get_worker

from lidarsim._version import __version__
from lidarsim.base.errors import LidarError
from lidarsim.base.plugins import Plugin, find_plugin
from raybeam.registry import backend_versions

T = TypeVar("T")

PACKAGES = ("lidarpool", "lidarscenes", "lidarsim", "lidarview", "poolpart", "raybeam")
# Files beside a package in a checkout, which an installed package lacks.
_DISTRIBUTION_FILES = ("pyproject.toml", "README.md", "LICENSE")
IMPORTED = time.time()  # a forked worker has the time of the fork server's import
CLOCK_TOLERANCE_S = 5.0  # largest difference of the clocks of a file server and of this machine


def software(backend: str = "", plugins: Iterable[Plugin] = ()) -> dict[str, str]:
    """Return the software of this process by name: equal software gives equal bytes.

    ``lidarpool`` is its version and a hash of the installed sources. For casting with a ray-casting
    `backend`, ``numpy`` and ``backend`` are versions. Each of the used `plugins` has its
    distribution, with version and sources, unless this process lacks the plug-in. Processors do not
    matter: no byte comes from a function whose last bits depend on them (`elementary`,
    `vectors`).
    """
    described = {"lidarpool": f"{__version__} (sources {sources()})"}
    if backend:
        described["numpy"] = np.__version__
        described["backend"] = f"{backend} {backend_versions(backend)}".strip()
    for plugin in plugins:
        if (installed := find_plugin(plugin.group, plugin.name)) is not None:
            described[_entry_of(installed)] = _version_of(installed)
    return described


@cache
def sources() -> str:
    """Return the hash of the installed sources: eight hexadecimal digits.

    "changed" if files have changed since this process started: it may run older code.
    """
    return _hash_of(PACKAGES)


@cache
def _version_of(plugin: Plugin) -> str:
    """Return the version of a plug-in's distribution, and the hash of its package."""
    return f"{plugin.version} (sources {_hash_of((_package_of(plugin.module),))})"


def _package_of(module: str) -> str:
    """Return the name of the outermost regular package of a module, or of the module itself."""
    parts = module.split(".")
    for count in range(1, len(parts)):
        name = ".".join(parts[:count])
        spec = find_spec(name)
        if spec is not None and spec.origin is not None:
            return name
    return module


def _hash_of(packages: Iterable[str]) -> str:
    """Return the hash of the files of packages or modules (`sources`)."""
    digest = hashlib.sha256()
    newest_s = 0.0
    for package in packages:
        for name, path in _files_of(package):
            content = path.read_bytes()
            newest_s = max(newest_s, path.stat().st_mtime)
            digest.update(f"{name} {len(content)} ".encode() + content)
    if newest_s > min(IMPORTED, psutil.Process().create_time()) + CLOCK_TOLERANCE_S:
        return "changed since the process started"
    return digest.hexdigest()[:8]


def _files_of(package: str) -> Iterator[tuple[str, Path]]:
    """Yield the files of a package or module, with names that start with the package's."""
    try:
        spec = find_spec(package)
    except ModuleNotFoundError:  # its outer package is missing
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
    """Return a function that describes a worker's software.

    It is nested, so that it is sent by value: a worker without the package, or with another
    version, can run it too. Without the package it returns an empty dictionary.
    """
    # As tuples, which are sent by value: classes of this package are sent by name.
    named = [
        (plugin.group, plugin.name, plugin.value, plugin.distribution, plugin.version)
        for plugin in plugins
    ]

    def ask() -> dict[str, str]:
        try:
            from lidarsim._version import __version__
        except ModuleNotFoundError:
            return {}
        try:
            from lidarsim.base.plugins import Plugin

            from .software import software
        except ModuleNotFoundError:
            return {"lidarpool": __version__}
        return software(backend, [Plugin(*fields) for fields in named])

    return ask


def plugin_versions(plugins: Iterable[Plugin]) -> dict[Plugin, str]:
    """Return the version and sources of plug-ins that this process uses."""
    return {plugin: _version_of(plugin) for plugin in plugins}


def call_with_same_sources(required: str, function: Callable[..., T], *arguments: Any) -> T:
    """Call a function in a task, if its worker has the sources of the run.

    `required` is ``lidarpool`` in the `software` of the run's driver. LidarError for different
    sources.
    """
    return _call(software(), {"lidarpool": required}, function, *arguments)


def call_with_plugins(
    versions: Mapping[Plugin, str], function: Callable[..., T], *arguments: Any
) -> T:
    """Call a function in a task, if its worker has the plug-ins of the run's driver.

    `versions` as of `plugin_versions`. LidarError if a plug-in differs or is missing.
    """
    required = {_entry_of(plugin): version for plugin, version in versions.items()}
    return _call(software(plugins=versions), required, function, *arguments)


def _call(
    installed: Mapping[str, str],
    required: Mapping[str, str],
    function: Callable[..., T],
    *arguments: Any,
) -> T:
    if differs := difference(installed, required):
        worker = get_worker()
        raise LidarError(
            f"Worker {worker.name} at {worker.address} has {differs}. Install the same version on "
            "both machines, and restart the worker."
        )
    return function(*arguments)


def _entry_of(plugin: Plugin) -> str:
    """Return the name of a plug-in's entry in `software`."""
    return f"plug-in {plugin.distribution}"


def difference(installed: Mapping[str, Any], required: Mapping[str, str]) -> str:
    """Return a clause on software that differs, or "" if all software is the same.

    Examples
    --------
    >>> difference({"numpy": "2.3.1"}, {"numpy": "2.4.6"})
    'numpy 2.3.1, but the run requires numpy 2.4.6'
    >>> difference({}, {"numpy": "2.4.6"})
    'no numpy, but the run requires numpy 2.4.6'
    """
    for name, value in required.items():
        if installed.get(name) != value:
            label = "the backend" if name == "backend" else name
            present = f"{label} {installed[name]}" if installed.get(name) else f"no {name}"
            return f"{present}, but the run requires {label} {value}"
    return ""
