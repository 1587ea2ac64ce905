"""Fetching what is there, without waiting for what is not."""

import asyncio
import os
import signal
import uuid

import pytest
from distributed import Event, wait

from poolpart import Partition, fetch, fetch_available

LONG_S = 120.0


def twice(x):
    return 2 * x


def wait_for(event):
    return Event(event).wait(120)


def test_only_what_is_finished_comes(client):
    gate = Event(f"gate-{uuid.uuid4().hex}", client=client)
    part = Partition("A", client)
    done, pending = part.submit_many(twice, range(5)), part.submit(wait_for, gate.name)
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


@pytest.mark.parametrize("partition", ["A", "B"])
def test_tasks_fetch_for_themselves(client, partition):
    def fetch(keys):
        from distributed import get_client

        return fetch_available(get_client(), keys, 120.0)

    future = Partition("A", client).submit(twice, 3)
    wait([future], timeout=120)
    fetched = Partition(partition, client).submit(fetch, [future.key]).result(120)
    assert fetched == {future.key: 6}


def answer_late(seconds, dask_worker):
    """Have a worker take longer to send results."""
    send = dask_worker.handlers["get_data"]

    async def send_late(comm, **asked):
        await asyncio.sleep(seconds)
        return await send(comm, **asked)

    dask_worker.handlers["get_data"] = send_late


def test_a_worker_that_is_slow_is_waited_for(nannies, monkeypatch):
    """Else it would send the same again with each call, and nothing would ever come."""
    futures = [nannies.submit(os.getpid, workers=[name], pure=False) for name in (0, 1)]
    pids = [future.result(120) for future in futures]
    nannies.run(answer_late, 1.0)
    # The scheduler's answer and a sign of life may take longer than the patience as well here.
    in_time = fetch.wait_for
    monkeypatch.setattr(fetch, "wait_for", lambda answer, _: in_time(answer, LONG_S))
    fetched = fetch_available(nannies, [future.key for future in futures], patience_s=0.2)
    assert fetched == {future.key: pid for future, pid in zip(futures, pids, strict=True)}


def test_a_worker_that_does_not_answer_keeps_only_its_own_results(nannies, wait_until):
    futures = [nannies.submit(os.getpid, workers=[name], pure=False) for name in (0, 1)]
    answering, stopped = (future.result(120) for future in futures)
    keys, fetched = [future.key for future in futures], {}

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
