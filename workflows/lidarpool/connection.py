"""Clients of clusters: of one on this machine that is started for it, or of one that is there."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

from distributed import Client
from distributed.comm import connect

from poolpart import local_cluster

from .errors import LidarpoolError
from .interrupts import children_spared, deferred_interrupts

CONNECT_TIMEOUT_S = 10


@contextmanager
def local_client(
    *, gpu_workers: int | None, collectors: int, other_workers: int | None
) -> Iterator[Client]:
    """Client of a cluster on this machine that lasts as long as the body.

    Half a cluster cannot be stopped in good order: an interrupt waits until it is up, and one
    that comes while it is being stopped waits until it is down.

    Parameters
    ----------
    gpu_workers, other_workers
        Workers of these partitions; None for what suits the machine.
    collectors
        Tasks of stage 4: with stages 1 and 3 they determine the slots of LIDAR.

    Raises
    ------
    PoolError
        If the workers do not start.
    """
    stack = ExitStack()
    try:
        with deferred_interrupts(), children_spared():
            cluster = local_cluster(
                gpu_workers=gpu_workers, lidar_slots=2 + collectors, other_workers=other_workers
            )
            stack.callback(cluster.close)
            client = stack.enter_context(Client(cluster, set_as_default=False))
        yield client
    finally:
        with deferred_interrupts():
            stack.close()


@contextmanager
def connected(scheduler: str) -> Iterator[Client]:
    """Client of a cluster that is running already.

    Raises
    ------
    LidarpoolError
        If no scheduler answers at this address.
    """
    try:
        asyncio.run(asyncio.wait_for(_knock(scheduler), CONNECT_TIMEOUT_S))
        client = Client(scheduler, timeout=CONNECT_TIMEOUT_S, set_as_default=False)
    except Exception as error:
        # What is there may be no scheduler, and what it answers may make any error.
        raise LidarpoolError(
            f"No Dask scheduler answers at {scheduler!r} ({type(error).__name__}): start one with "
            "dask scheduler, and give its address as tcp://host:8786."
        ) from error
    with client:
        yield client


async def _knock(address: str) -> None:
    """See whether a scheduler answers; a client waits for ever for one that says nothing."""
    comm = await connect(address, timeout=CONNECT_TIMEOUT_S)
    comm.abort()
