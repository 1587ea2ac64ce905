"""Pipes between threads of one process: order, bound, end, failure, deletion."""

import itertools
import logging
import signal
import threading
import time
from collections import deque
from concurrent.futures import ThreadPoolExecutor

import pytest
from distributed import Client, Queue, Variable, get_worker
from distributed.protocol.pickle import dumps
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.daemons import wait_until
from tests.poolpart.helpers import LONG_S

from poolpart import Pipe, PipeClosed, PipeFailed, cancelled
from poolpart import pipe as pipe_module
from poolpart.pipe import exchange_items, get_advice, set_advice, take_items
from poolpart.pipe_states import (
    CHANGE,
    PUT,
    TAKE,
    USES_PIPES,
    PipeState,
    create_pipe,
    fail_pipes_of_killed_task,
    pipes_of,
    reply_without_pipes,
)


def other_end(pipe):
    """Return a further object for the same pipe, with an empty buffer."""
    return Pipe(pipe.name, pipe.capacity, pipe.client)


def known(client):
    """What the scheduler knows of pipes, and can be asked."""
    scheduler = client.cluster.scheduler
    handlers = {
        name: answer
        for name, answer in scheduler.handlers.items()
        if answer is not reply_without_pipes
    }
    return set(pipes_of(scheduler)), set(scheduler.plugins), handlers


def consume(pipe):
    return list(pipe)


def produce(pipe, items):
    for item in items:
        pipe.put(item)


go = threading.Event()  # the workers are threads of this process


def wait_to_go():
    return go.wait(LONG_S)


@pytest.fixture
def gate():
    """The event that `wait_to_go` waits for; it is set at the end."""
    go.clear()
    yield go
    go.set()


@pytest.fixture
def pool():
    pool = ThreadPoolExecutor(16)
    yield pool
    pool.shutdown(wait=False)  # threads of a failed test wait until its pipes are deleted


OPERATIONS = st.lists(
    st.one_of(
        st.tuples(st.just("put"), st.none() | st.integers() | st.text(max_size=5)),
        st.tuples(st.sampled_from(["get", "drain", "get_all"]), st.none()),
    ),
    max_size=30,
)


@pytest.fixture
def patient(monkeypatch):
    """Have all waits last long, so that only a notification ends them in time."""
    monkeypatch.setattr(pipe_module, "WAIT_S", LONG_S)
    monkeypatch.setattr("poolpart.internals.queues.CHECK_S", LONG_S)


@pytest.fixture
def requests(monkeypatch):
    """Record the requests of pipes: (name, longest wait in seconds or None)."""
    found = []
    ask = pipe_module.send_request

    def record(client, timeout_s, handler, **arguments):
        found.append((handler, arguments.get("seconds")))
        return ask(client, timeout_s, handler, **arguments)

    monkeypatch.setattr(pipe_module, "send_request", record)
    return found


def wait_for_waiters(client, counts):
    """Wait until so many requests wait at each pipe: {pipe: number}."""
    queues = client.cluster.scheduler.extensions["queues"].queues
    wait_until(lambda: all(len(queues[p.name].waiters) == n for p, n in counts.items()))


@pytest.mark.extended
@given(operations=OPERATIONS, capacity=st.integers(1, 4))
@settings(max_examples=40)
def test_behaves_as_a_bounded_queue(_threads_client, operations, capacity):
    pipe = Pipe("model", capacity, _threads_client).create()
    producer = other_end(pipe)
    queued = deque()
    taken = deque()
    try:
        for operation, item in operations:
            if operation == "put" and len(queued) == capacity:
                with pytest.raises(TimeoutError, match="remained full for 0 s"):
                    producer.put(item, timeout_s=0)
            elif operation == "put":
                producer.put(item)
                queued.append(item)
            elif operation == "get" and (taken or queued):
                if not taken:
                    taken.extend(queued)
                    queued.clear()
                assert pipe.get(timeout_s=0) == taken.popleft()
            elif operation == "drain" or taken or queued:
                assert getattr(pipe, operation)() == [*taken, *queued]
                taken.clear()
                queued.clear()
            else:
                with pytest.raises(TimeoutError, match=r"No item arrived in .* within 0 s"):
                    getattr(pipe, operation)(timeout_s=0)
            assert producer.depth == len(queued)
    finally:
        pipe.delete()


@pytest.fixture(scope="module")
def _threads_client(_threads):
    with Client(_threads) as client:
        yield client


@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("put", [produce, Pipe.put_many])
def test_several_producers_and_consumers_lose_and_double_nothing(
    client, make_pipe, pool, shared, put
):
    pipe = make_pipe(client, capacity=5)
    ends = [pipe if shared else other_end(pipe) for _ in range(8)]
    consumers = [pool.submit(consume, end) for end in ends[:4]]
    producers = [
        pool.submit(put, end, [(number, item) for item in range(40)])
        for number, end in enumerate(ends[4:])
    ]
    while not all(producer.done() for producer in producers):
        assert pipe.depth <= 5
    pipe.close()
    received = [consumer.result(LONG_S) for consumer in consumers]
    assert sorted(itertools.chain(*received)) == [(n, i) for n in range(4) for i in range(40)]
    for items, number in itertools.product(received, range(4)):
        mine = [item for n, item in items if n == number]
        assert shared or mine == sorted(mine)  # in order, unless threads take turns


def test_consumers_drain_a_closed_pipe_and_end(client, make_pipe):
    pipe = make_pipe(client)
    pipe.put(1)
    pipe.put(2)
    pipe.close()
    pipe.close()
    end = other_end(pipe)
    assert end.get() == 1
    assert list(end) == [2]
    with pytest.raises(PipeClosed, match="is closed and empty"):
        end.get()
    with pytest.raises(PipeClosed, match="is closed and empty"):
        end.get_all()
    assert end.drain() == []


def test_poll_returns_an_item_and_whether_there_was_one(client, make_pipe, pool):
    pipe = make_pipe(client)
    assert pipe.poll() == (None, False)
    pipe.put_many([None, 2])
    end = other_end(pipe)
    assert (end.poll(), end.poll(), end.poll(0.01)) == ((None, True), (2, True), (None, False))
    waiting = pool.submit(end.poll, LONG_S)
    wait_for_waiters(client, {pipe: 1})
    pipe.put(3)
    assert waiting.result(LONG_S) == (3, True)
    waiting = pool.submit(end.poll, LONG_S)
    wait_for_waiters(client, {pipe: 1})
    pipe.close()
    assert waiting.result(LONG_S) == (None, False)
    pipe.fail("the disk is full")
    with pytest.raises(PipeFailed, match="the disk is full"):
        end.poll(LONG_S)


def test_failing_wakes_both_ends_with_the_reason(client, make_pipe, pool):
    empty = make_pipe(client)
    full = make_pipe(client, capacity=1)
    full.put("x")
    waiting = [pool.submit(other_end(empty).get), pool.submit(other_end(empty).get_all)]
    waiting += [pool.submit(other_end(full).put, number) for number in range(3)]
    wait_for_waiters(client, {empty: 2, full: 3})
    assert not any(future.done() for future in waiting)
    for pipe in (empty, full):
        pipe.fail("the disk is full")
        pipe.fail("a consequence")
    for future in waiting:
        with pytest.raises(PipeFailed, match=r"^the disk is full$"):
            future.result(LONG_S)


def take_one_and_fail(pipes):
    for pipe in pipes:
        pipe.get()
    raise OSError("the disk is full")


def test_a_consumer_that_fails_ends_its_producers(client, b, make_pipe, pool):
    pipes = [make_pipe(client, capacity=1) for _ in range(2)]
    kept = Pipe(pipes[1].name, 1, client, fails_with_tasks=False)
    for pipe in pipes:
        pipe.put("taken")
    consumer = b.submit(take_one_and_fail, [pipes[0], kept], key=f"consumer-{pipes[0].name}")
    with pytest.raises(OSError, match="the disk is full"):
        consumer.result(LONG_S)
    reason = rf"^Task '{consumer.key}', which uses the pipe, failed: OSError\('the disk is full'"
    with pytest.raises(PipeFailed, match=reason):
        produce(pipes[0], range(9))
    kept.put("the program submits another consumer")
    assert pipes[1].get(LONG_S) == "the program submits another consumer"


def close_and_fail(pipe):
    pipe.put("last")
    pipe.close()
    raise OSError("the disk is full")


def test_a_closed_pipe_does_not_fail_with_its_task(client, b, make_pipe):
    pipe = make_pipe(client)
    with pytest.raises(OSError, match="the disk is full"):
        b.submit(close_and_fail, pipe).result(LONG_S)
    assert list(pipe) == ["last"]


def test_a_task_whose_input_fails_ends_its_pipe_with_the_error_of_the_input(client, b, make_pipe):
    pipe = make_pipe(client)
    dependent = b.submit(produce, pipe, b.submit(int, "no number"), key=f"producer-{pipe.name}")
    reason = rf"^Task '{dependent.key}', which uses the pipe, failed: ValueError\(.*'no number'"
    with pytest.raises(PipeFailed, match=reason):
        pipe.get(LONG_S)


def test_a_task_of_for_each_that_fails_ends_the_consumers_of_its_pipe(client, a, make_pipe):
    results = make_pipe(client)
    with pytest.raises(ValueError, match="bad item"):
        a.for_each([1], put_or_fail, results=results)
    with pytest.raises(PipeFailed, match=r"^Task 'put_or_fail-.*failed: ValueError\('bad item'"):
        results.get(LONG_S)


def put_or_fail(item, results):
    raise ValueError("bad item")


def test_a_producer_that_is_cancelled_ends_its_consumers(client, b, make_pipe, wait_until):
    """Dask cancels a task also when its last future is gone."""
    pipe = make_pipe(client)
    gate = make_pipe(client)
    running = b.submit(gate.get)  # keeps the only slot
    key = f"producer-{pipe.name}"
    waiting = b.submit(produce, pipe, range(3), key=key)
    wait_until(lambda: key in client.cluster.scheduler.tasks)
    del waiting
    reason = f"^Task '{key}', which uses the pipe, was canceled before it had used the pipe"
    with pytest.raises(PipeFailed, match=reason):
        pipe.get(LONG_S)
    gate.put("go on")
    assert running.result(LONG_S) == "go on"


def test_a_consumer_that_is_cancelled_leaves_the_pipe_to_others(client, b, make_pipe, wait_until):
    pipe = make_pipe(client)
    scheduler = client.cluster.scheduler
    consumer = b.submit(consume, pipe)
    wait_until(lambda: len(scheduler.extensions["queues"].queues[pipe.name].waiters) == 1)
    consumer.cancel()
    wait_until(lambda: consumer.key not in scheduler.tasks)
    pipe.put_many([1, 2])
    pipe.close()
    # Dask does not stop the function: it shares the items with this one.
    assert {*consume(other_end(pipe))} <= {1, 2}


def put_until_cancelled(pipe):
    pipe.put("started")
    while not cancelled():
        time.sleep(0.01)
    pipe.put("cancelled")
    pipe.close()


def test_a_running_producer_that_is_cancelled_can_go_on(client, b, make_pipe):
    pipe = make_pipe(client)
    producer = b.submit(put_until_cancelled, pipe)
    assert pipe.get(LONG_S) == "started"
    producer.cancel()
    assert list(pipe) == ["cancelled"]


def test_a_task_that_ends_without_closing_its_pipe_is_no_failure(client, a, make_pipe, wait_until):
    pipe = make_pipe(client, capacity=9)
    for item in range(2):
        assert a.submit(pipe.put, item).result(LONG_S) is None
        assert a.submit(produce, pipe, [item]).result(LONG_S) is None
    assert pipe.name in a.submit(str, pipe).result(LONG_S)  # does not use it
    wait_until(lambda: not client.cluster.scheduler.tasks)
    assert sorted(pipe.get_all(LONG_S)) == [0, 0, 1, 1]
    pipe.put(3)


def test_advice_can_return_to_what_it_was(client, make_pipe):
    pipe = make_pipe(client)
    set_advice(pipe, 5)
    set_advice(other_end(pipe), 1)
    assert get_advice(other_end(pipe)) == 1


def test_advice_is_requested_once_and_sent_only_if_it_changes(client, make_pipe, requests):
    pipe = make_pipe(client)
    assert [get_advice(pipe), get_advice(pipe)] == [1, 1]
    set_advice(pipe, 1)
    assert requests == [(CHANGE, None)]
    set_advice(pipe, 2)
    set_advice(pipe, 2)
    assert get_advice(pipe) == 2
    assert len(requests) == 2
    with pytest.raises(ValueError, match=r"Invalid advice 0 .* of at least 1"):
        set_advice(pipe, 0)


def test_each_request_waits_for_a_part_of_the_time_that_is_left(
    client, make_pipe, requests, monkeypatch
):
    monkeypatch.setattr(pipe_module, "WAIT_S", 0.05)
    pipe = make_pipe(client, capacity=2)
    for take in (Pipe.get, Pipe.get_all):
        requests.clear()
        with pytest.raises(TimeoutError):
            take(pipe, timeout_s=0.12)
        questions, seconds = zip(*requests, strict=True)
        assert {*questions} == {TAKE}
        assert seconds[0] == max(seconds) == 0.05
        assert 0.05 < sum(seconds) < 0.125
    requests.clear()
    assert pipe.drain() == []
    pipe.put_many([0, 1])
    with pytest.raises(TimeoutError, match="remained full for 0 s"):
        pipe.put(2, timeout_s=0)
    assert pipe.get() == 0
    assert pipe.get_all() == [1]  # has it already, and looks for more
    assert requests == [(TAKE, 0.0), (PUT, 0.05), (PUT, 0.0), (TAKE, 0.05), (TAKE, 0.0)]


def test_items_are_taken_beside_tasks(client, make_pipe, requests, monkeypatch, gate):
    monkeypatch.setattr(pipe_module, "WAIT_S", 0.05)
    pipe = make_pipe(client, capacity=9)
    pipe.put_many(range(7))
    assert take_items(pipe, [], 2, LONG_S) == ([0, 1], False, False)
    assert pipe.depth == 5
    assert pipe.get() == 2
    requests.clear()
    assert take_items(pipe, [], 3, LONG_S) == ([3, 4, 5], False, False)
    pipe.close()
    assert take_items(pipe, [], 3, LONG_S) == ([6], False, False)
    assert [handler for handler, _ in requests] == [CHANGE]  # items of the buffer need none
    assert take_items(pipe, [], 3, LONG_S) == ([], True, True)

    pipe = make_pipe(client)
    task = client.submit(wait_to_go, pure=False)
    assert take_items(pipe, [task], 1, 0.1) == ([], False, False)
    threading.Timer(0.2, pipe.put, ["late"]).start()
    assert take_items(pipe, [task], 1, LONG_S) == (["late"], False, False)
    pipe.put("not taken")
    requests.clear()
    threading.Timer(0.2, gate.set).start()
    assert take_items(pipe, [task], 0, LONG_S) == ([], False, False)
    assert task.done() and len(requests) > 1
    assert pipe.poll() == ("not taken", True)


@pytest.mark.parametrize("take", ["get_all", "exchange_items"])
def test_a_wait_for_more_items_ends_when_the_pipe_is_full_or_ends(
    client, make_pipe, pool, patient, take
):
    def take_all(pipe):
        if take == "get_all":
            return other_end(pipe).get_all(linger_s=LONG_S)
        return exchange_items(client, LONG_S, [pipe.name], linger_s=LONG_S)[pipe.name]

    start = time.monotonic()
    pipe = make_pipe(client)
    for last in (lambda: pipe.put(2), pipe.close):
        pipe.put(0)
        waiting = pool.submit(take_all, pipe)
        wait_for_waiters(client, {pipe: 1})
        pipe.put(1)
        assert not waiting.done()
        last()
        assert waiting.result(LONG_S) == ([0, 1] if last == pipe.close else [0, 1, 2])
    pipe = make_pipe(client)
    pipe.put(0)
    assert pipe.get_all(timeout_s=0.1, linger_s=LONG_S) == [0]
    assert time.monotonic() - start < LONG_S / 2


def test_of_many_items_those_before_an_error_are_in_the_pipe(client, make_pipe):
    pipe = make_pipe(client, capacity=2)
    source = itertools.count()
    pipe.put_many([])
    pipe.put("first")
    with pytest.raises(TimeoutError, match=r"remained full for 0\.1 s"):
        pipe.put_many(source, timeout_s=0.1)
    assert next(source) == 2  # no more than fit into one request
    assert pipe.drain() == ["first", 0]
    pipe.put_many(range(5), unbounded=True)
    pipe.close()
    with pytest.raises(PipeClosed):
        pipe.put(5, unbounded=True)
    with pytest.raises(PipeClosed):
        pipe.put_many(range(5))
    assert list(pipe) == [0, 1, 2, 3, 4]
    failed = make_pipe(client)
    failed.fail("")
    with pytest.raises(PipeFailed, match="No reason was given"):
        failed.put(1)
    failed = make_pipe(client)
    failed.fail("no more")
    with pytest.raises(PipeFailed, match="no more"):
        failed.put_many(range(5))


USES = {
    "put": lambda pipe: pipe.put(1),
    "put_many": lambda pipe: pipe.put_many([1, 2]),
    "get": lambda pipe: pipe.get(),
    "get_all": lambda pipe: pipe.get_all(),
    "drain": lambda pipe: pipe.drain(),
    "depth": lambda pipe: pipe.depth,
    "close": lambda pipe: pipe.close(),
    "fail": lambda pipe: pipe.fail("x"),
    "advise": lambda pipe: set_advice(pipe, 5),
    "iterate": list,
}


@pytest.fixture(autouse=True)
def _only_notifications(monkeypatch):
    """Have waits end by notifications, rather than when they look again after a second."""
    monkeypatch.setattr("poolpart.internals.queues.CHECK_S", 30.0)


@pytest.mark.parametrize("others", [True, False])
def test_using_a_deleted_pipe_says_so_and_does_not_bring_it_back(
    client, make_pipe, monkeypatch, others
):
    """Without others, the scheduler answers requests of pipes no more."""
    monkeypatch.setattr("poolpart.pipe.WAIT_S", 5.0)
    if others:
        make_pipe(client)
    before = known(client)
    pipe = make_pipe(client)
    pipe.put(1)
    pipe.delete()
    pipe.delete()
    began_at = time.monotonic()
    for use in USES.values():
        for end in (pipe, other_end(pipe)):
            with pytest.raises(
                PipeFailed, match=r"does not exist\. It was deleted or never created"
            ):
                use(end)
    assert time.monotonic() - began_at < 15  # no request has waited
    assert known(client) == before


def use_in_task(name, use):
    with pytest.raises(PipeFailed, match=r"does not exist\. It was deleted or never created"):
        USES[use](Pipe(name))


def test_a_pipe_that_was_never_created_is_an_error_of_its_user_only(start, caplog):
    """Not of the scheduler, whose log had a traceback for each request."""
    client = start({"a": {}})
    caplog.set_level(logging.WARNING)  # a cluster that is started silences it
    for use in USES.values():
        with pytest.raises(PipeFailed, match=r"does not exist\. It was deleted or never created"):
            use(Pipe("never-created", client=client))
    assert exchange_items(client, 0.0, ["never-created"]) == {}
    with Client(client.cluster) as other:
        other.gather([other.submit(use_in_task, "never-created", use) for use in USES])
    with Pipe("made", client=client) as pipe:
        pipe.put(1)
    client.submit(use_in_task, "made", "iterate").result(LONG_S)
    assert not caplog.records


def test_leaving_its_block_deletes_a_pipe_also_after_an_error(client):
    scheduler = client.cluster.scheduler
    with pytest.raises(ZeroDivisionError), Pipe("in-a-block", 2, client) as pipe:
        pipe.put(1)
        assert "in-a-block" in pipes_of(scheduler)
        raise ZeroDivisionError
    assert "in-a-block" not in pipes_of(scheduler)


def test_two_pipes_of_one_name(client, make_pipe):
    pipe = make_pipe(client)
    pipe.put("mine")
    with pytest.raises(ValueError, match=f"already has a queue or variable named {pipe.name!r}"):
        other_end(pipe).create()
    assert pipe.get() == "mine"
    pipe.delete()
    assert other_end(pipe).create().depth == 0


@pytest.mark.parametrize("kind", [Queue, Variable])
def test_a_pipe_does_not_take_over_a_queue_or_variable(client, kind):
    name = f"taken-{kind.__name__}"
    found = kind(name, client)
    found.put(1) if kind is Queue else found.set(1)
    with pytest.raises(ValueError, match=f"already has a queue or variable named '{name}'"):
        Pipe(name, client=client).create()
    assert found.get() == 1
    found.close() if kind is Queue else found.delete()


@pytest.mark.parametrize(
    ("change", "outcome"),
    [
        (Pipe.drain, None),
        (Pipe.close, PipeClosed),
        (Pipe.delete, PipeFailed),
        (lambda pipe: pipe.fail("no more"), PipeFailed),
    ],
)
def test_a_put_that_waits_for_room_hears_at_once(client, make_pipe, patient, change, outcome):
    """By the scheduler's answer: it would look by itself only after the longest wait."""
    pipe = make_pipe(client, capacity=1)
    pipe.put("first")
    with ThreadPoolExecutor(1) as thread:
        waiting = thread.submit(pipe.put, "second")
        wait_for_waiters(client, {pipe: 1})
        assert not waiting.done()
        start = time.monotonic()
        change(Pipe(pipe.name, 1, client))
        error = waiting.exception(LONG_S)
    assert time.monotonic() - start < LONG_S / 2
    assert error is None if outcome is None else isinstance(error, outcome)
    if outcome is None:
        assert pipe.drain() == ["second"]


ENDS = [Pipe.close, Pipe.delete, lambda pipe: pipe.fail("why not")]


@pytest.mark.parametrize("change", [*ENDS, lambda pipe: pipe.put("item")])
def test_an_item_or_the_end_of_a_pipe_ends_the_wait(client, make_pipe, patient, change):
    pipe = make_pipe(client)
    start = time.monotonic()
    threading.Timer(0.1, change, [pipe]).start()
    assert exchange_items(client, LONG_S, [pipe.name]) in ({}, {pipe.name: ["item"]})
    assert 0.1 <= time.monotonic() - start < LONG_S / 2


def test_a_task_that_ends_or_is_not_known_ends_the_wait(client, make_pipe, patient, pool, gate):
    pipe = make_pipe(client)
    future = client.submit(wait_to_go, pure=False)
    wait_until(lambda: future.key in client.cluster.scheduler.tasks)
    start = time.monotonic()
    waiting = pool.submit(exchange_items, client, LONG_S, [pipe.name], [future.key])
    wait_for_waiters(client, {pipe: 1})
    assert (
        exchange_items(client, 0.1, [pipe.name], [future.key]) == {}
    )  # leaves the other wait alone
    assert time.monotonic() - start >= 0.1
    assert not waiting.done()
    gate.set()
    assert waiting.result(LONG_S) == {}
    exchange_items(client, LONG_S, [], ["nobody-knows"])
    assert time.monotonic() - start < LONG_S / 2


def test_items_are_put_beyond_the_capacity_in_the_request_that_takes_others(client, make_pipe):
    inlet, outlet = make_pipe(client, capacity=1), make_pipe(client)
    outlet.put("news")
    puts = {inlet.name: [1, 2], "nobody-knows": [3]}
    assert exchange_items(client, 0.0, [outlet.name], puts=puts) == {outlet.name: ["news"]}
    assert inlet.drain() == [1, 2]


def test_all_that_is_in_the_pipes_is_taken_in_one_request(client, make_pipe, monkeypatch):
    one, two, empty = pipes = [make_pipe(client, capacity=100) for _ in range(3)]
    for number in range(5):
        one.put(number)
    two.put({"scan": 7})
    one.close()
    asked = []
    ask = client.sync
    monkeypatch.setattr(client, "sync", lambda *a, **k: asked.append(1) or ask(*a, **k))
    found = exchange_items(client, LONG_S, [pipe.name for pipe in pipes])
    assert len(asked) == 1
    assert found == {one.name: [0, 1, 2, 3, 4], two.name: [{"scan": 7}]}
    assert exchange_items(client, 0.0, [one.name, two.name, empty.name]) == {}


# -- waits and items that go wrong ---------------------------------------------------------


class Unreadable:
    """An item whose unpickling raises ValueError."""

    def __reduce__(self):
        return int, ("not a number",)


@pytest.mark.parametrize("take", [Pipe.get_all, Pipe.drain])
def test_of_the_items_of_a_request_only_the_unreadable_one_is_lost(client, make_pipe, take):
    pipe = make_pipe(client, capacity=10)
    pipe.put_many([0, 1, Unreadable(), 2, 3])
    assert take(pipe) == [0, 1]
    with pytest.raises(ValueError, match="not a number"):
        take(pipe)
    assert take(pipe) == [2, 3]


def test_get_raises_the_error_of_an_unreadable_item_in_the_place_of_the_item(client, make_pipe):
    pipe = make_pipe(client, capacity=10)
    pipe.put_many([0, Unreadable(), 1])
    pipe.close()
    assert pipe.get() == 0
    with pytest.raises(ValueError, match="not a number"):
        pipe.get()
    assert list(pipe) == [1]


@pytest.fixture
def interrupt():
    """Return a function that interrupts the main thread after some seconds, as Ctrl-C does."""

    def raise_interrupt(number, frame):
        raise KeyboardInterrupt

    handler = signal.signal(signal.SIGALRM, raise_interrupt)
    yield lambda seconds: signal.setitimer(signal.ITIMER_REAL, seconds)
    signal.setitimer(signal.ITIMER_REAL, 0)
    signal.signal(signal.SIGALRM, handler)


@pytest.mark.parametrize("take", [Pipe.get, Pipe.get_all, list])
def test_a_wait_that_is_interrupted_takes_no_item_away(client, make_pipe, interrupt, take):
    pipe = make_pipe(client)
    interrupt(0.3)
    with pytest.raises(KeyboardInterrupt):
        take(pipe)
    other_end(pipe).put("item")  # within the second for which the scheduler keeps the request
    time.sleep(0.1)
    assert pipe.get(5.0) == "item"


def test_an_interrupted_wait_asks_no_further(client, make_pipe, interrupt):
    pipe = make_pipe(client)
    interrupt(0.3)
    with pytest.raises(KeyboardInterrupt):
        pipe.get()
    time.sleep(1.5)  # the scheduler keeps a request for a second
    other_end(pipe).put("item")
    assert other_end(pipe).get(5.0) == "item"


def test_a_variable_that_is_read_before_its_pipe_exists(client, make_pipe, pool):
    """Dask wakes the requests that wait for a variable only when a client sets the variable."""
    with Client(client.cluster, set_as_default=False) as other:
        waiting = pool.submit(Variable("opened-later", other).get, LONG_S)
        time.sleep(0.2)
        with Pipe("opened-later", 3, client):
            assert waiting.result(5.0)["capacity"] == 3


# -- several producers -------------------------------------------------------------------------


def test_a_pipe_of_several_producers_is_closed_by_the_last(client, make_pipe):
    pipe = make_pipe(client, capacity=10, producers=3)
    for number in range(3):
        with pytest.raises(TimeoutError):
            other_end(pipe).get(timeout_s=0)
        pipe.put(number)
        assert pipe.get() == number
        pipe.close()
    with pytest.raises(PipeClosed):
        pipe.get()


def produce_and_close(pipe, items):
    pipe.put_many(items)
    pipe.close()


def test_a_task_that_is_run_again_closes_for_one_producer(client, a, make_pipe, wait_until):
    pipe = make_pipe(client, capacity=100, producers=2)
    for _ in range(2):
        a.submit(produce_and_close, pipe, range(3), key="producer-1").result(LONG_S)
        wait_until(lambda: not client.cluster.scheduler.tasks)
    assert pipe.get_all() == [0, 1, 2, 0, 1, 2]
    with pytest.raises(TimeoutError):
        pipe.get(timeout_s=0)
    a.submit(produce_and_close, pipe, [9], key="producer-2").result(LONG_S)
    assert list(pipe) == [9]


@pytest.mark.parametrize(
    "options", [{"name": ""}, {"name": 5}, {"drop_repeats": "no"}, {"fails_with_tasks": None}]
)
def test_names_and_flags_that_make_no_pipe(client, options):
    with pytest.raises(ValueError, match=r"Invalid (name|value) .* Expected (a string|True or)"):
        Pipe(**{"name": "nothing", "client": client} | options)


@pytest.mark.parametrize(
    "options", [{"capacity": 0}, {"capacity": True}, {"producers": 0}, {"producers": 1.5}]
)
def test_numbers_that_make_no_pipe(client, options):
    with pytest.raises(
        ValueError,
        match=r"Invalid value (0|True|1\.5) for the .* Expected an integer of at least 1",
    ):
        Pipe("nothing", client=client, **options)


# -- beside distributed.Queue and distributed.Variable, which a pipe consists of ---------------


@pytest.fixture
def other(client):
    """Another client, which uses Dask's own classes."""
    with Client(client.cluster, set_as_default=False) as other:
        yield other


def test_a_queue_of_another_client_puts_and_gets_the_same_items(client, other, make_pipe, pool):
    pipe = make_pipe(client)
    queue = Queue(pipe.name, other)
    waiting = pool.submit(pipe.get, LONG_S)
    wait_for_waiters(client, {pipe: 1})
    queue.put({"plain": (1, b"2")})
    assert waiting.result(LONG_S) == {"plain": (1, b"2")}
    waiting = pool.submit(queue.get, LONG_S)
    wait_for_waiters(client, {pipe: 1})
    pipe.put({1, 2})  # pickled, and unpickled by the other client
    assert waiting.result(LONG_S) == {1, 2}
    pipe.put("first")
    queue.put("second")
    queue.put(other.submit(pow, 2, 10))
    assert queue.qsize() == pipe.depth == 3
    first, second, future = pipe.get_all()
    assert (first, second, future.result(LONG_S)) == ("first", "second", 1024)
    pipe.put_many(range(3))
    assert queue.get(batch=True) == [0, 1, 2]
    assert queue.qsize() == pipe.depth == 0


def test_a_queue_waits_for_room_as_well(client, other, make_pipe, pool):
    pipe = make_pipe(client, capacity=1)
    queue = Queue(pipe.name, other)
    pipe.put(1)
    waiting = pool.submit(queue.put, 2)
    wait_for_waiters(client, {pipe: 1})
    assert not waiting.done()
    assert pipe.drain() == [1]
    waiting.result(LONG_S)
    waiting = pool.submit(pipe.put, 3)
    wait_for_waiters(client, {pipe: 1})
    assert not waiting.done()
    assert queue.get() == 2
    waiting.result(LONG_S)
    assert pipe.drain() == [3]


def test_several_queues_and_pipes_lose_and_double_nothing(client, other, make_pipe, pool):
    pipe = make_pipe(client, capacity=2)
    queue = Queue(pipe.name, other)
    consumers = [pool.submit(consume, other_end(pipe)) for _ in range(2)]
    takers = [pool.submit(lambda: [queue.get() for _ in range(20)]) for _ in range(2)]
    producers = [pool.submit(produce, other_end(pipe), range(30)) for _ in range(2)]
    putters = [pool.submit(lambda: [queue.put(item) for item in range(30, 60)]) for _ in range(2)]
    for future in producers + putters:
        future.result(LONG_S)
    received = list(itertools.chain(*(taker.result(LONG_S) for taker in takers)))
    pipe.close()
    received += itertools.chain(*(consumer.result(LONG_S) for consumer in consumers))
    assert sorted(received) == sorted([*range(60), *range(60)])


@pytest.mark.parametrize("end", ["close", "fail", "delete"])
def test_waits_of_a_queue_end_with_the_pipe(client, other, make_pipe, pool, end):
    empty = make_pipe(client)
    full = make_pipe(client, capacity=1)
    full.put(1)
    waiting = [pool.submit(Queue(empty.name, other).get, LONG_S)]
    waiting += [pool.submit(Queue(full.name, other).put, 2, LONG_S)]
    wait_for_waiters(client, {empty: 1, full: 1})
    for pipe in (empty, full):
        pipe.fail("the disk is full") if end == "fail" else getattr(pipe, end)()
    message = {"close": "is closed", "fail": "the disk is full", "delete": "was deleted"}[end]
    for future in waiting:
        with pytest.raises((PipeClosed, PipeFailed), match=message):
            future.result(LONG_S)


def test_the_items_of_a_closed_pipe_are_left_for_queues_those_of_a_failed_one_not(
    client, other, make_pipe
):
    pipe = make_pipe(client)
    queue = Queue(pipe.name, other)
    pipe.put_many([1, 2])
    pipe.close()
    assert queue.get() == 1
    pipe.fail("the disk is full")
    with pytest.raises(PipeFailed, match="the disk is full"):
        queue.get()


def test_the_variable_is_the_state(client, other, make_pipe, pool):
    pipe = make_pipe(client, producers=2)
    variable = Variable(pipe.name, other)
    assert variable.get() == {
        "owner": client.id,
        "capacity": 3,
        "producers": 2,
        "closed_by": (),
        "closed": False,
        "failure": "",
        "advice": 1,
    }
    variable.set({**variable.get(), "advice": 5})
    assert get_advice(other_end(pipe)) == 5
    pipe.close()
    assert len(variable.get()["closed_by"]) == 1
    waiting = pool.submit(pipe.get, LONG_S)
    wait_for_waiters(client, {pipe: 1})
    variable.set({**variable.get(), "closed": True})
    with pytest.raises(PipeClosed):
        waiting.result(LONG_S)
    variable.set({**variable.get(), "failure": "of another client"})
    with pytest.raises(PipeFailed, match="of another client"):
        pipe.get()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"closed": False}, "a closed pipe cannot be opened again"),
        ({"capacity": 9}, "`capacity` cannot be changed to 9"),
        ({"owner": ""}, "`owner` cannot be changed to ''"),
        ({"closed_by": ["x"]}, "`closed_by` cannot be changed"),
        ({"closed": 1}, "`closed` cannot be 1"),
        ({"advice": 0}, "`advice` must be at least 1, not 0"),
        ({"failure": "another"}, "the reason for a failure cannot be changed"),
        ({"size": 2}, "has different fields"),
    ],
)
def test_what_cannot_follow_from_the_state_is_refused(client, other, make_pipe, change, message):
    pipe = make_pipe(client)
    pipe.close()
    pipe.fail("the first")
    variable = Variable(pipe.name, other)
    state = variable.get()
    with pytest.raises(ValueError, match=f"holds the state of a pipe.*{message}"):
        variable.set({**state, **change})
    for value in (None, 5, client.submit(pow, 2, 10)):
        with pytest.raises(ValueError, match="has different fields"):
            variable.set(value)
    assert variable.get() == state


@pytest.mark.parametrize("kind", [Queue, Variable])
def test_who_deletes_the_queue_or_the_variable_deletes_the_pipe(
    client, other, make_pipe, pool, kind, monkeypatch
):
    monkeypatch.setattr("poolpart.internals.queues.CHECK_S", 0.05)  # Dask notifies nobody
    pipe = make_pipe(client)
    queue = Queue(pipe.name, other)
    waiting = [pool.submit(other_end(pipe).get), pool.submit(queue.get)]
    wait_for_waiters(client, {pipe: 2})
    if kind is Variable:
        Variable(pipe.name, other).delete()
    else:
        queue.close()
        queue.close()  # Dask counts references: this one, and the pipe's
    for future in waiting:
        with pytest.raises(PipeFailed, match="does not exist"):
            future.result(LONG_S)
    with pytest.raises(PipeFailed, match="does not exist"):
        pipe.put(1)
    pipe.delete()
    assert other_end(pipe).create().depth == 0


def test_other_queues_and_variables_are_as_ever(client, other, make_pipe):
    make_pipe(client)
    queue = Queue("of-somebody", other)
    variable = Variable("of-somebody", other)
    queue.put(1)
    variable.set("a value")
    variable.set(other.submit(pow, 2, 10))
    assert queue.get() == 1
    assert variable.get().result(LONG_S) == 1024
    variable.delete()
    queue.close()


def test_a_change_of_a_pipe_wakes_those_that_wait_for_it_only(
    client, make_pipe, pool, monkeypatch, patient, wait_until
):
    """The time of an item would grow with the number of pipes."""
    looks = []
    has_ended = PipeState.has_ended.fget
    monkeypatch.setattr(
        PipeState,
        "has_ended",
        property(lambda state: looks.append(state.name) or has_ended(state)),
    )
    idle = [make_pipe(client) for _ in range(8)]
    busy = make_pipe(client)
    waiting = [pool.submit(other_end(pipe).get, LONG_S) for pipe in idle]
    states = pipes_of(client.cluster.scheduler)
    wait_until(lambda: all(states[pipe.name].queue.waiters for pipe in idle))
    looks.clear()
    for number in range(20):
        busy.put(number)
        assert busy.get() == number
    assert set(looks) == {busy.name}
    for pipe in idle:
        pipe.close()
    for future in waiting:
        assert isinstance(future.exception(LONG_S), PipeClosed)


def test_a_pipe_of_a_client_that_has_left_is_not_made(client):
    """The last request of a client that was killed may arrive after the news of its end."""
    before = known(client)
    late = {"name": "late", "owner": "gone", "capacity": 1, "producers": 1}
    assert client.run_on_scheduler(create_pipe, **late) is False
    assert known(client) == before


def test_requests_of_a_client_that_has_left_change_nothing(client, make_pipe):
    """They may arrive after the news of its end; nobody would get the answer."""
    pipe = make_pipe(client)
    pipe.put("kept")

    async def request(dask_scheduler=None):
        handlers = dask_scheduler.handlers
        common = {"names": [pipe.name], "client_id": "gone", "seconds": 0.0}
        return (
            handlers[PUT](**common, items=[dumps("lost")], unbounded=False),
            await handlers[TAKE](**common),
        )

    put, taken = client.run_on_scheduler(request)
    assert put[pipe.name]["answer"] == 0
    assert taken[pipe.name]["answer"] == []
    assert pipe.poll() == ("kept", True)


def get_and_return_key(pipe):
    return pipe.get(LONG_S), get_worker().get_current_task()


@pytest.mark.parametrize("case", ["open", "closed", "consumer", "without pipe"])
def test_a_killed_task_ends_the_open_pipes_that_it_does_not_consume(client, b, make_pipe, case):
    pipe = make_pipe(client)
    pipe.put(1)
    key = "producer"
    annotations = {USES_PIPES: [pipe.name]}
    if case == "consumer":
        item, key = b.submit(get_and_return_key, pipe).result(LONG_S)
        pipe.put(item)
    elif case == "closed":
        pipe.close()
    elif case == "without pipe":
        annotations = None

    def fail(dask_scheduler=None):
        fail_pipes_of_killed_task(dask_scheduler, key, annotations)

    client.run_on_scheduler(fail)
    if case == "open":
        reason = "^Task 'producer', which uses the pipe, was canceled, and its worker was restart"
        with pytest.raises(PipeFailed, match=reason):
            pipe.poll()
    else:
        assert pipe.poll() == (1, True)
