"""Assign a CUDA device to each worker, and record this on the scheduler.

The assignment is part of the worker's state on the scheduler, and is removed together with the
worker. Therefore, all tasks of a worker get the same device, and nothing has to be cleaned up. A
restarted worker is a new worker for Dask and may have a new name, but it finds the device of its
predecessor free.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

from distributed import get_worker

from . import probe
from .task_context import WorkerLeavingError, own_client, translate_leaving_errors
from .workers import run_on_scheduler

_HELD = "poolpart-gpu"  # key in the scheduler's state of a worker, whose value is a device UUID

_own: dict[str, int | None] = {}  # {worker address in this process: device index}


@translate_leaving_errors()
def own_device() -> int | None:
    """Return the CUDA device index for this task's worker, or None if the worker has no GPU.

    The index refers to the devices that are visible to the worker. Workers are distributed evenly
    over the devices, because each worker is assigned the device with the fewest workers of its
    partition. Ties are resolved in favor of the device with the fewest workers of the whole
    cluster, and then in favor of the lowest index. A worker keeps its device until it exits, so all
    of its tasks receive the same index, and only the first call takes time.

    Raises
    ------
    WorkerLeavingError
        If the worker is leaving the cluster.
    ValueError
        If the function is called outside of a task.
    PoolError
        If poolpart is not installed in the scheduler's environment, or if the first call on a
        worker is made in a coroutine. In the latter case, call the function in a thread.

    Notes
    -----
    dask-cuda rotates `CUDA_VISIBLE_DEVICES` from worker to worker, so that device 0 differs between
    workers. Workers started by a plain `dask worker` command list the same devices in the same
    order. This function supports both cases.

    Examples
    --------
    >>> def decode(block):                                             # doctest: +SKIP
    ...     with cupy.cuda.Device(poolpart.own_device()):
    ...         return cupy.asnumpy(work(cupy.asarray(block)))
    """
    address = get_worker().address
    if address not in _own:
        device: int | None = None
        if gpus := probe.visible_gpus():
            device = run_on_scheduler(own_client(), assign_device, address=address, gpus=gpus)
            if device is None:
                raise WorkerLeavingError(f"The scheduler has removed the worker at {address}.")
        _own[address] = device
    return _own[address]


@translate_leaving_errors()
def own_device_share() -> float:
    """Return the fraction of device memory, from 0 to 1, that this task's worker may use.

    The fraction is 1 if no other worker shares the device. Workers of a partition that run on the
    same host and see the same number of devices share them evenly. A worker is counted as soon as
    it has joined the cluster, even before it uses its device.

    Raises
    ------
    WorkerLeavingError, ValueError, PoolError
        In the same cases as `own_device`.

    Examples
    --------
    >>> limit = int(own_device_share() * 8e9)                          # doctest: +SKIP
    """
    if own_device() is None:
        return 1.0
    address = get_worker().address
    gpus = probe.visible_gpus()
    sharers: int = run_on_scheduler(own_client(), count_sharers, address=address, gpus=gpus)
    return 1 / sharers


# -- on the scheduler ------------------------------------------------------------------


def assign_device(address: str, gpus: Sequence[str], dask_scheduler: Any = None) -> int | None:
    """Return the index in `gpus` of a worker's device, or None if the worker has left.

    The first call for a worker selects its device.
    """
    worker = dask_scheduler.workers.get(address)
    if worker is None:
        return None
    if _HELD not in worker.extra:
        worker.extra[_HELD] = _least_used(dask_scheduler, worker, gpus)
    return gpus.index(worker.extra[_HELD])


def count_sharers(address: str, gpus: Sequence[str], dask_scheduler: Any = None) -> int:
    """Return how many workers use, or are expected to use, the same device as a worker."""
    worker = dask_scheduler.workers.get(address)
    if worker is None:
        return 1
    partitions = _partitions(worker)
    peers = [
        peer
        for peer in dask_scheduler.workers.values()
        if peer.host == worker.host and not partitions.isdisjoint(_partitions(peer))
    ]
    held = worker.extra.get(_HELD)
    users = sum(peer.extra.get(_HELD) == held for peer in dask_scheduler.workers.values())
    return max(1, users, -(-len(peers) // len(gpus)))


def _least_used(scheduler: Any, worker: Any, gpus: Sequence[str]) -> str:
    """Return the UUID of the device that is used by the fewest workers in the partition.

    Ties are resolved in favor of the device with the fewest workers in the cluster.
    """
    users_in_partition = Counter[str]()  # {UUID: workers}
    users = Counter[str]()  # {UUID: workers}
    partitions = _partitions(worker)
    for peer in scheduler.workers.values():
        if gpu := peer.extra.get(_HELD):
            users[gpu] += 1
            users_in_partition[gpu] += not partitions.isdisjoint(_partitions(peer))
    return min(gpus, key=lambda gpu: (users_in_partition[gpu], users[gpu]))


def _partitions(worker: Any) -> set[str]:
    return {name for name, slots in worker.resources.items() if slots}
