"""Map functions over items on the OTHER workers of a cluster."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import cloudpickle
import dask
from distributed import Client, KilledWorker
from distributed.client import FutureCancelledError

from lidarsim.errors import LidarError
from poolpart import Partition, PipeClosed, PipeFailed

from .lost_workers import LostWorkersError

LOST_S = 0.5  # time until a client notices that its scheduler is lost
# Errors that Dask raises after the scheduler is lost. Connection errors are OSErrors.
CLUSTER_LOST = (OSError, FutureCancelledError, PipeClosed, PipeFailed)
_PARTITION = "OTHER"
# Parts of a recording are processed one after the other, so large tasks do not accumulate.
_LARGE_TASKS = {"distributed.admin.large-graph-warning-threshold": "1 GiB"}


@contextmanager
def cluster_map(client: Client) -> Iterator[Callable[..., Iterator[Any]]]:
    """Yield a `map` function that runs on the OTHER workers of a client's cluster."""
    with dask.config.set(_LARGE_TASKS):
        yield partial(_map, client)


def is_connection_lost(client: Client, error: BaseException) -> bool:
    """Return True if the connection of a client to its scheduler is lost.

    Requests may fail shortly before the client notices the loss. If `error` suggests a lost
    scheduler, wait up to `LOST_S` seconds for the client to notice.
    """
    deadline = time.monotonic() + LOST_S
    while (
        client.status == "running"
        and isinstance(error, CLUSTER_LOST)
        and time.monotonic() < deadline
    ):
        time.sleep(0.01)
    return client.status != "running"


def _call(function: Callable[[Any], Any], item: Any) -> Any:
    return function(item)


def _map(client: Client, function: Callable[[Any], Any], items: Iterable[Any]) -> Iterator[Any]:
    address = getattr(client.scheduler, "address", "")
    # Each process unpickles the function once, so that the function can keep open files.
    setup = partial(cloudpickle.loads, cloudpickle.dumps(function))
    try:
        yield from Partition(_PARTITION, client).map(_call, items, chunk=1, setup=setup)
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
            "command were canceled by another client."
        ) from error
