"""Items that a task sends again, because it runs again, are accepted once."""

import threading
import time
from collections import Counter

import pytest
from distributed import get_worker
from distributed.protocol.pickle import dumps
from hypothesis import given
from hypothesis import strategies as st
from tests.daemons import wait_until
from tests.poolpart.helpers import LONG_S, addresses, kill

from poolpart import Partition, Pipe
from poolpart import accepted_items as accepted_module
from poolpart.accepted_items import AcceptedItems
from poolpart.pipe import _ask
from poolpart.pipe_states import PUT, pipes_of

ITEMS = [bytes([number % 3]) for number in range(40)]  # neighbors differ, and all are repeated


def send(accepted, run, items):
    """Send items as the scheduler handles them; return the items that were not dropped."""
    dropped = accepted.skip_repeats(run, items)
    if items[dropped:]:
        accepted.append(run, items[dropped:])
    return items[dropped:]


@given(steps=st.lists(st.tuples(st.integers(0, 3), st.integers(0, 7)), max_size=40))
def test_runs_that_alternate_send_each_item_once(steps):
    accepted = AcceptedItems()
    positions = Counter()
    arrived = []
    for run, number in steps:
        position = positions[run]
        positions[run] += number
        arrived += send(accepted, run, ITEMS[position : position + number])
    assert arrived == ITEMS[: max(positions.values(), default=0)]


@pytest.mark.parametrize("start", [1, 2, 20, 40])
def test_a_run_that_goes_on_where_the_last_one_ended_loses_nothing(start):
    accepted = AcceptedItems()
    send(accepted, 1.0, ITEMS[:start])
    rest = [b"another", *ITEMS[start:], *ITEMS]
    assert [item for i in rest for item in send(accepted, 2.0, [i])] == rest
    assert send(accepted, 3.0, ITEMS[:start]) == []  # as in the first run


def test_the_first_items_are_compared_and_all_are_counted(monkeypatch):
    monkeypatch.setattr(accepted_module, "COMPARED", 5)
    accepted = AcceptedItems()
    for position in range(0, 40, 8):
        send(accepted, 1.0, ITEMS[position : position + 8])
    assert send(accepted, 2.0, ITEMS[:30]) == []
    assert send(accepted, 2.0, [*ITEMS[30:], b"new"]) == [b"new"]
    assert send(accepted, 3.0, [*ITEMS[:4], b"different"]) == [b"different"]


# -- tasks ---------------------------------------------------------------------------------


def fail_once(name):
    """Raise an error in the first run of a task."""
    worker = get_worker()
    failed = worker.__dict__.setdefault("failed", set())
    if name not in failed:
        failed.add(name)
        raise OSError("try again")


def produce(pipe, items, close=False):
    for item in items:
        pipe.put(item)
    if close:
        pipe.close()
    fail_once(pipe.name)


def produce_many(pipe, items, close=False):
    pipe.put_many(items)
    if close:
        pipe.close()
    fail_once(pipe.name)


@pytest.mark.parametrize("function", [produce, produce_many])
@pytest.mark.parametrize("close", [True, False])
def test_a_task_that_is_retried_needs_no_space_for_its_first_items(
    client, b, make_pipe, function, close
):
    pipe = make_pipe(client, capacity=3)
    b.submit(function, pipe, [1, 1, "a"], close, retries=1).result(LONG_S)
    assert pipe.get_all() == [1, 1, "a"]
    assert pipe.drain() == []


def test_it_can_be_switched_off(client, b):
    with Pipe("repeated", 9, client, drop_repeats=False) as pipe:
        b.submit(produce, pipe, [1, 2], retries=1).result(LONG_S)
        assert pipe.drain() == [1, 2, 1, 2]


def produce_other_items(pipe):
    runs = get_worker().__dict__.setdefault("runs", [])
    runs.append(None)
    pipe.put_many(["first", len(runs), "last"])
    fail_once(pipe.name)


def test_a_task_that_sends_other_items_loses_none_of_them(client, b, make_pipe, caplog):
    pipe = make_pipe(client, capacity=9)
    b.submit(produce_other_items, pipe, key="other", retries=1).result(LONG_S)
    assert pipe.drain() == ["first", 1, "last", 2, "last"]
    assert caplog.text.count("'other' runs again, and sends items") == 1


def acknowledge(pipe, acknowledged):
    pipe.get()
    acknowledged.put("done")
    fail_once(pipe.name)


def test_items_of_a_task_that_takes_items_are_all_accepted(client, b, make_pipe):
    pipe = make_pipe(client, capacity=1)
    acknowledged = make_pipe(client)
    working = b.submit(acknowledge, pipe, acknowledged, retries=1)
    pipe.put(1)
    pipe.put(2)  # the consumer takes all items that are in the pipe
    working.result(LONG_S)
    assert acknowledged.drain() == ["done", "done"]


def produce_in_threads(pipe):
    threads = [threading.Thread(target=pipe.put, args=("equal",)) for _ in range(3)]
    pipe.put("of the task")
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    fail_once(pipe.name)


def test_items_of_threads_of_a_task_are_all_accepted(client, b, make_pipe):
    pipe = make_pipe(client, capacity=9)
    _ = pipe.client
    b.submit(produce_in_threads, pipe, retries=1).result(LONG_S)
    assert Counter(pipe.drain()) == {"of the task": 1, "equal": 6}


def produce_with_copies(pipe):
    for item in range(3):
        Pipe(pipe.name).put(item)
    fail_once(pipe.name)


def test_all_objects_of_a_pipe_in_a_task_count_together(client, b, make_pipe):
    pipe = make_pipe(client, capacity=9)
    b.submit(produce_with_copies, pipe, retries=1).result(LONG_S)
    assert pipe.drain() == [0, 1, 2]


# -- tasks that the scheduler forgets ------------------------------------------------------


go = threading.Event()  # the workers are threads of this process


def wait_to_go():
    return go.wait(LONG_S)


def put_as(client, pipe, task, run, items):
    _ask(
        client,
        PUT,
        names=[pipe.name],
        items=[dumps(item) for item in items],
        unbounded=True,
        seconds=0.0,
        task=task,
        run=run,
    )


def state_of(client, key):
    task = client.cluster.scheduler.tasks.get(key)
    return task and task.state


def accepted_by(client, pipe):
    return pipes_of(client.cluster.scheduler)[pipe.name].accepted


def test_items_of_finished_tasks_are_forgotten_with_the_task(client, b, make_pipe):
    pipe = make_pipe(client, capacity=9)
    future = b.submit(Pipe.put, pipe, 1, key=("tuple", 1))
    future.result(LONG_S)
    assert [accepted.count for accepted in accepted_by(client, pipe).values()] == [1]
    del future
    wait_until(lambda: not accepted_by(client, pipe))
    put_as(client, pipe, "unknown", 1.0, ["a"])
    assert not accepted_by(client, pipe)
    assert pipe.drain() == [1, "a"]


def test_a_running_task_that_is_forgotten_does_not_repeat_items(client, b, make_pipe, monkeypatch):
    """`for_each` releases a future whose result is computed again, since its worker has died."""
    monkeypatch.setattr("poolpart.pipe_states.MAX_KEPT", 2)
    pipe = make_pipe(client, capacity=99)
    go.clear()
    for number in range(3):
        key = f"running-{number}"
        future = b.submit(wait_to_go, key=key)
        wait_until(lambda key=key: state_of(client, key) == "processing")
        put_as(client, pipe, key, 1.0, ["a", "b"])
        future.cancel()
        wait_until(lambda key=key: state_of(client, key) is None)
        put_as(client, pipe, key, 2.0, ["a", "b", number])
        assert pipe.drain() == ["a", "b", number]
    assert list(accepted_by(client, pipe)) == ["running-1", "running-2"]
    go.set()
    # Another task of the same key is not the same task.
    b.submit(Pipe.put_many, pipe, ["a", "b"], key="running-2").result(LONG_S)
    assert pipe.drain() == ["a", "b"]


# -- workers that are killed ---------------------------------------------------------------


def kill_and_wait(client, name):
    """Kill a worker's process, and wait until its nanny has started another one."""
    killed = kill(client, name)
    wait_until(lambda: addresses(client).get(name, killed) != killed)


def count_to(pipe, number, many):
    if many:
        pipe.put_many(range(number))
    else:
        for item in range(number):
            pipe.put(item)
    pipe.close()


@pytest.mark.extended(every=2)
@pytest.mark.parametrize("many", [True, False])
def test_a_producer_that_is_killed_while_it_waits_sends_each_item_once(processes, make_pipe, many):
    pipe = make_pipe(processes, capacity=20)
    producer = Partition("OTHER", processes).submit(count_to, pipe, 100, many)
    received = []
    for _ in range(2):
        while pipe.depth < 20:
            time.sleep(0.005)
        kill_and_wait(processes, "OTHER-0")
        received += pipe.drain()
    received += list(pipe)
    assert received == list(range(100))
    producer.result(LONG_S)


def square(number, squares):
    squares.put((number, number**2))
    time.sleep(0.003)


@pytest.mark.extended
def test_for_each_with_killed_workers_puts_each_result_once(processes, make_pipe):
    pipe = make_pipe(processes, capacity=20)
    squares = make_pipe(processes, capacity=1000)
    producer = Partition("OTHER", processes).submit(count_to, pipe, 400, many=False)
    counting = Partition("IO", processes).for_each(pipe, square, squares=squares, wait=False)
    for name in ("OTHER-0", "IO-0", "OTHER-0", "IO-0"):
        time.sleep(0.1)
        kill_and_wait(processes, name)
    assert counting.result(LONG_S) == 400
    producer.result(LONG_S)
    assert sorted(squares.drain()) == [(number, number**2) for number in range(400)]
