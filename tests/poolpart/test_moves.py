"""Moving workers between partitions while tasks run: none is lost, none runs elsewhere."""

import os
import queue
import signal
import threading
import time

import pytest
from distributed import Event, get_worker, secede
from tests.poolpart.helpers import (
    LONG_S,
    declared,
    declared_by_themselves,
    join,
    leave,
    wait_for,
    worker_name,
)

from poolpart import Partition, Pool, PoolError, n_workers, per_host, rest, steward
from poolpart.workers import worker_identities


def brief(_=None):
    time.sleep(0.01)
    return worker_name()


def is_in(partition):
    time.sleep(0.01)
    return partition in get_worker().state.total_resources


# The workers are threads of this process. A task that has been cancelled needs no client to wait.
begun = queue.SimpleQueue()
released = threading.Event()


def begin_and_wait(worker):
    begun.put(worker)
    return released.wait(LONG_S)


def hold_on(event):
    secede()
    return Event(event).wait(LONG_S)


def used(client):
    return {str(w.name): w.used_resources for w in client.cluster.scheduler.workers.values()}


def members(part):
    return [worker.name for worker in part.workers]


@pytest.fixture
def divided(start):
    """Client and partitions of six workers: A has three, B one, the rest two."""
    client = start({name: {} for name in "abcdef"})
    rules = {"A": n_workers(3), "B": n_workers(1), "C": rest()}
    return client, Pool.from_client(client).divide(rules)


def test_what_has_not_started_is_shared_out_evenly(divided, wait_until):
    client, parts = divided
    event = Event("evenly", client)
    event.set()
    parts["A"].submit(wait_for, "evenly").result()  # workers only receive short tasks in advance
    event.clear()
    tasks = [parts["A"].submit(wait_for, "evenly") for _ in range(45)]
    scheduler = client.cluster.scheduler
    wait_until(lambda: sum(len(w.processing) for w in scheduler.workers.values()) == 45)
    members_of_a = [scheduler.workers[worker.address] for worker in parts["A"].workers]
    moving = threading.Thread(target=parts["A"].shrink)
    moving.start()
    # What the worker that leaves has begun ends there.
    wait_until(lambda: sorted(len(worker.processing) for worker in members_of_a)[0] == 1)
    given = sorted(len(worker.processing) for worker in members_of_a)
    event.set()
    moving.join()
    client.gather(tasks)
    assert given[0] == 1
    assert given[2] - given[1] <= 5


def test_a_partition_is_resized_to_a_number_of_workers(divided):
    _, parts = divided
    a, rest_of_pool = parts["A"], parts["C"]
    assert a.resize(3) == [] and len(a) == 3
    assert len(a.resize(5)) == 2 and (len(a), len(rest_of_pool)) == (5, 0)
    with pytest.raises(
        PoolError,
        match=r"cannot grow by 1 worker, .* should provide them as `source`",
    ):
        a.resize(6)
    assert len(a.resize(2)) == 3 and (len(a), len(rest_of_pool)) == (2, 3)
    (moved,) = a.resize(3, source="C")
    assert moved in members(a) and a.stats().target == 3
    with pytest.raises(
        PoolError, match=r"'A' cannot be resized to 0 workers, because its minimum is 1"
    ):
        a.resize(0)
    with pytest.raises(PoolError, match="value -1 for the number of workers of partition 'A'"):
        a.resize(-1)
    assert rest_of_pool.stats().target is None


def test_after_a_loss_resize_returns_to_the_size_and_grow_does_not(start, wait_until):
    client = start({name: {} for name in "abcde"})
    a, _ = Pool.from_client(client).divide({"A": n_workers(2), "C": rest()}).values()
    leave(client, members(a)[0])
    wait_until(lambda: len(a) == 1)
    assert (a.stats().target, repr(a)) == (2, "<Partition 'A': 1 of 2 workers, 1 slot>")
    a.grow(1)
    assert (len(a), a.stats().target) == (2, 3)
    a.resize(2)
    assert (len(a), a.stats().target) == (2, 2)
    leave(client, members(a)[0])
    wait_until(lambda: len(a) == 1)
    assert len(a.resize(2)) == 1
    assert (len(a), a.stats().target, repr(a)) == (2, 2, "<Partition 'A': 2 workers, 2 slots>")
    join(client, "late")
    client.wait_for_workers(4)
    wait_until(lambda: declared(client)["late"] == {"C": 1})


def test_slots_are_those_of_the_partition(start):
    client = start({name: {"nthreads": 3} for name in "abc"})
    rules = {"A": n_workers(1, slots=7), "B": rest()}
    parts = Pool.from_client(client).divide(rules)
    parts["A"].grow(1)
    assert (parts["A"].slots, parts["B"].slots) == (14, 3)


def test_the_least_busy_worker_goes(divided):
    client, parts = divided
    event = Event("least-busy", client)
    busy = parts["A"].workers[:2]
    tasks = [parts["A"].submit(wait_for, "least-busy", workers=w.address) for w in busy]
    scheduler = client.cluster.scheduler
    while sum(len(scheduler.workers[w.address].processing) for w in busy) < 2:
        time.sleep(0.01)
    left = parts["A"].shrink(1)
    assert left and not {worker.name for worker in busy} & set(left)
    event.set()
    client.gather(tasks)


def test_a_task_that_does_not_end_keeps_its_worker(divided, wait_until):
    client, parts = divided
    event = Event("endless", client)
    tasks = [
        parts["A"].submit(function, "endless", key=f"endless-{i}", workers=worker.address)
        for i, (function, worker) in enumerate(
            zip((wait_for, hold_on, hold_on), parts["A"].workers, strict=True)
        )
    ]
    scheduler = client.cluster.scheduler
    wait_until(lambda: sum(len(w.processing) for w in scheduler.workers.values()) == 3)
    before = declared(client)
    with pytest.raises(
        PoolError, match=r"1 of 1 worker could .* 0\.2 s\. .* in their partition: \w\."
    ):
        parts["A"].shrink(1, timeout_s=0.2)
    wait_until(lambda: declared(client) == before)
    assert declared_by_themselves(client) == before
    assert sum(sum(u.values()) for u in used(client).values()) == 3
    event.set()
    assert client.gather(tasks) == [True] * 3
    assert len(parts["A"].shrink(1)) == 1


@pytest.mark.extended
def test_a_task_that_was_cancelled_but_runs_on_keeps_its_slot(divided):
    client, parts = divided
    released.clear()
    workers = {w.address for w in parts["A"].workers}
    tasks = [parts["A"].submit(begin_and_wait, address, workers=address) for address in workers]
    assert {begun.get(timeout=LONG_S) for _ in workers} == workers
    client.cancel(tasks)
    threading.Timer(1.5, released.set).start()
    left = parts["A"].shrink(1)
    assert released.is_set()
    assert declared_by_themselves(client)[left[0]] == {"C": 1}
    assert parts["A"].submit(brief).result() in members(parts["A"])


def test_a_cancelled_task_that_is_on_its_way_when_its_worker_leaves(start, monkeypatch, wait_until):
    client = start({"a": {}, "b": {}})
    parts = Pool.from_client(client).divide({"A": n_workers(1, minimum=0), "B": rest()})
    scheduler = client.cluster.scheduler
    moving = parts["A"].workers[0]
    stream = scheduler.stream_comms[moving.address]
    on_the_way = []
    send = stream.send
    monkeypatch.setattr(stream, "send", lambda *messages: on_the_way.extend(messages))
    task = parts["A"].submit(brief)
    wait_until(lambda: any(message["op"] == "compute-task" for message in on_the_way[:]))
    task.cancel()
    wait_until(lambda: not scheduler.tasks)
    assert parts["A"].shrink() == [moving.name]
    monkeypatch.undo()
    client.sync(_send_all, send, on_the_way)
    assert (
        client.submit(worker_name, workers=[moving.address]).result(timeout=LONG_S) == moving.name
    )
    worker = client.cluster.workers[moving.name]
    wait_until(lambda: not worker.state.tasks)
    assert worker.state.total_resources == worker.state.available_resources == {"B": 1}


async def _send_all(send, messages):
    send(*messages)


def test_never_below_the_minimum(start):
    client = start({name: {} for name in "abcd"})
    rules = {"A": n_workers(2, minimum=2), "B": n_workers(1), "C": rest(minimum=1)}
    parts = Pool.from_client(client).divide(rules)
    before = declared(client)
    with pytest.raises(
        PoolError,
        match="'A' cannot shrink by 1 worker, because it has 2 workers and its minimum is 2",
    ):
        parts["A"].shrink()
    with pytest.raises(
        PoolError,
        match="the remainder of the pool has no workers to spare",
    ):
        parts["B"].grow()
    with pytest.raises(
        PoolError,
        match="partition 'A' has no workers to spare beyond its minimum",
    ):
        parts["B"].grow(source="A")
    assert declared(client) == before


def test_what_makes_no_sense(divided):
    client, parts = divided
    for workers in (0, -1, 1.5):
        with pytest.raises(PoolError, match="for the number of workers to move"):
            parts["A"].grow(workers)
        with pytest.raises(PoolError, match="for the number of workers to move"):
            parts["A"].shrink(workers)
    with pytest.raises(PoolError, match="'A' cannot take workers from itself"):
        parts["A"].grow(source="A")
    with pytest.raises(
        PoolError, match=r"There is no partition 'X'\. No worker declares this resource"
    ):
        parts["A"].grow(source="X")
    with pytest.raises(PoolError, match="There is no partition 'X'"):
        Partition("X", client).shrink()


def test_a_cluster_that_was_divided_when_it_was_started(start):
    client = start({"a": {"resources": {"A": 1}}, **{n: {"resources": {"B": 2}} for n in "bc"}})
    plugins = set(client.cluster.scheduler.plugins)
    parts = Pool.from_client(client).partitions()
    assert parts["A"].grow(1, source="B")[0] in "bc"
    assert {name: (len(part), part.slots) for name, part in parts.items()} == {
        "A": (2, 2),
        "B": (1, 2),
    }
    assert Pool.from_client(client).dissolve() == ["A", "B"]
    assert declared(client) == {"a": {"A": 1}, "b": {"B": 2}, "c": {"B": 2}}
    assert set(client.cluster.scheduler.plugins) == plugins


GPU_AND_OTHER = {
    "gpu-0": {"resources": {"GPU": 1}},
    **{f"other-{i}": {"resources": {"OTHER": 1}} for i in range(3)},
}


@pytest.mark.parametrize(
    "give_back",
    [
        lambda gpu, other: gpu.resize(1),
        lambda gpu, other: gpu.shrink(2),
        lambda gpu, other: other.grow(2, source="GPU"),
        lambda gpu, other: other.resize(3, source="GPU"),
    ],
    ids=["resize", "shrink", "grow", "resize the source"],
)
def test_borrowed_workers_are_given_back_and_own_workers_stay(start, give_back, wait_until):
    client = start(GPU_AND_OTHER)
    before = declared(client)
    parts = Pool.from_client(client).partitions()
    borrowed = parts["GPU"].resize(3, source="OTHER")
    # Tasks make the borrowed workers busier than the worker of the GPU.
    tasks = [parts["GPU"].submit(time.sleep, 0.5, workers=name) for name in borrowed]
    scheduler = client.cluster.scheduler
    wait_until(lambda: sum(len(w.processing) for w in scheduler.workers.values()) == 2)
    assert sorted(give_back(parts["GPU"], parts["OTHER"])) == sorted(borrowed)
    client.gather(tasks)
    assert declared(client) == before


def test_borrowed_workers_leave_for_a_third_partition_first(start):
    client = start(GPU_AND_OTHER)
    pool = Pool.from_client(client)
    gpu = pool["GPU"]
    borrowed = gpu.grow(2, source="OTHER")
    plan = pool.divide({"PLAN": n_workers(2, minimum=0)})["PLAN"]
    assert sorted(plan.resize(2, source="GPU")) == sorted(borrowed)
    assert members(gpu) == ["gpu-0"]
    assert plan.resize(3, source="GPU") == ["gpu-0"]
    assert gpu.grow(1, source="PLAN") == ["gpu-0"]  # not one of the borrowed workers
    assert sorted(plan.resize(0)) == sorted(borrowed)  # they return to OTHER
    assert len(pool["OTHER"]) == 3


def test_workers_that_a_rule_selected_stay_and_workers_of_the_rest_return(divided):
    _, parts = divided
    own = members(parts["B"])
    given = parts["B"].grow(2, source="A") + parts["B"].grow(1)
    assert sorted(parts["B"].resize(1)) == sorted(given)
    assert members(parts["B"]) == own
    assert [len(part) for part in parts.values()] == [3, 1, 2]


def test_a_partition_that_workers_were_started_with_may_become_empty(start):
    pool = Pool.from_client(start({"a": {"resources": {"A": 1}}, "b": {}}))
    assert pool["A"].resize(0) == ["a"]
    assert {name: len(part) for name, part in pool.partitions().items()} == {"A": 0}


@pytest.mark.extended
def test_a_worker_that_is_killed_while_it_moves(nannies, wait_until, monkeypatch):
    parts = Pool.from_client(nannies).divide({"A": per_host(1), "B": rest()})
    target = members(parts["A"])[0]
    moving = members(parts["B"])[0]
    tasks = [parts["B"].submit(is_in, "B") for _ in range(20)]
    tasks += [parts["A"].submit(is_in, "A") for _ in range(20)]
    pids = nannies.run(os.getpid)
    killed = []
    declare = steward.call_worker

    async def kill_and_declare(scheduler, address, *args, **kwargs):
        if not killed:  # its tasks have ended, and it is about to be told
            killed.append(address)
            os.kill(pids[address], signal.SIGKILL)
        return await declare(scheduler, address, *args, **kwargs)

    monkeypatch.setattr(steward, "call_worker", kill_and_declare)
    assert parts["A"].grow(1, timeout_s=LONG_S) == [moving]
    wait_until(lambda: killed[0] not in worker_identities(nannies))
    wait_until(lambda: len(parts["A"]) == 2)
    assert members(parts["A"]) == sorted([target, moving])
    assert declared(nannies) == declared_by_themselves(nannies) == {"0": {"A": 1}, "1": {"A": 1}}
    # Those of B that had ended are lost with their worker, and wait for the next one.
    assert parts["A"].shrink(1)
    assert all(nannies.gather(tasks))
    nannies.restart()
    wait_until(lambda: sorted(map(str, declared(nannies).values())) == ["{'A': 1}", "{'B': 1}"])
