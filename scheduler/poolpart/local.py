"""A partitioned cluster on this machine."""

from __future__ import annotations

import logging
import multiprocessing
import os
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from distributed import Nanny, Scheduler, Security, SpecCluster, Status

from .errors import PoolError
from .probe import visible_gpus

LOOPBACK = "127.0.0.1"


def usable_cores() -> int:
    """Processor cores that this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def default_workers(cores: int, gpus: int) -> dict[str, int]:
    """Worker processes of the GPU and OTHER partitions for a machine.

    One worker a GPU. Without GPUs the GPU partition falls back to CPU workers, for half of
    the cores; OTHER has the rest. The LIDAR stages mostly wait and share one process.

    Examples
    --------
    >>> default_workers(cores=2, gpus=0), default_workers(cores=16, gpus=2)
    ({'GPU': 1, 'OTHER': 1}, {'GPU': 2, 'OTHER': 13})
    """
    casting = gpus or max(1, cores // 2)
    return {"GPU": casting, "OTHER": max(1, cores - casting - (1 if cores > 2 else 0))}


def local_cluster(
    *,
    gpu_workers: int | None = None,
    lidar_slots: int = 4,
    other_workers: int | None = None,
    host: str = LOOPBACK,
    dashboard_port: int | None = 0,
    environment: Mapping[str, str] | None = None,
    security: Security | bool = False,
) -> SpecCluster:
    """Start a Dask cluster on this machine, divided into GPU, LIDAR and OTHER.

    Scheduler, workers and dashboard listen on the loopback interface only. Each partition's
    workers are processes with a nanny, which restarts them when they die. They import the
    script that starts them: there, call this under ``if __name__ == "__main__":``.

    Parameters
    ----------
    gpu_workers
        Workers of the GPU partition, one thread each; by default one a GPU, or for half of
        the cores where there is no GPU.
    lidar_slots
        Threads, and slots, of the one LIDAR worker.
    other_workers
        Workers of the OTHER partition, one thread each; by default what is left.
    host
        Address to listen on.
    dashboard_port
        Port of Dask's dashboard, 0 for any free one, None for none.
    environment
        Variables to set in the workers.
    security
        True encrypts what the processes say to each other, with a certificate that is made
        for this cluster and kept in memory; nobody without it can connect. A
        `distributed.Security` brings certificates of one's own. The dashboard stays http.

    Returns
    -------
    SpecCluster
        Use it as a context manager, or call its `close`. The scheduler runs in this process.

    Raises
    ------
    PoolError
        If a number is below 1, the workers do not start, or a certificate is asked for and
        the package cryptography is missing.
    """
    _refuse_in_import()
    defaults = default_workers(usable_cores(), len(visible_gpus()))
    counts = {
        "GPU": defaults["GPU"] if gpu_workers is None else gpu_workers,
        "OTHER": defaults["OTHER"] if other_workers is None else other_workers,
    }
    _check_count("gpu_workers", counts["GPU"])
    _check_count("other_workers", counts["OTHER"])
    _check_count("lidar_slots", lidar_slots)
    security = _security(security)
    spec = partial(_worker_spec, host, environment or {}, security)
    workers = {f"GPU-{i}": spec("GPU", 1) for i in range(counts["GPU"])}
    workers |= {"LIDAR-0": spec("LIDAR", lidar_slots)}
    workers |= {f"OTHER-{i}": spec("OTHER", 1) for i in range(counts["OTHER"])}
    scheduler = {
        "cls": Scheduler,
        "options": {
            "host": host,
            "port": 0,
            "security": security,
            "dashboard": dashboard_port is not None,
            # Also without a dashboard there is an HTTP server, else on port 8787.
            "dashboard_address": f"{host}:{dashboard_port or 0}",
        },
    }
    try:
        return _NannyCluster(
            workers=workers, scheduler=scheduler, security=security, silence_logs=logging.ERROR
        )
    except RuntimeError as error:
        raise PoolError(
            f"The workers did not start ({error.__cause__ or error}). {_advice()}"
        ) from error


def _advice() -> str:
    """Say what to do where workers do not start, as far as that can be known."""
    try:
        Path.home()
    except RuntimeError:  # a user without an entry in the list of users, as in containers
        return "Dask's dashboard looks for a home folder: let HOME name one."
    return (
        "Each imports the script that starts the cluster: do that under "
        "`if __name__ == '__main__':` in it. If it does so, or there is none, one was killed while "
        "it started: look whether memory is short."
    )


def _security(wanted: Security | bool) -> Security:
    """Certificates to use: those given, new ones, or none but for Dask's configuration."""
    if isinstance(wanted, Security):
        return wanted
    if not wanted:
        return Security()
    try:
        return Security.temporary()
    except ImportError as error:
        raise PoolError(
            "A certificate for the cluster cannot be made, the package cryptography is "
            "missing: pip install cryptography, or start the cluster without encryption."
        ) from error


def _worker_spec(
    host: str, environment: Mapping[str, str], security: Security, partition: str, slots: int
) -> dict[str, Any]:
    """Describe a worker of a partition as SpecCluster wants it."""
    # One thread for each worker's numerical libraries: the processes share the cores.
    env = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    options = {
        "nthreads": slots,
        "resources": {partition: slots},
        "host": host,
        "security": security,
        "dashboard": False,
        "memory_limit": "auto",
        "env": {**env, **environment},
        "silence_logs": logging.ERROR,
    }
    return {"cls": Nanny, "options": options}


class _NannyCluster(SpecCluster):
    """A cluster that leaves dead workers to their nannies, and keeps the workers it has.

    A SpecCluster looks 15 seconds after a worker was lost whether one of its name is there,
    and if not closes the nanny for good. A worker that dies twice within that time may be
    starting just then, and would never come back.
    """

    def _update_worker_status(self, op: str, msg: Any) -> None:
        super(SpecCluster, self)._update_worker_status(op, msg)

    def scale(self, n: int = 0, **options: Any) -> None:
        """Refuse: SpecCluster would drop the workers described last, whatever their kind."""
        if self.status == Status.closing:  # it stops its workers by this
            super().scale(n, **options)
            return
        raise PoolError(
            "A cluster of local_cluster has a fixed number of workers: give it when you start "
            "one, or move workers with Partition.grow and Partition.shrink."
        )


def _check_count(name: str, count: int) -> None:
    if not isinstance(count, int) or count < 1:
        raise PoolError(f"{name} is {count!r}; give a whole number, 1 or more.")


def _refuse_in_import() -> None:
    """End a worker that has come here by importing the script which is starting it."""
    # What multiprocessing itself goes by; its error, a page from each worker, hides ours.
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        raise SystemExit(1)
