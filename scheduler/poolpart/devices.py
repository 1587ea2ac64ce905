"""The CUDA device of each worker, kept on the scheduler for the worker's life.

It is stored in the scheduler's state of the worker, which ends with the worker. So everybody
gets the same answer; a restarted worker, which is a new one to Dask and may have a new name,
finds the device of its predecessor free; and nothing has to be cleaned up.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from distributed import Client, get_worker

from . import probe
from .task_context import WorkerLeft, in_event_loop, own_client, telling_departure
from .workers import WorkerInfo, on_scheduler

_HELD = "poolpart-gpu"  # key in the scheduler's state of a worker: UUID of its device

_lock = threading.Lock()
_own: dict[str, int | None] = {}  # {address of a worker of this process: its device}


def assign_devices(client: Client, workers: Iterable[WorkerInfo]) -> dict[str, int]:
    """Give each worker a CUDA device, by the worker's own numbering.

    Workers spread over the devices that they see: each takes the first device in its list that
    the fewest others use, in its partition first, then in the cluster. dask-cuda rotates
    `CUDA_VISIBLE_DEVICES` from worker to worker so that number 0 is another device in each,
    whereas workers of a plain `dask worker` all list the same devices in the same order.
    Workers that see the fewest devices choose first. A worker keeps its device until it ends.

    Parameters
    ----------
    client
        Client of their cluster.
    workers
        The workers, as a `Pool` knows them.

    Returns
    -------
    dict
        Address to ordinal, for the present workers that see a device.

    Raises
    ------
    PoolError
        If the scheduler lacks this package.

    Examples
    --------
    >>> assign_devices(client, Pool.from_client(client))               # doctest: +SKIP
    {'tcp://127.0.0.1:36721': 0, 'tcp://127.0.0.1:44013': 1}
    """
    visible = {worker.address: worker.gpus for worker in workers if worker.gpus}
    if not visible:
        return {}
    devices: dict[str, int] = on_scheduler(client, _assign, visible=visible)
    return devices


@telling_departure()
def own_device() -> int | None:
    """CUDA device that this task's worker should use; None if it sees none.

    See `assign_devices`, which need not have been called. The answer is the same for all tasks
    of a worker, and takes no time from the second one on.

    Raises
    ------
    WorkerLeft
        If the worker is leaving.
    ValueError
        Outside of a task.
    PoolError
        In the first call on a worker, if it is in a coroutine: call it in a thread.

    Examples
    --------
    >>> def decode(block):                                             # doctest: +SKIP
    ...     with cupy.cuda.Device(poolpart.own_device()):
    ...         return cupy.asnumpy(work(cupy.asarray(block)))
    """
    address = get_worker().address
    if address in _own:
        return _own[address]
    if in_event_loop():  # a thread that holds the lock needs the loop
        return _ask(address)
    with _lock:  # of several tasks that start at once, one asks
        if address not in _own:
            _own[address] = _ask(address)
        return _own[address]


def _ask(address: str) -> int | None:
    # Ask the driver only for unknown devices: that takes up to a second.
    if not probe.has_driver():
        return None
    device: int | None = on_scheduler(own_client(), _known, address=address)
    if device is None and (gpus := probe.visible_gpus()):
        devices = on_scheduler(own_client(), _assign, visible={address: gpus})
        if address not in devices:
            raise WorkerLeft(f"the scheduler has given up the worker at {address}")
        device = devices[address]
    return device


# -- on the scheduler ------------------------------------------------------------------


def _known(address: str, dask_scheduler: Any = None) -> int | None:
    state = dask_scheduler.workers.get(address)
    held: tuple[str, int] | None = state and state.extra.get(_HELD)
    return held[1] if held else None


def _assign(visible: Mapping[str, Sequence[str]], dask_scheduler: Any = None) -> dict[str, int]:
    """Choose for workers without a device; {address: UUIDs that it sees, by ordinal}."""
    here = {a: list(gpus) for a, gpus in visible.items() if a in dask_scheduler.workers}
    for address, gpus in sorted(here.items(), key=lambda item: len(item[1])):
        state = dask_scheduler.workers[address]
        if _HELD not in state.extra:
            gpu = _least_used(dask_scheduler, state, gpus)
            state.extra[_HELD] = gpu, gpus.index(gpu)
    return {address: dask_scheduler.workers[address].extra[_HELD][1] for address in here}


def _least_used(scheduler: Any, worker: Any, gpus: Sequence[str]) -> str:
    fellows, everyone = Counter[str](), Counter[str]()  # {UUID: workers that use it}
    own = _partitions(worker)
    for other in scheduler.workers.values():
        if held := other.extra.get(_HELD):
            everyone[held[0]] += 1
            fellows[held[0]] += not own.isdisjoint(_partitions(other))
    return min(gpus, key=lambda gpu: (fellows[gpu], everyone[gpu]))


def _partitions(worker: Any) -> set[str]:
    return {name for name, slots in worker.resources.items() if slots}
