"""Several tasks of one worker that ask for its client at the same moment."""

from __future__ import annotations

import asyncio
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from distributed import Client
from distributed.diagnostics.plugin import SchedulerPlugin

from poolpart import worker_identities
from poolpart.current_client import own_client


def test_one_asks_at_a_time(monkeypatch):
    inside, together = threading.Semaphore(1), []

    def slow() -> str:
        together.append(not inside.acquire(blocking=False))
        time.sleep(0.01)
        inside.release()
        return "client"

    monkeypatch.setattr("poolpart.current_client.get_client", slow)
    with ThreadPoolExecutor(4) as threads:
        assert [*threads.map(lambda _: own_client(), range(8))] == ["client"] * 8
    assert together == [False] * 8


def test_one_that_fails_does_not_keep_others_out(monkeypatch):
    def fail() -> Client:
        raise OSError("no scheduler")

    monkeypatch.setattr("poolpart.current_client.get_client", fail)
    for _ in range(2):
        with pytest.raises(OSError, match="no scheduler"):
            own_client()


def test_a_coroutine_does_not_wait_for_a_thread_that_needs_its_loop(monkeypatch):
    """As a task that is a coroutine, beside one that is none: both would wait for ever."""

    async def meet() -> list[str]:
        loop, entered = asyncio.get_running_loop(), threading.Event()

        def make() -> str:
            if threading.current_thread() is threading.main_thread():
                return "coroutine"
            entered.set()
            asyncio.run_coroutine_threadsafe(asyncio.sleep(0.01), loop).result(10)
            return "thread"

        monkeypatch.setattr("poolpart.current_client.get_client", make)
        thread = asyncio.create_task(asyncio.to_thread(own_client))
        await asyncio.to_thread(entered.wait)
        return [own_client(), await thread]

    assert asyncio.run(meet()) == ["coroutine", "thread"]


class TellAtOnce(SchedulerPlugin):
    """Has the scheduler tell the next client something in the message that greets it."""

    name = "tell-at-once"

    def __init__(self) -> None:
        self.told = 0

    def add_client(self, scheduler, client) -> None:
        if not self.told:
            self.told += 1
            word = {"op": "lost-data", "key": "nothing"}
            scheduler.loop.add_callback(lambda: scheduler.client_comms[client].send(word))


def status_on_worker() -> str:
    return own_client().status


def test_one_that_was_told_too_much_at_once_is_made_again(nannies):
    """Without a second try the task fails with an AssertionError."""
    nannies.register_plugin(TellAtOnce())
    worker = next(iter(worker_identities(nannies)))
    futures = [nannies.submit(status_on_worker, workers=[worker], pure=False) for _ in range(3)]
    assert nannies.gather(futures) == ["running"] * 3
    told = nannies.run_on_scheduler(
        lambda dask_scheduler: dask_scheduler.plugins[TellAtOnce.name].told
    )
    assert told == 1


def identity(_: str) -> tuple[str, str]:
    client = own_client()
    return client.id, client.status


def test_tasks_of_a_worker_share_its_client(start):
    client = start({"a": {"nthreads": 4}})
    told = client.gather(client.map(identity, [str(number) for number in range(8)]))
    assert len({name for name, _ in told}) == 1
    assert {status for _, status in told} == {"running"}
