"""Map functions over items in worker processes, either in a cluster or on this machine."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager, nullcontext
from functools import partial
from typing import Any

import dask
from dask.system import CPU_COUNT
from distributed import Client, KilledWorker, SpecCluster

import poolpart.deploy
from lidarsim.errors import LidarError
from lidarsim.io.allowance import memory
from poolpart import Partition
from poolpart.deploy import forked_workers

from ...processes.fork_server import start_fork_server
from ..pipeline.stage_names import OTHER
from .cluster import is_connection_lost
from .connection import check_starts_workers, client_of

MapFunction = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]

# Dask would terminate workers that exceed their share of the memory, and lose their tasks.
_UNLIMITED = dict.fromkeys(
    (f"distributed.worker.memory.{limit}" for limit in ("target", "spill", "pause", "terminate")),
    False,
)


# Parts of a recording are processed one after the other, so large tasks do not accumulate.
_LARGE_TASKS = {"distributed.admin.large-graph-warning-threshold": "1 GiB"}


class LostWorkersError(LidarError):
    """Raised if the cluster is lost, or if an item repeatedly kills its workers."""


@contextmanager
def parallel_map(
    client: Client | None, count: int, worker_bytes: int, workers: int | None = None
) -> Iterator[MapFunction]:
    """Yield a `map` function that runs in worker processes and preserves the order of items.

    Items may come from a generator, because the number of items in flight is limited. The
    function raises LostWorkersError if the scheduler is lost or if an item kills its workers.

    Parameters
    ----------
    client
        Client of a cluster whose OTHER workers run the function. None to start processes on this
        machine.
    count
        Maximum number of items. A single item is processed in this process.
    worker_bytes
        Memory that a process on this machine requires, in bytes.
    workers
        Number of processes on this machine. By default, it depends on the number of cores and the
        memory.

    Raises
    ------
    LidarError
        If this process cannot start worker processes.
    """
    if workers is None:
        workers = min(CPU_COUNT, max(1, memory() // worker_bytes))
    workers = min(count, workers)
    if client is not None:
        with dask.config.set(_LARGE_TASKS):
            yield partial(_map, client)
    elif workers <= 1:
        yield map
    else:
        check_starts_workers()
        with (
            dask.config.set(_LARGE_TASKS),
            client_of(_local_cluster(workers, forks=start_fork_server())) as own,
        ):
            yield partial(_map, own)


@contextmanager
def _local_cluster(workers: int, *, forks: bool) -> Iterator[SpecCluster]:
    with (
        dask.config.set(_UNLIMITED),
        forked_workers() if forks else nullcontext(),
        closing(
            poolpart.deploy.local_cluster({OTHER: (workers, 1)}, dashboard_port=None)
        ) as cluster,
    ):
        yield cluster


def _map(client: Client, function: Callable[[Any], Any], items: Iterable[Any]) -> Iterator[Any]:
    address = getattr(client.scheduler, "address", "")
    try:
        yield from Partition(OTHER, client).map(function, items, chunk=1)
    except LidarError:
        raise
    except KilledWorker as error:
        raise LostWorkersError(
            "Several workers ended while they processed the same part of the recording, probably "
            "because they ran out of memory. Use fewer workers per machine."
        ) from error
    except Exception as error:  # a client without a scheduler may raise any error
        if not is_connection_lost(client, error):
            raise
        raise LostWorkersError(
            f"The cluster at {address} is no longer reachable, or the tasks of this "
            "command were canceled by a different client."
        ) from error
