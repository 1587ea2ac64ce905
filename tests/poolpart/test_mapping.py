"""Mapping many items: order, bounds, errors, early ends, lost workers."""

import itertools
import logging
import os
import queue
import signal
import threading
import time
import uuid
import weakref
from typing import ClassVar

import pytest
from distributed import CancelledError, Client, Event, wait

from poolpart import Partition, Pool

LONG_S = 120.0


def twice(x):
    return 2 * x


def add(x, y):
    return x + y


def slow_if_even(x):
    if x % 2 == 0:
        time.sleep(0.02)
    return x


def slow_from_200_to_220(x):
    if 200 <= x < 220:
        time.sleep(0.15)
    return x


def fail_at_3(x):
    if x == 3:
        raise ZeroDivisionError("at 3")
    return x


def stop_at_3(x):
    if x == 3:
        raise StopIteration
    return x


class UnpicklableError(Exception):
    def __init__(self, text, more):
        super().__init__(text)


def fail_unpicklably(x):
    if x == 3:
        raise UnpicklableError("what happened", "more")
    return x


def wait_for(event):
    return Event(event).wait(120)


def pid_slowly(_):
    time.sleep(0.05)
    return os.getpid()


def die_at_3(x):
    if x == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return x


class Thing:
    """Something that knows of all the others."""

    alive: ClassVar = weakref.WeakSet()

    def __init__(self, _):
        self.alive.add(self)


@pytest.fixture
def a(client):
    return Partition("A", client)


@pytest.fixture
def b(client):
    return Partition("B", client)


@pytest.fixture
def gate(client):
    """An event; it is set at the end, so that nothing goes on waiting for it."""
    event = Event(f"gate-{uuid.uuid4().hex}", client=client)
    yield event
    event.set()


def task_count(client):
    return len(client.cluster.scheduler.tasks)


def unfinished(client):
    """Number of tasks that are under way."""
    tasks = list(client.cluster.scheduler.tasks.values())
    return sum(task.state in ("waiting", "queued", "no-worker", "processing") for task in tasks)


def test_results_are_in_the_order_of_the_items(a):
    assert list(a.map(slow_if_even, range(30), chunk=1)) == list(range(30))
    assert list(a.map(twice, range(3000))) == list(range(0, 6000, 2))


def test_unordered_gives_each_once(a):
    assert sorted(a.map(slow_if_even, range(30), ordered=False, chunk=1)) == list(range(30))
    assert sorted(a.map(twice, range(3000), ordered=False)) == list(range(0, 6000, 2))


def test_unordered_does_not_wait_for_a_slow_item(a, gate):
    def function(item):
        return (Event(gate.name).wait(120) and item) if item == 0 else item

    results = a.map(function, range(4), window=4, ordered=False)
    assert sorted(next(results) for _ in range(3)) == [1, 2, 3]
    gate.set()
    assert list(results) == [0]


@pytest.mark.parametrize("ordered", [True, False])
def test_of_nothing(a, ordered):
    assert list(a.map(twice, [], ordered=ordered)) == []
    assert list(a.map(twice, ordered=ordered)) == []


def test_several_iterables_end_with_the_shortest(a):
    assert list(a.map(add, itertools.count(10), [1, 2, 3], range(5, 10)[:0])) == []
    assert list(a.map(add, itertools.count(10), [1, 2, 3])) == [11, 13, 15]


def test_futures_are_items(a, b):
    halves = b.submit_many(twice, range(5))
    assert list(a.map(twice, halves)) == [0, 4, 8, 12, 16]
    assert list(a.map(add, halves, [1] * 5, chunk=3)) == [1, 3, 5, 7, 9]


@pytest.mark.parametrize("ordered", [True, False])
@pytest.mark.parametrize("window", [1, 3])
@pytest.mark.parametrize("chunk", [1, 4])
def test_a_bounded_number_is_under_way_even_of_endless_items(a, client, ordered, window, chunk):
    taken = itertools.count()
    results = a.map(twice, taken, window=window, chunk=chunk, ordered=ordered)
    for number in range(20):
        next(results)
        # Items taken and not delivered: a window under way, and one that has come back.
        assert next(taken) - number - (number + 1) <= 2 * window * chunk
        assert task_count(client) <= 2 * window  # those that are done go a moment later
    results.close()


def test_hundred_thousand_items_are_a_few_tasks_at_a_time(a, client):
    most, total = 0, 0
    for result in a.map(twice, range(100_000)):
        most, total = max(most, task_count(client)), total + result
    assert total == 100_000 * 99_999
    assert most <= 4 * a.slots


def test_results_that_were_taken_are_dropped_everywhere(a):
    # Driver, scheduler and workers are one process here: these are all there are.
    most = 0
    for result in a.map(Thing, range(2000), window=4, chunk=5):
        most = max(most, len(Thing.alive))
        assert isinstance(result, Thing)
    assert 0 < most <= 200


def test_the_first_tasks_start_at_once(a, client, wait_until):
    results = a.map(twice, range(100))
    wait_until(lambda: task_count(client) == 2 * a.slots)
    assert repr(results) == "<Results of twice on 'A': 8 items taken, 8 tasks under way>"
    assert next(results) == 0
    results.close()
    assert repr(results).endswith("items taken, closed>")


def test_items_that_take_longer_than_those_before_are_shared_out_again(a, client):
    # One after the other they would take three seconds, in the chunk that has them.
    numbers = []
    for ordered in (True, False):
        results = a.map(slow_from_200_to_220, iter(range(3000)), ordered=ordered)
        numbers.append(list(results))
    assert numbers[0] == sorted(numbers[1]) == list(range(3000))


@pytest.mark.parametrize("chunk", [None, 1, 10])
@pytest.mark.parametrize("ordered", [True, False])
def test_an_error_names_its_item_and_lets_go_of_the_others(a, client, ordered, chunk, wait_until):
    results, taken = a.map(fail_at_3, range(50), ordered=ordered, chunk=chunk, window=8), []
    with pytest.raises(ZeroDivisionError, match="at 3") as caught:
        taken.extend(results)
    assert taken == [0, 1, 2] or not ordered
    assert caught.value.__notes__ == ["poolpart: this was item 3 of a map: 3"]
    assert "fail_at_3" in [entry.name for entry in caught.traceback]
    assert list(results) == []
    wait_until(lambda: task_count(client) <= 1)  # the failed one, by the traceback


@pytest.mark.parametrize("chunk", [1, 10])
def test_an_error_that_cannot_be_sent_comes_as_its_text(a, chunk):
    with pytest.raises(Exception, match="what happened"):
        list(a.map(fail_unpicklably, range(50), chunk=chunk))


@pytest.mark.parametrize("chunk", [1, 10])
def test_stop_iteration_in_a_task_does_not_end_the_map_silently(a, chunk):
    with pytest.raises(RuntimeError, match=r"stop_at_3.* raised StopIteration"):
        list(a.map(stop_at_3, range(50), chunk=chunk))


def test_an_error_of_the_items_is_raised(a, client, wait_until):
    def items():
        yield from range(20)
        raise OSError("no more")

    with pytest.raises(OSError, match="no more"):
        list(a.map(twice, items()))
    wait_until(lambda: task_count(client) == 0)


@pytest.mark.parametrize("ordered", [True, False])
@pytest.mark.parametrize("stop", ["close", "del", "with"])
def test_stopping_lets_go_of_tasks_that_have_not_started(
    b, client, gate, ordered, stop, wait_until
):
    gate.set()
    results = b.map(wait_for, itertools.repeat(gate.name), window=5, ordered=ordered, chunk=1)
    assert next(results)
    gate.clear()
    wait_until(lambda: task_count(client) >= 4)
    if stop == "close":
        results.close()
    elif stop == "with":
        with results:
            pass
    else:
        del results
    gate.set()
    wait_until(lambda: task_count(client) == 0)


def test_leaving_a_loop_stops(b, client, gate, wait_until):
    gate.set()
    for _ in b.map(wait_for, itertools.repeat(gate.name), chunk=1):
        break
    wait_until(lambda: task_count(client) == 0)


@pytest.mark.parametrize("option", ["window", "chunk"])
@pytest.mark.parametrize("value", [0, -1, 1.5])
def test_options_are_checked_at_once(a, option, value):
    with pytest.raises(ValueError, match=f"{option} is {value}; give a whole number, 1 or more"):
        a.map(twice, [1], **{option: value})


def test_a_client_that_is_closed_ends_it(client, gate):
    with Client(client.cluster) as own:
        results = Partition("B", own).map(wait_for, [gate.name])
    with pytest.raises(CancelledError):
        next(results)


def test_a_partition_without_workers_is_told_of(client, caplog):
    with caplog.at_level(logging.WARNING, "poolpart"):
        results = Partition("nobody", client).map(twice, range(10))
    assert "Partition 'nobody' has no workers: a map on it waits." in caplog.text
    results.close()


# -- quotas ----------------------------------------------------------------------------


def test_a_limited_handle_has_so_many_tasks_under_way(a, client, gate, wait_until):
    mine, others = a.limited(2), a.limited(1, priority=4)
    assert (mine.name, mine.slots, mine.priority, others.priority) == ("A", 4, 0, 4)
    first = mine.submit(wait_for, gate.name)
    results = mine.map(wait_for, [gate.name] * 20, chunk=1)
    wait_until(lambda: task_count(client) == 2)
    assert others.submit(twice, 2).result(LONG_S) == 4  # it has a quota of its own
    assert unfinished(client) == 2
    gate.set()
    most = 0
    for result in results:
        most = max(most, unfinished(client))
        assert result
    assert most <= 2
    assert first.result(LONG_S)


def test_a_limited_handle_submits_many_as_others_are_done(a):
    assert [f.result(LONG_S) for f in a.limited(3).submit_many(twice, range(50))] == [
        2 * x for x in range(50)
    ]


def test_two_maps_share_the_quota_of_their_handle(a):
    handle = a.limited(1)
    doubles, sums = handle.map(twice, range(40)), handle.map(add, range(40), range(40))
    pairs = list(zip(doubles, sums, strict=True))
    assert pairs == [(2 * x, 2 * x) for x in range(40)]


def test_a_task_that_failed_or_was_cancelled_gives_its_place_back(a, gate):
    handle = a.limited(1)
    wait([handle.submit(fail_at_3, 3)], timeout=LONG_S)
    handle.submit(wait_for, gate.name).cancel()
    results = handle.map(wait_for, [gate.name] * 3)
    results.close()
    last = handle.submit(twice, 1)
    gate.set()  # what was cancelled goes on on its worker, which may be the one for the last
    assert last.result(LONG_S) == 2


def test_what_cannot_be_submitted_gives_its_places_back(a):
    handle, lock = a.limited(2), threading.Lock()
    for _ in range(3):
        with pytest.raises(TypeError, match="must be a callable"):
            handle.submit(3)
        with pytest.raises(TypeError, match="Could not serialize"):
            handle.submit(twice, lock)
        with pytest.raises(TypeError, match="Could not serialize"):
            handle.map(twice, [lock] * 9)
    assert handle.submit(twice, 1).result(LONG_S) == 2


def test_a_callback_may_submit_more_than_the_quota(a):
    handle, submitted = a.limited(1), queue.SimpleQueue()

    def go_on(_):
        for number in range(3):
            submitted.put(handle.submit(twice, number))

    handle.submit(twice, 1).add_done_callback(go_on)
    futures = [submitted.get(timeout=LONG_S) for _ in range(3)]
    assert [future.result(LONG_S) for future in futures] == [0, 2, 4]


@pytest.mark.parametrize("slots", [0, -1, 1.5])
def test_quotas_are_checked(a, slots):
    with pytest.raises(ValueError, match=f"A quota of {slots} slots; give a whole number"):
        a.limited(slots)


# -- lost workers ----------------------------------------------------------------------


@pytest.mark.parametrize("ordered", [True, False])
def test_a_lost_worker_is_survived(nannies, ordered):
    partition, _ = Pool.from_client(nannies).partition("N", n_workers=2)
    results = partition.map(pid_slowly, range(60), ordered=ordered, chunk=2)
    pids = [next(results) for _ in range(10)]
    os.kill(pids[-1], signal.SIGKILL)
    pids += results
    assert len(pids) == 60
    assert len(set(pids)) >= 2


@pytest.mark.parametrize("ordered", [True, False])
def test_results_that_are_lost_before_they_are_fetched(start, wait_until, ordered):
    client = start({"x": {"resources": {"A": 1}}, "y": {"resources": {"A": 1}}})
    again = Event("again", client)
    again.set()
    results = Partition("A", client).map(
        wait_for, ["again"] * 4, chunk=1, window=4, ordered=ordered
    )
    wait_until(lambda: all(future.done() for future in results._running))
    again.clear()
    client.sync(client.cluster.workers["x"].close)
    wait_until(lambda: any(future.status == "lost" for future in results._running))
    threading.Timer(0.5, again.set).start()
    assert list(results) == [True] * 4


def test_items_that_kill_their_workers_are_named(nannies):
    partition, _ = Pool.from_client(nannies).partition("N", n_workers=2)
    with pytest.raises(Exception, match="map-die_at_3") as caught:
        list(partition.map(die_at_3, [3, 2, 1, 0], chunk=2, window=1))
    assert type(caught.value).__name__ == "KilledWorker"
    assert caught.value.__notes__ == ["poolpart: the task was for items 0 to 1 of a map"]
