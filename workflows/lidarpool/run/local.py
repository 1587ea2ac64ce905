"""The local cluster of a survey: the number of workers of each partition."""

from __future__ import annotations

import os
from typing import Any

from distributed import SpecCluster

import poolpart
from poolpart.local import check_count
from poolpart.probe import visible_gpus

from ..pipeline import GPU, LIDAR, OTHER


def usable_cores() -> int:
    """Processor cores that this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def default_workers(cores: int, gpus: int) -> dict[str, int]:
    """Worker processes of the GPU and OTHER partitions for a machine.

    One worker for each GPU, and OTHER has the remaining cores. Without GPUs the GPU partition has
    CPU workers for three quarters of the cores. The LIDAR stages mostly wait, so they share one
    process.

    Examples
    --------
    >>> default_workers(cores=2, gpus=0), default_workers(cores=16, gpus=2)
    ({'GPU': 2, 'OTHER': 1}, {'GPU': 2, 'OTHER': 13})
    """
    casting = gpus or max(1, cores - cores // 4)
    return {GPU: casting, OTHER: max(1, cores - casting - (1 if gpus and cores > 2 else 0))}


def local_cluster(
    *,
    gpu_workers: int | None = None,
    lidar_slots: int = 4,
    other_workers: int | None = None,
    **options: Any,
) -> SpecCluster:
    """Start a Dask cluster on this machine, divided into GPU, LIDAR and OTHER.

    Parameters
    ----------
    gpu_workers
        Workers of the GPU partition, one thread each; by default one for each GPU, or without GPUs
        for three quarters of the cores.
    lidar_slots
        Threads, and slots, of the one LIDAR worker.
    other_workers
        Workers of the OTHER partition, one thread each; by default the remaining cores. 0 for none.
    **options
        Further options of `poolpart.local_cluster`.

    Raises
    ------
    PoolError
        If a number is too small, or for the reasons of `poolpart.local_cluster`.
    """
    defaults = default_workers(usable_cores(), len(visible_gpus()))
    gpu_workers = defaults[GPU] if gpu_workers is None else gpu_workers
    other_workers = defaults[OTHER] if other_workers is None else other_workers
    check_count("gpu_workers", gpu_workers)
    return poolpart.local_cluster(
        {GPU: (gpu_workers, 1), LIDAR: (1, lidar_slots), OTHER: (other_workers, 1)}, **options
    )
