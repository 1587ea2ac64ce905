"""Clients for a local cluster started for the run, or for an existing cluster."""

from __future__ import annotations

import asyncio
import errno
import socket
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
from .checks import LOOK_EVERY_S
from .cluster_file import ClusterFile
from .local import local_cluster
from .waiting import Waiting

CONNECT_TIMEOUT_S = 10
_UNREACHABLE = (errno.EHOSTUNREACH, errno.ENETUNREACH, errno.EHOSTDOWN)  # a host that is starting

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
                dashboard_port=None,  # its address is never printed, and Bokeh takes half a second
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
def connected(
    scheduler: str, files: TlsFiles | None = None, waiting: Waiting | None = None
) -> Iterator[Client]:
    """Client of a cluster that is running already, or will be soon.

    Parameters
    ----------
    scheduler
        Address, ``tcp://host:8786`` or ``tls://host:8786``.
    files
        Certificates for the latter; by default those of Dask's configuration.
    waiting
        How long to wait for a scheduler that nobody has started yet; by default some seconds, for
        a slow one.

    Raises
    ------
    LidarpoolError
        If no scheduler answers at this address, or the certificates are wrong.
    """
    if not scheduler.startswith("inproc"):
        _check_address(scheduler)
    waiting = waiting or Waiting()
    try:
        security = Security()
        if files and any(files):
            ca, cert, key = (path and str(path) for path in files)
            security = Security(
                require_encryption=True, tls_ca_file=ca, tls_client_cert=cert, tls_client_key=key
            )
        asyncio.run(_reach(scheduler, security, waiting))
        client = Client(
            scheduler, security=security, timeout=CONNECT_TIMEOUT_S, set_as_default=False
        )
    except Exception as error:
        waited = f" within {waiting.seconds:g} s" if waiting.seconds and _absent(error) else ""
        raise LidarpoolError(
            f"No Dask scheduler answers at {scheduler!r}{waited} ({_reason(error)}): start one "
            "with dask scheduler, and give its address as tcp://host:8786; of an encrypted one as "
            "tls://host:8786, with --tls-ca, --tls-cert and --tls-key."
        ) from error
    with client:
        yield client


def _check_address(address: str) -> None:
    """Refuse an address at which nothing can ever be."""
    host, _, port = address.rpartition("//")[2].partition("/")[0].rpartition(":")
    if not host:
        raise LidarpoolError(
            f"The address {address!r} has no {'host' if port.isdigit() else 'port'}: give that of "
            f"the scheduler, such as {'tcp://host' if port.isdigit() else address}:8786."
        )
    if port.isdigit() and not 0 < int(port) < 1 << 16:
        raise LidarpoolError(
            f"The address {address!r} has the port {port}: ports are 1 to 65535; a scheduler's is "
            "8786 if nothing else is said, tcp://host:8786."
        )


async def _reach(address: str, security: Security, waiting: Waiting) -> None:
    """Return when a scheduler answers; a client waits for ever for a silent one."""
    why = "nobody answers"
    while True:
        timeout: float = CONNECT_TIMEOUT_S
        if waiting.seconds:
            timeout = min(timeout, max(waiting.left(), 1.0))
        knock = asyncio.ensure_future(asyncio.wait_for(_knock(address, security), timeout))
        while not (await asyncio.wait({knock}, timeout=LOOK_EVERY_S))[0]:
            waiting.tell(f"the scheduler at {address}", why)
        if (error := knock.exception()) is None:
            return
        if not waiting.left() or not _absent(error):
            raise error
        why = _reason(error)
        waiting.tell(f"the scheduler at {address}", why)
        await asyncio.sleep(LOOK_EVERY_S)


async def _knock(address: str, security: Security) -> None:
    """Check that a scheduler answers."""
    comm = await connect(
        address, timeout=CONNECT_TIMEOUT_S, **security.get_connection_args("client")
    )
    comm.abort()


def _root(error: BaseException) -> BaseException:
    """First cause of an error. Another program may listen there, and its answer may cause any."""
    while error.__cause__ or error.__context__:
        error = error.__cause__ or error.__context__  # type: ignore[assignment]
    return error


def _absent(error: BaseException) -> bool:
    """Whether nothing was there, not even a name, so that it may come; not a refusal."""
    root = _root(error)
    absent = (ConnectionRefusedError, TimeoutError, asyncio.CancelledError, socket.gaierror)
    return isinstance(root, absent) or getattr(root, "errno", None) in _UNREACHABLE


def _reason(error: BaseException) -> str:
    root = _root(error)
    return " ".join(f"{type(root).__name__}: {root}".split())[:200].rstrip(": ")
