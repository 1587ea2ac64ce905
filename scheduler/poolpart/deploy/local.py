"""Start clusters with partitions on this machine."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from importlib.util import find_spec
from typing import Any

import dask
from distributed import Scheduler, Security, SpecCluster

from ..errors import PoolError
from ..internals.names import CLUSTERS, require_feature
from ..rules import check_count, check_name
from .local_processes import FixedCluster, ScriptlessNanny

LOOPBACK = "127.0.0.1"

# Dask's nannies make each worker return freed memory to the system immediately, so the pages of
# every large array have to be faulted in again. With these settings, workers that create arrays of
# several megabytes were 1.36 times as fast. They have to be set before the process starts.
_PRE_SPAWN = {
    f"distributed.nanny.pre-spawn-environ.{name}": 256 << 20
    for name in ("MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_")
}


def local_cluster(
    partitions: Mapping[str, tuple[int, int]],
    *,
    dashboard_port: int | None = 0,
    security: Security | bool = False,
) -> SpecCluster:
    """Start a Dask cluster with partitions on this machine.

    The scheduler, the workers and the dashboard only listen on the loopback interface. The workers
    are processes with nannies, which restart them if they die. They do not import the script that
    starts them, so the script does not need a main guard.

    Parameters
    ----------
    partitions
        Mapping of each name to (number of workers, slots of each worker). A worker has as many
        threads as slots. Workers are named after their partition, for example ``GPU-0`` and
        ``GPU-1``. Partitions with 0 workers are omitted.
    dashboard_port
        Port of Dask's dashboard, 0 for any free port, or None to disable the dashboard.
    security
        If True, encrypt the traffic between the processes with a certificate that is created for
        this cluster and only stored in memory. Nobody can connect without it. Pass a
        `distributed.Security` to use your own certificates. The dashboard is not encrypted.

    Returns
    -------
    SpecCluster
        The cluster, which can be used as a context manager. The scheduler runs in this process.

    Raises
    ------
    PoolError
        If there would be no workers, if a number of workers is below 0 or a number of slots below
        1, if the workers do not start, or if an encrypted cluster is requested and the package
        cryptography is not installed.

    Examples
    --------
    >>> with local_cluster({"GPU": (2, 1), "IO": (1, 8)}) as cluster:    # doctest: +SKIP
    ...     parts = Pool.from_client(Client(cluster)).partitions()
    """
    require_feature(CLUSTERS)
    for name, (count, slots) in partitions.items():
        check_name(name)
        check_count(f"the number of workers of partition {name!r}", count, minimum=0)
        check_count(f"the number of slots of partition {name!r}", slots)
    if not any(count for count, _ in partitions.values()):
        raise PoolError(
            "The cluster would have no workers. Specify the partitions as "
            '`{"NAME": (workers, slots)}`, with at least one worker.'
        )
    if not isinstance(security, Security):
        security = _temporary_security() if security else Security()
    workers = {
        f"{name}-{number}": _worker_spec(name, slots, security)
        for name, (count, slots) in partitions.items()
        for number in range(count)
    }
    scheduler = {
        "cls": Scheduler,
        "options": {
            "host": LOOPBACK,
            "port": 0,
            "security": security,
            "dashboard": dashboard_port is not None,
            # There is an HTTP server even without a dashboard, by default on port 8787.
            "dashboard_address": f"{LOOPBACK}:{dashboard_port or 0}",
        },
    }
    try:
        with dask.config.set(_PRE_SPAWN):
            return FixedCluster(
                workers=workers, scheduler=scheduler, security=security, silence_logs=logging.ERROR
            )
    except RuntimeError as error:
        cause = error.__cause__ or error
        if isinstance(cause, AssertionError):  # its message is only a status
            cause = RuntimeError("a worker process ended or did not respond during its start")
        raise PoolError(
            f"The workers did not start: {cause}. Check their output above, and whether the "
            "machine has enough memory."
        ) from error


def _temporary_security() -> Security:
    """Create credentials for one cluster that exist only in memory."""
    if find_spec("cryptography") is None:
        raise PoolError(
            "An encrypted cluster requires cryptography, which is not installed. Run "
            "pip install cryptography."
        )
    return Security.temporary()


def _worker_spec(partition: str, slots: int, security: Security) -> dict[str, Any]:
    """Return the SpecCluster specification of a worker that belongs to a partition."""
    options = {
        "nthreads": slots,
        "resources": {partition: slots},
        "host": LOOPBACK,
        "security": security,
        "dashboard": False,
        "memory_limit": "auto",
        # Numerical libraries use one thread in each worker, because the processes share the cores.
        "env": dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"),
        "silence_logs": logging.ERROR,
        "preload": [__name__],  # calls `dask_setup`
    }
    return {"cls": ScriptlessNanny, "options": options}


def dask_setup(worker: Any) -> None:
    """Suppress the log message about the last heartbeat of a worker.

    If a worker is closed while its heartbeat waits for a response, the connection is closed and
    Dask logs an error with a traceback. This happens in most runs on a busy machine, where the
    scheduler responds late. A worker that has actually lost its scheduler closes in any case.
    """
    logging.getLogger("distributed.worker").addFilter(
        lambda record: "scheduler during heartbeat" not in str(record.msg)
    )
