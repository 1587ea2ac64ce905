"""Groups of workers that follow the work of their partitions, on a stand-in for Kubernetes."""

import importlib.util
import inspect
import time
from collections.abc import Iterator

import pytest
from distributed import Client, Event
from tests import kubernetes
from tests.poolpart.helpers import LONG_S, twice, wait_for, worker_name

from poolpart import Partition, PoolError
from poolpart.deploy import KubernetesGroups, scale_groups

IDLE_S = 0.2
ADAPTIVE = {"adapt": [0, 3], "idle_s": IDLE_S}


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[kubernetes.KubeCluster]:
    """A stand-in for Kubernetes, with the empty groups gpu and io."""
    kubernetes.install(monkeypatch)
    with kubernetes.KubeCluster(name="survey", n_workers=0) as cluster:
        for name in ("GPU", "IO"):
            command = f"dask worker --nthreads 1 --resources {name}=1"
            cluster.add_worker_group(name.lower(), n_workers=0, worker_command=command)
        yield cluster


@pytest.fixture
def client(cluster: kubernetes.KubeCluster) -> Iterator[Client]:
    with Client(cluster) as client:
        yield client


def members(cluster, group):
    return [name for name, its_group in cluster.deployments.items() if its_group == group]


def test_each_group_follows_its_own_work_and_no_worker_of_another_is_closed(
    cluster, client, wait_until
):
    partitions = {"GPU": ADAPTIVE, "IO": ADAPTIVE}
    with scale_groups(client, KubernetesGroups(cluster), partitions):
        gpu, io = (Partition(name, client) for name in ("GPU", "IO"))
        tasks = [gpu.submit(wait_for, "go") for _ in range(8)]
        wait_until(lambda: len(gpu) == 3)
        assert members(cluster, "io") == []
        kept = io.submit(twice, 21)  # its worker has the only copy of a result
        assert kept.result(LONG_S) == 42
        # The operator would close the worker of IO, the only idle worker of the cluster.
        Event("go", client).set()
        client.gather(tasks)
        del tasks
        wait_until(lambda: cluster.sizes[-1] == ("gpu", 0))
        assert members(cluster, "gpu") == []
        assert cluster.retired == []
        assert len(io) == 1
        assert kept.result(LONG_S) == 42


def test_a_container_of_a_closed_worker_gets_no_task_and_is_removed(cluster, client, wait_until):
    messages = []
    groups = KubernetesGroups(cluster)
    with scale_groups(client, groups, {"GPU": ADAPTIVE}, messages.append):
        gpu = Partition("GPU", client)
        first = gpu.submit(worker_name).result(LONG_S)
        cluster.is_away = True
        wait_until(lambda: cluster.started.count(first) > 1)  # its container was started again
        second = gpu.submit(worker_name)
        wait_until(lambda: len(messages) > 1)
        cluster.is_away = False
        assert second.result(LONG_S) != first
        assert first not in cluster.deployments
    assert messages[0] == ("Group 'GPU' could not be scaled to 0 workers: the API server is away")


def test_the_range_can_be_changed_and_the_groups_stay_at_the_end(cluster, client, wait_until):
    with scale_groups(client, KubernetesGroups(cluster), {"GPU": ADAPTIVE}):
        gpu = Partition("GPU", client)
        gpu.adapt(2, 2, idle_s=IDLE_S)
        wait_until(lambda: len(gpu) == 2)
    time.sleep(2 * IDLE_S)
    assert len(gpu) == 2


def test_wrong_arguments_are_named(client):
    with pytest.raises(PoolError, match="expects a `KubeCluster`"):
        KubernetesGroups({})
    with pytest.raises(PoolError, match="an object with a method `scale"):
        scale_groups(client, object(), {"GPU": ADAPTIVE})
    groups = KubernetesGroups(client.cluster)
    with pytest.raises(PoolError, match=r"Unknown options: queue\. Expected `adapt`"):
        scale_groups(client, groups, {"GPU": {**ADAPTIVE, "queue": "gpus"}})
    with pytest.raises(PoolError, match="`adapt` is missing"):
        scale_groups(client, groups, {"GPU": {}})
    with pytest.raises(PoolError, match="for the maximum of partition 'GPU'"):
        scale_groups(client, groups, {"GPU": {"adapt": [3, 1]}})


@pytest.mark.skipif(
    importlib.util.find_spec("dask_kubernetes") is None, reason="dask-kubernetes is not installed"
)
@pytest.mark.parametrize("method", ["add_worker_group", "delete_worker_group", "scale"])
def test_the_stand_in_has_the_interface_of_dask_kubernetes(method):
    from dask_kubernetes.operator import KubeCluster

    theirs = inspect.signature(getattr(KubeCluster, method)).parameters
    ours = inspect.signature(getattr(kubernetes.KubeCluster, method)).parameters
    assert [(p.name, p.default) for p in ours.values()] == [
        (p.name, p.default) for p in theirs.values()
    ]
