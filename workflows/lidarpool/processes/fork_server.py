"""Start and stop the server process from which the workers of a local cluster are forked.

A spawned worker imports Dask, NumPy and lidarpool, which takes about one second of CPU time. The
fork server imports them once, while the driver continues. It then forks each worker in about
20 ms, including workers that are restarted.
"""

from __future__ import annotations

import os
import signal
import sys
from multiprocessing import forkserver
from typing import Any

from lidarsim.environment.interrupts import block_child_signals

# Numerical libraries are limited to one thread, because workers share the cores and threads do not
# survive a fork.
_ENVIRONMENT = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")


def start_fork_server() -> bool:
    """Start the fork server and return True, or return False if forking is not supported.

    The fork server exits after this process and all workers have exited. Forking is only supported
    on Linux, because the system libraries of macOS do not work in forked processes.
    """
    if sys.platform != "linux":
        return False
    server: Any = forkserver._forkserver
    preload = server._preload_modules
    environment = dict(os.environ)
    server.set_forkserver_preload(
        ["lidarpool.processes.rare_collections", "lidarpool.run.pipeline.forked"]
    )
    os.environ.update(_ENVIRONMENT)
    try:
        with block_child_signals():
            server.ensure_running()
    finally:
        server.set_forkserver_preload(preload)
        os.environ.clear()
        os.environ.update(environment)
    return True


def stop_fork_server() -> None:
    """Kill the fork server, and wait until it has exited.

    The CPU time of the server and its workers is then included in the CPU time that the system
    reports for the children of this process.
    """
    server: Any = forkserver._forkserver
    if server._forkserver_pid is not None:
        # Without the signal, the server would wait until the last worker exits.
        os.kill(server._forkserver_pid, signal.SIGKILL)
        server._stop()
