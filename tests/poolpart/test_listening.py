"""A function that is called in this process for the items of a pipe."""

import threading

import pytest
from tests.poolpart.helpers import LONG_S

from poolpart import PipeClosed, PipeFailed


def produce(pipe, count):
    pipe.put_many(range(count))
    pipe.close()


def test_each_item_in_order_and_in_one_thread_of_this_process(client, a, make_pipe):
    pipe = make_pipe(client, capacity=4)
    calls = []
    listener = pipe.listen(lambda item: calls.append((item, threading.get_ident())))
    producer = a.submit(produce, pipe, 50)
    listener.close()
    items, threads = zip(*calls, strict=True)
    assert items == (*range(50),)
    assert len({*threads}) == 1 and threading.get_ident() not in threads
    producer.result(LONG_S)
    listener.close()  # again


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
            listener.close()
    assert items == [0, 1, 2]
    with pytest.raises(PipeFailed, match="fail_on_two has failed: ValueError"):
        pipe.put(9)


@pytest.mark.parametrize("error", [PipeClosed, TimeoutError])
def test_an_error_of_the_function_that_a_pipe_raises_too(client, make_pipe, error):
    pipe = make_pipe(client)

    def fail(item):
        raise error("of the function")

    pipe.put(1)
    with pytest.raises(error, match="of the function"):
        pipe.listen(fail).close()


def test_a_pipe_that_fails_is_an_error(client, make_pipe):
    pipe = make_pipe(client)
    listener = pipe.listen(print)
    pipe.fail("the disk is full")
    with pytest.raises(PipeFailed, match="the disk is full"):
        listener.close()


def test_a_block_that_raises_does_not_wait_for_the_pipe(client, make_pipe, monkeypatch):
    monkeypatch.setattr("poolpart.extras.listening._LOOK_S", 0.05)
    pipe = make_pipe(client)
    items = []
    with pytest.raises(ZeroDivisionError), pipe.listen(items.append):
        raise ZeroDivisionError
    pipe.put(1)
    assert pipe.get(LONG_S) == 1
    assert items == []
