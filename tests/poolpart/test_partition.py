"""Tasks of a partition: where they run, in which order, and how many at a time."""

import time
import uuid
from functools import partial

import pytest
from distributed import Client, Event, get_worker, wait

from poolpart import Partition, PoolError


def here(_=None):
    return str(get_worker().name)


def twice(x):
    return 2 * x


def ident(_):
    return uuid.uuid4()


def options(key=None, priority=None, workers=None):
    return key, priority, workers


def wait_for(event):
    return Event(event).wait(30)


def stamp(_):
    return time.monotonic()


@pytest.fixture
def a(client):
    return Partition("A", client)


@pytest.fixture
def b(client):
    return Partition("B", client)


def test_tasks_run_on_its_workers_and_on_all_of_them(a, b):
    in_a, in_b = a.submit_many(here, range(200)), b.submit_many(here, range(200))
    assert {future.result() for future in in_a} == {"A-0", "A-1"}
    assert {future.result() for future in in_b} == {"B-0"}


def test_members_are_what_the_workers_declare(a, b):
    assert [worker.name for worker in a.workers] == ["A-0", "A-1"]
    assert (len(a), a.slots, len(b), b.slots) == (2, 4, 1, 1)


def test_repr(a, client):
    assert repr(a) == "<Partition 'A': 2 workers (A-0, A-1), 4 slots>"
    with_note = Partition("B", client, note="no GPU")
    assert repr(with_note) == "<Partition 'B': 1 worker (B-0), 1 slots; no GPU>"
    assert repr(Partition("C", client)) == "<Partition 'C': 0 workers (), 0 slots>"


def test_repr_when_the_client_has_closed(client):
    with Client(client.cluster) as own:
        partition = Partition("A", own)
    assert repr(partition) == "<Partition 'A': its client is closed>"


def test_equal_calls_run_each_by_itself(a):
    futures = [a.submit(uuid.uuid4) for _ in range(20)]
    assert len({future.result() for future in futures}) == 20


def test_a_key_makes_two_calls_one(a):
    first, second = (a.submit(uuid.uuid4, key="same") for _ in range(2))
    assert first.result() == second.result()


def test_futures_are_arguments_across_partitions(a, b):
    assert b.submit(twice, a.submit(twice, 5)).result() == 20


@pytest.mark.parametrize("option", ["workers", "resources", "retries", "pure", "actor"])
def test_options_of_dask_do_not_swallow_arguments(a, option):
    with pytest.raises(TypeError, match=f"{option}: Client.submit has options of this name"):
        a.submit(options, **{option: 1})


def test_arguments_named_like_options_can_be_bound(a):
    task = a.submit(partial(options, workers=3, key=1, priority=2), key="bound")
    assert (task.key, task.result()) == ("bound", (1, 2, 3))
    assert a.submit(options, 1, 2, 3).result() == (1, 2, 3)


def test_higher_priority_runs_first(b, client, wait_until):
    gate = f"gate-{uuid.uuid4().hex}"
    blocker = b.submit(wait_for, gate, priority=100)
    low = b.submit_many(stamp, range(3))
    high = b.submit_many(stamp, range(3), priority=5)
    wait_until(lambda: len(client.cluster.workers["B-0"].state.tasks) == 7)
    Event(gate, client=client).set()
    assert blocker.result()
    assert max(future.result() for future in high) < min(future.result() for future in low)


def test_the_priority_of_the_partition_is_that_of_its_tasks(client, wait_until):
    tasks = client.cluster.scheduler.tasks

    def priority(future):
        return -tasks[future.key].priority[0]

    partition = Partition("B", client, priority=3)
    one, two = partition.submit(stamp, 0), partition.submit(stamp, 0, priority=0)
    many = partition.submit_many(stamp, range(2))
    wait([one, two, *many])
    assert [priority(future) for future in (one, two, *many)] == [3, 0, 3, 3]
    partition.priority = 7
    later = partition.submit(stamp, 0)
    wait([later])
    assert priority(later) == 7
    results = partition.map(wait_for, [f"gate-{uuid.uuid4().hex}"])
    wait_until(lambda: any(key.startswith("map-") for key in tasks))
    (mapped,) = (task for key, task in tasks.items() if key.startswith("map-"))
    assert -mapped.priority[0] == 7
    results.close()


def test_submit_many_stops_with_the_shortest_iterable(a):
    assert [future.result() for future in a.submit_many(pow, [2, 3, 4], [5, 6])] == [32, 729]
    assert a.submit_many(pow, []) == a.submit_many(pow) == []


def test_submit_many_takes_iterators_and_runs_equal_calls_each_by_itself(a):
    futures = a.submit_many(ident, iter([1] * 20))
    assert len({future.result() for future in futures}) == 20


def test_wait_returns_when_the_workers_are_there(a):
    a.wait(2, timeout_s=0)


def test_wait_names_what_is_missing(client):
    with pytest.raises(PoolError, match=r"'C' has 0 of 2 workers after 0.05 s: .*C=1"):
        Partition("C", client).wait(2, timeout_s=0.05)
