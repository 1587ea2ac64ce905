"""What tasks of a partition submit belongs to it."""

from itertools import chain

import dask
import pytest
from distributed import get_client, get_worker, secede, worker_client

from poolpart import Partition, Pool
from poolpart.inherit import begin_inheritance, end_inheritance

LONG_S = 120.0
CLUSTER = {"A-0": {"resources": {"A": 1}}, "B-0": {"resources": {"B": 1}}, "plain": {}}


def inherit(client, name):
    async def begin(dask_scheduler):
        begin_inheritance(dask_scheduler, name)

    client.run_on_scheduler(begin)


def disinherit(client, name):
    async def end(dask_scheduler):
        end_inheritance(dask_scheduler, name)

    client.run_on_scheduler(end)


def here(*_):
    return str(get_worker().name)


def descend(depth, way):
    """Names of the workers of a tree of tasks, each of which waits for those it submits."""
    if not depth:
        return [here()]
    if way == "get_client":
        client = get_client()
        children = [client.submit(descend, depth - 1, way, pure=False) for _ in range(2)]
        secede()
        below = client.gather(children)
    elif way == "compute":
        tree = dask.delayed(descend, pure=False)
        with worker_client():
            below = dask.compute(*(tree(depth - 1, way) for _ in range(2)))
    else:
        with worker_client() as client:
            below = client.gather(client.map(descend, [depth - 1] * 2, way=way, pure=False))
    return [here(), *chain.from_iterable(below)]


@pytest.fixture
def client(start):
    client = start(CLUSTER)
    client.cluster.scheduler.validate = True
    return client


@pytest.mark.parametrize("way", ["get_client", "worker_client", "compute"])
def test_at_any_depth_and_without_waiting_for_a_slot(client, way):
    inherit(client, "A")
    names = Partition("A", client).submit(descend, 3, way).result(LONG_S)
    assert names == ["A-0"] * 15
    # What submits nothing itself, or belongs to no partition, is where Dask wants it.
    assert len(set(client.submit(descend, 4, way, pure=False).result(LONG_S))) > 1


def test_those_of_another_partition_and_of_resources_alone(client):
    inherit(client, "A")
    inherit(client, "B")
    task = client.submit(descend, 3, "worker_client", resources={"B": 1}, pure=False)
    assert set(task.result(LONG_S)) == {"B-0"}


def say_otherwise():
    with worker_client() as client:
        with dask.annotate(resources={}):
            anywhere = [client.submit(here, i, pure=False) for i in range(20)]
        by_resource = client.submit(here, "resource", resources={"B": 1})
        by_partition = Partition("B", client).submit(here)
        by_worker = client.submit(here, "worker", workers=["plain"])
        inherited = client.submit(here, "inherited")
        with dask.annotate(resources={"B": 1}):
            annotated = dask.delayed(here)("annotated")
        mixed = dask.compute(annotated, dask.delayed(here)("mixed"), optimize_graph=False)
        return (
            set(client.gather(anywhere)),
            client.gather([by_resource, by_partition, by_worker, inherited]),
            mixed,
        )


def test_unless_they_say_otherwise(client):
    inherit(client, "A")
    anywhere, named, mixed = Partition("A", client).submit(say_otherwise).result(LONG_S)
    assert anywhere > {"A-0"}
    assert named == ["B-0", "B-0", "plain", "A-0"]
    assert mixed == ("B-0", "A-0")


def test_a_worker_that_left_the_partition_gets_none(start, wait_until):
    client = start({"a": {}})
    pool = Pool.from_client(client)
    part, _ = pool.partition("A", n_workers=1, minimum=0)
    part.shrink()
    # As what a task of the partition submits: it takes no slot, and no slots are what is there.
    nested = client.submit(here, resources={"A": 0}, pure=False)
    wait_until(lambda: client.cluster.scheduler.unrunnable)
    part.grow()
    assert nested.result(LONG_S) == "a"


def test_pools_do_it_and_dissolving_undoes_it(start):
    client = start({"one": {}, "two": {}, "three": {}})
    before = set(vars(client.cluster.scheduler)), set(client.cluster.scheduler.plugins)
    pool = Pool.from_client(client)
    part, _ = pool.partition("P", workers=["two"])
    assert set(part.submit(descend, 3, "worker_client").result(LONG_S)) == {"two"}
    pool.dissolve()
    assert (set(vars(client.cluster.scheduler)), set(client.cluster.scheduler.plugins)) == before
    assert len(set(client.submit(descend, 4, "worker_client", pure=False).result(LONG_S))) > 1


def test_disinherit(client):
    inherit(client, "A")
    inherit(client, "B")
    disinherit(client, "A")
    disinherit(client, "A")
    names = Partition("A", client).submit(descend, 4, "worker_client").result(LONG_S)
    assert len(set(names)) > 1
    assert set(Partition("B", client).submit(descend, 2, "get_client").result(LONG_S)) == {"B-0"}
    disinherit(client, "B")
    assert "_create_taskstate_from_graph" not in vars(client.cluster.scheduler)
