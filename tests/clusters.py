"""Clusters whose workers are threads of the process that tests."""

from __future__ import annotations

import signal
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from typing import Any

import pytest
from distributed import Scheduler, SpecCluster, Worker

QUIET = 50  # logging level: the workers that tests kill are not news


def import_jobqueue() -> Any:
    """Import dask-jobqueue, which takes Ctrl-C for itself; skip the test if it is missing."""
    before = signal.getsignal(signal.SIGINT)
    try:
        return pytest.importorskip("dask_jobqueue")
    finally:
        signal.signal(signal.SIGINT, before)


def thread_cluster(
    *resources: Mapping[str, int], **options: Any
) -> AbstractContextManager[SpecCluster]:
    """A cluster with a worker for each mapping of resources: {partition: slots}.

    Each worker has one thread: stages 1, 3 and 4 give it away while they wait. It is named after
    its resources, which have to differ. `options` are for scheduler and workers.
    """
    workers = {"-".join(names): {"resources": dict(names)} for names in resources}
    return cluster_of(workers, {}, host="127.0.0.1", **options)


@contextmanager
def cluster_of(
    workers: Mapping[str, Mapping[str, Any]], scheduler: Mapping[str, Any], **options: Any
) -> Iterator[SpecCluster]:
    """A cluster of workers, their options by name; `options` are for scheduler and workers."""
    common = {"dashboard": False, **options}
    specs = {
        name: {"cls": Worker, "options": {"nthreads": 1, **common, **own}}
        for name, own in workers.items()
    }
    spec = {
        "cls": Scheduler,
        "options": {"port": 0, "dashboard_address": "127.0.0.1:0", **common, **scheduler},
    }
    security = options.get("security")
    with SpecCluster(specs, spec, security=security, silence_logs=QUIET) as cluster:
        try:
            yield cluster
        finally:
            # Dask does that when the last worker of the process closes. Until then a client asks
            # by the connections of a worker that is gone: "ConnectionPool is closed".
            for client in list(Worker._initialized_clients):
                if client.scheduler and client.scheduler.address == cluster.scheduler_address:
                    client.close()
