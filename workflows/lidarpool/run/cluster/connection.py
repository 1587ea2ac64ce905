"""Clients of a local cluster that is started for the run, or of an existing cluster."""

from __future__ import annotations

import asyncio
import errno
import socket
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import (
    AbstractContextManager,
    ExitStack,
    closing,
    contextmanager,
    nullcontext,
)
from multiprocessing import current_process
from typing import Any

import dask
from dask.system import CPU_COUNT
from distributed import Client, Security, SpecCluster, get_worker
from distributed.comm import connect
from distributed.utils import LoopRunner

import poolpart.deploy
from lidarsim.environment.interrupts import block_child_signals, defer_interrupts
from lidarsim.errors import LidarError
from poolpart.deploy import forked_workers
from poolpart.probe import visible_gpus
from poolpart.rules import check_count

from ...connection.scheduler_address import check_address
from ...connection.tls_files import TlsFiles
from ...processes.fork_server import start_fork_server
from ..cluster_file import ClusterFile
from ..pipeline.stage_names import GPU, LIDAR, OTHER
from .checks import LOOK_EVERY_S, TooFewWorkersError
from .watch import Waiting

CONNECT_TIMEOUT_S = 10
KNOCK_S = 5.0  # longest attempt to connect to a scheduler that may not be up yet
_UNREACHABLE = (errno.EHOSTUNREACH, errno.ENETUNREACH, errno.EHOSTDOWN)  # a host that is starting

# Dask profiles each process many times a second, for a dashboard that a cluster of one run does not
# have: an idle worker took 3 % of a core, and takes a fifth of that with these settings.
_QUIET = {
    "distributed.worker.profile.enabled": False,
    "distributed.scheduler.http.routes": [],  # nobody knows the address of these pages
    "distributed.worker.http.routes": [],
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.system-monitor.interval": "5s",
    "distributed.admin.low-level-log-length": 100,  # messages to workers that are kept: 1,000
}


def default_workers(cores: int, gpus: int) -> dict[str, int]:
    """Return the number of worker processes of the partitions GPU and OTHER for a machine.

    One worker for each GPU, and OTHER has the remaining cores. Without GPUs the GPU partition has
    CPU workers for three quarters of the cores. The LIDAR stages mostly wait, so they share one
    process.

    Examples
    --------
    >>> default_workers(cores=2, gpus=0), default_workers(cores=16, gpus=2)
    ({'GPU': 2, 'OTHER': 1}, {'GPU': 2, 'OTHER': 13})
    """
    casting = gpus or max(1, cores - cores // 4)
    return {GPU: casting, OTHER: max(1, cores - casting - (1 if gpus and cores > 2 else 0))}


def local_cluster(
    *,
    gpu_workers: int | None = None,
    lidar_slots: int = 4,
    other_workers: int | None = None,
    **options: Any,
) -> SpecCluster:
    """Start a Dask cluster on this machine, divided into GPU, LIDAR and OTHER.

    Workers of GPU and OTHER have one thread each; their default numbers are `default_workers` of
    this machine, and OTHER may have none. The one LIDAR worker has `lidar_slots` threads and slots;
    with 0 there is none.
    Further options, and the errors, are as in `poolpart.deploy.local_cluster`.
    """
    defaults = default_workers(CPU_COUNT, len(visible_gpus()))
    gpu_workers = defaults[GPU] if gpu_workers is None else gpu_workers
    other_workers = defaults[OTHER] if other_workers is None else other_workers
    check_count("gpu_workers", gpu_workers)
    lidar = (min(1, lidar_slots), max(1, lidar_slots))
    return poolpart.deploy.local_cluster(
        {GPU: (gpu_workers, 1), LIDAR: lidar, OTHER: (other_workers, 1)}, **options
    )


def check_starts_workers() -> None:
    """Raise LidarError if this process may not start workers: in a task of Dask or a daemon."""
    try:
        get_worker()
        context = "a Dask task"
        advice = "Pass `client=distributed.get_client()`, or start the run in a separate process."
    except ValueError:  # outside of tasks
        context = "a daemonic process, such as a worker of a DataLoader"
        advice = "Pass a client, or start the run in a separate process."
        if not current_process().daemon:
            return
    raise LidarError(
        f"A run without a client starts workers, which is not possible in {context}. {advice}"
    )


def local_client(
    required_slots: Mapping[str, int],
    gpu_workers: int | None = None,
    other_workers: int | None = None,
    *,
    tls: bool = False,
) -> AbstractContextManager[Client]:
    """Return a context with a client of a cluster on this machine that ends with the context.

    Workers as of `local_cluster`, with the `required_slots` of LIDAR, and by default no worker of
    OTHER unless it has required slots. `tls` encrypts the traffic, with a new certificate;
    PoolError if no certificate can be made, or the workers do not start.
    """
    forks = start_fork_server()  # here, for it changes the environment of this process

    @contextmanager
    def started() -> Iterator[SpecCluster]:
        with (
            dask.config.set(_QUIET),
            forked_workers() if forks else nullcontext(),
            closing(
                local_cluster(
                    gpu_workers=gpu_workers,
                    lidar_slots=required_slots.get(LIDAR, 0),
                    other_workers=other_workers if OTHER in required_slots or other_workers else 0,
                    security=tls,
                    dashboard_port=None,  # is never printed, and Bokeh takes half a second
                )
            ) as cluster,
        ):
            yield cluster

    return _client_of(started())


class StartedAhead(AbstractContextManager[Client]):
    """The context of a client, entered by a thread while the caller does something else.

    The context can be left before it is entered, and left again.
    """

    def __init__(self, context: AbstractContextManager[Client]) -> None:
        self._context = context
        self._left = False
        executor = ThreadPoolExecutor(1, "start")
        self._client = executor.submit(context.__enter__)
        executor.shutdown(wait=False)

    def __enter__(self) -> Client:
        return self._client.result()

    def __exit__(self, *error: object) -> None:
        with defer_interrupts():
            if not self._left and self._client.exception() is None:
                self._context.__exit__(None, None, None)
            self._left = True


@contextmanager
def started_client(file: ClusterFile, tell: Callable[[str], object]) -> Iterator[Client]:
    """Start the cluster of a file, yield its client, and stop the cluster after the body.

    `tell` is called when the cluster has started, and with messages about failing workers.
    LidarError if the cluster does not start.
    """
    with _client_of(file.started(tell)) as client:
        tell(f"started {file}")
        try:
            yield client
        except TooFewWorkersError as error:
            error.add_note("If queued jobs failed, see their logs.")
            raise


@contextmanager
def _client_of(cluster: AbstractContextManager[SpecCluster]) -> Iterator[Client]:
    """Start a cluster, yield its client, and stop the cluster after the body.

    Half a cluster cannot be stopped in good order: an interrupt waits until all workers are up, or
    all jobs in the queue, and an interrupt while workers are being stopped waits until they are.
    """
    stack = ExitStack()
    try:
        with defer_interrupts(), block_child_signals():
            client = Client(stack.enter_context(cluster), set_as_default=False)
            stack.enter_context(client)
        yield client
    finally:
        with defer_interrupts():
            stack.close()


@contextmanager
def connected(
    scheduler: str, files: TlsFiles | None = None, waiting: Waiting | None = None
) -> Iterator[Client]:
    """Yield a client of a cluster that is running already, or will be soon.

    `scheduler` is an address such as ``tcp://host:8786`` or ``tls://host:8786``; certificates for
    the latter are by default from Dask's configuration. A scheduler that is not up yet is waited
    for as `waiting` says, by default some seconds. LidarError if no scheduler answers, or the
    certificates are wrong.
    """
    if not scheduler.startswith("inproc"):
        check_address(scheduler)
    waiting = waiting or Waiting()
    try:
        security = Security()
        if files and any(files):
            ca, cert, key = (path and str(path) for path in files)
            security = Security(
                require_encryption=True, tls_ca_file=ca, tls_client_cert=cert, tls_client_key=key
            )
        # Not in this thread: an interrupt could be raised in a callback of the loop, and get lost.
        LoopRunner().run_sync(_reach, scheduler, security, waiting)
        client = Client(
            scheduler, security=security, timeout=CONNECT_TIMEOUT_S, set_as_default=False
        )
    except Exception as error:
        waited = f" within {waiting.seconds:g} s" if waiting.seconds and _absent(error) else ""
        raise LidarError(
            f"No Dask scheduler responded at {scheduler!r}{waited} ({_reason(error)}). Start one "
            "with `dask scheduler`, and pass its address, such as tcp://host:8786. For a TLS "
            "cluster, pass tls://host:8786 with `--tls-ca`, `--tls-cert` and `--tls-key`."
        ) from error
    with client:
        yield client


async def _reach(address: str, security: Security, waiting: Waiting) -> None:
    """Wait until a scheduler answers.

    A client would wait for ever for a silent scheduler.
    """
    reason = "no response"
    while True:
        timeout: float = CONNECT_TIMEOUT_S
        if waiting.seconds:
            timeout = min(KNOCK_S, max(waiting.remaining_s(), 1.0))
        waiting.tell(f"the scheduler at {address}", reason)
        try:
            options = security.get_connection_args("client")
            # `connect` times out first, with a reason, unless a silent program listens.
            answer = connect(address, timeout=timeout, **options)
            comm = await asyncio.wait_for(answer, timeout + 1)
            comm.abort()
            return
        except Exception as error:
            if not waiting.remaining_s() or not _absent(error):
                raise
            reason = _reason(error)
        await asyncio.sleep(LOOK_EVERY_S)


def _root(error: BaseException) -> BaseException:
    """Return the first cause of an error, which may be any error of a foreign program."""
    cause = error.__cause__ or error.__context__
    # An operation that a time-out has cut off says less than the time-out.
    if cause is None or isinstance(cause, asyncio.CancelledError):
        return error
    return _root(cause)


def _absent(error: BaseException) -> bool:
    """Return True if the address does not resolve or answer yet, so that a retry may help."""
    root = _root(error)
    absent = (ConnectionRefusedError, TimeoutError, asyncio.CancelledError, socket.gaierror)
    return isinstance(root, absent) or getattr(root, "errno", None) in _UNREACHABLE


def _reason(error: BaseException) -> str:
    root = _root(error)
    return " ".join(f"{type(root).__name__}: {root}".split())[:200].rstrip(": ")
