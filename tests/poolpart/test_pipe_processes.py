"""Pipes between processes, one of which may be killed."""

import os
import signal
import subprocess
import sys
import time
import uuid

import pytest
from tests.poolpart.helpers import LONG_S

from poolpart import Partition, Pipe, PipeFailed
from poolpart.pipe import pipes_of


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
    greetings, pipe = make_pipe(processes), make_pipe(processes, capacity=10)
    kill_a_waiting_consumer(processes, greetings, pipe)
    for item in range(8):
        pipe.put(item)
    pipe.close()
    assert list(pipe) == list(range(8))


def test_deleting_forgets_consumers_that_were_killed(processes, make_pipe, wait_until):
    def names(dask_scheduler):
        return set(pipes_of(dask_scheduler))

    greetings, pipe = make_pipe(processes), make_pipe(processes)
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


def test_a_pipe_ends_with_the_process_that_made_it(processes, make_pipe):
    """Tasks that wait at its ends would keep their slots for ever."""

    def plugins(dask_scheduler):
        return sorted(name for name in dask_scheduler.plugins if name.startswith("poolpart"))

    before = processes.run_on_scheduler(plugins)
    maker = subprocess.Popen(
        [sys.executable, "-c", MAKER, processes.scheduler.address], stdout=subprocess.PIPE
    )
    assert maker.stdout.readline() == b"made\n"
    other = make_pipe(processes)
    consumer = Partition("OTHER", processes).submit(consume, Pipe("of-a-process", 3))
    time.sleep(0.2)
    assert consumer.status == "pending"
    maker.kill()
    maker.wait(LONG_S)
    maker.stdout.close()
    with pytest.raises(PipeFailed, match="does not exist"):
        consumer.result(LONG_S)
    other.put("another's pipe is untouched")
    assert other.get() == "another's pipe is untouched"
    other.delete()
    assert processes.run_on_scheduler(plugins) == before
