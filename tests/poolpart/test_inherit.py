"""What tasks of a partition submit belongs to it."""

from itertools import chain

import dask
import pytest
from distributed import get_client, secede, worker_client
from tests.poolpart.helpers import LONG_S, worker_name

from poolpart import Partition, Pool, PoolError, named


def descend(depth, way):
    """Names of the workers of a tree of tasks, each of which waits for those it submits."""
    if not depth:
        return [worker_name()]
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
    return [worker_name(), *chain.from_iterable(below)]


@pytest.fixture
def client(start):
    """Client of a cluster with partitions A and B of a worker each, and a plain worker."""
    client = start({key: {} for key in ("A-0", "B-0", "plain")})
    client.cluster.scheduler.validate = True
    Pool.from_client(client).divide({"A": named("A-0"), "B": named("B-0")})
    return client


@pytest.mark.extended
@pytest.mark.parametrize("way", ["get_client", "worker_client", "compute"])
def test_at_any_depth_and_on_a_single_slot(client, way):
    names = Partition("A", client).submit(descend, 3, way).result(LONG_S)
    assert names == ["A-0"] * 15
    by_resource = client.submit(descend, 3, way, resources={"B": 1}, pure=False)
    assert set(by_resource.result(LONG_S)) == {"B-0"}
    # What belongs to no partition is where Dask wants it, and so is everything in the end.
    assert len(set(client.submit(descend, 4, way, pure=False).result(LONG_S))) > 1
    Partition("A", client).dissolve()
    by_resource = client.submit(descend, 3, way, resources={"B": 1}, pure=False)
    assert set(by_resource.result(LONG_S)) == {"B-0"}
    Pool.from_client(client).dissolve()
    assert "_create_taskstate_from_graph" not in vars(client.cluster.scheduler)


def say_otherwise():
    with worker_client() as client:
        with dask.annotate(resources={}):
            anywhere = [client.submit(worker_name, i, pure=False) for i in range(20)]
        by_resource = client.submit(worker_name, "resource", resources={"B": 1})
        by_partition = Partition("B", client).submit(worker_name)
        by_worker = client.submit(worker_name, "worker", workers=["plain"])
        inherited = client.submit(worker_name, "inherited")
        with dask.annotate(resources={"B": 1}):
            annotated = dask.delayed(worker_name)("annotated")
        mixed = dask.compute(annotated, dask.delayed(worker_name)("mixed"), optimize_graph=False)
        return (
            set(client.gather(anywhere)),
            client.gather([by_resource, by_partition, by_worker, inherited]),
            mixed,
        )


def test_unless_they_say_otherwise(client):
    anywhere, named, mixed = Partition("A", client).submit(say_otherwise).result(LONG_S)
    assert anywhere > {"A-0"}
    assert named == ["B-0", "B-0", "plain", "A-0"]
    assert mixed == ("B-0", "A-0")


async def names_from_coroutine(client):
    """Names of the workers of tasks that a library submits in the event loop."""
    futures = client.map(worker_name, range(8), pure=False)
    [value] = client.persist([dask.delayed(worker_name)("persisted")])
    with dask.annotate(resources={"B": 1}):
        annotated = client.map(worker_name, range(8), pure=False)
    inside = {*await client.gather(futures), await client.compute(value)}
    return inside, set(await client.gather(annotated))


def use_coroutine(**options):
    client = get_client()
    return client.sync(names_from_coroutine, client, **options)


async def name_of_worker(client, worker):
    return await client.submit(worker_name, workers=[worker], pure=False)


def submit_to_worker(worker):
    client = get_client()
    return client.sync(name_of_worker, client, worker)


def test_tasks_that_a_coroutine_of_the_task_submits(client):
    part = Partition("A", client)
    for options in ({}, {"asynchronous": False}):
        inside, annotated = part.submit(use_coroutine, **options).result(LONG_S)
        assert inside == {"A-0"}
        assert annotated == {"B-0"}
    for worker in ("plain", "A-0"):  # the second one takes the slot of the waiting task
        assert part.submit(submit_to_worker, worker).result(LONG_S) == worker
    future = part.submit(Foreman, actor=True)
    foreman = future.result(LONG_S)  # an actor may end with its future
    assert foreman.from_coroutine().result(LONG_S) == {"A-0"}


class Foreman:
    """An actor whose method submits tasks."""

    def from_coroutine(self):
        return use_coroutine()[0]

    def places(self, count):
        client = get_client()
        return client.gather([client.submit(worker_name, n, pure=False) for n in range(count)])


def ask_foreman(foreman):
    return foreman.places(6).result()


def test_what_an_actor_submits_belongs_to_the_partition_of_the_actor(client):
    future = Partition("A", client).submit(Foreman, actor=True)
    foreman = future.result(LONG_S)  # an actor may end with its future
    assert foreman.places(6).result(LONG_S) == ["A-0"] * 6
    # A task in the only slot that waits for the actor lends the slot to what the actor submits.
    assert Partition("A", client).submit(ask_foreman, foreman).result(LONG_S) == ["A-0"] * 6
    # Two actors of one key prefix in different partitions: which of them submits is not known.
    other = Partition("B", client).submit(Foreman, actor=True)
    assert len(set(other.result(LONG_S).places(12).result(LONG_S))) > 1
    of_b = Partition("B", client).submit(Foreman, actor=True, key="of-b")
    assert of_b.result(LONG_S).places(6).result(LONG_S) == ["B-0"] * 6


async def coroutine(number=0):
    return number


@pytest.mark.extended
@pytest.mark.parametrize("method", ["submit", "map"])
def test_coroutine_functions_are_refused(client, method):
    arguments = () if method == "submit" else ([1, 2],)
    with pytest.raises(PoolError, match="'coroutine' is a coroutine function"):
        getattr(Partition("A", client), method)(coroutine, *arguments)
