"""Results that a worker of another partition cannot unpickle."""

import os

import pytest
from tests.poolpart.helpers import LONG_S

from poolpart import Partition, PoolError


class Local:
    """An object that can be unpickled only in the process that has made it."""

    def __init__(self, pid=None):
        self.pid = pid or os.getpid()

    def __reduce__(self):
        return load, (self.pid,)


def load(pid):
    if os.getpid() != pid:
        raise ValueError("made in another process")
    return Local(pid)


def make(number=0):
    return Local() if number == 3 else number


def use(value):
    return str(value)


@pytest.fixture
def io(processes):
    return Partition("IO", processes)


@pytest.fixture
def gpu(processes):
    return Partition("GPU", processes)


def test_a_task_whose_worker_cannot_unpickle_its_input_fails(processes, io, gpu):
    made = io.submit(Local)
    for retries in (0, 2, 0):
        used = gpu.submit(use, made, retries=retries)
        message = (
            f"^Task '{used.key}' cannot run, because worker GPU-0 cannot unpickle the result of "
            rf"task '{made.key}': ValueError\('made in another process'\). Return plain data"
        )
        with pytest.raises(PoolError, match=message):
            used.result(LONG_S)
    assert io.submit(use, made).result(LONG_S).startswith("<")  # on the worker that has it
    assert gpu.submit(use, 5).result(LONG_S) == "5"  # the slot is free


def test_tasks_whose_inputs_are_fetched_beside_it_run(processes, io, gpu):
    """A worker fetches many small results in one request, and reports all of them."""
    made = [io.submit(make, number) for number in range(8)]
    processes.gather([io.submit(use, future) for future in made])  # all are there
    used = [gpu.submit(use, future) for future in made]
    both = gpu.submit(sum, [made[1], made[2]])
    with pytest.raises(PoolError, match=f"cannot unpickle the result of task '{made[3].key}'"):
        used.pop(3).result(LONG_S)
    assert [future.result(LONG_S) for future in used] == ["0", "1", "2", "4", "5", "6", "7"]
    assert both.result(LONG_S) == 3


def test_a_map_of_a_map_ends_with_the_error(processes, io, gpu):
    with pytest.raises(PoolError, match="cannot unpickle the result of task 'make-map-"):
        list(gpu.map(use, io.map(make, range(6), chunk=1), chunk=1))
