"""The process that forks the workers of a local cluster.

A spawned worker imports Dask, NumPy and the packages of lidarpool, which takes a second of a core.
The fork server imports them once, in parallel to the driver, and forks each worker in 20 ms, also
after a restart.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from multiprocessing import forkserver
from typing import Any

from lidarsim.base.interrupts import children_spared

# Numerical libraries get one thread: workers share the cores, and threads cannot be forked.
_ENVIRONMENT = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
# glibc's numbers of M_TRIM_THRESHOLD and M_MMAP_THRESHOLD.
_THRESHOLDS = {-1: 256 << 20, -3: 256 << 20}


def start_fork_server() -> bool:
    """Start the fork server, which ends when this process and all workers have ended.

    Returns False on systems whose libraries cannot be forked, such as macOS.
    """
    if sys.platform != "linux":
        return False
    server: Any = forkserver._forkserver
    preload = server._preload_modules
    environment = dict(os.environ)
    server.set_forkserver_preload(
        ["lidarpool.base.rare_collections", "lidarpool.run.pipeline.forked"]
    )
    os.environ.update(_ENVIRONMENT)
    try:
        with children_spared():
            server.ensure_running()
    finally:
        server.set_forkserver_preload(preload)
        os.environ.clear()
        os.environ.update(environment)
    return True


def keep_freed_memory() -> None:
    """Let this process and its forks keep the memory of freed large arrays.

    Pages that were returned to the system have to be faulted in again. That took one of the eight
    seconds of the pictures.
    """
    if mallopt := getattr(ctypes.CDLL(None), "mallopt", None):  # only in glibc
        for option, size in _THRESHOLDS.items():
            mallopt(option, size)


def stop_fork_server() -> None:
    """Kill the fork server and wait for its end.

    The processor time of the server and its workers counts for this process afterwards.
    """
    server: Any = forkserver._forkserver
    if server._forkserver_pid is not None:
        os.kill(server._forkserver_pid, signal.SIGKILL)  # it would wait for the last worker
        server._stop()
