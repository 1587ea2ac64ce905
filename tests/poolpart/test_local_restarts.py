from __future__ import annotations

import os
import signal

import dask
from distributed import Client

from poolpart import Pool, local_cluster


def test_a_worker_that_is_slow_to_come_back_is_not_given_up():
    """Dask's SpecCluster closes the nanny of a worker that is not back after this time."""
    with (
        dask.config.set({"distributed.deploy.lost-worker-timeout": "10ms"}),
        local_cluster(gpu_workers=1, other_workers=1) as cluster,
        Client(cluster) as client,
    ):
        partition = Pool.from_client(client).partitions()["OTHER"]
        address = partition.workers[0].address
        pid = client.run(os.getpid, workers=[address])[address]
        os.kill(pid, signal.SIGKILL)
        assert partition.submit(os.getpid).result(timeout=120) != pid
        assert "OTHER-0" in cluster.workers
