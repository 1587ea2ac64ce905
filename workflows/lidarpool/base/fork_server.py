"""The process that a cluster on this machine forks its workers from.

A worker that is spawned imports Dask, NumPy and our packages for itself, which takes a second of
a core. The fork server imports them once, beside the driver, and then forks each worker in 20 ms,
also one that takes the place of another.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from multiprocessing import forkserver
from typing import Any

from .interrupts import children_spared

# Numerical libraries get one thread: workers share the cores, and threads cannot be forked.
_ENVIRONMENT = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
# glibc's numbers of M_TRIM_THRESHOLD and M_MMAP_THRESHOLD.
_KEPT = {-1: 256 << 20, -3: 256 << 20}


def start_fork_server() -> bool:
    """Have the fork server running, which ends when this process and all workers have ended.

    Returns False where libraries do not stand being forked, as on macOS.
    """
    if sys.platform != "linux":
        return False
    forkserver.set_forkserver_preload(["lidarpool.scan.forked"])
    before = dict(os.environ)
    os.environ.update(_ENVIRONMENT)
    try:
        with children_spared():
            forkserver.ensure_running()
    finally:
        os.environ.clear()
        os.environ.update(before)
    return True


def keep_freed_memory() -> None:
    """Have this process, and those that are forked from it, keep the memory of large arrays.

    Handed back to the system each time, it is made of pages that have to be faulted in again. Of
    eight seconds that pictures take, that was one.
    """
    if mallopt := getattr(ctypes.CDLL(None), "mallopt", None):  # which only glibc has
        for option, size in _KEPT.items():
            mallopt(option, size)


def stop_fork_server() -> None:
    """End the fork server at once; what it and its workers took counts as this process's."""
    server: Any = forkserver._forkserver
    if server._forkserver_pid is not None:
        os.kill(server._forkserver_pid, signal.SIGKILL)  # it would wait for the last worker
        server._stop()
