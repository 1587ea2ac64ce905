"""Tasks hold memory of their worker, and the peak memory of each stage is measured."""

import threading
import time

import dask
import numpy as np
import pytest
from distributed import Client, Event, wait
from tests.poolpart.helpers import LONG_S, join, leave, metrics_of, wait_for, worker_name

from poolpart import Partition, Pool, PoolError, n_workers

GIB = 2**30
HALF = "4 GiB"  # of the memory limit of the workers in these tests

running = {}  # {worker: memory that running tasks hold}, of the threads of this process
highest = {}  # {worker: maximum of this}
_lock = threading.Lock()


def hold(number, gib=4, seconds=0.03):
    """Count the memory that the running tasks of a worker have requested."""
    name = worker_name()
    with _lock:
        running[name] = running.get(name, 0) + gib
        highest[name] = max(highest.get(name, 0), running[name])
    time.sleep(seconds)
    with _lock:
        running[name] -= gib
    return number


def options(**others):
    return {"resources": {"P": 4}, "nthreads": 4, "memory_limit": "9 GiB", **others}


@pytest.fixture(autouse=True)
def _unpaused():
    """Do not pause workers, which are threads of this process and measure its memory."""
    limits = ("target", "spill", "pause")
    with dask.config.set({f"distributed.worker.memory.{name}": False for name in limits}):
        yield


@pytest.fixture
def cluster(start, monkeypatch):
    """Start one worker, which has memory for two tasks of `HALF`; return the client.

    Tasks are only assigned after events such as the end of a task, and not by periodic checks.
    """
    monkeypatch.setattr("poolpart.shares.CHECK_EVERY_S", 3600.0)
    running.clear()
    highest.clear()
    return start({"w": options()})


@pytest.fixture
def part(cluster):
    return Partition("P", cluster)


def by_submit(part, numbers):
    return part.client.gather([part.submit(hold, n, memory=HALF) for n in numbers])


def by_map(part, numbers):
    return list(part.map(hold, numbers, chunk=1, memory=HALF))


def by_for_each(part, numbers):
    return list(range(part.for_each(numbers, hold, memory=4 * GIB)))


def by_compute(part, numbers):
    tasks = part.compute([dask.delayed(hold)(n) for n in numbers], memory=HALF)
    return part.client.gather(tasks)


@pytest.mark.parametrize("way", [by_submit, by_map, by_for_each, by_compute])
def test_tasks_do_not_hold_more_than_their_worker_has(part, way):
    assert way(part, range(12)) == [*range(12)]
    assert highest == {"w": 8}


def test_tasks_without_memory_use_the_other_slots(part):
    gate = Event("memory-gate", part.client)
    holders = [part.submit(wait_for, gate.name, memory=HALF) for _ in range(4)]
    others = [part.submit(abs, -n) for n in range(4)]
    assert part.client.gather(others) == [0, 1, 2, 3]
    assert part.stats().running == 2
    gate.set()
    assert all(part.client.gather(holders))


def test_a_client_with_small_tasks_does_not_keep_a_large_task_waiting(part):
    with Client(part.client.cluster, name="bob") as bob:
        small = [part.submit(hold, n, 2, memory="2 GiB") for n in range(120)]
        large = Partition("P", bob).submit(hold, -1, 8, memory="8 GiB")
        assert large.result(LONG_S) == -1
        assert sum(not task.done() for task in small) > 60
        assert part.client.gather(small) == [*range(120)]
    assert highest == {"w": 8}


def test_a_large_task_of_a_client_is_not_passed_by_its_small_tasks(part):
    first = [part.submit(hold, n, 2, memory="2 GiB") for n in range(8)]
    large = part.submit(hold, -1, 8, memory="8 GiB", priority=1)
    later = [part.submit(hold, n, 2, memory="2 GiB") for n in range(60)]
    assert large.result(LONG_S) == -1
    assert sum(task.done() for task in later) < 20
    wait([*first, *later], timeout=LONG_S)


def test_a_task_that_needs_more_than_any_worker_has_is_refused(part):
    assert part.submit(abs, -1, memory="9 GiB").result(LONG_S) == 1
    with pytest.raises(PoolError, match=r"requests 9.31 GiB .* one worker.* at most 9.00 GiB\."):
        part.submit(abs, -1, memory="10 GB").result(LONG_S)
    with pytest.raises(PoolError, match=r"at most 9\.00 GiB"):
        list(part.map(abs, [-1], memory="10 GB"))
    with pytest.raises(PoolError, match=r"at most 9\.00 GiB"):
        part.for_each([-1], abs, memory="10 GB")


def test_workers_without_a_memory_limit_hold_no_memory(start):
    client = start({"x": options(memory_limit=0), "y": options(resources={"Q": 4})})
    with pytest.raises(PoolError, match=r"of memory, but .* 'P' have no memory limit\."):
        Partition("P", client).submit(abs, -1, memory="1 MiB").result(LONG_S)
    join(client, "z", memory_limit="1 GiB")
    part = Partition("P", client)
    tasks = [part.submit(hold, n, 0, memory="1 MiB") for n in range(8)]
    names = {part.submit(worker_name, memory="1 MiB").result(LONG_S) for _ in range(4)}
    assert part.client.gather(tasks) == [*range(8)]
    assert names == {"z"}


def test_slots_and_memory_are_those_of_one_worker(start):
    small = options(resources={"P": 1}, memory_limit="9 GiB")
    client = start({"many": options(memory_limit="2 GiB"), "much": small})
    part = Partition("P", client)
    assert part.submit(worker_name, memory="4 GiB").result(LONG_S) == "much"
    assert part.submit(worker_name, slots=2, memory="2 GiB").result(LONG_S) == "many"
    with pytest.raises(PoolError, match=r"those workers .* have 2 slots have at most 2.00 GiB"):
        part.submit(abs, -1, slots=2, memory="4 GiB").result(LONG_S)


WRONG = ["", "2", "GiB", "2 apples", "-1 GiB", "0 MB", "1e400 GB", 0, -1, True, float("nan"), [1]]


@pytest.mark.parametrize("wrong", WRONG)
def test_invalid_amounts_are_refused(part, wrong):
    for call in (
        lambda: part.submit(abs, -1, memory=wrong),
        lambda: part.map(abs, [-1], memory=wrong),
        lambda: part.for_each([-1], abs, memory=wrong),
        lambda: part.compute(dask.delayed(1), memory=wrong),
    ):
        with pytest.raises(ValueError, match="for `memory`"):
            call()


def test_an_actor_holds_no_memory(part):
    with pytest.raises(PoolError, match="An actor cannot hold memory"):
        part.submit(dict, actor=True, memory="1 GiB")


def fail_once(tries):
    with _lock:
        running[tries] = running.get(tries, 0) + 1
    if running[tries] == 1:
        raise ValueError("first try")
    return running.pop(tries)


def test_memory_is_free_again_after_errors_retries_and_cancellation(part):
    gate = Event("memory-cancel-gate", part.client)
    assert part.submit(fail_once, "tries", retries=1, memory="9 GiB").result(LONG_S) == 2
    with pytest.raises(ValueError, match="first try"):
        part.submit(fail_once, "other", memory="9 GiB").result(LONG_S)
    started = part.submit(wait_for, gate.name, memory="5 GiB")
    waiting = [part.submit(wait_for, gate.name, memory="9 GiB") for _ in range(3)]
    while part.stats().running < 1:
        time.sleep(0.01)
    part.cancel(waiting)
    assert part.submit(abs, -1, memory="4 GiB").result(LONG_S) == 1
    part.cancel(started)
    gate.set()
    assert part.submit(abs, -2, memory="9 GiB").result(LONG_S) == 2


def test_memory_is_free_again_after_the_loss_of_a_worker(cluster, part):
    join(cluster, "other", **options())
    tasks = [part.submit(hold, n, 9, 0.3, memory="9 GiB") for n in range(3)]
    while part.stats().running < 2:
        time.sleep(0.01)
    leave(cluster, "other")
    assert cluster.gather(tasks) == [0, 1, 2]
    running.clear()
    join(cluster, "third", **options())
    assert cluster.gather([part.submit(hold, n, memory=HALF) for n in range(16)])
    assert max(running.values()) == 0
    assert max(highest.values()) == 9


def hold_nested(part, gate):
    """Hold memory while a nested task runs, which needs more than is left."""
    wait_for(gate)
    return part.submit(hold, 1, 7, memory="7 GiB").result()


def test_nested_tasks_use_the_memory_of_the_waiting_task(part):
    gate = Event("memory-nested-gate", part.client)
    parents = [part.submit(hold_nested, part, gate.name, memory=HALF) for _ in range(2)]
    while part.stats().running < 2:
        time.sleep(0.01)
    with Client(part.client.cluster, name="bob") as bob:
        other = Partition("P", bob).submit(hold, 2, 5, memory="5 GiB")
        gate.set()
        assert part.client.gather(parents) == [1, 1]
        assert other.result(LONG_S) == 2
    assert highest == {"w": 7}  # the other task did not use the memory that was lent


def test_tasks_that_are_moved_find_their_memory(start, wait_until):
    """Tasks that wait on a worker that leaves the partition move to another one."""
    running.clear()
    highest.clear()
    free = {"nthreads": 2, "memory_limit": "9 GiB"}
    client = start({"x": free, "y": free})
    pool = Pool.from_client(client)
    with pool:
        part = pool.divide({"P": n_workers(2, slots=2, minimum=0)})["P"]
        client.gather([part.submit(hold, n, 0, 0.001, memory="1 GiB") for n in range(20)])
        x = client.cluster.scheduler.workers[client.cluster.workers["x"].address]
        tasks = [part.submit(hold, n, 1, 0.01, memory="1 GiB") for n in range(200)]
        part.shrink(1)
        assert sorted(client.gather(tasks)) == [*range(200)]
        assert max(highest.values()) <= 9
        part.resize(2)
        large = [part.submit(hold, n, 9, memory="9 GiB") for n in range(4)]
        assert client.gather(large) == [*range(4)]
        assert max(highest.values()) == 9
        wait_until(lambda: not x.processing)


def allocate(mib, seconds):
    array = np.ones((mib, 2**17))
    time.sleep(seconds)
    return array.size


def test_the_peak_memory_of_a_stage_is_shown(processes):
    part = Partition("IO", processes)
    part.submit(abs, -1).result(LONG_S)
    part.submit(allocate, 200, 0.5).result(LONG_S)
    peaks = {name: stage.peak_memory / 2**20 for name, stage in part.stats().stages.items()}
    assert 200 < peaks["allocate"] < 800
    assert part.stats().peak_memory == part.stats().stages["allocate"].peak_memory
    assert "peak memory" in repr(part.stats())
    assert metrics_of(processes)["peak_memory_bytes", "IO"] == part.stats().peak_memory
