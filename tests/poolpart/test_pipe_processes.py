"""Pipes between processes, one of which may be killed."""

import os
import signal
import subprocess
import sys
import time
import uuid

import pytest
from distributed import Client
from tests.poolpart.helpers import LONG_S

from poolpart import Partition, Pipe, PipeFailed, Pool, rest
from poolpart.pipe_states import pipes_of


def consume(pipe):
    return list(pipe)


def greet_and_get(greetings, pipe):
    """Say that this consumer is there, then wait for an item."""
    greetings.put(os.getpid())
    return pipe.get()


def kill_a_waiting_consumer(client, greetings, pipe):
    """Start a consumer on OTHER, kill its worker while it waits, and let nobody run it again."""
    other = Partition("OTHER", client)
    consumer = other.submit(greet_and_get, greetings, pipe, key=f"consumer-{uuid.uuid4().hex}")
    pid = greetings.get(timeout_s=LONG_S)
    time.sleep(0.1)  # let it begin to wait
    consumer.cancel()
    os.kill(pid, signal.SIGKILL)
    assert other.submit(os.getpid).result(LONG_S) != pid  # the nanny has started another


def test_a_consumer_that_is_killed_while_it_waits_swallows_nothing(processes, make_pipe):
    greetings = make_pipe(processes)
    pipe = make_pipe(processes, capacity=10)
    kill_a_waiting_consumer(processes, greetings, pipe)
    for item in range(8):
        pipe.put(item)
    pipe.close()
    assert list(pipe) == list(range(8))


def test_deleting_forgets_consumers_that_were_killed(processes, make_pipe, wait_until):
    def names(dask_scheduler):
        return set(pipes_of(dask_scheduler))

    greetings = make_pipe(processes)
    pipe = make_pipe(processes)
    kill_a_waiting_consumer(processes, greetings, pipe)
    assert {pipe.name, greetings.name} <= processes.run_on_scheduler(names)
    pipe.delete()
    greetings.delete()
    assert not {pipe.name, greetings.name} & processes.run_on_scheduler(names)
    assert not any(pipe.name in name for name in processes.cluster.scheduler.clients)


MAKER = """
import sys, time
from distributed import Client
from poolpart import Partition, Pipe
client = Client(sys.argv[1])
pipe = Pipe("of-a-process", 3, client).create()
print("made", flush=True)
time.sleep(60)
"""


@pytest.mark.extended
def test_a_pipe_ends_with_the_process_that_made_it(processes, make_pipe, wait_until):
    """Tasks that wait at its ends would keep their slots for ever."""

    def plugins(dask_scheduler):
        return sorted(name for name in dask_scheduler.plugins if name.startswith("poolpart"))

    other = make_pipe(processes)
    # A client that submits to a partition keeps nested tasks in it for as long as the client
    # exists, so a client of its own submits here.
    before = processes.run_on_scheduler(plugins)
    maker = subprocess.Popen(
        [sys.executable, "-c", MAKER, processes.scheduler.address], stdout=subprocess.PIPE
    )
    assert maker.stdout.readline() == b"made\n"
    with Client(processes.scheduler.address, set_as_default=False) as client:
        consumer = Partition("OTHER", client).submit(consume, Pipe("of-a-process", 3))
        time.sleep(0.2)
        assert consumer.status == "pending"
        maker.kill()
        maker.wait(LONG_S)
        maker.stdout.close()
        with pytest.raises(PipeFailed, match="does not exist"):
            consumer.result(LONG_S)
    other.put("another's pipe is untouched")
    assert other.get() == "another's pipe is untouched"
    wait_until(lambda: processes.run_on_scheduler(plugins) == before)
    other.delete()
    assert "poolpart-pipes" not in processes.run_on_scheduler(plugins)


def test_a_plain_client_of_another_process_uses_queue_and_variable(processes, make_pipe):
    pipe = make_pipe(processes)
    pipe.put_many([{1, 2}, {"scan": 7}])
    program = f"""
from distributed import Client, Queue, Variable
with Client("{processes.scheduler.address}") as client:
    queue, variable = Queue("{pipe.name}"), Variable("{pipe.name}")
    print(queue.qsize(), queue.get(), queue.get(), variable.get()["capacity"])
    queue.put({{"plain": 8}})
    variable.set({{**variable.get(), "closed": True}})
"""
    answer = subprocess.run([sys.executable, "-c", program], stdout=subprocess.PIPE, check=True)
    assert answer.stdout == b"2 {1, 2} {'scan': 7} 3\n"
    assert list(pipe) == [{"plain": 8}]


SCHEDULER = """
import asyncio
from distributed import Scheduler, Worker
async def main():
    options = {"host": "127.0.0.1", "dashboard": False}
    async with Scheduler(port=0, **options) as scheduler:
        async with Worker(scheduler.address, resources={"P": 1}, nthreads=1, **options):
            print(scheduler.address, flush=True)
            await scheduler.finished()
asyncio.run(main())
"""


@pytest.mark.extended
def test_a_scheduler_that_does_not_answer_is_an_error_of_each_call(monkeypatch):
    """A process that is stopped keeps its connections open."""
    scheduler = subprocess.Popen(
        [sys.executable, "-c", SCHEDULER], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    )
    try:
        address = scheduler.stdout.readline().decode().strip()
        client = Client(address, set_as_default=False)
        part = Partition("P", client)
        full = Pipe("full", 1, client).create()
        empty = Pipe("empty", 1, client).create()
        full.put(1)
        monkeypatch.setattr("poolpart.mapping.CHECK_S", 0.1)
        computed = part.map(abs, [-1], chunk=1)
        assert part.submit(pow, 2, 10).result(LONG_S) == 1024  # after the map, on the same slot
        running = part.map(time.sleep, [LONG_S])
        pool = Pool.from_client(client)
        monkeypatch.setattr("poolpart.internals.client.ANSWER_S", 0.03)
        monkeypatch.setattr("poolpart.division.ANSWER_S", 0.03)
        monkeypatch.setattr("poolpart.for_each.CHECK_S", 0.1)
        os.kill(scheduler.pid, signal.SIGSTOP)
        calls = {
            "get": empty.get,
            "get with a time limit": lambda: empty.get(timeout_s=LONG_S),
            "put": lambda: full.put(2),
            "poll": empty.poll,
            "iteration": lambda: list(empty),
            "close of a pipe": empty.close,
            "delete": empty.delete,
            "listener": lambda: empty.listen(print).join(),
            "for_each": lambda: part.for_each(empty, print),
            "map": lambda: list(running),
            "map whose tasks have ended": lambda: list(computed),
            "stats": part.stats,
            "tasks": part.tasks,
            "partitions": pool.partitions,
            "grow": lambda: part.grow(1, timeout_s=0.1),
            "shrink": lambda: part.shrink(1, timeout_s=0.1),
            "dissolve": lambda: pool.dissolve(timeout_s=0.1),
            "divide": lambda: pool.divide({"Q": rest()}),
            "adapt": lambda: part.adapt(0, 1),
            "want": lambda: part.request_slots(1),
            "first submit": lambda: Partition("Q", client).submit(abs, 1),
        }
        message = f"^The scheduler at {address} has not responded for 0.[0-9]+ s. Check that"
        for name, call in calls.items():
            with pytest.raises(OSError, match=message):
                call()
                pytest.fail(f"{name} has returned")
        empty.listen(print).close()  # does not raise
    finally:
        os.kill(scheduler.pid, signal.SIGCONT)
        client.close()
        scheduler.kill()
        scheduler.wait(LONG_S)
        scheduler.stdout.close()
