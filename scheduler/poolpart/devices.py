"""The CUDA device of each worker, kept on the scheduler for the worker's life.

It is stored in the scheduler's state of the worker, which ends with the worker. So everybody
gets the same answer; a restarted worker, which is a new one to Dask and may have a new name,
finds the device of its predecessor free; and nothing has to be cleaned up.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

from distributed import get_worker

from . import probe
from .task_context import WorkerLeft, own_client, telling_departure
from .workers import on_scheduler

_HELD = "poolpart-gpu"  # key in the scheduler's state of a worker: UUID of its device

_own: dict[str, int | None] = {}  # {address of a worker of this process: its device}


@telling_departure()
def own_device() -> int | None:
    """CUDA device that this task's worker should use, by the worker's own numbering, or None.

    Workers spread over the devices that they see: each takes the first device in its list that
    the fewest others use, in its partition first, then in the cluster. dask-cuda rotates
    `CUDA_VISIBLE_DEVICES` from worker to worker so that number 0 is another device in each,
    whereas workers of a plain `dask worker` all list the same devices in the same order.
    A worker keeps its device until it ends: the answer is the same for all of its tasks, and takes
    no time from the second one on.

    Raises
    ------
    WorkerLeft
        If the worker is leaving.
    ValueError
        Outside of a task.
    PoolError
        If the scheduler lacks this package; in the first call on a worker, if it is in a
        coroutine: call it in a thread.

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
            device = on_scheduler(own_client(), assign_device, address=address, gpus=gpus)
            if device is None:
                raise WorkerLeft(f"the scheduler has given up the worker at {address}")
        _own[address] = device
    return _own[address]


@telling_departure()
def own_device_share() -> float:
    """Share of its device's memory that this task's worker may take: 1 if no other uses the device.

    The workers of a partition and host that see as many devices share these evenly. They count as
    soon as they have joined. The errors of `own_device` are raised here, too.
    """
    if own_device() is None:
        return 1.0
    address = get_worker().address
    gpus = probe.visible_gpus()
    sharers: int = on_scheduler(own_client(), count_sharers, address=address, gpus=gpus)
    return 1 / sharers


# -- on the scheduler ------------------------------------------------------------------


def assign_device(address: str, gpus: Sequence[str], dask_scheduler: Any = None) -> int | None:
    """Return the device of a worker for its list of UUIDs, or None if the worker has left."""
    worker = dask_scheduler.workers.get(address)
    if worker is None:
        return None
    if _HELD not in worker.extra:
        worker.extra[_HELD] = _least_used(dask_scheduler, worker, gpus)
    return gpus.index(worker.extra[_HELD])


def count_sharers(address: str, gpus: Sequence[str], dask_scheduler: Any = None) -> int:
    """Return the number of workers that use a worker's device, or are about to, at least 1."""
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
    """Return the device that the fewest workers use, in the partition first, then in all."""
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
