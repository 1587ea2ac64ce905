"""A function of the results of futures, called when all have succeeded."""

import concurrent.futures
import threading
import time

import pytest
from distributed import Event
from tests.poolpart.helpers import LONG_S, wait_for

from poolpart import after_all


def invert(item):
    return 1 / item


def test_results_are_in_the_order_of_the_futures_of_either_kind(client, a, b):
    count = b.for_each([-1, -2, -3], abs, wait=False)
    futures = [a.submit(pow, 2, exponent) for exponent in range(4)]
    total = after_all([*futures, count], sum)
    assert total.result(LONG_S) == 1 + 2 + 4 + 8 + 3
    assert after_all([total, *futures], list).result(LONG_S) == [18, 1, 2, 4, 8]
    assert after_all([], len).result(LONG_S) == 0


def test_the_function_runs_in_this_process_and_may_fail(client, a):
    thread = after_all([a.submit(abs, -1)], lambda results: threading.current_thread())
    assert thread.result(LONG_S) is not threading.current_thread()
    with pytest.raises(ZeroDivisionError):
        after_all([a.submit(abs, 0)], lambda results: 1 / results[0]).result(LONG_S)


def test_it_fails_with_the_first_error_while_other_tasks_run(client, a, b):
    event = Event(f"slow-{time.time()}", client)
    slow = b.submit(wait_for, event.name)
    called = []
    failed = after_all([slow, a.submit(invert, 0)], called.append)
    assert isinstance(failed.exception(LONG_S), ZeroDivisionError)
    assert called == []
    event.set()
    slow.result(LONG_S)


def test_a_cancelled_future_does_not_call_the_function(client, b):
    event = Event(f"slow-{time.time()}", client)
    slow = b.submit(wait_for, event.name)
    called = []
    future = after_all([slow], called.append)
    assert future.cancel()
    concurrent.futures.wait([future], LONG_S)
    event.set()
    assert slow.result(LONG_S) is True
    assert called == []


def test_a_cancelled_task_is_an_error(client, b):
    event = Event(f"slow-{time.time()}", client)
    running, waiting = (b.submit(wait_for, event.name) for _ in range(2))
    future = after_all([waiting], len)
    waiting.cancel()
    with pytest.raises(concurrent.futures.CancelledError):
        future.result(LONG_S)
    event.set()
    running.result(LONG_S)
