"""Clients of local clusters, of clusters that are started for a run, and of existing clusters."""

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
from .requirements import default_workers
from .watch import WaitTimer

CONNECT_TIMEOUT_S = 10
KNOCK_S = 5.0  # time limit of one attempt to connect to a scheduler that may not have started yet
_UNREACHABLE = (errno.EHOSTUNREACH, errno.ENETUNREACH, errno.EHOSTDOWN)  # host may be starting

# By default, Dask profiles each process many times per second for its dashboard, which the cluster
# of a single run does not have. These settings reduce the load of an idle worker to a fifth of 3 %
# of a core.
_QUIET = {
    "distributed.worker.profile.enabled": False,
    "distributed.scheduler.http.routes": [],  # the address of these pages is not published
    "distributed.worker.http.routes": [],
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.system-monitor.interval": "5s",
    "distributed.admin.low-level-log-length": 100,  # the default is 1,000 messages
}


def local_cluster(
    *,
    gpu_workers: int | None = None,
    lidar_slots: int = 4,
    other_workers: int | None = None,
    **options: Any,
) -> SpecCluster:
    """Start a Dask cluster on this machine, with the partitions GPU, LIDAR and OTHER.

    Parameters
    ----------
    gpu_workers, other_workers
        Number of workers in GPU and OTHER, each with one thread. OTHER may have none. Defaults to
        `default_workers` for this machine.
    lidar_slots
        Number of threads and slots of the LIDAR worker. With 0 slots, there is no LIDAR worker.
    options
        Further options of `poolpart.deploy.local_cluster`, which also describes the errors.
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
    """Raise LidarError in a Dask task or daemonic process, which cannot start workers."""
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
    """Return a context manager that starts a cluster on this machine and yields its client.

    The cluster is stopped when the context exits.

    Parameters
    ----------
    required_slots
        Number of slots that the run requires, by partition. If OTHER has none, it has no workers by
        default.
    gpu_workers, other_workers
        Number of workers, as in `local_cluster`.
    tls
        Whether to encrypt the traffic with a new certificate.

    Raises
    ------
    PoolError
        On entering, if the certificate cannot be created or the workers do not start.
    """
    forks = start_fork_server()  # called here because it temporarily changes the environment

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
                    dashboard_port=None,  # its address is never shown, and Bokeh takes 0.5 s
                )
            ) as cluster,
        ):
            yield cluster

    return client_of(started())


class BackgroundClient(AbstractContextManager[Client]):
    """Context manager that starts to connect a client as soon as it is created.

    The client is connected in a background thread. Entering this object waits for the thread. It
    may be exited without being entered, and more than once.
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
def start_client(file: ClusterFile, report: Callable[[str], object]) -> Iterator[Client]:
    """Start the cluster that a file describes, yield its client, and stop the cluster at the end.

    Parameters
    ----------
    file
        Cluster file.
    report
        Function that is called when the cluster has started, and with messages about failing
        workers.

    Raises
    ------
    LidarError
        If the cluster does not start.
    """
    with client_of(file.start(report)) as client:
        report(f"started {file}")
        try:
            yield client
        except TooFewWorkersError as error:
            error.add_note("If queued jobs failed, see their logs.")
            raise


@contextmanager
def client_of(cluster: AbstractContextManager[SpecCluster]) -> Iterator[Client]:
    """Start a cluster, yield its client, and stop the cluster at the end.

    A cluster cannot be stopped cleanly while it is starting. An interrupt is therefore deferred
    until all workers have started or have been queued. An interrupt while workers are being stopped
    is deferred until they have stopped.
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
def connect_client(
    scheduler: str, files: TlsFiles | None = None, waiting: WaitTimer | None = None
) -> Iterator[Client]:
    """Connect to an existing cluster and yield its client.

    Parameters
    ----------
    scheduler
        Address of the scheduler, such as ``tcp://host:8786`` or ``tls://host:8786``.
    files
        Certificates for a TLS cluster. Defaults to those in Dask's configuration.
    waiting
        Time limit for a scheduler that has not started yet. By default, a single attempt is made.

    Raises
    ------
    LidarError
        If no scheduler responds, or if the certificates are invalid.
    """
    if not scheduler.startswith("inproc"):
        check_address(scheduler)
    waiting = waiting or WaitTimer()
    try:
        security = Security()
        if files and any(files):
            ca, cert, key = (path and str(path) for path in files)
            security = Security(
                require_encryption=True, tls_ca_file=ca, tls_client_cert=cert, tls_client_key=key
            )
        # The event loop runs in another thread, because an interrupt in one of its callbacks could
        # be lost.
        LoopRunner().run_sync(_wait_for_scheduler, scheduler, security, waiting)
        client = Client(
            scheduler, security=security, timeout=CONNECT_TIMEOUT_S, set_as_default=False
        )
    except Exception as error:
        waited = (
            f" within {waiting.seconds:g} s"
            if waiting.seconds and _may_become_reachable(error)
            else ""
        )
        raise LidarError(
            f"No Dask scheduler responded at {scheduler!r}{waited} ({_describe_error(error)}). "
            "Start one with `dask scheduler`, and pass its address, such as tcp://host:8786. For a "
            "TLS cluster, pass tls://host:8786 with `--tls-ca`, `--tls-cert` and `--tls-key`."
        ) from error
    with client:
        yield client


async def _wait_for_scheduler(address: str, security: Security, waiting: WaitTimer) -> None:
    """Wait until a scheduler responds.

    A client would wait forever for a scheduler that accepts connections but does not respond.
    """
    reason = "no response"
    while True:
        timeout: float = CONNECT_TIMEOUT_S
        if waiting.seconds:
            timeout = min(KNOCK_S, max(waiting.remaining_s(), 1.0))
        waiting.report(f"the scheduler at {address}", reason)
        try:
            options = security.get_connection_args("client")
            # Normally, `connect` times out first and reports a reason. It does not time out if a
            # program accepts the connection without responding.
            answer = connect(address, timeout=timeout, **options)
            comm = await asyncio.wait_for(answer, timeout + 1)
            comm.abort()
            return
        except Exception as error:
            if not waiting.remaining_s() or not _may_become_reachable(error):
                raise
            reason = _describe_error(error)
        await asyncio.sleep(LOOK_EVERY_S)


def _root_cause(error: BaseException) -> BaseException:
    cause = error.__cause__ or error.__context__
    # A timeout is more informative than the canceled operation that it was raised from.
    if cause is None or isinstance(cause, asyncio.CancelledError):
        return error
    return _root_cause(cause)


def _may_become_reachable(error: BaseException) -> bool:
    """Return True if an address may become resolvable or reachable, so that a retry makes sense."""
    root = _root_cause(error)
    absent = (ConnectionRefusedError, TimeoutError, asyncio.CancelledError, socket.gaierror)
    return isinstance(root, absent) or getattr(root, "errno", None) in _UNREACHABLE


def _describe_error(error: BaseException) -> str:
    root = _root_cause(error)
    return " ".join(f"{type(root).__name__}: {root}".split())[:200].rstrip(": ")
