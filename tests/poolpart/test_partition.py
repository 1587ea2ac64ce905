"""Tasks of a partition: where they run, in which order, and how many at a time."""

import time
import uuid
from collections import Counter
from functools import partial

import dask
import dask.array as da
import dask.bag
import numpy as np
import pytest
from distributed import Client, Event, secede
from tests.poolpart.helpers import twice, wait_for, worker_name

from poolpart import Partition, Pipe, Pool, PoolError


def stamp():
    return time.monotonic()


@pytest.mark.extended
def test_tasks_run_on_its_workers_and_on_all_of_them(a, b):
    assert [worker.name for worker in a.workers] == ["A-0", "A-1"]
    assert (len(a), a.slots, len(b), b.slots) == (2, 4, 1, 1)
    in_a, in_b = ([part.submit(worker_name) for _ in range(200)] for part in (a, b))
    assert {future.result() for future in in_a} == {"A-0", "A-1"}
    assert {future.result() for future in in_b} == {"B-0"}


def test_equal_calls_run_each_by_itself(a):
    futures = [a.submit(uuid.uuid4) for _ in range(20)]
    assert len({future.result() for future in futures}) == 20


def test_futures_are_arguments_across_partitions(a, b):
    assert b.submit(twice, a.submit(twice, 5)).result() == 20


def test_higher_priority_runs_first(b, client, wait_until):
    gate = f"gate-{uuid.uuid4().hex}"
    blocker = b.submit(wait_for, gate, priority=100)
    low = [b.submit(stamp) for _ in range(3)]
    high = [b.submit(stamp, priority=5) for _ in range(3)]
    keys = {future.key for future in (blocker, *low, *high)}
    wait_until(lambda: keys <= client.cluster.scheduler.tasks.keys())
    Event(gate, client=client).set()
    assert blocker.result()
    assert max(future.result() for future in high) < min(future.result() for future in low)


def submit_to(part, number):
    secede()
    return part.submit(worker_name).result(), sum(part.map(twice, range(number)))


def test_a_partition_can_be_given_to_a_task_of_another(a, b):
    assert a.submit(submit_to, b, 100).result() == ("B-0", 9900)


tries = Counter()  # the workers are threads of this process


def fail_at_first(name, item):
    """Fail until it was called for the third time with a third item."""
    tries[name, item] += 1
    if item % 3 == 0 and tries[name, item] < 3:
        raise ValueError(f"item {item}, try {tries[name, item]}")
    return item


def test_tasks_that_fail_run_again(a):
    assert a.submit(fail_at_first, "tasks", 0, retries=2).result() == 0
    with pytest.raises(ValueError, match="item 9, try 2"):
        a.submit(fail_at_first, "tasks", 9, retries=1).result()


@pytest.mark.parametrize("chunk", [None, 1, 5])
def test_items_that_fail_are_tried_again(a, chunk):
    call = partial(fail_at_first, f"chunks of {chunk}")
    assert list(a.map(call, range(12), retries=2, chunk=chunk)) == list(range(12))


def test_a_client_that_cannot_be_asked(_threads):
    with Client(_threads, set_as_default=False) as client:
        part = Partition("A", client)
        assert len(part) == 2
    for ask in (part.stats, part.grow, lambda: len(part), lambda: part.map(twice, [1])):
        with pytest.raises(PoolError, match=r"The client is closed\. Create a new client"):
            ask()
    with pytest.raises(PoolError, match="The client is closed"):
        Pool.from_client(client)


def keywords_of(_, **keywords):
    return sorted(keywords)


def test_options_of_dask_are_not_passed_to_the_function_of_a_map(a):
    with pytest.raises(
        PoolError, match=r"map` does not accept `pure`\. The function is called for"
    ):
        a.map(keywords_of, [1], pure=True)
    with pytest.raises(PoolError, match=r"map` does not accept `resources`\. To request"):
        a.map(keywords_of, [1], resources={"A": 2})
    assert list(a.map(keywords_of, [1], other=1)) == [["other"]]


def test_an_asynchronous_client_is_refused(_threads):
    async def ask():
        async with Client(_threads, asynchronous=True, set_as_default=False) as client:
            with pytest.raises(PoolError, match="does not support asynchronous clients"):
                Pool.from_client(client)
            part = Partition("A", client)
            calls = (
                part.stats,
                lambda: part.submit(abs, -1),
                lambda: part.map(abs, [-1]),
                lambda: part.for_each([-1], abs),
                lambda: part.compute([]),
                lambda: part.scatter([1]),
                part.as_client,
                part.__enter__,
                part.page,
                lambda: part.cancel([]),
                part.dissolve,
                lambda: Pipe("asynchronous", 1, client).create(),
            )
            for call in calls:
                with pytest.raises(PoolError, match="does not support asynchronous clients"):
                    call()

    _threads.sync(ask)


def test_a_task_may_take_several_slots(a, client, wait_until):
    gate = Event(f"gate-{uuid.uuid4().hex}", client=client)
    tasks = [a.submit(wait_for, gate.name, slots=2) for _ in range(2)]
    wait_until(lambda: a.stats().busy == 4)
    behind = a.submit(worker_name)
    time.sleep(0.1)
    assert not behind.done()
    gate.set()
    assert client.gather(tasks) == [True, True]
    assert behind.result() in ("A-0", "A-1")
    assert list(a.map(abs, range(5), slots=2)) == list(range(5))
    for call in (a.submit, a.map):
        with pytest.raises(
            ValueError, match=r"Invalid value 0 for `slots`\. Expected an integer of at least 1"
        ):
            call(abs, [1], slots=0)


def places(_=None):
    return np.array([[int(worker_name() == "B-0")]])


def ones(name):
    return da.map_blocks(places, chunks=((1,) * 4, (1,)), dtype=int, name=f"{name}-{uuid.uuid4()}")


def test_collections_are_computed_on_its_workers(b, client):
    total = ones("a").sum()
    assert b.compute(total).result() == b.compute(total, sync=True) == 4
    first, second = b.compute([ones("a").sum(), dask.delayed(worker_name, pure=False)()])
    assert client.gather([first, second]) == [4, "B-0"]
    assert dask.bag.range(4, 2).map(lambda _: worker_name()).compute() != ["B-0"] * 4


def test_in_a_block_everything_is_on_its_workers(a, b, client):
    with b:
        assert ones("c").sum().compute() == 4
        assert dask.compute(dask.delayed(worker_name, pure=False)())[0] == "B-0"
        kept = ones("b").persist()
        assert client.submit(worker_name, pure=False).result() == "B-0"
        with a:
            assert client.submit(worker_name, pure=False).result() in ("A-0", "A-1")
        assert set(client.gather(client.map(places, range(3)))[0].flat) == {1}
    assert kept.sum().compute() == 4
    assert not dask.get_annotations()
    with pytest.raises(ZeroDivisionError), b:
        1 / 0  # noqa: B018
    assert not dask.get_annotations()


def test_data_is_put_on_its_workers(a, client):
    address = {worker.address for worker in a.workers}
    data = a.scatter({"x": 1, "y": 2})
    assert client.gather(data) == {"x": 1, "y": 2}
    assert {w for held in client.who_has(list(data.values())).values() for w in held} <= address
    assert set(client.who_has(a.scatter(3, broadcast=True)).popitem()[1]) == address
    with pytest.raises(PoolError, match="Partition 'C' has no workers to store the data"):
        Partition("C", client).scatter(1)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda a: a.submit(abs, 1, resources={"A": 2}),
            "submit` does not accept `resources`. To request",
        ),
        (lambda a: a.submit(abs, 1, pure=True), "submit` does not accept `pure`. Each call"),
        (
            lambda a: a.for_each(None, abs, resources={}),
            "for_each` does not accept `resources`. To request",
        ),
        (
            lambda a: a.compute([], resources={"A": 2}),
            "compute` does not accept `resources`. To request",
        ),
        (lambda a: a.scatter([1], workers=["x"]), "scatter` does not accept `workers`. The data"),
        (
            lambda a: a.submit(abs, 1, workers=1.5),
            "Invalid value 1.5 for `workers`. Expected the name",
        ),
        (lambda a: a.submit(3), "Partition 'A' expects a callable, but got 3"),
        (lambda a: a.map(3, [1]), "Partition 'A' expects a callable, but got 3"),
        (lambda a: a.for_each(None, 3), "Partition 'A' expects a callable, but got 3"),
    ],
)
def test_what_cannot_be_given(a, call, message):
    with pytest.raises(PoolError, match=message):
        call(a)
