"""Cores, memory and GPUs of this machine, as Dask and poolpart determine them.

`dask.system`, `distributed.system` and `poolpart.probe` have the same values, but importing them
imports all of Dask, which takes longer than the rest of `lidarpool check`.
"""

from __future__ import annotations

import ctypes
import math
import os
from contextlib import suppress
from pathlib import Path

import psutil

_GROUPS = Path("/sys/fs/cgroup")  # folder in which Linux publishes the limits of control groups
_MEMORY_FILES = (
    *("memory/memory.limit_in_bytes", "memory/memory.soft_limit_in_bytes"),  # version 1
    *("memory.max", "memory.high", "memory.low"),  # version 2
)
_CUDA_DRIVER = "libcuda.so.1"


def _core_limits() -> list[int]:
    """Return the number of cores, and the limits of the CPU affinity and of the control group."""
    # Unlike `cpu_count`, `process_cpu_count` (Python 3.13) heeds `PYTHON_CPU_COUNT`.
    cores = [getattr(os, "process_cpu_count", os.cpu_count)() or 1]
    process = psutil.Process()
    if hasattr(process, "cpu_affinity"):
        cores.append(len(process.cpu_affinity()))
    for folder in ("cpuacct,cpu", "cpu,cpuacct"):
        with suppress(OSError, ValueError):
            quota, period = (
                int((_GROUPS / folder / f"cpu.cfs_{name}_us").read_text("ascii"))
                for name in ("quota", "period")
            )
            return [*cores, math.ceil(quota / period)]
    with suppress(OSError, ValueError):  # the quota is "max" if there is no limit
        group = Path("/proc/self/cgroup").read_text("utf-8").strip().split(":")[-1]
        quota, period = map(
            int, (_GROUPS / group.lstrip("/") / "cpu.max").read_text("ascii").split()
        )
        cores.append(math.ceil(quota / period))
    return cores


def _memory_limits() -> list[int]:
    """Return the physical memory, and the limits of control groups and `ulimit -m`, in bytes."""
    limits = [psutil.virtual_memory().total]
    for name in _MEMORY_FILES:
        with suppress(OSError, ValueError):
            limits.append(int((_GROUPS / name).read_text("ascii")))
    with suppress(ImportError):  # not available on Windows
        import resource

        limits.append(resource.getrlimit(resource.RLIMIT_RSS)[1])
    return limits


def gpu_count() -> int:
    """Return the number of CUDA devices of this process."""
    try:
        ctypes.CDLL(_CUDA_DRIVER)
    except OSError:
        return 0
    from poolpart.probe import visible_gpus  # imported late, as the module docstring explains

    return len(visible_gpus())


CPU_COUNT = min(count for count in _core_limits() if count > 0)
MEMORY_LIMIT = min(limit for limit in _memory_limits() if limit > 0)  # bytes
