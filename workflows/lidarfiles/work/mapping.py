"""Map functions over items in worker processes, either on this machine or in a cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager
from typing import TYPE_CHECKING, Any

from lidarsim.environment.extras import require_package
from lidarsim.io.allowance import memory

from ..processes.processors import processor_count

if TYPE_CHECKING:
    from distributed import Client as Client  # for annotations of its callers

MapFunction = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]


def describe_sweeps(first: int, last: int) -> str:
    """Describe consecutive sweeps in a message.

    Examples
    --------
    >>> describe_sweeps(8, 15), describe_sweeps(3, 3)
    ('sweeps 8 to 15', 'sweep 3')
    """
    return f"sweep {first}" if first == last else f"sweeps {first} to {last}"


@contextmanager
def parallel_map(
    client: Client | None, count: int, worker_bytes: int, workers: int | None = None
) -> Iterator[MapFunction]:
    """Yield a `map` function that runs in worker processes and preserves the order of items.

    Items may come from a generator, because the number of items in flight is limited. If a process
    dies, its item is tried once more. The function raises LostWorkersError if an item kills its
    process twice, or if the scheduler is lost.

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
    """
    if client is not None:
        require_package("poolpart", "cluster", "Work on a cluster")
        from .cluster_map import cluster_map  # imports Dask

        with cluster_map(client) as run:
            yield run
        return
    if workers is None:
        workers = min(processor_count(), max(1, memory() // worker_bytes))
    workers = min(count, workers)
    if workers <= 1:
        yield map
        return
    from .process_pool import ProcessPool

    with closing(ProcessPool(workers)) as pool:
        yield pool.map
