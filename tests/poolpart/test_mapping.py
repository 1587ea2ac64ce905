"""Mapping many items: order, bounds, errors, early ends, lost workers."""

import itertools
import logging
import math
import os
import signal
import threading
import time
import uuid
from collections import Counter
from types import SimpleNamespace

import pytest
from distributed import CancelledError, Client, Event, KilledWorker, as_completed, get_worker
from tests.daemons import wait_until
from tests.poolpart.helpers import LONG_S, join, kill, leave, twice, wait_for

from poolpart import Partition, Pool, PoolError, mapping, n_workers, named, rest


def add(x, y):
    return x + y


def slow_if_even(x):
    if x % 2 == 0:
        time.sleep(0.02)
    return x


def slowly(x):
    time.sleep(0.06)
    return x


class UnpicklableError(Exception):
    def __init__(self, item):
        super().__init__(f"item {item}", lambda: None)

    def __reduce__(self):
        raise TypeError


def fail_unpicklably(x):
    raise UnpicklableError(x)


TENS = {10, 20, 30, 40}


def fail_at_tens(x):
    if x in TENS:
        raise ZeroDivisionError(f"at {x}")
    return x


def fail_at_3(x):
    if x == 3:
        raise ZeroDivisionError("at 3")
    return x


def pid_slowly(_):
    time.sleep(0.05)
    return os.getpid()


def die_at_3(x):
    if x == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return x


@pytest.fixture
def gate(client):
    """An event; it is set at the end, so that nothing goes on waiting for it."""
    event = Event(f"gate-{uuid.uuid4().hex}", client=client)
    yield event
    event.set()


def task_count(client):
    return len(client.cluster.scheduler.tasks)


@pytest.mark.extended
@pytest.mark.parametrize("ordered", [True, False])
def test_each_item_gives_its_result_once(a, ordered):
    for function, count, chunk in ((slow_if_even, 30, 1), (abs, 3000, None), (abs, 0, None)):
        got = list(a.map(function, range(count), chunk=chunk, ordered=ordered))
        assert (got if ordered else sorted(got)) == list(range(count))
    assert list(a.map(abs, ordered=ordered)) == []


def test_unordered_does_not_wait_for_a_slow_item(a, gate):
    def function(item):
        return (Event(gate.name).wait(120) and item) if item == 0 else item

    results = a.map(function, range(4), window=4, ordered=False)
    assert sorted(next(results) for _ in range(3)) == [1, 2, 3]
    gate.set()
    assert list(results) == [0]


def test_keyword_arguments_are_those_of_each_call(a, b):
    half = b.submit(twice, 8)
    assert list(a.map(pow, [2, 3], exp=3, mod=5)) == [3, 2]
    assert list(a.map(int, b.map(str, [10, 11]), base=half, chunk=1)) == [16, 17]


def test_its_length_is_that_of_the_shortest_iterable(a, b):
    results = a.map(add, range(9), [1, 2, 3, 4])
    assert [results.done for _ in results] == [1, 2, 3, 4]
    assert len(results) == results.done == 4
    begun = a.map(twice, range(9))
    next(begun)
    rest = b.map(twice, begun)
    assert len(rest) == len(list(rest)) == 8
    for iterables in ([itertools.count(), [1]], [a.map(twice, iter([1])), [1]]):
        results = a.map(add, *iterables)
        with pytest.raises(TypeError, match="one of its iterables has no length"):
            len(results)
        results.close()


def test_futures_are_items(a, b):
    halves = [b.submit(twice, number) for number in range(5)]
    assert list(a.map(twice, halves)) == [0, 4, 8, 12, 16]
    assert list(a.map(add, halves, [1] * 5, chunk=3)) == [1, 3, 5, 7, 9]


@pytest.mark.extended
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


task_clock = threading.local()  # of each thread of a worker; only `last_on_task_clock` moves it


def read_task_clock():
    return getattr(task_clock, "seconds", 0.0)


def last_on_task_clock(x):
    """Take 5 ms, or an hour from item 100 on, however busy the machine is."""
    task_clock.seconds = read_task_clock() + (0.005 if x < 100 else 3600)
    return x


@pytest.mark.extended
def test_the_window_of_small_chunks_grows_with_short_items_and_shrinks_with_long_ones(
    a, client, monkeypatch, wait_until
):
    clock = SimpleNamespace(perf_counter=read_task_clock, monotonic=time.monotonic)
    monkeypatch.setattr("poolpart.mapping.time", clock)
    taken = itertools.count()
    results = a.map(last_on_task_clock, taken, chunk=1)
    most = 0
    for number in range(100):
        assert next(results) == number
        most = max(most, task_count(client))
    assert 4 * a.slots < most <= 2 * 512
    reached = next(taken)
    assert reached <= 100 + 2 * 512
    for _ in range(100, reached):
        next(results)
    wait_until(lambda: task_count(client) <= 4 * a.slots)  # those that are done go a moment later
    results.close()


ended_items = []  # of the tasks below, which run in this process


def wait_if_first(x, *, event, nbytes):
    if x == 0:
        Event(event).wait(LONG_S)
    else:
        ended_items.append(x)
    return bytes(nbytes)


@pytest.mark.extended
@pytest.mark.parametrize(
    ("options", "nbytes", "count", "ended"),
    [
        ({}, 1, 200, range(199, 200)),  # the default is at most 512
        ({"window": 4}, 1, 50, range(3, 4)),
        ({}, 4 * 2**20, 40, range(12, 16)),  # 64 MiB, with the slow item
    ],
)
def test_others_go_on_behind_a_slow_item_up_to_the_window_and_a_limit_of_memory(
    a, client, gate, options, nbytes, count, ended
):
    ended_items.clear()
    options = {"chunk": 1, "event": gate.name, "nbytes": nbytes, **options}
    results = a.map(wait_if_first, range(count), **options)
    lengths = []
    reader = threading.Thread(target=lambda: lengths.extend(map(len, results)))
    reader.start()
    wait_until(lambda: len(ended_items) >= ended[0] and task_count(client) == 1)
    assert len(ended_items) in ended
    assert not lengths
    gate.set()
    reader.join()
    assert lengths == [nbytes] * count


def wait_for_those_before(count):
    """Yield numbers, each as soon as the tasks of all earlier numbers have ended."""
    for number in range(count):
        wait_until(lambda number=number: len(ended_items) >= number)
        yield number


def note_end(x):
    ended_items.append(x)
    return x


def test_items_of_a_slow_iterable_are_sent_as_they_come(a, monkeypatch):
    monkeypatch.setattr("poolpart.mapping.SEND_S", 0.0)
    ended_items.clear()
    assert list(a.map(note_end, wait_for_those_before(12))) == list(range(12))


def test_what_dask_does_with_results(a, client):
    assert list(client.gather(a.map(twice, range(50)))) == list(range(0, 100, 2))
    results = a.map(twice, iter(range(3)))
    with pytest.raises(TypeError, match=r"map` returns an iterator of results, not futures"):
        as_completed(results)
    assert list(results) == [0, 2, 4]


def test_the_first_tasks_start_at_once(a, client, wait_until):
    results = a.map(twice, range(100))
    wait_until(lambda: task_count(client) == 2 * a.slots)
    assert repr(results) == "<Results of twice on 'A': 8 items taken, 8 tasks in flight>"
    assert next(results) == 0
    results.close()
    assert repr(results).endswith("items taken, closed>")


@pytest.mark.extended
@pytest.mark.parametrize("chunk", [None, 1, 10])
@pytest.mark.parametrize("ordered", [True, False])
def test_an_error_names_its_item_and_lets_go_of_the_others(a, client, ordered, chunk, wait_until):
    results = a.map(fail_at_3, range(50), ordered=ordered, chunk=chunk, window=8)
    taken = []
    with pytest.raises(ZeroDivisionError, match="at 3") as caught:
        taken.extend(results)
    assert taken == [0, 1, 2] or not ordered
    assert caught.value.__notes__ == ["poolpart: The error occurred for item 3 of a map: 3"]
    assert "fail_at_3" in [entry.name for entry in caught.traceback]
    assert list(results) == []
    wait_until(lambda: task_count(client) <= 1)  # the failed one, by the traceback


@pytest.mark.extended(every=5)
@pytest.mark.parametrize("retries", [0, 1])
@pytest.mark.parametrize("chunk", [None, 1, 10])
@pytest.mark.parametrize("ordered", [True, False])
def test_errors_are_results_in_their_places(a, ordered, chunk, retries):
    options = {"ordered": ordered, "chunk": chunk, "retries": retries}
    results = list(a.map(fail_at_tens, range(1, 50), return_exceptions=True, **options))
    errors = {r.__notes__[0]: r for r in results if isinstance(r, ZeroDivisionError)}
    assert errors.keys() == {
        f"poolpart: The error occurred for item {x - 1} of a map: {x}" for x in TENS
    }
    shown = [str(r) if isinstance(r, ZeroDivisionError) else r for r in results]
    expected = [f"at {x}" if x in TENS else x for x in range(1, 50)]
    assert shown == expected if ordered else Counter(shown) == Counter(expected)


def test_an_error_that_cannot_be_sent_is_a_result_that_shows_it(a):
    (error,) = a.map(fail_unpicklably, [1], return_exceptions=True)
    assert "UnpicklableError('item 1'" in str(error)
    assert error.__notes__ == ["poolpart: The error occurred for item 0 of a map: 1"]


@pytest.mark.extended
@pytest.mark.parametrize("chunk", [1, None])
def test_errors_as_results_of_a_map_of_a_map(a, b, chunk):
    inner = a.map(fail_at_tens, range(1, 50), chunk=chunk)
    results = list(b.map(twice, inner, return_exceptions=True, chunk=chunk))
    shown = [str(r) if isinstance(r, ZeroDivisionError) else r for r in results]
    assert shown == [f"at {x}" if x in TENS else 2 * x for x in range(1, 50)]
    # Errors that are results are arguments of the next function.
    inner = a.map(fail_at_tens, range(1, 50), return_exceptions=True, chunk=chunk)
    assert list(b.map(str, inner)) == [f"at {x}" if x in TENS else str(x) for x in range(1, 50)]


def test_stop_iteration_in_a_task_does_not_end_the_map_silently(a):
    with pytest.raises(RuntimeError, match=r"next.* raised StopIteration"):
        list(a.map(next, [iter(())] * 3))


@pytest.mark.parametrize("stop", ["close", "del"])
def test_stopping_lets_go_of_tasks_that_have_not_started(b, client, gate, stop, wait_until):
    gate.set()
    results = b.map(wait_for, itertools.repeat(gate.name), window=5, chunk=1)
    assert next(results)
    gate.clear()
    wait_until(lambda: task_count(client) >= 4)
    if stop == "close":
        results.close()
    else:
        del results
    gate.set()
    wait_until(lambda: task_count(client) == 0)


@pytest.mark.parametrize("value", [-1, None, True, "5 min", float("nan")])
def test_a_longest_wait_that_cannot_be(a, value):
    with pytest.raises(
        ValueError, match=f"value {value!r} for `empty_s`. Expected a number of seconds"
    ):
        a.map(twice, [1], empty_s=value)


@pytest.mark.parametrize(("option", "least"), [("window", 1), ("chunk", 1), ("retries", 0)])
@pytest.mark.parametrize("value", [-1, 1.5])
def test_options_are_checked_at_once(a, option, least, value):
    message = f"value {value} for `{option}`. Expected an integer of at least {least}"
    with pytest.raises(ValueError, match=message):
        a.map(twice, [1], **{option: value})


def test_a_client_that_is_closed_ends_it(client, gate):
    with Client(client.cluster) as own:
        results = Partition("B", own).map(wait_for, [gate.name])
    with pytest.raises(CancelledError):
        next(results)


@pytest.mark.extended
@pytest.mark.parametrize("ordered", [True, False])
@pytest.mark.parametrize("by_another", [False, True])
def test_a_partition_that_is_dissolved_ends_it(start, monkeypatch, by_another, ordered):
    monkeypatch.setattr("poolpart.mapping.CHECK_S", 0.05)
    client = start({"a": {}})
    part = Pool.from_client(client).divide({"A": rest()})["A"]
    results = part.map(twice, itertools.count(), ordered=ordered, chunk=1, window=4, empty_s=1.0)
    assert next(results) == 0
    with Client(client.cluster) as other:
        Pool(other if by_another else client, []).dissolve()
    with pytest.raises(PoolError, match=r"Partition 'A' was dissolved\. Divide the pool again"):
        list(results)
    assert next(results, "ended") == "ended"


def test_all_results_of_a_partition_that_was_dissolved_are_read(start, monkeypatch):
    monkeypatch.setattr("poolpart.mapping.CHECK_S", 0.0)
    client = start({"a": {}})
    part = Pool.from_client(client).divide({"A": rest()})["A"]
    results = part.map(twice, range(4), chunk=1, window=4)
    Pool(client, []).dissolve()
    assert list(results) == [0, 2, 4, 6]


def test_a_restart_of_the_cluster_ends_it(own_nannies):
    part = Pool.from_client(own_nannies).divide({"A": rest()})["A"]
    results = part.map(slowly, itertools.count(100), chunk=1)
    assert next(results) == 100
    own_nannies.restart()
    with pytest.raises(CancelledError, match="Scheduler has restarted") as caught:
        list(results)  # it may have fetched some
    assert not hasattr(caught.value, "__notes__")  # no item has killed a worker


@pytest.mark.parametrize(
    ("empty_s", "limit"),
    [(math.inf, ""), (1.5, " at most 1.5 s"), (300.0, " at most 300 s")],
)
def test_a_partition_without_workers_is_told_of(client, caplog, empty_s, limit):
    with caplog.at_level(logging.WARNING, "poolpart"):
        results = Partition("nobody", client).map(twice, range(10), empty_s=empty_s)
    assert f"Partition 'nobody' has no workers. The map waits{limit} for a worker." in caplog.text
    results.close()


WAITED = (
    r"Partition '{}' has no workers\. The map waited {:g} s, and no worker is "
    r'starting\. Start workers with `--resources "{}=1"`, move workers with `Partition\.grow`, or '
    r"pass a longer `empty_s`\."
)


@pytest.mark.extended
@pytest.mark.parametrize("by_rule", [False, True])
def test_a_map_whose_only_worker_left_for_good_ends(start, monkeypatch, by_rule):
    monkeypatch.setattr("poolpart.mapping.CHECK_S", 0.0)
    client = start({"a": {} if by_rule else {"resources": {"A": 1}}, "b": {"resources": {"B": 1}}})
    if by_rule:
        Pool.from_client(client).divide({"A": named("a")})
    results = Partition("A", client).map(twice, itertools.count(), chunk=1, empty_s=0.2)
    assert next(results) == 0
    leave(client, "a")
    with pytest.raises(PoolError, match=WAITED.format("A", 0.2, "A")):
        list(results)
    assert next(results, "ended") == "ended"
    # The stage without workers counts.
    inner = Partition("A", client).map(twice, [1], empty_s=0.1)
    with pytest.raises(PoolError, match=WAITED.format("A", 0.1, "A")):
        list(Partition("B", client).map(twice, inner))


def test_a_map_waits_again_as_long_after_a_worker_has_come(start, monkeypatch, wait_until):
    monkeypatch.setattr("poolpart.mapping.CHECK_S", 0.0)
    client = start({"b": {}})
    results = Partition("A", client).map(twice, [1, 2], chunk=1, empty_s=LONG_S)
    join(client, "a", resources={"A": 1})
    assert list(results) == [2, 4]


def test_a_map_does_not_wait_for_workers_much_longer_than_its_limit(start):
    client = start({"b": {}})
    results = Partition("A", client).map(twice, [1], empty_s=0.5)
    begun = time.monotonic()
    with pytest.raises(PoolError, match=WAITED.format("A", 0.5, "A")):
        list(results)
    assert time.monotonic() - begun < mapping.CHECK_S


@pytest.mark.extended
def test_a_map_waits_while_the_nanny_starts_the_only_worker(nannies, monkeypatch):
    monkeypatch.setattr("poolpart.mapping.CHECK_S", 0.0)
    part = Pool.from_client(nannies).divide({"A": n_workers(1)})["A"]
    results = part.map(slowly, range(9), chunk=1, window=2, empty_s=0.0)
    assert next(results) == 0
    kill(nannies, part.workers[0].name)
    assert list(results) == [*range(1, 9)]


# -- maps of maps ----------------------------------------------------------------------


def block(_):
    return bytearray(2**20)


def length_and_place(data, other=0):
    return len(data) + other, get_worker().name.partition("-")[0]


@pytest.mark.slow
def test_a_map_of_a_map_keeps_data_away_from_driver_and_scheduler(processes, received):
    io = Partition("IO", processes)
    gpu = Partition("GPU", processes)
    results = list(gpu.map(length_and_place, io.map(block, range(64))))
    assert results == [(2**20, "GPU")] * 64
    assert 0 < received.total() < 2**20  # of 64 MiB
    # What the user iterates over does come here.
    assert len(list(gpu.map(length_and_place, (b for b in io.map(block, range(8)))))) == 8
    assert received.total() > 8 * 2**20


@pytest.mark.extended
@pytest.mark.parametrize("chunk", [None, 3])
def test_a_map_of_a_map_of_a_map_with_other_arguments(a, b, chunk):
    inner = a.map(twice, range(500), chunk=chunk)
    middle = b.map(add, itertools.count(), inner)
    outer = a.map(twice, middle)
    assert list(outer) == [6 * x for x in range(500)]
    assert list(middle) == list(inner) == []  # whoever has taken them over has them
    short = b.map(add, a.map(twice, range(500), chunk=chunk), range(7))
    assert list(short) == [3 * x for x in range(7)]
    begun = a.map(twice, range(9), chunk=1)
    assert next(begun) == 0
    assert list(b.map(twice, begun)) == [4 * x for x in range(1, 9)]
    twins = b.map(add, a.map(twice, range(50)), a.map(twice, range(50)))
    assert list(twins) == [4 * x for x in range(50)]


@pytest.mark.extended
def test_a_map_of_an_endless_map_has_a_bounded_number_under_way(a, b, client):
    results = b.map(twice, a.map(twice, itertools.count(), chunk=1), chunk=1)
    most = 0
    for number in range(200):
        assert next(results) == 4 * number
        most = max(most, task_count(client))
    assert most <= 2 * 512  # those that wait and those that ended
    results.close()


def test_dask_counts_the_bytes_of_results(a, client, wait_until):
    """So that workers spill results that lie in them."""
    results = a.map(bytes, [10_000_000] * 4, chunk=1)
    wait_until(lambda: sum(client.nbytes(summary=False).values()) >= 4 * 10_000_000)
    assert [len(result) for result in results] == [10_000_000] * 4


@pytest.mark.extended
@pytest.mark.parametrize("chunk", [1, 2, None])
def test_an_error_of_the_inner_map_names_its_item(a, b, chunk):
    results = b.map(twice, a.map(fail_at_3, range(9), chunk=chunk))
    got = []
    with pytest.raises(ZeroDivisionError, match="at 3") as caught:
        for result in results:
            got.append(result)  # noqa: PERF402 - the error is to leave what came before
    assert got == [0, 2, 4]
    assert "The error occurred for item 3 of a map: 3" in "".join(caught.value.__notes__)


# -- lost workers ----------------------------------------------------------------------


@pytest.mark.extended
@pytest.mark.parametrize("ordered", [True, False])
def test_a_lost_worker_is_survived(nannies, ordered):
    partition, _ = Pool.from_client(nannies).partition("N", n_workers=2)
    results = partition.map(pid_slowly, range(60), ordered=ordered, chunk=2)
    pids = [next(results) for _ in range(10)]
    os.kill(pids[-1], signal.SIGKILL)
    pids += results
    assert len(pids) == 60
    assert len(set(pids)) >= 2


@pytest.mark.extended
@pytest.mark.parametrize("ordered", [True, False])
def test_results_that_are_lost_before_they_are_fetched(start, wait_until, ordered):
    client = start({"x": {"resources": {"A": 1}}, "y": {"resources": {"A": 1}}})
    again = Event("again", client)
    again.set()
    results = Partition("A", client).map(
        wait_for, ["again"] * 4, chunk=1, window=4, ordered=ordered
    )
    # The futures of a map stay inside: nothing public says that a result was there and is lost.
    wait_until(lambda: all(future.done() for future in results._running))
    again.clear()
    client.sync(client.cluster.workers["x"].close)
    wait_until(lambda: any(future.status == "lost" for future in results._running))
    threading.Timer(0.5, again.set).start()
    assert list(results) == [True] * 4


@pytest.mark.extended(every=2)
@pytest.mark.parametrize("as_results", [True, False])
def test_an_item_that_kills_its_workers_is_one_error(nannies, monkeypatch, as_results):
    monkeypatch.setattr(nannies.cluster.scheduler, "allowed_failures", 0)
    partition, _ = Pool.from_client(nannies).partition("N", n_workers=2)
    results = partition.map(die_at_3, range(6), chunk=2, window=1, return_exceptions=as_results)
    assert [next(results) for _ in range(3)] == [0, 1, 2]
    if as_results:
        error, *others = results
        assert others == [4, 5]
    else:
        with pytest.raises(KilledWorker) as caught:
            next(results)
        error = caught.value
    assert isinstance(error, KilledWorker)
    (note,) = error.__notes__
    assert note.startswith("poolpart: Workers died while they processed item 3 of a map: 3.")
