from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from distributed import Client

from lidarpool import Cloud
from poolpart import local_cluster


@pytest.fixture(scope="module")
def client() -> Iterator[Client]:
    """A local cluster with two casting workers, so that one can die."""
    with local_cluster(gpu_workers=2, other_workers=1) as cluster, Client(cluster) as client:
        yield client


@pytest.fixture
def kill(client: Client) -> Callable[[str], None]:
    """Kill the first worker of a partition with SIGKILL."""

    def kill(partition: str) -> None:
        workers = client.scheduler_info(n_workers=-1)["workers"]
        address = next(a for a, w in workers.items() if partition in w["resources"])
        pid = client.run(os.getpid, workers=[address])[address]
        os.kill(pid, signal.SIGKILL)

    return kill


@pytest.fixture
def same_cloud() -> Callable[[Cloud, Cloud], bool]:
    def same(one: Cloud, two: Cloud) -> bool:
        return all(
            np.array_equal(getattr(one, name), getattr(two, name))
            for name in ("positions", "scan", "ring", "object")
        )

    return same
