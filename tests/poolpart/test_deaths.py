"""The death of a worker is blamed on the tasks that it was running."""

import os
import time

import pytest
from distributed import Event, KilledWorker, wait
from tests.poolpart.helpers import LONG_S, kill, wait_for

from poolpart import Pool, rest


@pytest.fixture
def part(own_nannies):
    return Pool.from_client(own_nannies).divide({"A": rest()})["A"]


def test_only_running_tasks_are_blamed(own_nannies, part, wait_until):
    """In plain Dask, all ten tasks that are assigned to the worker are blamed."""
    scheduler = own_nannies.cluster.scheduler
    scheduler.allowed_failures = 0
    gate = Event("blame", own_nannies)
    gate.set()  # so that tasks are expected to be short, and are assigned in advance
    own_nannies.gather([part.submit(wait_for, "blame") for _ in range(20)])
    gate.clear()
    futures = [part.submit(wait_for, "blame") for _ in range(20)]
    wait_until(lambda: sum(len(w.executing) for w in scheduler.workers.values()) == 2)
    wait_until(lambda: min(len(worker.processing) for worker in scheduler.workers.values()) > 1)
    kill(own_nannies, "0")
    wait_until(lambda: any(future.status == "error" for future in futures))
    gate.set()
    wait(futures, LONG_S)
    assert sorted(future.status for future in futures) == ["error"] + ["finished"] * 19
    stats = part.stats()
    assert (stats.done, stats.failed) == (39, 1)


def kill_soon():
    """Kill the worker after it has reported the tasks that ended before this one."""
    time.sleep(0.2)
    os._exit(1)


def test_before_the_first_heartbeat_the_next_task_in_line_is_blamed(own_nannies, part):
    """The task with the higher priority runs first, and kills each of its workers."""
    own_nannies.cluster.scheduler.allowed_failures = 1
    futures = [part.submit(abs, -number) for number in range(10)]
    killer = part.submit(kill_soon, priority=1)
    assert own_nannies.gather(futures) == [*range(10)]
    assert isinstance(killer.exception(LONG_S), KilledWorker)
