"""Clusters whose workers are threads of the process that tests."""

from __future__ import annotations

import signal
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import pytest
from distributed import Scheduler, SpecCluster, Worker


def import_jobqueue() -> Any:
    """Import dask-jobqueue, which takes Ctrl-C for itself; skip the test if it is missing."""
    before = signal.getsignal(signal.SIGINT)
    try:
        return pytest.importorskip("dask_jobqueue")
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def thread_cluster(*resources: Mapping[str, int], **options: Any) -> Iterator[SpecCluster]:
    """A cluster with a worker for each mapping of resources: {partition: slots}.

    Each worker has one thread: stages 1, 3 and 4 give it away while they wait. It is named after
    its resources, which have to differ. `options` are for scheduler and workers.
    """
    common = {"host": "127.0.0.1", "dashboard": False, **options}
    workers = {
        "-".join(names): {
            "cls": Worker,
            "options": {"resources": dict(names), "nthreads": 1, **common},
        }
        for names in resources
    }
    own = {"port": 0, "dashboard_address": "127.0.0.1:0"}
    scheduler = {"cls": Scheduler, "options": {**common, **own}}
    security = options.get("security")
    with SpecCluster(workers, scheduler, security=security, silence_logs=50) as cluster:
        try:
            yield cluster
        finally:
            # Dask does that when the last worker of the process closes. Until then a client asks
            # by the connections of a worker that is gone: "ConnectionPool is closed".
            for client in list(Worker._initialized_clients):
                if client.scheduler and client.scheduler.address == cluster.scheduler_address:
                    client.close()
