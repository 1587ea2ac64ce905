"""A cluster on this machine: how its workers start, and start again."""

from __future__ import annotations

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
    """Let nannies fork workers from the fork server, at first and for a restart.

    Dask would make it import pandas and more; it has already imported what is needed.
    """
    utils = distributed.utils
    preload_set = utils._forkserver_preload_set
    with dask.config.set({"distributed.worker.multiprocessing-method": "forkserver"}):
        utils._forkserver_preload_set = True
        try:
            yield
        finally:
            utils._forkserver_preload_set = preload_set


_starting: set[Nanny] = set()  # nannies of `ScriptlessNanny` that are starting a worker


@cache  # once: another library may have wrapped the same since
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
    """A nanny whose workers do not import the script that starts the nanny.

    multiprocessing imports it to find functions by name, and a script without a main guard would
    start itself again in each worker. Dask sends what a script defines by value.
    """

    async def instantiate(self) -> Status:
        """Start or restart a worker."""
        _spare_workers_the_script()
        _starting.add(self)
        try:
            return await super().instantiate()
        finally:
            _starting.discard(self)


class FixedCluster(SpecCluster):
    """A cluster that leaves dead workers to their nannies, and cannot be scaled.

    15 seconds after a worker was lost, a SpecCluster closes its nanny unless a worker of its name
    is present. A worker that dies twice within that time may be starting just then, and would
    never come back.
    """

    def _update_worker_status(self, op: str, msg: Any) -> None:
        super(SpecCluster, self)._update_worker_status(op, msg)

    def scale(self, n: int = 0, **options: Any) -> None:
        """Refuse: SpecCluster would drop the workers specified last, whatever their kind."""
        if self.status == Status.closing:  # it stops its workers by this
            super().scale(n, **options)
            return
        raise PoolError(
            "A cluster that `local_cluster` started has a fixed number of workers. Specify the "
            "number when you start the cluster. To move workers between partitions, use "
            "`Partition.grow` and `Partition.shrink`."
        )
