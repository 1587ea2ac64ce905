"""The cluster that a survey starts on this machine: how many workers each partition has."""

from __future__ import annotations

import os
from typing import Any

from distributed import SpecCluster

import poolpart
from poolpart.local import check_count
from poolpart.probe import visible_gpus

from ..scan import GPU, LIDAR, OTHER


def usable_cores() -> int:
    """Processor cores that this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def default_workers(cores: int, gpus: int) -> dict[str, int]:
    """Worker processes of the GPU and OTHER partitions for a machine.

    One worker a GPU, and OTHER has the rest of the cores. Without GPUs the GPU partition falls
    back to CPU workers, for three quarters of the cores. The LIDAR stages mostly wait and share
    one process.

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
        Workers of the GPU partition, one thread each; by default one a GPU, or for three
        quarters of the cores where there is no GPU.
    lidar_slots
        Threads, and slots, of the one LIDAR worker.
    other_workers
        Workers of the OTHER partition, one thread each; by default what is left. 0 for none.
    **options
        What `poolpart.local_cluster` takes besides.

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
