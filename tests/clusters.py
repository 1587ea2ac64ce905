"""Clusters whose workers are threads of the process that tests."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from distributed import Scheduler, SpecCluster, Worker


def thread_cluster(*resources: Mapping[str, int], **options: Any) -> SpecCluster:
    """Start a cluster with a worker for each mapping of resources: {partition: slots}.

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
    return SpecCluster(workers, scheduler, security=options.get("security"), silence_logs=50)
