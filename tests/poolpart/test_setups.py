"""Values that tasks of a stage share: once per process, and not longer than the stage."""

import contextlib
import gc
import itertools
import logging
import os
import threading
import time
import uuid
from weakref import WeakSet

import pytest
from distributed import Client, Event
from distributed.core import Status
from tests.poolpart.helpers import LONG_S, kill, set_status, wait_for

from poolpart import Partition, Pool, PoolError, TaskTimeoutError, cancelled, rest, setups

models = WeakSet()  # in this process


class Model:
    """A value that takes a while to load."""

    def __init__(self):
        time.sleep(0.02)
        self.cycle = self
        models.add(self)

    def detect(self, item, scale=1):
        if item == "bad":
            raise ZeroDivisionError
        return item * scale


@pytest.fixture(autouse=True)
def _none_is_left(wait_until):
    yield
    wait_until(lambda: gc.collect() >= 0 and not models)
    wait_until(lambda: not setups._values._values)


def load_identity():
    return os.getpid(), uuid.uuid4().hex


def identity(loaded, _, seconds=0.02):
    time.sleep(seconds)
    return loaded


def put_identity(loaded, item, done):
    done.put(identity(loaded, item))


def test_each_process_calls_it_once_and_a_restarted_one_calls_it_again(nannies):
    with Pool.from_client(nannies) as pool:
        part = pool.divide({"A": rest()})["A"]
        results = part.map(identity, range(60), setup=load_identity, chunk=1, seconds=0.1)
        loaded = {next(results) for _ in range(10)}
        kill(nannies, "0")
        loaded |= {*results}
        again = {*part.map(identity, range(4), setup=load_identity, chunk=1, seconds=0.1)}
    processes = {pid for pid, _ in loaded}
    assert len(loaded) == len(processes)
    assert len(processes) in (2, 3)  # the new process may be late
    assert loaded.isdisjoint(again)  # of another stage


def test_for_each_calls_it_once_for_all_slots(client, a, make_pipe):
    done = make_pipe(client, capacity=100)
    assert a.for_each(range(20), put_identity, setup=load_identity, done=done) == 20
    assert len({*done.drain()}) == 1  # both workers are in this process


def exhausted(part):
    assert list(part.map(Model.detect, range(9), setup=Model, scale=2)) == [*range(0, 18, 2)]


def failed(part):
    results = part.map(Model.detect, [1, "bad", 3], setup=Model, chunk=1)
    assert next(results) == 1
    with pytest.raises(ZeroDivisionError) as caught:
        list(results)
    assert "for item 1 of a map: 'bad'" in caught.value.__notes__[0]


def closed(part):
    with contextlib.closing(part.map(Model.detect, itertools.count(), setup=Model)) as results:
        assert next(results) == 0
        assert models


def deleted(part):
    assert next(part.map(Model.detect, itertools.count(), setup=Model)) == 0


def client_left(part):
    with Client(part.client.cluster) as other:
        results = Partition(part.name, other).map(Model.detect, itertools.count(), setup=Model)
        assert next(results) == 0
        assert models


def for_each_ended(part):
    assert part.for_each(range(9), Model.detect, setup=Model) == 9


def for_each_failed(part):
    with pytest.raises(ZeroDivisionError):
        part.for_each([1, "bad"], Model.detect, setup=Model)


@pytest.mark.parametrize(
    "end", [exhausted, failed, closed, deleted, client_left, for_each_ended, for_each_failed]
)
def test_it_is_released_at_the_end(client, a, wait_until, end):
    end(a)
    wait_until(lambda: gc.collect() >= 0 and not models)  # threads share errors and their frames
    wait_until(lambda: setups.NAME not in client.cluster.scheduler.plugins)


def wait_at_2(model, item, started, release):
    if item == 2:
        Event(started).set()
        wait_for(release)
    return id(model)


def test_a_paused_worker_releases_what_no_task_uses(start, monkeypatch, wait_until, caplog):
    monkeypatch.setattr(setups, "WATCH_S", 0.02)
    # Without a limit, the worker's memory monitor does not end the pause.
    client = start({"x": {"resources": {"A": 1}, "memory_limit": 0}})
    caplog.set_level(logging.WARNING, "poolpart.setups")  # the cluster has silenced it
    started, release = (Event(f"{name}-{uuid.uuid4()}", client) for name in ("started", "release"))
    names = {"started": started.name, "release": release.name}
    results = Partition("A", client).map(
        wait_at_2, itertools.count(), setup=Model, window=2, chunk=1, **names
    )
    first = [next(results) for _ in range(2)]
    assert started.wait(LONG_S)
    set_status(client, "x", Status.paused)
    time.sleep(0.2)
    assert len(models) == 1  # in use
    release.set()
    wait_until(lambda: not models)  # which are part of a reference cycle
    assert "the values of 1 setup functions were released" in caplog.text
    set_status(client, "x", Status.running)
    assert [next(results)] == first[:1] == first[1:]
    next(results)
    assert len(models) == 1
    results.close()


calls = []


def fail_first():
    calls.append(threading.get_ident())
    if len(calls) == 1:
        raise FileNotFoundError("weights.pt")
    return 5


def test_its_error_is_no_error_of_an_item(b):
    calls.clear()
    with pytest.raises(FileNotFoundError, match=r"weights\.pt") as caught:
        list(b.map(pow, [2, 3], setup=fail_first, return_exceptions=True))
    assert caught.value.__notes__ == [
        "The error occurred in the setup function 'fail_first' on worker B-0.",
        "poolpart: The task processed items 0 to 0 of a map.",
    ]
    calls.clear()
    assert list(b.map(pow, [2, 3], setup=fail_first, retries=1)) == [25, 125]
    calls.clear()
    with pytest.raises(FileNotFoundError) as caught:
        b.for_each([2], pow, setup=fail_first)
    assert "setup function 'fail_first'" in caught.value.__notes__[0]


def test_an_error_says_that_loading_counts_toward_the_time_limit(a):
    def load():
        while not cancelled():
            time.sleep(0.01)

    def use(loaded, item):
        return item

    (error,) = a.map(use, [1], setup=load, timeout_s=0.2, return_exceptions=True)
    assert isinstance(error, TaskTimeoutError)
    assert error.__notes__[0].endswith(f": 1. {setups.SETUP_COUNTS}")
    with pytest.raises(TaskTimeoutError) as caught:
        a.for_each([1], use, setup=load, timeout_s=0.2)
    assert caught.value.__notes__[-1] == f"poolpart: {setups.SETUP_COUNTS}"
    with pytest.raises(TaskTimeoutError) as caught:
        list(a.map(lambda _: load(), [1], timeout_s=0.2))
    assert not any(setups.SETUP_COUNTS in note for note in caught.value.__notes__)


def test_each_stage_of_a_chain_has_its_own(a, b):
    first = b.map(pow, [1, 2], setup=lambda: 3)
    second = a.map(divmod, first, setup=lambda: 20, chunk=1)
    first.close()  # continued by the second map
    assert list(second) == [(6, 2), (2, 2)]


async def load_in_loop():
    return 1


def test_what_is_no_setup_function_is_refused(a):
    for setup in (3, load_in_loop):
        for call in (a.map, lambda f, items, **o: a.for_each(items, f, **o)):
            with pytest.raises(PoolError, match="Expected a plain function without arguments"):
                call(pow, [1], setup=setup)
    with pytest.raises(PoolError, match=r"does not accept `setup`\. Use `map` or `for_each`"):
        a.submit(pow, 1, setup=load_identity)


def test_a_task_that_starts_after_the_end_does_not_create_it(client, a, wait_until):
    results = a.map(Model.detect, [1], setup=Model)
    [setup] = [stage.setup for stage in results._stages]
    assert list(results) == [1]
    wait_until(lambda: setup.stage_id in setups._values._ended)
    late = a.submit(setups.FunctionWithSetup(Model.detect, setup), 1)
    with pytest.raises(PoolError, match="has ended"):
        late.result(LONG_S)
