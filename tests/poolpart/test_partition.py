"""Tasks of a partition: where they run, in which order, and how many at a time."""

import itertools
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


def slow_if_even(x):
    if x % 2 == 0:
        time.sleep(0.02)
    return x


def fail_at_3(x):
    if x == 3:
        raise ZeroDivisionError("at 3")
    return x


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


def task_count(client):
    return len(client.cluster.scheduler.tasks)


def test_tasks_run_on_its_workers_and_on_all_of_them(a, b):
    in_a, in_b = a.map(here, range(200)), b.map(here, range(200))
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
    low = b.map(stamp, range(3))
    high = b.map(stamp, range(3), priority=5)
    wait_until(lambda: len(client.cluster.workers["B-0"].state.tasks) == 7)
    Event(gate, client=client).set()
    assert blocker.result()
    assert max(future.result() for future in high) < min(future.result() for future in low)


def test_map_stops_with_the_shortest_iterable(a):
    assert [future.result() for future in a.map(pow, [2, 3, 4], [5, 6])] == [32, 729]
    assert a.map(pow, []) == []


def test_wait_returns_when_the_workers_are_there(a):
    a.wait(2, timeout_s=0)


def test_wait_names_what_is_missing(client):
    with pytest.raises(PoolError, match=r"'C' has 0 of 2 workers after 0.05 s: .*C=1"):
        Partition("C", client).wait(2, timeout_s=0.05)


# -- imap ------------------------------------------------------------------------------


def test_imap_keeps_the_order_of_the_items(a):
    assert list(a.imap(slow_if_even, range(30))) == list(range(30))


def test_imap_unordered_gives_each_once(a):
    assert sorted(a.imap(slow_if_even, range(30), ordered=False)) == list(range(30))


def test_imap_unordered_does_not_wait_for_a_slow_item(a, client):
    gate = Event(f"gate-{uuid.uuid4().hex}", client=client)

    def function(item):
        return (Event(gate.name).wait(30) and item) if item == 0 else item

    results = a.imap(function, range(4), window=4, ordered=False)
    assert sorted(next(results) for _ in range(3)) == [1, 2, 3]
    gate.set()
    assert list(results) == [0]


@pytest.mark.parametrize("ordered", [True, False])
def test_imap_of_nothing(a, ordered):
    assert list(a.imap(twice, [], ordered=ordered)) == []


@pytest.mark.parametrize("ordered", [True, False])
@pytest.mark.parametrize("window", [1, 3])
def test_imap_keeps_so_many_tasks_under_way_even_of_an_endless_iterator(a, client, ordered, window):
    taken = itertools.count()
    results = a.imap(twice, taken, window=window, ordered=ordered)
    for number in range(20):
        next(results)
        assert next(taken) - 2 * number <= window + number + 1
        assert task_count(client) <= window + 1
    results.close()


@pytest.mark.parametrize("ordered", [True, False])
def test_imap_raises_what_a_task_raises_and_lets_go_of_the_others(a, client, ordered, wait_until):
    with pytest.raises(ZeroDivisionError, match="at 3") as caught:
        list(a.imap(fail_at_3, range(50), window=8, ordered=ordered))
    wait_until(lambda: task_count(client) <= 2)  # the failed one and the last, by the traceback
    assert caught.tb is not None


@pytest.mark.parametrize("ordered", [True, False])
def test_closing_imap_lets_go_of_tasks_that_have_not_started(b, client, ordered, wait_until):
    gate = Event(f"gate-{uuid.uuid4().hex}", client=client)
    blocker = b.submit(wait_for, gate.name)
    results = b.imap(wait_for, itertools.repeat(gate.name), window=5, ordered=ordered)
    gate.set()
    assert next(results)
    gate.clear()
    assert wait([blocker], timeout=30).done
    results.close()
    del blocker
    gate.set()
    wait_until(lambda: task_count(client) == 0)


@pytest.mark.parametrize("window", [0, -1])
def test_imap_refuses_windows_at_once(a, window):
    with pytest.raises(ValueError, match=f"window of {window} tasks"):
        a.imap(twice, [1], window=window)
