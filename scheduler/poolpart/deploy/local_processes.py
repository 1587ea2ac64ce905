"""Start and restart the worker processes of local clusters."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache, wraps
from multiprocessing import spawn
from typing import Any

import dask
import distributed
from distributed import Nanny, SpecCluster, Status

from ..errors import PoolError


@contextmanager
def forked_workers() -> Iterator[None]:
    """Within the block, make nannies fork their workers from the fork server.

    This applies to the first start and to restarts. By default, Dask would make the fork server
    import pandas and other libraries. Here, the fork server has already imported what is needed.
    """
    utils = distributed.utils
    preload_set = utils._forkserver_preload_set
    with dask.config.set({"distributed.worker.multiprocessing-method": "forkserver"}):
        utils._forkserver_preload_set = True
        try:
            yield
        finally:
            utils._forkserver_preload_set = preload_set


_starting: set[Nanny] = set()  # instances of `ScriptlessNanny` that are starting a worker


@cache  # only once per process, because another library may have wrapped the wrapper since
def _spare_workers_the_script() -> None:
    prepare = spawn.get_preparation_data

    @wraps(prepare)
    def without_script(name: str) -> dict[str, Any]:
        data = prepare(name)
        if _starting and name.startswith("Dask Worker process"):
            data = {key: data[key] for key in data if not key.startswith("init_main_from")}
        return data

    spawn.get_preparation_data = without_script


class ScriptlessNanny(Nanny):
    """Nanny whose workers do not import the script that starts the nanny.

    multiprocessing imports the main script of the parent process to find functions by name. A
    script without a main guard would therefore run again in each worker. Dask pickles the functions
    of a script by value, so the import is not needed.

    A restart waits for the previous start. In distributed 2026.8, a worker may die right after it
    has connected. The previous start then returns during the restart, and marks the process that
    has not started yet as running. Closing the nanny would raise an AssertionError.
    """

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._start_lock = asyncio.Lock()

    async def instantiate(self) -> Status:
        """Start or restart the worker process, without importing the script."""
        _spare_workers_the_script()
        async with self._start_lock:
            _starting.add(self)
            try:
                return await super().instantiate()
            finally:
                _starting.discard(self)


class FixedCluster(SpecCluster):
    """Cluster with a fixed number of workers. Only nannies restart dead workers.

    15 seconds after a worker was lost, a plain SpecCluster closes the nanny of this worker unless a
    worker with the same name is present. A worker that dies twice within this time may just be
    restarting at that moment, and would never return.

    In distributed 2026.8, `Client.wait_for_workers` replaces the worker list. If a worker leaves
    meanwhile, its removal is announced although the new list does not contain it. A plain cluster
    would raise KeyError when it closes.
    """

    def _update_worker_status(self, op: str, msg: Any) -> None:
        if op == "remove" and msg not in self.scheduler_info["workers"]:
            return
        super(SpecCluster, self)._update_worker_status(op, msg)

    def scale(self, n: int = 0, **options: Any) -> None:
        """Raise PoolError, because SpecCluster would ignore partitions when removing workers."""
        if self.status == Status.closing:  # SpecCluster calls this method to close its workers
            super().scale(n, **options)
            return
        raise PoolError(
            "A cluster that `local_cluster` started has a fixed number of workers. Specify the "
            "number when you start the cluster. To move workers between partitions, use "
            "`Partition.grow` and `Partition.shrink`."
        )
