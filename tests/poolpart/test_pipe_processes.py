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

from poolpart import Partition, Pipe, PipeFailed
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
