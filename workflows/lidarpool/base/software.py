"""The software of a process, as far as the bytes of a result depend on it."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Mapping
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import psutil
from distributed import get_worker

from lidarsim._version import __version__
from lidarsim.base.errors import LidarError
from raybeam import backend_build

T = TypeVar("T")

PACKAGES = ("lidarpool", "poolpart", "raybeam")
IMPORTED = time.time()  # in a forked worker, when the fork server imported it
CLOCKS_S = 5.0  # clocks of a file server and of this machine may differ by so much


def software(backend: str = "") -> dict[str, str]:
    """Describe the software of this process: equal software gives equal bytes.

    ``lidarpool`` is its version and a hash of the installed sources. Where it casts with a
    ray-casting `backend`, ``numpy`` and ``backend`` are versions. Processors do not matter: no byte
    comes from a function whose last bits depend on them, see `elementary` and `vectors`.
    """
    found = {"lidarpool": f"{__version__} (sources {sources()})"}
    if backend:
        found["numpy"] = np.__version__
        found["backend"] = f"{backend} {backend_build(backend)}".strip()
    return found


@cache
def sources() -> str:
    """Hash of the installed sources: eight hexadecimal digits.

    "changed" if files have changed since this process started: it may run code of before.
    """
    digest = hashlib.sha256()
    newest = 0.0
    for package in PACKAGES:
        spec = find_spec(package)
        [root] = spec.submodule_search_locations or [""] if spec else [""]
        files = [path for path in Path(root).rglob("*") if path.is_file()]
        for path in sorted(files, key=lambda path: path.relative_to(root).as_posix()):
            if "__pycache__" in path.parts:
                continue
            content = path.read_bytes()
            newest = max(newest, path.stat().st_mtime)
            name = f"{package}/{path.relative_to(root).as_posix()}"
            digest.update(f"{name} {len(content)} ".encode() + content)
    if newest > min(IMPORTED, psutil.Process().create_time()) + CLOCKS_S:
        return "changed since the process started"
    return digest.hexdigest()[:8]


def software_there(backend: str = "") -> Callable[[], dict[str, str]]:
    """Make a function that describes a worker's software.

    It is nested, so that it is sent by value: a worker without the package, or with another
    version, can run it too. Without the package it returns an empty dictionary.
    """

    def ask() -> dict[str, str]:
        try:
            from lidarsim._version import __version__
        except ModuleNotFoundError:
            return {}
        try:
            from .software import software
        except ModuleNotFoundError:
            return {"lidarpool": __version__}
        return software(backend)

    return ask


def call_alike(wanted: str, function: Callable[..., T], *arguments: Any) -> T:
    """Call a function in a task, if its worker has the sources of the run.

    `wanted` is ``lidarpool`` in the `software` of the run's driver. LidarError if not.
    """
    here = software()["lidarpool"]
    if here != wanted:
        worker = get_worker()
        raise LidarError(
            f"worker {worker.name} at {worker.address} has lidarpool {here}, the run {wanted}: "
            "install the same on both, and start the worker again."
        )
    return function(*arguments)


def difference(there: Mapping[str, Any], here: Mapping[str, str]) -> str:
    """Describe what differs in a clause, such as "numpy 2.3.1, the run 2.4.6"; "" for nothing."""
    for name, value in here.items():
        if there.get(name) != value:
            what = "" if name == "backend" else f"{name} "
            return f"{what}{there.get(name) or 'not installed'}, the run {what}{value}"
    return ""
