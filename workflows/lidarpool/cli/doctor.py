"""Check the installation, the machine and a cluster, and suggest which problem to fix first."""

from __future__ import annotations

import errno
import shutil
import socket
import tempfile
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, metadata, requires, version
from pathlib import Path
from typing import Any

import psutil
from dask.system import CPU_COUNT
from distributed.system import MEMORY_LIMIT
from packaging.requirements import Requirement

from lidarfiles.open3d_access.open3d_module import load_open3d
from lidarscenario.sections import TaskOptions
from lidarsim.environment.extras import CHECKOUT
from lidarsim.errors import LidarError
from poolpart import Pool, PoolError
from poolpart.probe import visible_gpus
from raybeam import available_backends
from raybeam.compiled import HAS_CACHE
from raybeam.installation import install_command

from ..report.report import versions
from ..run.cluster.requirements import slots_needed
from ..run.pipeline.stage_names import GPU, LIDAR
from .installed_copies import find_second_copy

READY = "ready"
FREE = "free"
# {port: program that uses it by default}
PORTS = {
    80: "HTTP interface of `lidarpool play`",
    8765: "Foxglove",
    8786: "Dask scheduler",
    8787: "Dask dashboard",
    9876: "Rerun",
}
_FOR_DEVELOPERS = ("bench", "dev", "docs", "lint")
_GIB = 2**30
_MIN_MEMORY_GIB = 2.0  # minimum memory for a small run with its three processes
_MIN_DISK_GIB = 1.0


def check_environment(cluster_fault: str = "") -> dict[str, Any]:
    """Check the environment, and return the results as a dictionary for JSON.

    The entry `fix_first` is an empty string if no problems were found. `cluster_fault` is the
    result of `find_cluster_fault`, or an empty string if there is no cluster.
    """
    figures: dict[str, Any] = {
        "versions": versions(),
        "machine": {
            "cores": CPU_COUNT,
            "memory_gib": MEMORY_LIMIT / _GIB,
            "available_memory_gib": min(psutil.virtual_memory().available, MEMORY_LIMIT) / _GIB,
            "disk_gib": {
                str(folder): shutil.disk_usage(folder).free / _GIB
                for folder in dict.fromkeys((Path.cwd(), Path(tempfile.gettempdir())))
            },
        },
        "gpus": list(visible_gpus()),
        "backends": {name: reason or READY for name, reason in available_backends().items()},
        "open3d": _open3d_state(),
        "extras": _extras(),
        "second_copy": find_second_copy(),
        "cluster_fault": cluster_fault,
        "ports": {str(port): _port_state(port) for port in PORTS},
    }
    return {**figures, "fix_first": _fix_first(figures)}


def find_cluster_fault(pool: Pool) -> str:
    """Return the reason why the workers of a cluster cannot run a scenario, or an empty string.

    Return an empty string if they can.
    """
    purpose = dict.fromkeys((GPU, LIDAR), "for a run with default options")
    try:
        pool.require(slots_needed(TaskOptions(), planning=False), purpose)
    except PoolError as error:
        return str(error).rstrip(".")
    return ""


def _open3d_state() -> str:
    """Return READY, or the reason why Open3D cannot be loaded."""
    try:
        load_open3d()
    except LidarError as error:
        return str(error).rstrip(".")
    return READY


def _extras() -> dict[str, str]:
    """Return the state of each optional extra, which is READY or the command that installs it."""
    try:
        names = metadata("lidarpool").get_all("Provides-Extra") or []
    except PackageNotFoundError:  # a checkout that is not installed
        return {}
    requirements = [Requirement(text) for text in requires("lidarpool") or ()]
    states = {}
    for name in sorted({*names} - {*_FOR_DEVELOPERS}):
        requirements_of_extra = [
            requirement
            for requirement in requirements
            if requirement.marker is not None
            and requirement.marker.evaluate({"extra": name})
            and not requirement.marker.evaluate({"extra": ""})
        ]
        is_ready = all(map(_is_installed, requirements_of_extra))
        states[name] = READY if is_ready else install_command("-e", f".[{name}]")
    return states


def _is_installed(requirement: Requirement) -> bool:
    try:
        return requirement.specifier.contains(version(requirement.name), prereleases=True)
    except PackageNotFoundError:
        return False


def _port_state(port: int) -> str:
    """Describe whether this process can listen on a port of the loopback interface."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
        except OSError as error:
            return "requires privileges" if error.errno == errno.EACCES else "in use"
    return FREE


def _fix_first(figures: dict[str, Any]) -> str:
    return next(_advice(figures), "")


def _advice(figures: dict[str, Any]) -> Iterator[str]:
    """Yield suggestions for solving problems, starting with the most urgent one."""
    machine = figures["machine"]
    backends = figures["backends"]
    if figures["open3d"] != READY:
        yield figures["open3d"]
    if machine["available_memory_gib"] < _MIN_MEMORY_GIB:
        yield (
            f"Only {machine['available_memory_gib']:.1f} GiB of memory is available, but a "
            f"small run needs about {_MIN_MEMORY_GIB:g} GiB. Close other programs"
        )
    for folder, free_gib in machine["disk_gib"].items():
        if free_gib < _MIN_DISK_GIB:
            yield f"The disk of {folder} has only {free_gib:.1f} GiB of free space. Free some space"
    if figures["cluster_fault"]:
        yield figures["cluster_fault"]
    if figures["gpus"] and backends["cuda"] != READY:
        yield f"The GPU of this machine is not used: {backends['cuda']}"
    if backends["tiles"] != READY:
        yield f"Without numba, ray casting is about a hundred times slower: {backends['tiles']}"
    elif not HAS_CACHE:
        yield (
            "Each process compiles its loops, which takes 20 s, because there is no writable "
            "cache folder. Set NUMBA_CACHE_DIR to a writable folder"
        )
    if figures["second_copy"]:
        yield figures["second_copy"]


def result_lines(figures: dict[str, Any]) -> list[str]:
    """Format the results of `check_environment` as lines of text."""
    machine = figures["machine"]
    disks = ", ".join(f"{free:.1f} GiB in {name}" for name, free in machine["disk_gib"].items())
    memory = f"{machine['memory_gib']:.1f} GiB, {machine['available_memory_gib']:.1f} GiB available"
    rows: dict[str, str] = {
        **figures["versions"],
        "cores": str(machine["cores"]),
        "memory": memory,
        "disk": disks,
        "GPUs here": ", ".join(figures["gpus"]) or "none",
        "writing clouds": figures["open3d"],
    }
    lines = [f"{name:<14} {value}" for name, value in rows.items()]
    extras = f"{'extras':<14} installed from {CHECKOUT}"
    for title, states in (("backends", figures["backends"]), (extras, figures["extras"])):
        lines.append(title)
        lines += [f"  {name:<12} {state}" for name, state in states.items()]
    lines.append("ports of 127.0.0.1")
    lines += [
        f"  {port:<12} {state} ({PORTS[int(port)]})" for port, state in figures["ports"].items()
    ]
    return lines


def advice_line(figures: dict[str, Any]) -> str:
    """Return the last line of the text output, which states what to fix first."""
    advice = figures["fix_first"]
    return f"fix first: {advice}." if advice else "No problems were found."
