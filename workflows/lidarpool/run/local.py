"""The local cluster of a survey: the number of workers of each partition."""

from __future__ import annotations

from typing import Any

from dask.system import CPU_COUNT
from distributed import SpecCluster

import poolpart
from poolpart.probe import visible_gpus
from poolpart.rules import check_count

from ..pipeline import GPU, LIDAR, OTHER


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

    Workers of GPU and OTHER have one thread each; their default numbers are `default_workers` of
    this machine, and OTHER may have none. The one LIDAR worker has `lidar_slots` threads and slots.
    Further options, and the errors, are those of `poolpart.local_cluster`.
    """
    defaults = default_workers(CPU_COUNT, len(visible_gpus()))
    gpu_workers = defaults[GPU] if gpu_workers is None else gpu_workers
    other_workers = defaults[OTHER] if other_workers is None else other_workers
    check_count("gpu_workers", gpu_workers)
    return poolpart.local_cluster(
        {GPU: (gpu_workers, 1), LIDAR: (1, lidar_slots), OTHER: (other_workers, 1)}, **options
    )
