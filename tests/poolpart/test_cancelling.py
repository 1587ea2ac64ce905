"""Cancelling tasks: those that wait, those that run and look, and those that do not."""

import asyncio
import os
import signal
import threading
import time
from contextlib import suppress

import pytest
from distributed import Client, Event, get_worker
from tests.poolpart.helpers import LONG_S, wait_for

from poolpart import Partition, PipeFailed, Pool, PoolError, cancelled


def until_cancelled(started, ended):
    Event(started).set()
    while not cancelled():
        time.sleep(0.01)
    Event(ended).set()


def set_and_wait(started, release):
    Event(started).set()
    wait_for(release)


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
        assert b.cancel(future) == {future.key: "kept: another client needs its result"}
        release.set()
        assert shared.result(LONG_S) is True
        assert future.result(LONG_S) is True


def test_what_cannot_be_cancelled_is_refused(client, a, b):
    future = a.submit(pow, 2, 10)
    with pytest.raises(PoolError, match=r"does not belong to partition 'B'\. No task was canceled"):
        b.cancel(future)
    with pytest.raises(PoolError, match="expects Dask futures, but got 5"):
        b.cancel([5])
    with pytest.raises(ValueError, match='Expected "continue" or "restart"'):
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


@pytest.mark.extended
def test_the_pipe_of_a_producer_whose_worker_is_restarted_fails(processes, make_pipe):
    gpu = Partition("GPU", processes)
    pipe = make_pipe(processes)
    producer = gpu.submit(put_and_sleep, pipe)
    assert pipe.get(LONG_S) == "started"
    outcomes = gpu.cancel(producer, running="restart")
    assert outcomes == {producer.key: "restarted: worker GPU-0"}
    reason = f"^Task '{producer.key}', which uses the pipe, was canceled, and its worker was rest"
    with pytest.raises(PipeFailed, match=reason):
        pipe.get(LONG_S)


def test_a_worker_with_another_task_or_result_is_not_restarted(processes, event, wait_until):
    io = Partition("IO", processes)
    names = [event(processes).name for _ in range(4)]
    first = io.submit(set_and_wait, *names[:2])
    assert Event(names[0], processes).wait(LONG_S)
    release = event(processes)
    reason = "running: worker IO-0 runs other tasks"
    other = io.submit(wait_for, release.name)
    wait_until(lambda: io.stats().running == 2)
    assert io.cancel(first, running="restart") == {first.key: reason}
    Event(names[1], processes).set()
    release.set()
    assert other.result(LONG_S) is True  # this result is on no further worker
    second = io.submit(set_and_wait, *names[2:])
    assert Event(names[2], processes).wait(LONG_S)
    reason = "running: worker IO-0 holds the only copy of a result"
    assert io.cancel(second, running="restart") == {second.key: reason}
    Event(names[3], processes).set()
    assert other.result(LONG_S) is True
    assert io.submit(get_name).result(LONG_S) == "IO-0"  # gets tasks again


def get_name():
    return get_worker().name


def test_what_a_worker_runs_and_holds_is_computed_again_if_allowed(processes, event, wait_until):
    io = Partition("IO", processes)
    held = io.submit(os.getpid)
    pid = held.result(LONG_S)
    [data] = io.scatter([1])
    started, release = event(processes), event(processes)
    hung = io.submit(sleep_long, started.name)
    other = io.submit(wait_for, release.name)
    assert started.wait(LONG_S)
    wait_until(lambda: io.stats().running == 2)
    reason = "running: worker IO-0 holds the only copy of scattered data"
    assert io.cancel(hung, running="restart", recompute=True) == {hung.key: reason}
    data.release()
    wait_until(lambda: data.key not in processes.who_has())
    again = {"running": "restart", "recompute": True}
    assert io.cancel(hung, **again) == {hung.key: "restarted: worker IO-0"}
    release.set()
    assert other.result(LONG_S) is True
    assert processes.submit(abs, held, pure=False).result(LONG_S) != pid  # computed again
    with pytest.raises(ValueError, match='`recompute` requires `running="restart"`'):
        io.cancel(held, recompute=True)


@pytest.mark.extended(every=2)
@pytest.mark.parametrize("responds", [True, False])
def test_waiting_tasks_and_results_move_to_another_worker(nannies, event, monkeypatch, responds):
    monkeypatch.setattr("poolpart.extras.cancelling.ANSWER_S", 2.0 if responds else 0.2)
    both, _ = Pool.from_client(nannies).partition("P", n_workers=2, slots=1)
    one, other = both_names(both)
    pid = both.submit(os.getpid, workers=one).result(LONG_S)
    held = None if not responds else both.submit(os.urandom, 8)
    value = held and held.result(LONG_S)
    started, release = event(nannies), event(nannies)
    hung = both.submit(sleep_long, started.name, workers=one)
    blocked = both.submit(wait_for, release.name, workers=other)
    assert started.wait(LONG_S)
    waiting = [both.submit(abs, number) for number in range(10)]
    if not responds:
        os.kill(pid, signal.SIGSTOP)
    release.set()
    assert both.cancel(hung, running="restart") == {hung.key: f"restarted: worker {one}"}
    assert nannies.gather(waiting) == [*range(10)] and blocked.result(LONG_S)
    assert held is None or nannies.submit(bytes, held).result(LONG_S) == value


def test_a_worker_that_cannot_be_restarted_gets_no_tasks_until_it_responds(
    nannies, event, monkeypatch
):
    monkeypatch.setattr("poolpart.extras.cancelling.ANSWER_S", 0.2)
    both, _ = Pool.from_client(nannies).partition("P", n_workers=2, slots=1)
    one, other = both_names(both)
    held = both.submit(os.getpid, workers=one)
    pid = held.result(LONG_S)
    started, ended = event(nannies), event(nannies)
    future = both.submit(until_cancelled, started.name, ended.name, workers=one)
    assert started.wait(LONG_S)
    waiting = [both.submit(get_name) for _ in range(6)]
    os.kill(pid, signal.SIGSTOP)
    try:
        outcomes = both.cancel(future, running="restart")
        reason = f"running: worker {one} does not respond and holds the only copy of a result"
        assert outcomes == {future.key: reason}
        assert {str(name) for name in nannies.gather(waiting)} == {other}
        assert str(both.submit(get_name).result(LONG_S)) == other
    finally:
        os.kill(pid, signal.SIGCONT)
    assert ended.wait(LONG_S)
    assert both.submit(os.getpid, workers=one).result(LONG_S) == pid


@pytest.mark.extended
def test_each_of_many_tasks_is_accounted_for_beside_a_worker_that_does_not_answer(
    nannies, event, monkeypatch
):
    monkeypatch.setattr("poolpart.extras.cancelling.ANSWER_S", 1.0)
    both, _ = Pool.from_client(nannies).partition("P", n_workers=2, slots=1)
    pids = dict(nannies.gather([both.submit(name_and_pid, workers=n) for n in both_names(both)]))
    running = {}
    for name in pids:
        started = event(nannies)
        running[name] = both.submit(sleep_long, started.name, workers=name)
        assert started.wait(LONG_S)
    waiting = [both.submit(abs, number) for number in range(18)]
    silent, _ = running
    os.kill(pids[silent], signal.SIGSTOP)
    outcomes = both.cancel([*running.values(), *waiting], running="restart")
    unknown = {outcomes[task.key] for task in waiting}
    assert unknown <= {"cancelled", f"restarted: worker {silent}"}
    assert [outcomes[task.key] for task in running.values()] == [
        f"restarted: worker {name}" for name in running
    ]
    assert len(outcomes) == 20
    assert both.submit(pow, 2, 10).result(LONG_S) == 1024


def name_and_pid():
    return str(get_worker().name), os.getpid()


def both_names(partition):
    return [worker.name for worker in partition.workers]


def test_a_request_that_goes_on_after_its_cancellation_is_not_waited_for(client, b, monkeypatch):
    """Closing a connection may take as long as the worker that does not read from it."""
    ended = threading.Event()

    async def call(*_):
        while not ended.is_set():
            with suppress(asyncio.CancelledError):
                await asyncio.sleep(0.05)

    monkeypatch.setattr("poolpart.extras.cancelling.ANSWER_S", 0.05)
    monkeypatch.setattr("poolpart.extras.cancelling.call_worker", call)
    # If cancel waits for the request, the request ends at last, and an empty answer counts as load.
    timer = threading.Timer(5.0, ended.set)
    timer.start()
    future = b.submit(until_released, key=f"asked-{os.urandom(4).hex()}")
    outcomes = b.cancel(future)
    assert not ended.is_set()
    assert outcomes == {future.key: "running: worker B-0 does not respond"}
    ended.set()
    timer.cancel()


def until_released():
    while not cancelled():
        time.sleep(0.01)
