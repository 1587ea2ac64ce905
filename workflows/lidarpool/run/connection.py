"""Clients of clusters: of one on this machine that is started for it, or of one that is there."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import NamedTuple

import dask
from distributed import Client, Security
from distributed.comm import connect

from poolpart.internals import forked_workers

from ..base.errors import LidarpoolError
from ..base.fork_server import start_fork_server
from ..base.interrupts import children_spared, deferred_interrupts
from .cluster_file import ClusterFile
from .local import local_cluster

CONNECT_TIMEOUT_S = 10

# What Dask watches many times a second in each process, for a dashboard that a cluster of one run
# does not have: idle, a worker took 3 % of a core, and now takes a fifth of that.
_QUIET = {
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.system-monitor.interval": "5s",
}


class TlsFiles(NamedTuple):
    """PEM files for an encrypted cluster: its authority's certificates, ours, and our key."""

    ca: Path | None = None
    cert: Path | None = None
    key: Path | None = None


@contextmanager
def local_client(
    *,
    gpu_workers: int | None,
    collectors: int,
    other_workers: int | None,
    planning: bool = True,
    tls: bool = False,
) -> Iterator[Client]:
    """Client of a cluster on this machine that lasts as long as the body.

    Half a cluster cannot be stopped in good order: an interrupt waits until it is up, and one
    that comes while it is being stopped waits until it is down.

    Parameters
    ----------
    gpu_workers, other_workers
        Workers of these partitions; None for what suits the machine.
    planning
        Whether something is planned; else there is no worker of OTHER by default.
    collectors
        Tasks of stage 4: with stages 1 and 3 they determine the slots of LIDAR.
    tls
        Encrypt what its processes say to each other, with a certificate of its own.

    Raises
    ------
    PoolError
        If the workers do not start, or no certificate can be made.
    """
    stack = ExitStack()
    try:
        with deferred_interrupts(), children_spared():
            stack.enter_context(dask.config.set(_QUIET))
            if start_fork_server():
                stack.enter_context(forked_workers())
            cluster = local_cluster(
                gpu_workers=gpu_workers,
                lidar_slots=2 + collectors,
                other_workers=other_workers if planning or other_workers else 0,
                security=tls,
                dashboard_port=None,  # nobody is told of it, and Bokeh takes half a second
            )
            stack.callback(cluster.close)
            client = stack.enter_context(Client(cluster, set_as_default=False))
        yield client
    finally:
        with deferred_interrupts():
            stack.close()


@contextmanager
def started_client(file: ClusterFile, tell: Callable[[str], object]) -> Iterator[Client]:
    """Client of a cluster that is started for it and lasts as long as the body.

    An interrupt waits until all jobs are in the queue, and until they have been cancelled. `tell`
    is called with what goes wrong with workers.

    Raises
    ------
    LidarpoolError
        If it does not start.
    """
    stack = ExitStack()
    try:
        with deferred_interrupts(), children_spared():
            cluster = stack.enter_context(file.started(tell))
            client = stack.enter_context(Client(cluster, set_as_default=False))
        yield client
    finally:
        with deferred_interrupts():
            stack.close()


@contextmanager
def connected(scheduler: str, files: TlsFiles | None = None) -> Iterator[Client]:
    """Client of a cluster that is running already.

    Parameters
    ----------
    scheduler
        Address, ``tcp://host:8786`` or ``tls://host:8786``.
    files
        Certificates for the latter; by default those of Dask's configuration.

    Raises
    ------
    LidarpoolError
        If no scheduler answers at this address, or the certificates are wrong.
    """
    if ":" not in scheduler.rpartition("//")[2] and not scheduler.startswith("inproc"):
        raise LidarpoolError(
            f"The address {scheduler!r} has no port: give that of the scheduler, such as "
            f"{scheduler}:8786."
        )
    try:
        security = Security()
        if files and any(files):
            ca, cert, key = (path and str(path) for path in files)
            security = Security(
                require_encryption=True, tls_ca_file=ca, tls_client_cert=cert, tls_client_key=key
            )
        asyncio.run(asyncio.wait_for(_knock(scheduler, security), CONNECT_TIMEOUT_S))
        client = Client(
            scheduler, security=security, timeout=CONNECT_TIMEOUT_S, set_as_default=False
        )
    except Exception as error:
        # Another program may listen there, and its answer may cause any error.
        cause: BaseException = error
        while cause.__cause__ or cause.__context__:
            cause = cause.__cause__ or cause.__context__  # type: ignore[assignment]
        reason = " ".join(f"{type(cause).__name__}: {cause}".split())[:200].rstrip(": ")
        raise LidarpoolError(
            f"No Dask scheduler answers at {scheduler!r} ({reason}): start one with dask "
            "scheduler, and give its address as tcp://host:8786; of an encrypted one as "
            "tls://host:8786, with --tls-ca, --tls-cert and --tls-key."
        ) from error
    with client:
        yield client


async def _knock(address: str, security: Security) -> None:
    """Check that a scheduler answers; a client waits for ever for a silent one."""
    comm = await connect(
        address, timeout=CONNECT_TIMEOUT_S, **security.get_connection_args("client")
    )
    comm.abort()
