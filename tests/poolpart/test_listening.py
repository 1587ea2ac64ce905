"""A function that is called in this process for the items of a pipe."""

import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
from tests.poolpart.helpers import LONG_S

from poolpart import Partition, PipeClosed, PipeFailed


@pytest.fixture
def pool():
    pool = ThreadPoolExecutor(8)
    yield pool
    pool.shutdown(wait=False)  # threads of a failed test wait until its pipes are deleted


def produce(pipe, count):
    pipe.put_many(range(count))
    pipe.close()


def test_each_item_in_order_and_in_one_thread_of_this_process(client, a, make_pipe):
    pipe = make_pipe(client, capacity=4)
    calls = []
    listener = pipe.listen(lambda item: calls.append((item, threading.get_ident())))
    producer = a.submit(produce, pipe, 50)
    listener.join()
    items, threads = zip(*calls, strict=True)
    assert items == (*range(50),)
    assert len({*threads}) == 1 and threading.get_ident() not in threads
    producer.result(LONG_S)
    listener.join()  # again


def test_the_end_of_a_block_waits_for_all_items(client, a, make_pipe):
    pipe = make_pipe(client)
    items = []
    with pipe.listen(items.append):
        producer = a.submit(produce, pipe, 9)
    assert items == [*range(9)]
    producer.result(LONG_S)


def test_after_an_error_the_function_is_not_called_again(client, make_pipe):
    pipe = make_pipe(client, capacity=9)
    items = []

    def fail_on_two(item):
        items.append(item)
        if item == 2:
            raise ValueError("two")

    pipe.put_many(range(5))
    listener = pipe.listen(fail_on_two)
    for _ in range(2):
        with pytest.raises(ValueError, match="two"):
            listener.join()
    assert items == [0, 1, 2]
    with pytest.raises(PipeFailed, match="Function 'fail_on_two' failed: ValueError"):
        pipe.put(9)


@pytest.mark.parametrize("error", [PipeClosed, TimeoutError])
def test_an_error_of_the_function_that_a_pipe_raises_too(client, make_pipe, error):
    pipe = make_pipe(client)

    def fail(item):
        raise error("of the function")

    pipe.put(1)
    with pytest.raises(error, match="of the function"):
        pipe.listen(fail).join()


def test_a_pipe_that_fails_is_an_error(client, make_pipe):
    pipe = make_pipe(client)
    listener = pipe.listen(print)
    pipe.fail("the disk is full")
    with pytest.raises(PipeFailed, match="the disk is full"):
        listener.join()


def test_a_block_that_raises_does_not_wait_for_the_pipe(client, make_pipe, monkeypatch):
    monkeypatch.setattr("poolpart.extras.listening._CHECK_S", 0.05)
    pipe = make_pipe(client)
    items = []
    with pytest.raises(ZeroDivisionError), pipe.listen(items.append):
        raise ZeroDivisionError
    pipe.put(1)
    assert pipe.get(LONG_S) == 1
    assert items == []


def test_close_stops_listening_while_the_pipe_is_open(client, make_pipe, monkeypatch):
    monkeypatch.setattr("poolpart.extras.listening._CHECK_S", 0.05)
    pipe = make_pipe(client)
    items = []
    listener = pipe.listen(items.append)
    listener.close()
    pipe.put(1)
    assert pipe.get(LONG_S) == 1
    listener.join(LONG_S)
    listener.close()  # again
    assert items == []
    pipe.put(2)  # the pipe is still open


def test_close_waits_for_a_call_that_is_running(client, make_pipe, monkeypatch, wait_until):
    monkeypatch.setattr("poolpart.extras.listening._CHECK_S", 0.05)
    pipe = make_pipe(client, capacity=9)
    entered, release = threading.Event(), threading.Event()
    items = []

    def wait(item):
        entered.set()
        assert release.wait(LONG_S)
        items.append(item)

    pipe.put_many(range(3))
    listener = pipe.listen(wait)
    assert entered.wait(LONG_S)
    closing = threading.Thread(target=listener.close)
    closing.start()
    wait_until(lambda: listener._closed.is_set())
    assert items == []
    release.set()
    closing.join(LONG_S)
    assert items == [0]
    assert [pipe.get(LONG_S) for _ in range(2)] == [1, 2]  # in order, none lost


def test_the_function_may_close_its_listener_but_not_join_it(client, make_pipe):
    pipe = make_pipe(client, capacity=9)
    items = []
    errors = []

    def take_one(item):
        items.append(item)
        try:
            listener.join()
        except RuntimeError as error:
            errors.append(str(error))
        listener.close()

    listener = pipe.listen(take_one)
    pipe.put_many([1, 2])
    listener.join(LONG_S)
    assert items == [1]
    assert errors == [
        "Function 'take_one' waits for the end of its own listener. Call `join` in "
        "another thread, or stop listening with `close`."
    ]
    assert pipe.get(LONG_S) == 2


def test_a_join_with_a_time_limit_leaves_the_listener_as_it_is(client, make_pipe):
    pipe = make_pipe(client)
    items = []
    listener = pipe.listen(items.append)
    with pytest.raises(TimeoutError, match=f"^Pipe '{pipe.name}' did not end within 0.05 s"):
        listener.join(0.05)
    pipe.put(1)
    pipe.close()
    listener.join(LONG_S)
    assert items == [1]


def fail_at_once(pipe):
    raise ValueError("no such file")


def test_a_producer_that_fails_ends_the_listener(client, a, make_pipe):
    """Also before its first item."""
    pipe = make_pipe(client)
    expected = r"^Task 'producer', which uses the pipe, failed: ValueError\('no such file'\)\.$"
    with pytest.raises(PipeFailed, match=expected), pipe.listen(print):
        producer = a.submit(fail_at_once, pipe, key="producer")
    assert producer.status == "error"


def test_a_restart_of_the_cluster_ends_the_listener_and_all_waits(start, make_pipe, pool):
    client = start({"worker": {"resources": {"P": 1}}})
    part = Partition("P", client)
    pipes = [make_pipe(client, capacity=1) for _ in range(4)]
    ended = make_pipe(client, capacity=1)
    for pipe in (pipes[1], ended):
        pipe.put("waits")
    ended.close()
    listener = pipes[0].listen(print)
    waits = [
        pool.submit(listener.join),
        pool.submit(pipes[1].put, "no room"),
        pool.submit(pipes[2].get),
        pool.submit(list, pipes[2]),
        part.for_each(pipes[3], print, wait=False),
    ]
    client.restart(wait_for_workers=False)
    for wait in waits:
        with pytest.raises(PipeFailed, match=r"^The cluster was restarted by Client\.restart"):
            wait.result(LONG_S)
    listener.close()
    assert list(ended) == ["waits"]  # its producers had ended before
