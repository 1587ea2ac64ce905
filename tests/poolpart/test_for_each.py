"""A function for each item of a pipe: each once, on its partition, no faster than it can."""

import concurrent.futures
import itertools
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from distributed import Client, Event, Queue, as_completed, wait
from tests.poolpart.helpers import LONG_S, join, leave, wait_for, worker_name

from poolpart import Partition, Pipe, PipeClosed, PipeFailed, PoolError
from poolpart.membership import request_capacity


@pytest.fixture
def pool():
    pool = ThreadPoolExecutor(8)
    yield pool
    pool.shutdown(wait=False)  # threads of a failed test wait until its pipes are deleted


def where(item, done):
    done.put((item, worker_name()))


def test_each_item_is_run_once_on_the_partition(client, a, make_pipe, pool):
    pipe = make_pipe(client)
    done = make_pipe(client, capacity=1000)
    counts = [pool.submit(a.for_each, pipe, where, done=done) for _ in range(2)]
    pipe.put_many(range(50))
    pipe.close()
    assert sum(count.result(LONG_S) for count in counts) == 50
    results = done.drain()
    assert sorted(item for item, _ in results) == list(range(50))
    assert {worker for _, worker in results} == {"A-0", "A-1"}


def test_of_a_pipe_without_items(client, a, make_pipe):
    pipe = make_pipe(client)
    pipe.close()
    assert a.for_each(pipe, abs) == 0
    assert repr(a) == "<Partition 'A': 2 workers, 4 slots>"


@pytest.mark.parametrize(("window", "counts"), [(None, [2, 4, 8, 16]), (3, [3, 3, 3, 3])])
def test_more_tasks_are_in_flight_if_slots_were_idle(b, monkeypatch, window, counts):
    in_flight = []

    def wait_for_all(futures, **_):
        """Return late, like a client that is short of processor time."""
        in_flight.append(len(futures))
        wait(futures)

    monkeypatch.setattr("poolpart.for_each.wait", wait_for_all)
    assert b.for_each(range(50), abs, window=window) == 50
    assert in_flight[: len(counts)] == counts
    # Tasks that end before the last items are submitted are not in flight at the last calls.
    assert max(in_flight) == counts[-1]


def test_of_a_partition_whose_only_worker_left_for_good(start, monkeypatch):
    monkeypatch.setattr("poolpart.for_each.CHECK_S", 0.05)
    client = start({"a": {"resources": {"A": 1}}, "b": {}})
    leave(client, "a")
    pipe = Pipe("of-nobody", 3, client).create()
    pipe.put(-1)
    message = "Partition 'A' has no workers. `for_each` waited 0.2 s"
    with pytest.raises(PoolError, match=message):
        Partition("A", client).for_each(pipe, abs, empty_s=0.2)
    with pytest.raises(PipeFailed, match=message):
        pipe.put(-2)


def test_of_a_partition_that_is_empty_for_a_while(start, monkeypatch, pool, wait_until):
    monkeypatch.setattr("poolpart.for_each.CHECK_S", 0.0)
    looks = []

    def look(*args):
        looks.append(args)
        return request_capacity(*args)

    monkeypatch.setattr("poolpart.for_each.request_capacity", look)
    client = start({"b": {}})
    pipe = Pipe("of-nobody", 3, client).create()
    # Nothing waits for a worker before the first item.
    count = pool.submit(Partition("A", client).for_each, pipe, abs, empty_s=0.0)
    wait_until(lambda: len(looks) > 3)
    join(client, "a", resources={"A": 1})
    pipe.put_many([-1, -2])
    pipe.close()
    assert count.result(LONG_S) == 2


def test_producers_wait_when_tasks_are_slow(client, b, make_pipe, pool, wait_until):
    pipe = make_pipe(client, capacity=3)
    event = f"slow-{time.time()}"
    put = []

    def produce():
        for number in itertools.count():
            pipe.put(event)
            put.append(number)

    producer = pool.submit(produce)
    consumer = pool.submit(b.for_each, pipe, wait_for, window=2)
    wait_until(lambda: len(put) >= 3 + 2)  # in the pipe, and under way
    time.sleep(0.5)
    assert len(put) == 3 + 2
    pipe.fail("enough")
    for future in (producer, consumer):
        with pytest.raises(PipeFailed, match="enough"):
            future.result(LONG_S)
    Event(event, client).set()


def invert(item):
    return 1 / item


def test_an_error_is_raised_at_once_and_ends_the_producers(client, a, make_pipe, pool):
    """Nothing else comes through the pipe that could wake who waits for it."""
    pipe = make_pipe(client, capacity=1)
    consumer = pool.submit(a.for_each, pipe, invert)
    pipe.put_many([4, 2, 0])
    error = consumer.exception(LONG_S)
    assert isinstance(error, ZeroDivisionError)
    assert error.__notes__ == [f"poolpart: The error occurred for item 2 of pipe {pipe.name!r}: 0"]
    with pytest.raises(PipeFailed, match="Function 'invert' failed: ZeroDivisionError"):
        pipe.put(1)


def test_an_error_of_the_last_item_of_a_closed_pipe(client, a, make_pipe):
    pipe = make_pipe(client, capacity=9)
    pipe.put_many([1, 2, 0])
    pipe.close()
    with pytest.raises(ZeroDivisionError):
        a.for_each(pipe, invert, window=1)


attempts = []


def fail_once(item):
    attempts.append(item)
    if attempts.count(item) == 1:
        raise OSError("try again")


def test_items_are_tried_again(client, a, make_pipe):
    attempts.clear()
    pipe = make_pipe(client, capacity=9)
    pipe.put_many([1, 2, 3, 4])
    pipe.close()
    assert pipe.get() == 1  # takes more than this item
    assert a.for_each(pipe, fail_once, retries=1) == 3
    assert sorted(attempts) == [2, 2, 3, 3, 4, 4]


def test_an_item_may_be_a_future_that_a_queue_has_put(client, a, make_pipe):
    pipe = make_pipe(client)
    done = make_pipe(client)
    with Client(client.cluster, set_as_default=False) as other:
        Queue(pipe.name, other).put(other.submit(pow, 2, 10))
        pipe.close()
        assert a.for_each(pipe, done.put) == 1
    assert done.drain() == [1024]


@pytest.mark.parametrize("options", [{"window": 0}, {"slots": 0}])
def test_options_that_make_no_sense(client, a, make_pipe, options):
    with pytest.raises(
        ValueError,
        match=r"Invalid value 0 for `(window|slots)`\. Expected an integer of at least 1",
    ):
        a.for_each(make_pipe(client), abs, **options)


def forward(pipe, outlet, partition):
    count = partition.for_each(pipe, outlet.put)
    outlet.close()
    return count


def test_it_may_run_in_a_task_and_its_tasks_may_put(client, a, b, make_pipe):
    first = make_pipe(client)
    second = make_pipe(client)
    task = b.submit(forward, first, second, a)
    first.put_many(range(3))
    first.close()
    assert sorted(second) == [0, 1, 2]
    assert task.result(LONG_S) == 3
    with pytest.raises(PipeClosed):
        second.put(1)


def test_items_that_the_pipe_object_has_taken_before_come_first(client, a, make_pipe):
    pipe = make_pipe(client, capacity=10)
    squares = make_pipe(client, capacity=10)
    pipe.put_many(range(5))
    pipe.close()
    assert pipe.get() == 0
    assert a.for_each(pipe, put_square, squares=squares, window=1) == 4
    assert sorted(squares.drain()) == [1, 4, 9, 16]


def put_square(number, squares):
    squares.put(number**2)


class Unreadable:
    """An item whose unpickling raises ValueError."""

    def __reduce__(self):
        return int, ("not a number",)


def test_an_unreadable_item_ends_it_with_the_error_of_the_item(client, a, make_pipe):
    pipe = make_pipe(client, capacity=10)
    pipe.put_many([1, Unreadable(), 2])
    pipe.close()
    with pytest.raises(ValueError, match="not a number"):
        a.for_each(pipe, abs)
    with pytest.raises(PipeFailed, match="not a number"):
        Pipe(pipe.name, client=client).get()


def test_without_waiting_it_returns_a_future_of_the_number_of_items(client, a, make_pipe):
    pipe = make_pipe(client, capacity=2)
    squares = make_pipe(client, capacity=10)
    count = a.for_each(pipe, put_square, squares=squares, wait=False)
    pipe.put_many(range(5))  # more than the pipe holds
    assert not count.done()
    pipe.close()
    assert count.result(LONG_S) == 5
    assert sorted(squares.drain()) == [0, 1, 4, 9, 16]


def test_a_future_has_the_first_error(client, a, make_pipe):
    pipe = make_pipe(client)
    count = a.for_each(pipe, invert, wait=False)
    pipe.put_many([4, 0])
    error = count.exception(LONG_S)
    assert isinstance(error, ZeroDivisionError)
    assert error.__notes__ == [f"poolpart: The error occurred for item 1 of pipe {pipe.name!r}: 0"]


def test_a_cancelled_future_ends_tasks_and_producers(client, b, make_pipe, wait_until):
    pipe = make_pipe(client)
    event = Event(f"cancelled-{time.time()}", client)
    count = b.for_each(pipe, wait_for, window=2, wait=False)
    pipe.put_many([event.name] * 5)
    wait_until(lambda: pipe.depth == 3)  # two have a task, one of which runs
    assert count.cancel()
    assert concurrent.futures.wait([count], LONG_S).done == {count}
    with pytest.raises(PipeFailed, match="`for_each` with function 'wait_for' was canceled"):
        pipe.put("more")
    event.set()
    wait_until(lambda: not client.cluster.scheduler.tasks)


def test_items_of_an_iterable_are_taken_as_slots_are_free(client, b, make_pipe, wait_until):
    event = Event(f"slow-{time.time()}", client)
    taken = []

    def names():
        for number in range(9):
            taken.append(number)
            yield event.name

    count = b.for_each(names(), wait_for, window=2, wait=False)
    wait_until(lambda: len(taken) == 2)
    wait_until(lambda: b.stats().running == 1)
    assert len(taken) == 2
    event.set()
    assert count.result(LONG_S) == len(taken) == 9


def test_an_endless_iterable_can_be_cancelled(client, a, wait_until):
    numbers = itertools.count()
    count = a.for_each(numbers, abs, wait=False)
    wait_until(lambda: not repr(numbers).endswith("(0)"))
    assert count.cancel()
    concurrent.futures.wait([count], LONG_S)
    wait_until(lambda: not client.cluster.scheduler.tasks)


def test_futures_as_they_end_are_items(client, a, b, make_pipe):
    roots = make_pipe(client, capacity=10)
    futures = [b.submit(pow, number, 2) for number in range(4)]
    assert a.for_each(as_completed(futures), put_square, squares=roots) == 4
    assert sorted(roots.drain()) == [0, 1, 16, 81]


def test_an_error_of_an_iterable_or_of_its_items(client, a):
    with pytest.raises(ZeroDivisionError):
        a.for_each((1 / n for n in (1, 0)), abs)
    with pytest.raises(ZeroDivisionError) as caught:
        a.for_each([1, 0], invert)
    assert caught.value.__notes__ == ["poolpart: The error occurred for item 1 of the iterable: 0"]
    with pytest.raises(PoolError, match="expects a pipe or an iterable of items, but got 5"):
        a.for_each(5, abs)


def test_the_pipe_fails_with_an_error_of_another_pipe_that_the_function_uses(client, a, make_pipe):
    pipe = make_pipe(client)
    outlet = make_pipe(client)
    outlet.fail("the disk is full")
    pipe.put(1)
    with pytest.raises(PipeFailed, match="the disk is full"):
        a.for_each(pipe, outlet.put)
    with pytest.raises(PipeFailed, match="the disk is full"):
        pipe.put(2)
