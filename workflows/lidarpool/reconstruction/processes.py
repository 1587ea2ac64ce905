"""Worker processes that reconstruct submaps, either in a cluster or on this machine."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager, nullcontext
from functools import partial
from typing import Any

import dask
from dask.system import CPU_COUNT
from distributed import Client

import poolpart.deploy
from lidarsim.io.allowance import memory
from poolpart import Partition
from poolpart.deploy import forked_workers

from ..processes.fork_server import start_fork_server
from ..run.cluster.connection import check_starts_workers
from ..run.pipeline.stage_names import OTHER
from .finished_steps import MapFunction

_SUBMAP_BYTES = 3 << 30  # memory per process for a submap of a sensor with 64 rings
# Dask would terminate workers that exceed their share of the memory, and lose their tasks.
_UNLIMITED = dict.fromkeys(
    (f"distributed.worker.memory.{limit}" for limit in ("target", "spill", "pause", "terminate")),
    False,
)


@contextmanager
def parallel_map(client: Client | None, count: int) -> Iterator[MapFunction]:
    """Yield a `map` function that runs in worker processes and preserves the order of items.

    Parameters
    ----------
    client
        Client of a cluster whose OTHER workers run the function. None to start processes on this
        machine.
    count
        Maximum number of items. A single item is processed in this process.

    Raises
    ------
    LidarError
        If this process cannot start worker processes.
    """
    workers = min(count, CPU_COUNT, max(1, memory() // _SUBMAP_BYTES))
    if client is not None:
        yield partial(_map, Partition(OTHER, client))
    elif workers == 1:
        yield map
    else:
        check_starts_workers()
        forks = start_fork_server()
        with (
            dask.config.set(_UNLIMITED),
            forked_workers() if forks else nullcontext(),
            closing(
                poolpart.deploy.local_cluster({OTHER: (workers, 1)}, dashboard_port=None)
            ) as cluster,
            Client(cluster, set_as_default=False) as own,
        ):
            yield partial(_map, Partition(OTHER, own))


def _map(
    partition: Partition, function: Callable[[Any], Any], items: Iterable[Any]
) -> Iterable[Any]:
    return partition.map(function, items, chunk=1)
