"""Cancelling tasks: those that wait, those that run and look, and those that do not."""

import os
import signal
import time

import pytest
from distributed import Client, Event, get_worker
from tests.poolpart.helpers import LONG_S, wait_for

from poolpart import Partition, PipeFailed, PoolError, cancelled


def until_cancelled(started, ended):
    Event(started).set()
    while not cancelled():
        time.sleep(0.01)
    Event(ended).set()


def sleep_long(started):
    Event(started).set()
    time.sleep(3600)


@pytest.fixture
def event():
    """Return a function that makes an event with a new name."""
    return lambda client: Event(f"cancelling-{os.urandom(4).hex()}", client)


def test_a_function_sees_that_it_was_cancelled(client, b, event):
    started, ended = event(client), event(client)
    future = b.submit(until_cancelled, started.name, ended.name)
    assert started.wait(LONG_S)
    assert b.cancel(future) == {future.key: "running: worker B-0"}
    assert ended.wait(LONG_S)
    assert future.cancelled()
    assert b.submit(pow, 2, 10).result(LONG_S) == 1024
    assert not cancelled()  # outside tasks
    assert b.submit(cancelled).result(LONG_S) is False


def test_waiting_and_ended_tasks(client, b, event):
    done = b.submit(abs, -1)
    done.result(LONG_S)
    release = event(client)
    running, waiting = (b.submit(wait_for, release.name) for _ in range(2))
    assert b.cancel([done, waiting]) == {done.key: "ended", waiting.key: "cancelled"}
    assert done.cancelled() and waiting.cancelled() and not running.done()
    release.set()
    assert running.result(LONG_S) is True


def test_a_worker_without_nanny_is_not_restarted(client, b, event):
    started, ended = event(client), event(client)
    future = b.submit(until_cancelled, started.name, ended.name)
    assert started.wait(LONG_S)
    outcomes = b.cancel([future], running="restart")
    assert outcomes == {future.key: "running: worker B-0 has no nanny to restart it"}
    assert ended.wait(LONG_S)


def test_what_another_client_wants_is_kept(client, b, event, wait_until):
    release = event(client)
    future = b.submit(wait_for, release.name, key=f"shared-{release.name}")
    with Client(client.cluster, set_as_default=False) as other:
        shared = Partition("B", other).submit(wait_for, release.name, key=future.key)
        tasks = client.cluster.scheduler.tasks
        wait_until(lambda: future.key in tasks and len(tasks[future.key].who_wants) == 2)
        assert b.cancel(future) == {future.key: "kept: another client wants its result"}
        release.set()
        assert shared.result(LONG_S) is True
        assert future.result(LONG_S) is True


def test_what_cannot_be_cancelled_is_refused(client, a, b):
    future = a.submit(pow, 2, 10)
    with pytest.raises(PoolError, match="is not of partition 'B': nothing was cancelled"):
        b.cancel(future)
    with pytest.raises(PoolError, match="takes futures of Dask, not 5"):
        b.cancel([5])
    with pytest.raises(ValueError, match='give "continue" or "restart"'):
        a.cancel(future, running="stop")
    assert future.result(LONG_S) == 1024


def test_a_worker_with_nothing_but_cancelled_tasks_is_restarted(processes, event):
    gpu = Partition("GPU", processes)
    pid = gpu.submit(os.getpid).result(LONG_S)
    started = event(processes)
    future, waiting = (gpu.submit(sleep_long, started.name) for _ in range(2))
    assert started.wait(LONG_S)
    future.cancel()  # before, which leaves it running
    outcomes = gpu.cancel([future, waiting], running="restart")
    assert outcomes == {future.key: "restarted: worker GPU-0", waiting.key: "cancelled"}
    assert gpu.submit(os.getpid).result(LONG_S) != pid


def put_and_sleep(pipe):
    pipe.put("started")
    time.sleep(3600)


def test_the_pipe_of_a_producer_whose_worker_is_restarted_fails(processes, make_pipe):
    gpu = Partition("GPU", processes)
    pipe = make_pipe(processes)
    producer = gpu.submit(put_and_sleep, pipe)
    assert pipe.get(LONG_S) == "started"
    outcomes = gpu.cancel(producer, running="restart")
    assert outcomes == {producer.key: "restarted: worker GPU-0"}
    reason = f"^Task '{producer.key}', which uses the pipe, was cancelled, and its worker was rest"
    with pytest.raises(PipeFailed, match=reason):
        pipe.get(LONG_S)


def test_a_worker_with_another_task_or_result_is_not_restarted(processes, event, wait_until):
    io = Partition("IO", processes)
    names = [event(processes).name for _ in range(4)]
    first = io.submit(until_cancelled, *names[:2])
    assert Event(names[0], processes).wait(LONG_S)
    release = event(processes)
    reason = "running: worker IO-0 has another task or result"
    other = io.submit(wait_for, release.name)
    wait_until(lambda: io.stats().running == 2)
    assert io.cancel(first, running="restart") == {first.key: reason}
    release.set()
    assert other.result(LONG_S) is True  # this result is on no further worker
    second = io.submit(until_cancelled, *names[2:])
    assert Event(names[2], processes).wait(LONG_S)
    assert io.cancel(second, running="restart") == {second.key: reason}
    assert Event(names[3], processes).wait(LONG_S)
    assert other.result(LONG_S) is True
    assert io.submit(get_name).result(LONG_S) == "IO-0"  # gets tasks again


def get_name():
    return get_worker().name


def test_a_worker_that_does_not_answer_is_not_restarted(processes, event, monkeypatch):
    monkeypatch.setattr("poolpart.extras.cancelling.ANSWER_S", 0.1)
    gpu = Partition("GPU", processes)
    pid = gpu.submit(os.getpid).result(LONG_S)
    started, ended = event(processes), event(processes)
    future = gpu.submit(until_cancelled, started.name, ended.name)
    assert started.wait(LONG_S)
    os.kill(pid, signal.SIGSTOP)
    try:
        outcomes = gpu.cancel(future, running="restart")
    finally:
        os.kill(pid, signal.SIGCONT)
    assert outcomes == {future.key: "running: worker GPU-0 does not answer"}
    assert ended.wait(LONG_S)
    assert gpu.submit(os.getpid).result(LONG_S) == pid
