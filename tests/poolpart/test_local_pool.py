"""A pool with a cluster of its own on this machine, which ends with its block or when idle."""

import logging
import threading

import psutil
import pytest
from tests.poolpart.helpers import LONG_S, worker_name

from poolpart import Pipe, Pool, PoolError
from poolpart.workers import run_on_scheduler


def processes():
    return {process.pid for process in psutil.Process().children(recursive=True)}


def test_it_has_the_partitions_and_ends_with_its_block(wait_until):
    before = processes()
    with pytest.raises(ZeroDivisionError), Pool.local({"GPU": (1, 1), "IO": (1, 4)}) as pool:
        assert {name: part.slots for name, part in pool.partitions().items()} == {"GPU": 1, "IO": 4}
        assert pool["GPU"].submit(worker_name).result(LONG_S) == "GPU-0"
        raise ZeroDivisionError
    wait_until(lambda: processes() - before <= fork_servers())
    with pytest.raises(PoolError, match="The client is closed"):
        pool.partitions()


def fork_servers():
    """Return the helpers of multiprocessing, which stay until this process ends."""
    words = ("forkserver", "resource_tracker")
    return {
        process.pid
        for process in psutil.Process().children()
        if any(word in "".join(process.cmdline()) for word in words)
    }


def test_it_ends_when_it_is_idle_but_not_under_results_and_pipes(wait_until, caplog, monkeypatch):
    monkeypatch.setattr("poolpart.deploy.local_pool.CHECK_EVERY_S", 0.01)
    looks = []
    begun = threading.Event()  # a busy machine takes longer than the idle time for the beginning

    def look(client, function):
        answer = run_on_scheduler(client, function)
        if answer is None:  # the beginning of counting
            return None
        looks.append(function)
        in_use, transitions = answer
        return in_use or not begun.is_set(), transitions

    monkeypatch.setattr("poolpart.deploy.local_pool.run_on_scheduler", look)

    def many_looks():  # which take longer than the idle time
        before = len(looks)
        wait_until(lambda: len(looks) > before + 30)

    with Pool.local({"IO": (1, 1)}, idle_s=0.2) as pool:
        first = Pipe("first", 3, pool.client).create()
        caplog.set_level(logging.WARNING)  # a cluster that is started silences it
        io = pool["IO"]
        kept = io.submit(abs, -1)
        assert kept.result(LONG_S) == 1
        begun.set()
        first.delete()
        many_looks()
        second = Pipe("second", 3, pool.client).create()
        kept.release()
        many_looks()
        second.put(1)
        second.delete()
        wait_until(lambda: pool.client.status == "closed")
        assert "The local pool was closed because it was idle for 0.2 s." in caplog.text
        with pytest.raises(PoolError, match="The client is closed"):
            io.for_each([1], abs)


@pytest.mark.parametrize("idle_s", [0, -1, "60", True])
def test_an_idle_time_that_makes_no_sense(idle_s):
    with pytest.raises(PoolError, match="Expected a positive number of seconds"):
        Pool.local({"IO": (1, 1)}, idle_s=idle_s)


def test_a_pool_without_workers():
    with pytest.raises(PoolError, match="would have no workers"):
        Pool.local({"IO": (0, 1)})
