"""Clients of clusters: of one on this machine that is started for it, or of one that is there."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

from distributed import Client, Security
from distributed.comm import connect

from ..base.errors import LidarpoolError
from ..base.interrupts import children_spared, deferred_interrupts
from .local import local_cluster
from .tls import NO_FILES, TlsFiles, security_for

CONNECT_TIMEOUT_S = 10

# What Dask, tornado and OpenSSL say of a connection that did not come about, and what it means.
_SIGNS = (
    (
        "tls://",
        ["CERTIFICATE_VERIFY_FAILED"],
        "shows a certificate that is not signed by the authority given here: give the cluster's "
        "own as --tls-ca.",
    ),
    (
        "tls://",
        # The second: it has sent its greeting already when the encryption is to begin.
        ["WRONG_VERSION_NUMBER", "IOStream is not idle"],
        "does not encrypt: give its address as tcp://host:8786, without certificates.",
    ),
    (
        "tls://",
        # It says so, or it has hung up before that was heard.
        ["_ALERT_", "SSLEOFError", "ConnectionResetError", "StreamClosedError"],
        "refuses the certificate given here: give one that the cluster's authority has signed, "
        "as --tls-cert and --tls-key.",
    ),
    (
        "tcp://",
        ["ConnectionResetError"],
        "hangs up, as an encrypted one does, and others that are no Dask scheduler: give its "
        "address as tls://host:8786, and its certificates.",
    ),
)


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
            cluster = local_cluster(
                gpu_workers=gpu_workers,
                lidar_slots=2 + collectors,
                other_workers=other_workers if planning or other_workers else 0,
                security=tls,
            )
            stack.callback(cluster.close)
            client = stack.enter_context(Client(cluster, set_as_default=False))
        yield client
    finally:
        with deferred_interrupts():
            stack.close()


@contextmanager
def connected(scheduler: str, files: TlsFiles = NO_FILES) -> Iterator[Client]:
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
        If no scheduler answers at this address, or the certificates do not do.
    """
    security = security_for(scheduler, files)
    try:
        asyncio.run(asyncio.wait_for(_knock(scheduler, security), CONNECT_TIMEOUT_S))
        client = Client(
            scheduler, security=security, timeout=CONNECT_TIMEOUT_S, set_as_default=False
        )
    except Exception as error:
        # What is there may be no scheduler, and what it answers may make any error.
        raise LidarpoolError(_no_answer(scheduler, error)) from error
    with client:
        yield client


async def _knock(address: str, security: Security) -> None:
    """See whether a scheduler answers; a client waits for ever for one that says nothing."""
    comm = await connect(
        address, timeout=CONNECT_TIMEOUT_S, **security.get_connection_args("client")
    )
    comm.abort()


def _no_answer(scheduler: str, error: BaseException) -> str:
    """Say what is known of a connection that did not come about."""
    said = " ".join(f"{type(link).__name__} {link}" for link in _chain(error))
    for protocol, signs, meaning in _SIGNS:
        if scheduler.startswith(protocol) and any(sign in said for sign in signs):
            return f"The scheduler at {scheduler!r} {meaning}"
    return (
        f"No Dask scheduler answers at {scheduler!r} ({type(error).__name__}): start one with "
        "dask scheduler, and give its address as tcp://host:8786."
    )


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    """Yield an error and what caused it."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__
