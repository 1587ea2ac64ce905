"""Clients of a partition take turns, however and how many tasks each of them submits."""

import itertools
import threading
import time
from collections import Counter
from contextlib import ExitStack

import dask
import pytest
from distributed import Client, Event, get_worker, wait
from tests.poolpart.helpers import LONG_S, addresses, kill, metrics_of, wait_for, worker_name

from poolpart import Partition, Pool, PoolError, rest
from poolpart.internals.scheduler import move_task
from poolpart.membership import request_capacity
from poolpart.shares import MAX_COMPARED, NAME

ran = []  # names of clients whose tasks have run, in order


def run(name, *_):
    ran.append(name)
    time.sleep(0.01)


@pytest.fixture
def pair(start):
    """Partition P with one slot, as seen by the clients alice and bob."""
    ran.clear()
    client = start({"w": {"resources": {"P": 1}, "nthreads": 2}})
    client.cluster.scheduler.validate = True  # Dask checks itself after each step
    with ExitStack() as stack:
        names = ("alice", "bob")
        clients = [stack.enter_context(Client(client.cluster, name=name)) for name in names]
        yield [Partition("P", client) for client in clients]


@pytest.fixture
def gate(pair):
    """Occupy the slot with a task of a third client until the event is set."""
    event = Event("gate", pair[0].client)
    with Client(pair[0].client.cluster, name="dora") as client:
        blocker = Partition("P", client).submit(wait_for, "gate", key="blocker")
        while pair[0].stats().running < 1:
            time.sleep(0.01)
        yield event
        blocker.result(LONG_S)


def await_queued(part, number):
    """Wait until a number of tasks wait for a slot."""
    while part.stats().queued < number:
        time.sleep(0.01)


def by_submit(part, name, number):
    return [part.submit(run, name, priority=100) for _ in range(number)]


def by_client(part, name, number):
    return part.as_client().map(run, [name] * number, range(number))


def by_compute(part, name, number):
    tasks = [dask.delayed(run)(name, dask.delayed(abs)(n)) for n in range(number)]
    return part.compute(tasks)


def submit_nested(part, name, number):
    for future in [part.client.submit(run, name, n) for n in range(number)]:
        future.result()


def by_nested_tasks(part, name, number):
    return [part.submit(submit_nested, part, name, number)]


def submit_nested_sleeps(part, number):
    for future in [part.client.submit(time.sleep, 0.3 + 0.001 * n) for n in range(number)]:
        future.result()


@pytest.mark.parametrize("way", [by_submit, by_client, by_compute, by_nested_tasks])
def test_a_second_client_does_not_wait_for_all_tasks_of_the_first(pair, gate, way):
    alice, bob = pair
    first = way(alice, "alice", 60)
    second = by_submit(bob, "bob", 5)
    await_queued(alice, len({*first, *second}))
    gate.set()
    wait([*first, *second], timeout=LONG_S)
    assert Counter(ran) == {"alice": 60, "bob": 5}
    last = max(number for number, name in enumerate(ran) if name == "bob")
    # The assumed and the measured running times of the first tasks differ.
    assert last < 40


def test_long_nested_tasks_leave_room_for_others(pair):
    alice, bob = pair
    parent = alice.submit(submit_nested_sleeps, alice, 4)
    while alice.stats().running < 1:
        time.sleep(0.01)
    bob.submit(run, "bob").result(LONG_S)
    assert not parent.done()
    parent.result(LONG_S)


def test_a_map_and_each_of_its_items_take_turns_with_other_tasks(pair):
    alice, bob = pair
    results = alice.map(run, ["alice"] * 300, chunk=1, window=100)
    first = by_submit(bob, "bob", 20)
    wait(first, timeout=LONG_S)
    assert Counter(ran)["alice"] < 60
    assert alice.for_each(["alice"] * 5, run) == 5
    results.close()


def test_the_window_of_a_map_follows_its_share(start):
    client = start({"w": {"resources": {"P": 2}, "nthreads": 2}})
    with Client(client.cluster, name="bob") as other:
        alice, bob = Partition("P", client), Partition("P", other)
        gate = Event("gate", client)
        blocker = bob.submit(wait_for, "gate")
        while bob.stats().running < 1:
            time.sleep(0.01)
        beside = alice.map(wait_for, itertools.repeat("gate"), chunk=1)
        time.sleep(0.1)
        stage = alice.stats().stages["wait_for-map"]
        assert stage.running + stage.queued == 2  # two tasks for its one slot
        capacity = request_capacity(client, "P", 1, by_rule="")
        assert (capacity.max_running, capacity.slots, capacity.free) == (1, 2, 0)
        assert capacity.idle_s == request_capacity(client, "P", 1, by_rule="").idle_s
        gate.set()
        assert next(beside)
        beside.close()
        assert blocker.result(LONG_S)
        gate.clear()
        while bob.stats().clients["bob"].slots:
            time.sleep(0.01)
        alone = alice.map(wait_for, itertools.repeat("gate"), chunk=1)
        time.sleep(0.1)
        stage = alice.stats().stages["wait_for-map"]
        assert stage.running + stage.queued == 4
        capacity = request_capacity(client, "P", 1, by_rule="")
        assert (capacity.max_running, capacity.slots, capacity.free) == (2, 2, 0)
        gate.set()
        alone.close()


def test_weights(pair, gate):
    alice, bob = pair
    pool = Pool.from_client(alice.client)
    pool.set_weight("bob", 3)
    futures = [*by_submit(alice, "alice", 150), *by_submit(bob, "bob", 150)]
    await_queued(alice, 300)
    gate.set()
    wait(futures, timeout=LONG_S)
    assert 0.6 < Counter(ran[50:170])["bob"] / 120 < 0.9
    pool.set_weight(bob.client, 1)
    assert alice.stats().clients["bob"].weight == 1


def test_the_priority_orders_the_tasks_of_one_client(pair, gate):
    alice, bob = pair
    futures = [alice.submit(run, f"alice {n}", priority=n) for n in range(4)]
    futures += by_submit(bob, "bob", 1)
    await_queued(alice, 5)
    gate.set()
    wait(futures, timeout=LONG_S)
    assert [name for name in ran if name != "bob"] == [f"alice {n}" for n in (3, 2, 1, 0)]


def test_slots_count(start):
    ran.clear()
    client = start({"w": {"resources": {"P": 2}, "nthreads": 2}})
    with (
        Client(client.cluster, name="alice") as first,
        Client(client.cluster, name="bob") as second,
    ):
        alice, bob = Partition("P", first), Partition("P", second)
        gate = Event("gate", first)
        blocker = alice.submit(wait_for, "gate", slots=2)
        futures = [alice.submit(run, "alice", slots=2) for _ in range(40)]
        futures += [bob.submit(run, "bob") for _ in range(80)]
        await_queued(alice, 120)
        gate.set()
        wait([blocker, *futures], timeout=LONG_S)
    assert Counter(ran[:60])["bob"] > 1.4 * Counter(ran[:60])["alice"]


def test_statistics_page_and_metrics_show_shares_and_waits(pair, gate):
    alice, bob = pair
    futures = [*by_submit(alice, "alice", 4), *by_submit(bob, "bob", 4)]
    await_queued(bob, 8)
    clients = alice.stats().clients
    assert clients["dora"].slots == 1
    assert (clients["alice"].waiting, clients["bob"].waiting) == (4, 4)
    assert "bob" in repr(alice.stats())
    started = time.monotonic()
    gate.set()
    wait(futures, timeout=LONG_S)
    elapsed_s = time.monotonic() - started
    clients = alice.stats().clients
    assert sum(client.share for client in clients.values()) == pytest.approx(1)
    assert 0.039 < clients["bob"].seconds < elapsed_s
    assert clients["bob"].wait_s > 0
    metrics = metrics_of(alice.client)
    assert metrics["client_waiting_tasks", "bob", "P"] == 0
    assert metrics["client_slot_seconds_total", "bob", "P"] == clients["bob"].seconds
    assert metrics["client_waiting_seconds_total", "bob", "P"] > 0


def test_a_task_that_two_clients_want_stays_when_the_first_leaves(pair, gate, wait_until):
    alice, bob = pair
    with Client(alice.client.cluster, name="carol") as client:
        shared = Partition("P", client).submit(run, "shared", key="shared")
        wait_until(lambda: "shared" in client.cluster.scheduler.tasks)
        again = bob.client.submit(run, "shared", key="shared", resources={"P": 1})
        wait_until(lambda: len(client.cluster.scheduler.tasks["shared"].who_wants) == 2)
        del shared
    gate.set()
    again.result(LONG_S)
    wait_until(lambda: "carol" not in bob.stats().clients)


def test_tasks_that_are_cancelled_while_they_wait_are_forgotten(pair, gate):
    alice, bob = pair
    futures = by_submit(alice, "alice", 30)
    await_queued(alice, 30)
    alice.client.cancel(futures)
    while alice.stats().clients["alice"].waiting:
        time.sleep(0.01)
    future = bob.submit(abs, -1)
    gate.set()
    assert future.result(LONG_S) == 1
    assert not ran


opened = threading.Event()


def wait_until_opened():
    """Wait without lending the slot, in contrast to tasks that wait for Dask's events."""
    return opened.wait(LONG_S)


def test_tasks_bound_to_a_worker_do_not_delay_others(start):
    client = start({name: {"resources": {"P": 1}} for name in "ab"})
    part = Partition("P", client)
    opened.clear()
    blocker = part.submit(wait_until_opened, workers="a")
    bound = [part.submit(abs, n, workers=addresses(client)["a"]) for n in range(9)]
    with Client(client.cluster) as other:
        others = [Partition("P", other).submit(abs, n) for n in range(9)]
        assert other.gather(others) == [*range(9)]
        assert not any(future.done() for future in bound)
        opened.set()
        assert client.gather([*bound, blocker]) == [*range(9), True]


def test_a_bound_task_waits_on_its_worker_and_leaves_room_for_others(pair, wait_until):
    alice, bob = pair
    scheduler = alice.client.cluster.scheduler
    [worker] = scheduler.workers.values()
    bound = [alice.submit(wait_for, f"gate {n}", workers="w") for n in range(4)]
    wait_until(lambda: len(worker.processing) == 2)  # the next one is there when a slot is free
    future = bob.submit(run, "bob")
    await_queued(alice, 4)  # all tasks but the first one
    for number in range(2):
        Event(f"gate {number}", alice.client).set()
    assert future.result(LONG_S) is None
    for number in range(2, 4):
        Event(f"gate {number}", alice.client).set()
    wait(bound, timeout=LONG_S)


def test_a_task_that_was_moved_counts_for_its_new_worker(start, wait_until):
    client = start({name: {"resources": {"P": 1}} for name in "xy"})
    scheduler = client.cluster.scheduler
    client.sync(scheduler.extensions["stealing"].stop)
    part = Partition("P", client)
    gate = Event("gate", client)
    gate.set()
    client.gather([part.submit(wait_for, gate.name) for _ in range(8)])
    gate.clear()  # further tasks are expected to be short, so they are assigned in advance
    futures = [part.submit(wait_for, gate.name) for _ in range(4)]
    loads = scheduler.plugins[NAME].queues["P"].loads
    wait_until(lambda: sum(load.used for load in loads.values()) == 4)
    x, y = (scheduler.workers[client.cluster.workers[name].address] for name in "xy")
    before = loads[x].used, loads[y].used
    task = max(x.processing, key=lambda task: task.priority)  # it has not started

    async def move():
        move_task(scheduler, task, y)

    client.sync(move)
    wait_until(lambda: (loads[x].used, loads[y].used) == (before[0] - 1, before[1] + 1))
    gate.set()
    assert all(client.gather(futures))


def wait_elsewhere(part, ready, gate):
    wait_for(ready)
    return part.submit(wait_for, gate).result()


def test_a_slot_is_used_as_soon_as_a_task_lends_it(start, monkeypatch):
    monkeypatch.setattr("poolpart.shares.CHECK_EVERY_S", 3600.0)
    client = start({name: {"resources": {name: 1}} for name in "PQ"})
    p, q = (Partition(name, client) for name in "PQ")
    parent = p.submit(wait_elsewhere, q, "ready", "gate")
    other = p.submit(abs, -1)
    await_queued(p, 1)
    Event("ready", client).set()
    assert other.result(LONG_S) == 1
    Event("gate", client).set()
    assert parent.result(LONG_S)


@pytest.fixture
def many(start, monkeypatch):
    """Partition of more workers than are compared for a task. Waiting tasks are not moved."""
    monkeypatch.setattr("poolpart.extras.watching.LATE_S", 3600.0)
    workers = {f"w{n}": {"resources": {"P": 1}} for n in range(MAX_COMPARED + 2)}
    return Partition("P", start(workers))


def with_room(part):
    """Return the addresses of the workers with room, in the order in which they are considered."""
    queue = part.client.cluster.scheduler.plugins[NAME].queues["P"]
    return [worker.address for worker in queue.with_room]


def test_a_task_runs_where_its_input_is(many):
    name = many.submit(worker_name)
    wait(name, timeout=LONG_S)
    address = addresses(many.client)[name.result()]
    assert with_room(many).index(address) >= MAX_COMPARED
    assert many.submit(worker_name, name).result(LONG_S) == name.result()


def test_a_free_slot_is_found_behind_many_workers_with_a_task(many, wait_until):
    scheduler = many.client.cluster.scheduler
    many.submit(abs, -1).result(LONG_S)
    *others, free = with_room(many)
    # A worker with a bound task has room for another task.
    bound = [many.submit(wait_for, "gate", workers=address) for address in others]
    wait_until(lambda: all(scheduler.workers[address].processing for address in others))
    assert with_room(many) == [*others, free]
    future = many.submit(wait_for, "gate", key="next")
    wait_until(lambda: "next" in scheduler.tasks and scheduler.tasks["next"].processing_on)
    assert scheduler.tasks["next"].processing_on.address == free
    Event("gate", many.client).set()
    assert all(many.client.gather([*bound, future]))


def test_tasks_that_run_before_the_partition_is_used_count(start, wait_until):
    client = start({"w": {"resources": {"P": 1, "Q": 1}, "nthreads": 2}})
    [worker] = client.cluster.scheduler.workers.values()
    options = {"resources": {"P": 1}}, {"resources": {"Q": 1}}
    futures = [client.submit(wait_for, "gate", pure=False, **option) for option in options]
    wait_until(lambda: len(worker.processing) == 2)
    part = Partition("P", client)
    last = part.submit(abs, -1)
    await_queued(part, 1)
    stats = part.stats().clients[client.id]
    assert (stats.slots, stats.waiting) == (1, 1)
    Event("gate", client).set()
    assert client.gather([*futures, last]) == [True, True, 1]


def most_executing(*_):
    """Return how many tasks this worker has run at the same time."""
    state = get_worker().state
    counts = []
    for _ in range(5):
        counts.append(len(state.executing))
        time.sleep(0.01)
    return max(counts)


def test_an_isolated_task_gets_a_worker_of_its_own_in_its_turn(start, wait_until):
    """Without a reserved worker, the slots of a worker would never be free at the same time."""
    client = start({name: {"resources": {"P": 2}, "nthreads": 2} for name in "xy"})
    alice = Partition("P", client)
    with Client(client.cluster, name="bob") as other:
        bob = Partition("P", other)
        blockers = [bob.submit(wait_for, "first gate", key=f"blocker-{n}") for n in range(4)]
        wait_until(lambda: bob.stats().running == 4)
        backlog = [bob.submit(run, "bob") for _ in range(150)]
        shares = client.cluster.scheduler.plugins[NAME]
        for number in range(3):
            shares.isolate(f"isolated-{number}")
        isolated = [alice.submit(most_executing, key=f"isolated-{n}") for n in range(3)]
        beside = alice.submit(run, "alice")
        await_queued(alice, 154)
        Event("first gate", client).set()
        assert client.gather(isolated) == [1, 1, 1]
        beside.result(LONG_S)
        assert not all(task.done() for task in backlog)
        wait([*blockers, *backlog], timeout=LONG_S)
        # A worker is kept free for a task, which is canceled.
        running = [bob.submit(wait_for, "gate", workers=name) for name in "xy"]
        wait_until(lambda: bob.stats().running == 2)
        shares.isolate("canceled")
        waiting = alice.submit(most_executing, key="canceled")
        await_queued(alice, 1)
        running += [bob.submit(wait_for, "gate", key="third")]
        wait_until(lambda: bob.stats().running == 3)
        alice.cancel(waiting)
        running += [bob.submit(wait_for, "gate", key="fourth")]
        wait_until(lambda: bob.stats().running == 4)
        Event("gate", client).set()
        assert all(other.gather(running))


@pytest.mark.extended
def test_workers_that_die_and_a_restart_change_no_shares(nannies):
    pool = Pool.from_client(nannies)
    part = pool.divide({"P": rest()})["P"]
    pool.set_weight(nannies, 2)
    futures = [part.submit(time.sleep, 0.1) for _ in range(20)]
    kill(nannies, "0")
    wait(futures, timeout=LONG_S)
    nannies.restart()
    assert part.submit(abs, -1).result(LONG_S) == 1
    [(name, client)] = part.stats().clients.items()
    assert name == nannies.id
    assert (client.weight, client.slots, client.waiting) == (2, 0, 0)
    pool.set_weight(nannies, 1)


@pytest.mark.parametrize("weight", [0, -1, True, "3", float("inf"), float("nan")])
def test_a_weight_is_a_positive_number(pair, weight):
    pool = Pool.from_client(pair[0].client)
    with pytest.raises(PoolError, match=r"Invalid weight .* Expected a positive number"):
        pool.set_weight("alice", weight)
    with pytest.raises(PoolError, match="Invalid client ''"):
        pool.set_weight("", 2)
