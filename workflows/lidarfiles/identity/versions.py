"""Versions of the software on which the bytes of a result depend."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterable, Iterator
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import psutil

from lidarsim._version import __version__
from lidarsim.environment.plugins import Plugin, find_plugin
from raybeam.registry import backend_versions

PACKAGES = (
    "lidarfiles", "lidarlive", "lidarpool", "lidarreal", "lidarscenario", "lidarscenes", "lidarsim",
    "lidarview", "poolpart", "raybeam",
)  # fmt: skip
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
            described[entry_name(installed)] = _plugin_version(installed)
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


def plugin_versions(plugins: Iterable[Plugin]) -> dict[Plugin, str]:
    """Return the version and source hash of each plug-in installed in this process."""
    return {plugin: _plugin_version(plugin) for plugin in plugins}


def entry_name(plugin: Plugin) -> str:
    """Return the key of a plug-in in `software`."""
    return f"plug-in {plugin.distribution}"
