"""A task's client, also where several ask at the same moment; tasks whose worker leaves."""

import asyncio
import threading

import pytest
from distributed import Status
from distributed.diagnostics.plugin import SchedulerPlugin
from tests.poolpart.helpers import LONG_S

from poolpart.task_context import WorkerLeavingError, own_client, translate_leaving_errors
from poolpart.workers import worker_identities


def test_a_coroutine_does_not_wait_for_a_thread_that_needs_its_loop(monkeypatch):
    """As a task that is a coroutine, beside one that is none: both would wait for ever."""

    async def meet() -> list[str]:
        loop = asyncio.get_running_loop()
        entered = threading.Event()

        def make() -> str:
            if threading.current_thread() is threading.main_thread():
                return "coroutine"
            entered.set()
            asyncio.run_coroutine_threadsafe(asyncio.sleep(0.01), loop).result(LONG_S)
            return "thread"

        monkeypatch.setattr("poolpart.task_context.get_client", make)
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
    nannies.restart()  # its workers have no client yet
    nannies.register_plugin(TellAtOnce())
    worker = next(iter(worker_identities(nannies)))
    futures = [nannies.submit(status_on_worker, workers=[worker], pure=False) for _ in range(3)]
    assert nannies.gather(futures) == ["running"] * 3
    told = nannies.run_on_scheduler(
        lambda dask_scheduler: dask_scheduler.plugins[TellAtOnce.name].told
    )
    nannies.unregister_scheduler_plugin(TellAtOnce.name)
    assert told == 1


def identity(_: str) -> tuple[str, str]:
    client = own_client()
    return client.id, client.status


def test_tasks_of_a_worker_share_its_client(start):
    client = start({"a": {"nthreads": 4}})
    told = client.gather(client.map(identity, [str(number) for number in range(8)]))
    assert len({name for name, _ in told}) == 1
    assert {status for _, status in told} == {"running"}


class ClosingWorker:
    """Stands in for the worker of a task."""

    status = Status.closing


def test_what_is_raised_while_a_worker_leaves_says_so(monkeypatch):
    monkeypatch.setattr("poolpart.task_context.get_worker", ClosingWorker)
    message = r"The worker has left the cluster \(AttributeError: 'NoneType' object has no"
    with pytest.raises(WorkerLeavingError, match=message) as caught, translate_leaving_errors():
        None.queue_get  # noqa: B018 - what Dask does with a client that was closed
    assert caught.value.__cause__ is None


@pytest.mark.parametrize("status", [Status.running, Status.closing_gracefully])
def test_on_a_worker_that_stays_errors_are_what_they_are(monkeypatch, status):
    monkeypatch.setattr(ClosingWorker, "status", status)
    monkeypatch.setattr("poolpart.task_context.get_worker", ClosingWorker)
    with pytest.raises(ZeroDivisionError), translate_leaving_errors():
        1 / 0  # noqa: B018
