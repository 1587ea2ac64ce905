"""Undoing partitions: what the scheduler and workers know is what they knew before."""

import asyncio
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
from distributed import Event
from tests.poolpart.helpers import LONG_S, declared, join, kill, wait_for, worker_name

from poolpart import Pool, PoolError, division, n_workers, named, per_host, rest, steward
from poolpart.workers import worker_identities


def known(client):
    """All that the scheduler, the workers and the nannies know of partitions."""
    scheduler = client.cluster.scheduler
    # Clients come and go, and Dask itself keeps an entry for a resource that was asked for.
    return {
        "workers": {
            str(w.name): (dict(w.resources), dict(w.used_resources), w.status.name)
            for w in scheduler.workers.values()
        },
        "by resource": {
            name: sorted(str(scheduler.workers[a].name) for a in workers)
            for name, workers in scheduler.resources.items()
            if workers
        },
        "plugins": set(scheduler.plugins),
        "plugins for others": (set(scheduler.worker_plugins), set(scheduler.nanny_plugins)),
        "extensions": set(scheduler.extensions),
        "handlers": {name: str(handler) for name, handler in scheduler.handlers.items()},
        "streams": set(scheduler.stream_handlers),
        "callbacks": set(scheduler.periodic_callbacks),
        "overridden": {name for name in vars(scheduler) if hasattr(type(scheduler), name)},
        "overridden of extensions": [sorted(vars(e)) for e in scheduler.extensions.values()],
        "idle": type(scheduler.idle_task_count),
        "unrunnable": set(scheduler.unrunnable),
        "tasks": {
            key: (task.state, task.resource_restrictions, task.worker_restrictions)
            for key, task in scheduler.tasks.items()
        },
        "themselves": sorted(client.run(_on_worker).values(), key=str),
    }


def _on_worker(dask_worker):
    state = dask_worker.state
    return (
        str(dask_worker.name),
        dict(state.total_resources),
        dict(state.available_resources),
        sorted(dask_worker.plugins),
    )


def test_everything_is_as_before(start, wait_until):
    workers = {"native": {"resources": {"GPU": 2}}, "disk": {"resources": {"DISK": 1}}}
    client = start({**{name: {} for name in "abcd"}, **workers})
    held = client.submit(worker_name, key="held")
    held.result()
    before = known(client)
    pool = Pool.from_client(client)
    parts = pool.divide({"A": n_workers(2, exclusive=True), "B": per_host(1), "C": rest()})
    part, _ = pool.partition("GPU", workers=["native"], slots=5)
    client.gather([part.submit(worker_name), *(p.submit(worker_name) for p in parts.values())])
    parts["A"].grow(1)
    wait_until(lambda: client.cluster.scheduler.tasks.keys() == {"held"})
    assert known(client) != before
    assert sorted(Pool.from_client(client).dissolve()) == ["A", "B", "C", "GPU"]
    assert known(client) == before
    assert Pool.from_client(client).dissolve() == []
    assert known(client) == before


def test_a_worker_that_has_left_what_it_was_started_with(start):
    client = start({name: {"resources": {"GPU": 1}} for name in "ab"})
    before = known(client)
    pool = Pool.from_client(client)
    pool["GPU"].shrink(1)
    assert pool.dissolve() == ["GPU"]
    assert known(client) == before


def test_a_worker_that_comes_back_after_all_is_as_it_was(nannies, wait_until):
    """There is no partition any more by then."""
    before = known(nannies)
    Pool.from_client(nannies).divide({"A": per_host(1), "B": rest()})
    address = kill(nannies, "0")
    wait_until(lambda: address not in worker_identities(nannies))
    assert Pool(nannies, []).dissolve(timeout_s=LONG_S) == ["A", "B"]
    nannies.wait_for_workers(2, timeout=LONG_S)
    assert known(nannies) == before


def test_a_worker_that_is_just_being_told_to_belong(start, wait_until, monkeypatch):
    client = start({"a": {}})
    Pool.from_client(client).divide({"A": rest()})
    told = threading.Event()
    call = steward.call_worker

    async def call_and_linger(*args, **kwargs):
        answer = await call(*args, **kwargs)
        if not told.is_set():
            told.set()
            await asyncio.sleep(0.5)
        return answer

    monkeypatch.setattr(steward, "call_worker", call_and_linger)
    join(client, "b")
    assert told.wait(LONG_S)
    Pool(client, []).dissolve()
    assert not any(dict(declares) for _, declares, *_ in client.run(_on_worker).values())


def test_no_fence_stays(start):
    client = start({"a": {}, "b": {}})
    before = known(client)
    pool = Pool.from_client(client)
    pool.partition("A", n_workers=1, exclusive=True)
    part, _ = pool.partition("A", n_workers=1)
    assert not part.stats().exclusive
    pool.dissolve()
    assert known(client) == before


def test_one_partition(start):
    client = start({name: {} for name in "abc"})
    before = known(client)
    parts = Pool.from_client(client).divide({"A": named("a"), "B": rest()})
    parts["A"].dissolve()
    assert declared(client) == {"a": {}, "b": {"B": 1}, "c": {"B": 1}}
    parts["B"].grow(1)
    assert len(parts["B"]) == 3
    parts["B"].dissolve()
    assert known(client) == before


def test_borrowed_workers_return_when_their_partition_is_dissolved(start):
    workers = {**{f"lidar-{i}": {"resources": {"LIDAR": 2}} for i in range(2)}, "a": {}, "b": {}}
    client = start(workers)
    before = known(client)
    pool = Pool.from_client(client)
    plan = pool.divide({"PLAN": n_workers(1, minimum=0)})["PLAN"]
    made = declared(client)
    assert len(plan.resize(3, source="LIDAR")) == 2
    plan.dissolve()
    assert declared(client) == {"lidar-0": {"LIDAR": 2}, "lidar-1": {"LIDAR": 2}, "a": {}, "b": {}}
    parts = pool.divide({"A": named("a"), "PLAN": n_workers(1)})
    parts["PLAN"].grow(1, source="LIDAR")
    parts["A"].grow(1, source="LIDAR")
    assert len(pool["LIDAR"]) == 0
    pool["LIDAR"].dissolve()  # its workers stay where they are
    assert (len(parts["A"]), len(parts["PLAN"])) == (2, 2)
    parts["PLAN"].dissolve()
    parts["A"].dissolve()
    assert declared(client) == {**made, "a": {}, "b": {}}
    assert known(client) == before


def test_workers_return_to_the_partition_that_a_rule_selected_them_for(start):
    client = start({name: {} for name in "abc"})
    parts = Pool.from_client(client).divide(
        {"A": n_workers(2, minimum=0), "B": n_workers(1), "C": rest()}
    )
    before = declared(client)
    parts["B"].grow(2, source="A")
    assert (parts["A"].stats().target, parts["B"].stats().target) == (0, 3)
    parts["B"].dissolve()
    assert {name: slots for name, slots in declared(client).items() if slots} == {
        name: slots for name, slots in before.items() if slots == {"A": 1}
    }
    assert parts["A"].stats().target == 2


def test_tasks_that_have_not_ended_are_waited_for(start, wait_until):
    client = start({"a": {}, "b": {}})
    pool = Pool.from_client(client)
    parts = pool.divide({"A": n_workers(1), "B": rest()})
    event = Event("dissolve", client)
    tasks = [parts["A"].submit(wait_for, "dissolve", key=f"t-{i}") for i in range(3)]
    # They come by another connection than what follows.
    wait_until(lambda: len(client.cluster.scheduler.tasks) == 3)
    before = declared(client)
    with pytest.raises(
        PoolError,
        match=r"3 tasks of partitions 'A' and 'B' have not finished after 0 s, for example 't-",
    ):
        pool.dissolve(timeout_s=0)
    assert declared(client) == before
    threading.Timer(0.3, event.set).start()
    pool.dissolve()
    assert client.gather(tasks) == [True] * 3
    assert declared(client) == {"a": {}, "b": {}}


def test_a_partition_that_is_made_while_it_waits_is_undone_too(start, wait_until, monkeypatch):
    client = start({"a": {}, "b": {}})
    part, others = Pool.from_client(client).partition("A", workers=["a"])
    event = Event("dissolve", client)
    task = part.submit(wait_for, "dissolve")
    wait_until(lambda: client.cluster.scheduler.tasks)
    looked = threading.Event()
    unfinished = division._unfinished

    def look(*arguments):
        looked.set()
        return unfinished(*arguments)

    monkeypatch.setattr(division, "_unfinished", look)
    with ThreadPoolExecutor(1) as thread:
        dissolved = thread.submit(Pool.from_client(client).dissolve)
        assert looked.wait(LONG_S)
        others.partition("B", workers=["b"], exclusive=True)
        event.set()
        assert sorted(dissolved.result(LONG_S)) == ["A", "B"]
    assert task.result() is True
    assert declared(client) == {"a": {}, "b": {}}


def test_a_result_that_is_lost_afterwards_is_computed_again(start, wait_until):
    client = start({"a": {}, "b": {}})
    pool = Pool.from_client(client)
    part, _ = pool.partition("P", workers=["a"])
    future = part.submit(worker_name)
    assert future.result() == "a"
    pool.dissolve()
    del client.cluster.worker_spec["a"]
    address = {w.name: w.address for w in pool}["a"]
    client.cluster.scheduler_comm  # noqa: B018
    client.sync(client.cluster.scheduler.remove_worker, address, stimulus_id="lost")
    assert future.result(LONG_S) == "b"
