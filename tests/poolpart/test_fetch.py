"""Fetching what is there, without waiting for what is not."""

import asyncio
import os
import signal
import time
import uuid

import dask
import numpy as np
from distributed import Event, wait
from distributed.comm.addressing import parse_host_port
from tests.poolpart.helpers import LONG_S, twice, wait_for

from poolpart import Partition, fetch
from poolpart.fetch import fetch_available, fetch_held_bytes, hold_bytes
from poolpart.workers import worker_identities


def test_only_what_is_finished_comes(client):
    gate = Event(f"gate-{uuid.uuid4().hex}", client=client)
    part = Partition("A", client)
    done = [part.submit(twice, number) for number in range(5)]
    pending = part.submit(wait_for, gate.name)
    wait(done, timeout=120)
    keys = [future.key for future in done]
    fetched = fetch_available(client, [*keys, pending.key, "never-submitted"], LONG_S)
    assert fetched == {key: 2 * number for number, key in enumerate(keys)}
    assert fetch_available(client, [], LONG_S) == {}
    gate.set()


def test_it_takes_no_reference(client, wait_until):
    future = Partition("A", client).submit(twice, 4)
    wait([future], timeout=120)
    key = future.key
    assert fetch_available(client, [key], LONG_S) == {key: 8}
    del future
    wait_until(lambda: key not in client.cluster.scheduler.tasks)
    assert fetch_available(client, [key]) == {}


def answer_late(seconds, dask_worker):
    """Have a worker take longer to send results."""
    send = dask_worker.handlers["get_data"]

    async def send_late(comm, **asked):
        await asyncio.sleep(seconds)
        return await send(comm, **asked)

    dask_worker.handlers["get_data"] = send_late


def answer_again(dask_worker):
    dask_worker.handlers["get_data"] = dask_worker.get_data


def test_a_worker_that_is_slow_is_waited_for(nannies, monkeypatch):
    """Else it would send the same again with each call, and nothing would ever come."""
    futures = [nannies.submit(os.getpid, workers=[name], pure=False) for name in (0, 1)]
    pids = [future.result(120) for future in futures]
    nannies.run(answer_late, 1.0)
    # The scheduler's answer and a sign of life may take longer than the patience as well here.
    in_time = fetch.wait_for
    monkeypatch.setattr(fetch, "wait_for", lambda answer, _: in_time(answer, LONG_S))
    fetched = fetch_available(nannies, [future.key for future in futures], patience_s=0.2)
    nannies.run(answer_again)
    assert fetched == {future.key: pid for future, pid in zip(futures, pids, strict=True)}


def test_a_worker_that_does_not_answer_keeps_only_its_own_results(nannies, wait_until):
    futures = [nannies.submit(os.getpid, workers=[name], pure=False) for name in (0, 1)]
    answering, stopped = (future.result(120) for future in futures)
    keys = [future.key for future in futures]
    fetched = {}

    def try_once():
        # The other one as well may be slower than that once.
        fetched.update(fetch_available(nannies, keys, patience_s=0.5))
        return fetched

    os.kill(stopped, signal.SIGSTOP)
    try:
        wait_until(try_once)
    finally:
        os.kill(stopped, signal.SIGCONT)
    assert fetched == {futures[0].key: answering}
    assert len(fetch_available(nannies, keys, LONG_S)) == 2


def test_results_come_from_the_worker_that_has_them(client):
    part = Partition("A", client)
    one, two = (worker.address for worker in part.workers)
    there, elsewhere = (part.submit(twice, n, workers=a) for n, a in ((3, one), (4, two)))
    wait([there, elsewhere], timeout=LONG_S)
    keys = [there.key, elsewhere.key, "never-submitted"]
    assert fetch_available(client, keys, LONG_S, holder=one) == {there.key: 6}
    assert fetch_available(client, keys, LONG_S, holder=two) == {elsewhere.key: 8}
    assert fetch_available(client, [], LONG_S, holder=one) == {}


SIZE = 8 * 2**20


def hold(name):
    """Hold bytes that do not compress, nor repeat; returns where."""
    data = np.random.default_rng(0).bytes(SIZE)
    return hold_bytes(name, data), os.getpid()


def test_held_bytes_are_fetched_once_and_do_not_pass_the_scheduler(processes, received):
    name = f"part-{uuid.uuid4().hex}"
    address, _ = Partition("GPU", processes).submit(hold, name).result(LONG_S)
    assert received.total() < SIZE / 8  # they have stayed where they were made
    other = Partition("OTHER", processes).workers[0].address
    assert fetch_held_bytes(processes, other, name) is None
    assert fetch_held_bytes(processes, address, "another") is None
    data = fetch_held_bytes(processes, address, name)
    assert bytes(data) == np.random.default_rng(0).bytes(SIZE)
    assert fetch_held_bytes(processes, address, name) is None
    # The client connects to the worker's address; the scheduler is called from another port.
    worker = parse_host_port(address.removeprefix("tcp://"))
    assert received.pop(worker) >= SIZE
    assert received.total() < SIZE / 8


def test_what_a_dead_worker_had_is_given_up_soon(nannies):
    """Dask tries to connect to it as long as its settings say."""
    address, pid = nannies.submit(hold, "part").result(LONG_S)
    result = nannies.submit(os.getpid, workers=[address])
    wait([result], timeout=LONG_S)
    assert fetch_available(nannies, [result.key], LONG_S, holder=address) == {result.key: pid}
    os.kill(pid, signal.SIGKILL)
    while address in worker_identities(nannies):
        time.sleep(0.01)
    start = time.monotonic()
    with dask.config.set({"distributed.comm.timeouts.connect": "1h"}):
        assert fetch_held_bytes(nannies, address, "part", patience_s=0.5) is None
        assert fetch_available(nannies, [result.key], 0.5, holder=address) == {}
    assert time.monotonic() - start < LONG_S
